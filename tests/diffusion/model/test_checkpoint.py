"""What a weights file tells of its training, and files that are written whole or not at all."""

from __future__ import annotations

import errno
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import SafetensorError
from safetensors.torch import save_file

from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.model.checkpoint import (
    AUTOENCODER,
    load_model,
    record_of_weights,
    save_model,
    weights_of,
    written_whole,
)
from mv3d_cli.diffusion.model.config import ModelConfig, text_from_config
from mv3d_cli.errors import BadWeights, OutOfSpace

RECORD = [{"stage": "1", "steps": 30, "loss": 0.125}, {"stage": "2", "steps": 5, "psnr": 21.5, "device": "cpu"}]


def test_the_record_travels_inside_the_weights(model: Model, tmp_path: Path) -> None:
    save_model(model, tmp_path / "model", record=RECORD)
    weights = weights_of(tmp_path / "model")
    assert weights == tmp_path / "model" / "model.safetensors"
    assert record_of_weights(weights) == RECORD
    alone = weights.rename(tmp_path / "alone.safetensors")
    assert weights_of(alone) == alone
    assert record_of_weights(weights_of(alone)) == RECORD


def test_the_same_model_and_record_are_the_same_bytes(model: Model, tmp_path: Path) -> None:
    """Several times: safetensors writes metadata in an order of chance."""
    shuffled = [dict(reversed(stage.items())) for stage in RECORD]
    for name in "abcdef":
        save_model(model, tmp_path / name, record=RECORD if name in "abc" else shuffled)
    assert len({weights_of(tmp_path / name).read_bytes() for name in "abcdef"}) == 1
    save_model(model, tmp_path / "other", record=RECORD[:1])
    assert weights_of(tmp_path / "other").read_bytes() != weights_of(tmp_path / "a").read_bytes()


def test_names_from_anywhere_survive_in_the_record(model: Model, tmp_path: Path) -> None:
    record = [{"data": 'Стул 椅子 "chaise" \\ \n \x7f'}]
    save_model(model, tmp_path, record=record)
    assert record_of_weights(weights_of(tmp_path)) == record
    load_model(tmp_path)
    load_model(weights_of(tmp_path))


def test_weights_that_tell_nothing_have_an_empty_record(model: Model, tmp_path: Path) -> None:
    save_model(model, tmp_path)
    assert record_of_weights(weights_of(tmp_path)) == []
    foreign = tmp_path / "foreign.safetensors"
    save_file({"x": torch.zeros(2)}, foreign)
    assert record_of_weights(foreign) == []


def test_a_model_of_folded_pictures_comes_back(model: Model, tmp_path: Path) -> None:
    save_model(model, tmp_path)
    again = load_model(tmp_path)
    assert text_from_config(again.config) == text_from_config(model.config)
    for name, value in model.state_dict().items():
        assert torch.equal(again.state_dict()[name], value), name


@pytest.fixture
def with_projection(smallest: ModelConfig) -> ModelConfig:
    return replace(smallest, projection={"patch": 4, "channels": 12})


def test_a_part_is_kept_alone_and_the_rest_is_drawn_anew(with_projection: ModelConfig, tmp_path: Path) -> None:
    """What is drawn comes from torch's global generator."""
    torch.manual_seed(0)
    model = Model(with_projection)
    model.autoencoder.fit(torch.rand(4, 3, 16, 16))
    save_model(model, tmp_path / "whole")
    save_model(model, tmp_path / "part", record=RECORD, part=AUTOENCODER)
    sizes = [weights_of(tmp_path / name).stat().st_size for name in ("whole", "part")]
    assert sizes[1] < 0.8 * sizes[0]
    torch.manual_seed(1)
    again = load_model(tmp_path / "part").state_dict()
    torch.manual_seed(1)
    fresh = Model(with_projection).state_dict()
    for name, value in model.state_dict().items():
        assert torch.equal(again[name], value if name.startswith(AUTOENCODER) else fresh[name]), name
    assert record_of_weights(weights_of(tmp_path / "part")) == RECORD


def test_a_part_of_another_model_is_refused(with_projection: ModelConfig, tmp_path: Path) -> None:
    save_model(Model(with_projection), tmp_path, part=AUTOENCODER)
    wider = replace(with_projection, projection=with_projection.projection | {"channels": 8})
    (tmp_path / "config.json").write_text(text_from_config(wider))
    with pytest.raises(BadWeights, match="conv_in takes 24 channels, and two latents have 16"):
        load_model(tmp_path)


def test_what_is_written_replaces_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("older")
    seen: list[str] = []

    def write(place: Path) -> None:
        place.write_text("newer")
        seen.append(path.read_text())

    written_whole(path, write)
    assert (seen, path.read_text()) == (["older"], "newer")
    assert [*tmp_path.iterdir()] == [path]


@pytest.mark.parametrize(
    ("error", "raised"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), OutOfSpace),
        (SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)"), OutOfSpace),
        (PermissionError(errno.EACCES, "Permission denied"), PermissionError),
        (SafetensorError("Error while serializing: something else"), SafetensorError),
        (KeyboardInterrupt(), KeyboardInterrupt),
    ],
    ids=["full", "full, says safetensors", "forbidden", "other", "interrupted"],
)
def test_a_write_that_fails_half_way_leaves_the_older_file(
    tmp_path: Path, error: BaseException, raised: type[BaseException]
) -> None:
    path = tmp_path / "file"
    path.write_text("older")

    def write(place: Path) -> None:
        place.write_text("half of the new")
        raise error

    with pytest.raises(raised):
        written_whole(path, write)
    assert path.read_text() == "older"
    assert [*tmp_path.iterdir()] == [path]


def test_a_write_that_fails_before_it_began_leaves_nothing(tmp_path: Path) -> None:
    def write(place: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutOfSpace, match="no space left for") as full:
        written_whole(tmp_path / "file", write)
    assert "free some space" in full.value.hint
    assert not [*tmp_path.iterdir()]


def test_when_the_disk_is_full_the_record_and_the_weights_stay_together(
    model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_model(model, tmp_path, record=RECORD)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(weights: object, path: Path, metadata: dict[str, str]) -> None:
        save_file(weights, path, metadata)
        path.write_bytes(path.read_bytes()[:1000])
        raise SafetensorError("I/O error: No space left on device (os error 28)")

    monkeypatch.setattr("mv3d_cli.diffusion.model.checkpoint.save_file", full)
    with torch.no_grad():
        next(model.network.parameters()).add_(1)
    with pytest.raises(OutOfSpace):
        save_model(model, tmp_path, record=RECORD[:1])
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
