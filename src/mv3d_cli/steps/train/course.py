"""A training as an artifact: found in the cache, gone on with, paused, or finished; alone or as one of several."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from mv3d_cli.diffusion.devices import has_quick_bf16
from mv3d_cli.diffusion.model.checkpoint import AUTOENCODER
from mv3d_cli.errors import UsageError
from mv3d_cli.steps.settings import Tell, Warned, key_config, settings_of, silent
from mv3d_cli.steps.train import VERSION, Config
from mv3d_cli.steps.train.fitting import fit_autoencoder
from mv3d_cli.steps.train.learning import STATE, Learning, Paused, learn
from mv3d_cli.steps.train.sources import Source, digest_of_sources, sources_of, split
from mv3d_cli.steps.train.start import rate_of, start_of
from mv3d_cli.steps.train.team import Team
from mv3d_cli.store import Artifact, Recipe, canonical_json, find_artifact, produce

HELD_OUT = 4  # objects to validate on, where none are given


@dataclass(frozen=True)
class Plan:
    """What is learnt, from what, and the recipe that it makes."""

    learning: Learning
    recipe: Recipe

    def work(self, folder: Path) -> None:
        """Does it."""
        (fit_autoencoder if self.learning.config.stage == AUTOENCODER else learn)(self.learning, folder)


def run_in_team(config: Config, inputs: Sequence[Path], tell: Tell, beside: Path | None = None) -> Artifact | None:
    """The trained model; None in all processes but the first. See `run`."""
    team = Team(config.device)
    plan = _plan(config, inputs, team, tell if team.first else silent)
    if not team.first:
        folder = team.hear_folder()
        if folder is not None:
            _with_others(plan, folder)
        return None
    try:
        if beside is not None:
            check_same_settings(plan.recipe, beside)
        return _produced(plan, team, tell)
    finally:
        team.tell_folder(None)


def _produced(plan: Plan, team: Team, tell: Tell) -> Artifact:
    """The finished model, or, where the time is up, the model so far; its work goes on when it is asked for again."""

    def build(folder: Path) -> None:
        team.tell_folder(folder)
        plan.work(folder)

    def notice(text: str) -> None:
        tell(Warned(text))

    device = str(team.device)
    try:
        return produce(plan.recipe, build, resumable=True, device=device, on_notice=notice)
    except Paused as pause:
        made = plan.recipe
        so_far = Recipe(made.step, made.version, {**made.config, "paused": pause.step}, made.inputs, None, made.sources)
        tell(Warned(f"paused after {pause.step} of {plan.learning.config.steps} steps; the same command goes on"))
        return produce(so_far, lambda folder: _copied(pause.folder, folder), device=device, on_notice=notice)


def _with_others(plan: Plan, folder: Path) -> None:
    """One of several processes learns; only the first writes."""
    with suppress(Paused):
        plan.work(folder)


def _plan(config: Config, inputs: Sequence[Path], team: Team, tell: Tell) -> Plan:
    """Raises what `run` does, but for what shows only while learning."""
    sources = sources_of(config, inputs)
    start = start_of(config)
    held_out = _validation(config)
    training, spared = (sources, held_out) if held_out else split(sources, HELD_OUT)
    settings = key_config(config) | {"lr": rate_of(config, start.model), "precision": _precision(config, team)}
    digests = {"data": digest_of_sources(sources), "start": start.digest, "validation": digest_of_sources(spared)}
    places = {"start": start.place} if start.place else {}
    recipe = Recipe("train", VERSION, settings | {"processes": team.size}, digests, sources=places)
    learning = Learning(config, settings, training, spared, start, team, tell)
    return Plan(learning, recipe)


def _precision(config: Config, team: Team) -> str:
    """The products' precision: the one given, or the device's quicker one."""
    quicker = "bf16" if has_quick_bf16(team.device) else "fp32"
    return quicker if config.precision == "auto" else config.precision


def _validation(config: Config) -> list[Source]:
    """The objects given to validate on. Raises MissingInput."""
    return sources_of(replace(config, procedural=0), [config.validation]) if config.validation else []


def _copied(work: Path, folder: Path) -> None:
    """The model so far, without what only its continuation needs."""
    for path in sorted(work.iterdir()):
        if path.name == STATE or path.name.startswith("."):
            continue
        if path.is_dir():
            shutil.copytree(path, folder / path.name)
        else:
            shutil.copy2(path, folder / path.name)


def check_same_settings(recipe: Recipe, output: Path) -> None:
    """Raises UsageError where `output` holds a paused training of another recipe: it would not be gone on with."""
    artifact = find_artifact(output)
    if artifact is None or "paused" not in artifact.manifest["config"]:
        return
    before, now = artifact.manifest["config"], json.loads(canonical_json(recipe.config))
    names = {setting.name: setting.option for setting in settings_of(Config)}
    differs = [
        f"{names.get(name, name)} {now[name]} (was {before[name]})"
        for name in now
        if name in before and now[name] != before[name]
    ]
    inputs = {item["label"]: item["digest"] for item in artifact.manifest["inputs"]}
    differs += [f"the {name}" for name, digest in recipe.inputs.items() if inputs.get(name) != digest]
    if differs:
        raise UsageError(
            f"{output} holds a training that was paused, and this one differs in {', '.join(differs)}",
            "give the same settings to go on with it, another -o, or --from it",
        )
