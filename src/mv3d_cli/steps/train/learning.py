"""Learning itself: batches in, steps, validation, checkpoints; the model, its record and its curve in a folder."""

from __future__ import annotations

import csv
import json
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from mv3d_cli.capture.examples import Example
from mv3d_cli.diffusion.generation import Sampling
from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.model.checkpoint import save_model
from mv3d_cli.diffusion.training import Course, Done, State, train
from mv3d_cli.diffusion.training.distillation import DistillationObjective
from mv3d_cli.diffusion.training.objectives import DiffusionObjective, Teaching
from mv3d_cli.diffusion.training.state import load_state, save_state
from mv3d_cli.errors import WorkFailed
from mv3d_cli.formats.images import write_png
from mv3d_cli.kernels.runtime import cpu_count
from mv3d_cli.steps.settings import Progress, Tell
from mv3d_cli.steps.train import Config, seconds_of
from mv3d_cli.steps.train.order import Order
from mv3d_cli.steps.train.sources import Source
from mv3d_cli.steps.train.start import Start
from mv3d_cli.steps.train.supply import Examples, Supply, check_usable, drawing_of, evaluation_drawing, trust_drafts
from mv3d_cli.steps.train.team import Team
from mv3d_cli.steps.train.validation import Validation, examples_for, validated

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

STATE, RECORD, CURVE = "state.safetensors", "training.json", "curve.csv"
COLUMNS = ("step", "objects", "loss", "lr", "psnr", "depth_error")


class Paused(Exception):
    """The time is up: the model so far and the state lie in `folder`."""

    def __init__(self, folder: Path, step: int):
        super().__init__(step)
        self.folder, self.step = folder, step


@dataclass(frozen=True)
class Learning:
    """Everything that a training needs; `settings` are those of its key."""

    config: Config
    settings: dict[str, Any]
    sources: Sequence[Source]
    held_out: Sequence[Source]
    start: Start
    team: Team
    tell: Tell


@dataclass
class Progressed:
    """What a training has behind it, beside its state."""

    seconds: float = 0.0
    curve: list[list[Any]] = field(default_factory=list)


def learn(learning: Learning, folder: Path) -> None:
    """Learns, from the folder's checkpoint if it has one, to the end.

    Raises Paused when the time is up, MissingInput where no object can be used, WorkFailed when the loss is no number.
    """
    if is_finished(folder):
        return
    team = learning.team
    model = learning.start.model.to(team.device)
    model.config = replace(model.config, views=learning.config.views)
    supply = supply_of(learning, model)
    check_usable(supply.examples)
    course = course_of(learning)
    if not any(done["stage"] != "autoencoder" for done in learning.start.record):
        trust_drafts(model, supply.examples)
    state = State(objective_of(learning, model), course, team.accelerator)
    behind = Progressed()
    if (folder / STATE).is_file():
        behind = Progressed(**load_state(state, folder / STATE))
    recorder = Recorder(learning, model, folder, state, behind)
    for done in train(state, supply.batches(state.step), course, team.accelerator):
        recorder.note(done)
        if team.agreed(recorder.is_time_up()) and done.step < course.steps:
            recorder.save(paused=True)
            raise Paused(folder, done.step)
    recorder.finish()


def is_finished(folder: Path) -> bool:
    """Whether all is there: a process may be killed after its last step and before its artifact has its place."""
    with suppress(OSError, ValueError, KeyError):
        return not json.loads((folder / RECORD).read_text())["paused"] and not (folder / STATE).exists()
    return False


def held_out_examples(learning: Learning, model: Model) -> list[Example]:
    """What the model is validated on."""
    return examples_for(learning.held_out, learning.config, evaluation_drawing(model.config))


def write_record(learning: Learning, folder: Path, stages: Sequence[dict[str, Any]], paused: bool) -> None:
    """Writes what was done, and how."""
    told = {"settings": learning.settings, "paused": paused, "stages": stages}
    (folder / RECORD).write_text(json.dumps(told, indent=1) + "\n")


def supply_of(learning: Learning, model: Model) -> Supply:
    """The batches of this process."""
    config, team = learning.config, learning.team
    here = config.batch * config.accumulate
    lanes = range(team.rank * here, (team.rank + 1) * here)
    order = Order(len(learning.sources), lanes, team.size * here, config.reuse, config.seed)
    examples = Examples(learning.sources, config, drawing_of(config, model.config), order)
    jobs = config.jobs
    if jobs is None:
        jobs = max(cpu_count() - 1, 1) if team.device.type == "cuda" else 1
    return Supply(examples, model, team.device, dtype_of(learning), config.accumulate, jobs, learning.tell)


def course_of(learning: Learning) -> Course:
    """The pace that the settings ask for."""
    config = learning.config
    return Course(config.steps, learning.settings["lr"], config.warmup, config.decay, config.accumulate, ema=config.ema)


def objective_of(learning: Learning, model: Model) -> torch.nn.Module:
    """What the stage wants."""
    config, dtype = learning.config, dtype_of(learning)
    if config.stage == "distill":
        return DistillationObjective(model, config.guidance, dtype)
    joint = config.stage == "2"
    teaching = Teaching(joint, config.gamma, config.floor, config.noisiest, config.dropout, dtype)
    return DiffusionObjective(model, teaching)


