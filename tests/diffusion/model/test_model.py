from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from mv3d_cli.diffusion.autoencoder import Autoencoder, Folding, Projection
from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.model.checkpoint import empty_model, load_model, save_model
from mv3d_cli.diffusion.model.config import ModelConfig, config_from_text, small, text_from_config, tiny
from mv3d_cli.errors import BadWeights, MissingInput, OutOfSpace


@pytest.fixture
def config(unet_config: dict[str, Any]) -> ModelConfig:
    projection = {"patch": 4, "channels": 4}
    tokens = {"size": 32, "patch": 16, "width": 12, "layers": 1, "heads": 2}
    return ModelConfig(unet_config, projection=projection, patch_tokens=tokens, positions=True, picture_size=32)


@pytest.fixture
def model(config: ModelConfig) -> Model:
    """Its autoencoder is fitted."""
    torch.manual_seed(0)
    model = Model(config).eval()
    model.autoencoder.fit(torch.rand(4, 3, 32, 32) * 2 - 1)
    return model


@torch.no_grad()
def answer(model: Model) -> torch.Tensor:
    generator = torch.Generator().manual_seed(5)
    photo = torch.rand(1, 3, 32, 32, generator=generator) * 2 - 1
    poses = torch.eye(4).expand(1, 2, 4, 4)
    latents = torch.randn(1, 2, 2, 4, 8, 8, generator=generator)
    prediction = model.network(latents, torch.tensor([400]), model.condition(photo, poses, torch.tensor([[0, 1]])))
    return model.autoencoder.decode(prediction)


def test_small_is_small() -> None:
    model = empty_model(small())
    count = {name: sum(p.numel() for p in part.parameters()) for name, part in model.named_children()}
    assert count == {"network": 9_523_361, "autoencoder": 0, "encoder": 1_333_056}
    assert sum(count.values()) <= 30_000_000


@torch.no_grad()
@pytest.mark.parametrize(("preset", "shape"), [(small, (64, 16, 16)), (tiny, (48, 8, 8))])
def test_a_presets_pictures_make_the_latents_that_its_network_expects(preset, shape: tuple[int, ...]) -> None:
    config = preset()
    model = Model(config)
    picture = torch.randn(1, 3, config.picture_size, config.picture_size).clamp(-1, 1)
    latents = model.autoencoder.encode(picture)
    assert latents.shape == (1, *shape)
    assert shape[0] == config.network["out_channels"] == config.network["in_channels"] // 2
    assert shape[1] == config.network["sample_size"]
    drafts = picture.expand(2, 3, -1, -1)[None, :, None]
    condition = model.condition(picture, torch.eye(4).expand(1, 1, 4, 4), torch.tensor([[0, 1]]), drafts)
    assert condition.photo_latent.shape == latents.shape
    torch.nn.init.normal_(model.network.unet.conv_out.bias)
    answer = model.network(torch.zeros(1, 2, 1, *shape), torch.tensor([5]), condition)
    assert answer.shape == (1, 2, 1, *shape)
    assert answer.abs().max() > 0
    assert model.autoencoder.decode(answer).shape == (1, 2, 1, *picture.shape[1:])


def test_a_model_has_the_autoencoder_of_its_configuration(config: ModelConfig, smallest: ModelConfig) -> None:
    """Stable Diffusion's where there is one, else ours, else the squares themselves."""
    kl = {"block_out_channels": (32,), "latent_channels": 4}
    assert isinstance(Model(smallest).autoencoder, Folding)
    assert isinstance(Model(config).autoencoder, Projection)
    assert isinstance(Model(replace(config, autoencoder=kl, projection=None)).autoencoder, Autoencoder)


def test_a_saved_model_gives_the_same_answer(model: Model, tmp_path: Path) -> None:
    save_model(model, tmp_path / "model")
    again = load_model(tmp_path / "model")
    torch.testing.assert_close(answer(again), answer(model), atol=0, rtol=0)
    assert text_from_config(again.config) == text_from_config(model.config)
    assert all(parameter.requires_grad for parameter in again.parameters())
    assert sorted(path.name for path in (tmp_path / "model").iterdir()) == ["config.json", "model.safetensors"]


def test_the_weights_file_carries_its_own_configuration(model: Model, tmp_path: Path) -> None:
    save_model(model, tmp_path)
    alone = (tmp_path / "model.safetensors").rename(tmp_path / "alone.safetensors")
    torch.testing.assert_close(answer(load_model(alone)), answer(model), atol=0, rtol=0)


