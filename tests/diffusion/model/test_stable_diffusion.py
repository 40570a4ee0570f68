from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch
from diffusers import AutoencoderKL, PNDMScheduler, UNet2DConditionModel
from safetensors.torch import load_file, save_file

from mv3d_cli.diffusion.model import Model
from mv3d_cli.diffusion.model.checkpoint import load_model, save_model
from mv3d_cli.diffusion.model.stable_diffusion import DEFAULT_ID, model_from_stable_diffusion
from mv3d_cli.errors import BadWeights, MissingInput

transformers = pytest.importorskip("transformers")


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Stable Diffusion Image Variations at tiny width, saved by the libraries."""
    folder = tmp_path_factory.mktemp("original")
    torch.manual_seed(0)
    UNet2DConditionModel(
        sample_size=8,
        block_out_channels=(8, 8, 16, 16),
        norm_num_groups=4,
        layers_per_block=1,
        attention_head_dim=2,
        cross_attention_dim=12,
    ).save_pretrained(folder / "unet")
    AutoencoderKL(
        block_out_channels=(8, 8),
        down_block_types=("DownEncoderBlock2D",) * 2,
        up_block_types=("UpDecoderBlock2D",) * 2,
        latent_channels=4,
        norm_num_groups=4,
    ).save_pretrained(folder / "vae")
    clip = transformers.CLIPVisionConfig(
        hidden_size=16,
        intermediate_size=32,
        num_hidden_layers=1,
        num_attention_heads=2,
        image_size=28,
        patch_size=14,
        projection_dim=12,
    )
    transformers.CLIPVisionModelWithProjection(clip).save_pretrained(folder / "image_encoder")
    PNDMScheduler(
        beta_schedule="scaled_linear", beta_start=0.00085, beta_end=0.012, skip_prk_steps=True
    ).save_pretrained(folder / "scheduler")
    return folder


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "copy"))


@torch.no_grad()
def test_at_the_start_it_is_stable_diffusion(original: Path) -> None:
    model = model_from_stable_diffusion(str(original))
    photo, poses = torch.rand(2, 3, 16, 16) * 2 - 1, torch.eye(4).expand(2, 3, 4, 4)
    condition = model.condition(photo, poses, torch.tensor([[0, 1]] * 2))
    latents, timestep = torch.randn(2, 2, 3, 4, 8, 8), torch.tensor([900, 30])
    heard = model.network(latents, timestep, condition, across_views=False)
    for parameter in model.network.unet.class_embedding.linear_2.parameters():
        parameter.zero_()
    ours = model.network(latents, timestep, condition, across_views=False)

    unet = UNet2DConditionModel.from_pretrained(original, subfolder="unet").eval()
    vision = transformers.CLIPVisionModelWithProjection.from_pretrained(original / "image_encoder").eval()
    assert model.encoder.clip.state_dict().keys() == vision.state_dict().keys()
    tokens = condition.tokens.repeat_interleave(6, dim=0)
    theirs = unet(latents.flatten(0, 2), timestep.repeat_interleave(6), tokens).sample
    torch.testing.assert_close(ours.flatten(0, 2), theirs, atol=1e-5, rtol=0)
    assert 1e-4 < (heard - ours).abs().max() < 1
    assert model.schedule.prediction == "epsilon"
    vae = AutoencoderKL.from_pretrained(original, subfolder="vae").eval()
    expected = vae.encode(photo).latent_dist.mode() * vae.config.scaling_factor
    torch.testing.assert_close(condition.photo_latent, expected, atol=1e-5, rtol=1e-5)


def test_it_saves_and_loads_as_any_model(original: Path, tmp_path: Path) -> None:
    model = model_from_stable_diffusion(str(original))
    save_model(model, tmp_path / "ours")
    again: Model = load_model(tmp_path / "ours")
    assert again.config.noise.curve == "scaled_linear"
    ours, theirs = model.state_dict(), again.state_dict()
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


def test_half_precision_files_and_old_names_are_understood(folder: Path) -> None:
    unet = folder / "unet" / "diffusion_pytorch_model.safetensors"
    save_file({name: value.half() for name, value in load_file(unet).items()}, unet.with_suffix(".fp16.safetensors"))
    unet.unlink()
    vae = folder / "vae" / "diffusion_pytorch_model.safetensors"
    renamed = {}
    for name, value in load_file(vae).items():
        for new, old in (("to_q", "query"), ("to_k", "key"), ("to_v", "value"), ("to_out.0", "proj_attn")):
            name = name.replace(f"attentions.0.{new}.", f"attentions.0.{old}.")
        renamed[name] = value
    assert any(".query." in name for name in renamed)
    save_file(renamed, vae)
    clip = folder / "image_encoder" / "model.safetensors"
    position = {"vision_model.embeddings.position_ids": torch.arange(5)[None]}
    save_file(load_file(clip) | position, clip)
    model = model_from_stable_diffusion(str(folder), torch.bfloat16)
    assert {value.dtype for value in model.state_dict().values()} == {torch.bfloat16}


@pytest.mark.parametrize("missing", ["unet/config.json", "scheduler/scheduler_config.json", "image_encoder"])
def test_a_missing_part_is_named(folder: Path, missing: str) -> None:
    path = folder / missing
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    with pytest.raises(MissingInput, match=missing) as caught:
        model_from_stable_diffusion(str(folder))
    assert DEFAULT_ID in caught.value.hint


def test_pickled_weights_are_refused_with_the_way_to_convert_them(folder: Path) -> None:
    weights = folder / "unet" / "diffusion_pytorch_model.safetensors"
    torch.save(load_file(weights), weights.with_suffix(".bin"))
    weights.unlink()
    with pytest.raises(BadWeights, match=r"diffusion_pytorch_model\.bin") as caught:
        model_from_stable_diffusion(str(folder))
    assert "save_pretrained" in caught.value.hint


@pytest.mark.parametrize("part", ["unet", "vae", "image_encoder"])
def test_damaged_or_foreign_weights_are_refused(folder: Path, part: str) -> None:
    (weights,) = (folder / part).glob("*.safetensors")
    tensors = load_file(weights)
    name, value = next((n, v) for n, v in tensors.items() if v.ndim == 2)
    save_file(tensors | {name: value[:, :-1].contiguous()}, weights)
    with pytest.raises(BadWeights, match=name):
        model_from_stable_diffusion(str(folder))
    save_file({n: v for n, v in tensors.items() if n != name}, weights)
    with pytest.raises(BadWeights, match="lack"):
        model_from_stable_diffusion(str(folder))
    weights.write_bytes(weights.read_bytes()[:-10])
    with pytest.raises(BadWeights, match="damaged"):
        model_from_stable_diffusion(str(folder))


def test_another_noise_schedule_is_refused(folder: Path) -> None:
    path = folder / "scheduler" / "scheduler_config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"beta_schedule": "linear"}))
    with pytest.raises(BadWeights, match="noise schedule linear"):
        model_from_stable_diffusion(str(folder))


def test_a_hub_id_is_found_in_the_cache_without_a_network(
    original: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(MissingInput, match=DEFAULT_ID) as caught:
        model_from_stable_diffusion()
    assert f"hf download {DEFAULT_ID}" in caught.value.hint
    repository = tmp_path / f"models--{DEFAULT_ID.replace('/', '--')}"
    shutil.copytree(original, repository / "snapshots" / "0123456789012345678901234567890123456789")
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text("0123456789012345678901234567890123456789")
    assert model_from_stable_diffusion().config.clip is not None


def test_what_is_neither_folder_nor_id_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingInput, match="is no folder"):
        model_from_stable_diffusion(str(tmp_path / "nowhere"))