def dtype_of(learning: Learning) -> torch.dtype:
    """The products' precision."""
    return torch.bfloat16 if learning.settings["precision"] == "bf16" else torch.float32


class Recorder:
    """What a training leaves behind: only the first of several processes writes."""

    def __init__(self, learning: Learning, model: Model, folder: Path, state: State, behind: Progressed):
        self.learning, self.model, self.folder, self.state, self.behind = learning, model, folder, state, behind
        self.writes = learning.team.first
        self.examples = held_out_examples(learning, model) if self.writes else []
        if self.writes:
            self._sweep()
        self.started = self.saved = time.monotonic()
        self.before = behind.seconds
        self.logs = self._logs() if self.writes else None

    def _logs(self) -> SummaryWriter:
        from torch.utils.tensorboard import SummaryWriter

        return SummaryWriter(str(self.folder / "logs"), purge_step=self.state.step + 1)

    def _sweep(self) -> None:
        """Removes what a process that was killed left half written."""
        for leftover in self.folder.glob(".*"):
            leftover.unlink()

    def note(self, done: Done) -> None:
        """A step is done: checked, told, and every now and then validated and saved. Raises WorkFailed."""
        if not (math.isfinite(done.loss) and math.isfinite(done.norm)):
            self._stop_at(done)
        config = self.learning.config
        objects = done.step * config.batch * config.accumulate * self.learning.team.size
        self.behind.curve.append([done.step, objects, done.loss, done.rate, None, None])
        if not self.writes:
            return
        assert self.logs is not None
        for name, value in (("loss", done.loss), ("lr", done.rate), ("gradient norm", done.norm), *_seconds(done)):
            self.logs.add_scalar(name, value, done.step)
        self.learning.tell(Progress(done.step, config.steps, "steps", f"loss {done.loss:.4f}"))
        if config.validate_every and done.step % config.validate_every == 0 and done.step < config.steps:
            with self.state.averaged():
                self._validate()
        if time.monotonic() - self.saved > config.save_every:
            self.save_state()

    def is_time_up(self) -> bool:
        """Whether this call has had its time."""
        allowed = seconds_of(self.learning.config.max_time)
        return allowed is not None and time.monotonic() - self.started > allowed

    def save_state(self) -> None:
        """A checkpoint."""
        self.saved = time.monotonic()
        self.behind.seconds = self.before + self.saved - self.started
        if self.logs is not None:
            self.logs.flush()
        save_state(self.state, self.folder / STATE, vars(self.behind))

    def save(self, paused: bool) -> None:
        """The model so far, its record and its curve, validated; when paused, also the state to go on from."""
        if not self.writes:
            return
        with self.state.averaged():
            score = self._validate()
            record = [*self.learning.start.record, self._record(score)]
            dtype = torch.float16 if self.learning.config.half else None
            save_model(self.model, self.folder, dtype, record)
        write_record(self.learning, self.folder, record, paused)
        with (self.folder / CURVE).open("w", newline="") as file:
            csv.writer(file).writerows([COLUMNS, *self.behind.curve])
        if paused:
            self.save_state()
        else:
            (self.folder / STATE).unlink(missing_ok=True)
        assert self.logs is not None
        self.logs.close()

    def finish(self) -> None:
        """The whole model."""
        self.save(paused=False)

    def _stop_at(self, done: Done) -> None:
        kept, what = self.folder / STATE, "gradient" if math.isfinite(done.loss) else "loss"
        last = "there is no checkpoint before it" if not kept.is_file() else f"the last good checkpoint is {kept}"
        raise WorkFailed(
            f"the {what} is no longer a number at step {done.step}; {last}",
            "the same command would come to the same: take a smaller --lr, more --warmup, or --precision fp32",
        )

    def _record(self, score: Validation) -> dict[str, Any]:
        config, spent = self.learning.config, self.before + time.monotonic() - self.started
        objects = self.state.step * config.batch * config.accumulate * self.learning.team.size
        return {
            "stage": config.stage,
            "steps": self.state.step,
            "objects": objects,
            "data": f"{len(self.learning.sources)} objects",
            "loss": sum(row[2] for row in self.behind.curve[-100:]) / len(self.behind.curve[-100:]),
            "psnr": round(score.psnr, 3),
            "depth_error": round(score.depth, 4),
            "minutes": round(spent / 60, 1),
            "device": str(self.learning.team.device),
        }

    def _validate(self) -> Validation:
        config, step = self.learning.config, self.state.step
        steps = 4 if config.stage == "distill" else 1
        sampling = Sampling(steps, "lcm" if config.stage == "distill" else "ddim")
        score = validated(self.model.eval(), self.examples, config.stage, sampling)
        self.model.train()
        (self.folder / "validation").mkdir(exist_ok=True)
        write_png(self.folder / "validation" / f"{step:07d}.png", score.sheet)
        assert self.logs is not None
        self.logs.add_scalar("validation/psnr", score.psnr, step)
        self.logs.add_scalar("validation/depth error", score.depth, step)
        self.logs.add_image("validation", score.sheet, step, dataformats="HWC")
        self.behind.curve[-1][4:] = [round(score.psnr, 4), round(score.depth, 5)]
        return score


def _seconds(done: Done) -> Iterator[tuple[str, float]]:
    for part in ("waiting", "learning", "stepping"):
        yield f"seconds/{part}", getattr(done, part)