def test_half_precision_halves_the_file_and_hardly_moves_the_answer(model: Model, tmp_path: Path) -> None:
    for name, dtype in (("full", None), ("half", torch.bfloat16)):
        save_model(model, tmp_path / name, dtype)
    sizes = [(tmp_path / name / "model.safetensors").stat().st_size for name in ("full", "half")]
    assert sizes[1] < 0.65 * sizes[0]
    half, full = answer(load_model(tmp_path / "half")), answer(model)
    assert 0 < (half - full).abs().mean() < 0.05 * full.abs().mean()


@pytest.mark.parametrize("preset", [small, tiny])
def test_configurations_survive_json(preset) -> None:
    again = config_from_text(text_from_config(preset()), "here")
    assert text_from_config(again) == text_from_config(preset())
    assert again.noise == preset().noise


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"noise": {}, "network": 3, "wheels": 4}', '{"noise": 5}'])
def test_other_json_is_refused(text: str) -> None:
    with pytest.raises(BadWeights, match=r"here is not the configuration"):
        config_from_text(text, "here")


def test_a_configuration_that_describes_no_model_is_refused(config: ModelConfig) -> None:
    with pytest.raises(BadWeights, match="describes no model"):
        empty_model(replace(config, network=config.network | {"block_out_channels": (8,)}))


def test_a_folder_without_configuration_or_weights_is_refused(model: Model, tmp_path: Path) -> None:
    save_model(model, tmp_path / "model")
    (tmp_path / "model" / "config.json").unlink()
    with pytest.raises(MissingInput, match=r"has no config\.json"):
        load_model(tmp_path / "model")
    save_model(model, tmp_path / "model")
    (tmp_path / "model" / "model.safetensors").unlink()
    with pytest.raises(MissingInput, match="no weights"):
        load_model(tmp_path / "model")
    with pytest.raises(MissingInput, match="no weights"):
        load_model(tmp_path / "nowhere")


@pytest.mark.parametrize("keep", [0.0, 0.001, 0.5, 0.999])
def test_truncated_weights_are_refused(model: Model, tmp_path: Path, keep: float) -> None:
    save_model(model, tmp_path)
    whole = (tmp_path / "model.safetensors").read_bytes()
    (tmp_path / "model.safetensors").write_bytes(whole[: int(len(whole) * keep)])
    with pytest.raises(BadWeights, match="damaged"):
        load_model(tmp_path)


def test_weights_of_another_model_are_refused(model: Model, config: ModelConfig, tmp_path: Path) -> None:
    save_model(model, tmp_path)
    wider = replace(config, network=config.network | {"cross_attention_dim": 16})
    (tmp_path / "config.json").write_text(text_from_config(wider))
    with pytest.raises(BadWeights, match=r"attn2.* is \(8, 12\); the configuration says \(8, 16\)"):
        load_model(tmp_path)
    deeper = replace(config, network=config.network | {"layers_per_block": 2})
    (tmp_path / "config.json").write_text(text_from_config(deeper))
    with pytest.raises(BadWeights, match="lack"):
        load_model(tmp_path)
    save_model(model, tmp_path)
    with safe_open(tmp_path / "model.safetensors", "pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    save_file(tensors | {"extra": torch.zeros(1)}, tmp_path / "model.safetensors")
    with pytest.raises(BadWeights, match="unknown extra"):
        load_model(tmp_path)
    with pytest.raises(MissingInput, match="carries no configuration"):
        load_model(tmp_path / "model.safetensors")


def test_a_pickle_is_never_read(model: Model, tmp_path: Path) -> None:
    torch.save(model.state_dict(), tmp_path / "model.bin")
    with pytest.raises(BadWeights, match="pickled"):
        load_model(tmp_path / "model.bin")


def test_when_the_disk_is_full_the_previous_model_survives(
    model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_model(model, tmp_path)
    before = answer(model)

    def full(_weights: object, path: Path, **_: object) -> None:
        path.write_bytes(b"half of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("mv3d_cli.diffusion.model.checkpoint.save_file", full)
    with torch.no_grad():
        next(model.network.parameters()).add_(1)
    with pytest.raises(OutOfSpace):
        save_model(model, tmp_path)
    torch.testing.assert_close(answer(load_model(tmp_path)), before)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["config.json", "model.safetensors"]
    assert json.loads((tmp_path / "config.json").read_text())["picture_size"] == 32
