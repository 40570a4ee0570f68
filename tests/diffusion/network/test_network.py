from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from diffusers import UNet2DConditionModel
from torch import Tensor, nn

from mv3d_cli.diffusion.network import MultiViewUNet, colour_depth_parameters, guided, reset_additions
from mv3d_cli.diffusion.network.blocks import MultiViewBlock
from mv3d_cli.diffusion.network.conditioning import FEATURES, Condition, view_features, without_photo
from mv3d_cli.formats.cameras import load_cameras


class RepeatedViews:
    """The naive formulation: every view's queries attend to their own copy of all views' keys and values."""

    def __init__(self, views: int):
        self.views = views

    def __call__(self, attn: Any, hidden_states: Tensor, **_: Any) -> Tensor:
        rows, tokens, channels = hidden_states.shape

        def copies(values: Tensor) -> Tensor:
            everyone = values.reshape(rows // self.views, self.views * tokens, channels)
            return everyone.repeat_interleave(self.views, dim=0)

        def heads(values: Tensor) -> Tensor:
            return values.unflatten(-1, (attn.heads, -1)).transpose(1, 2)

        query = heads(attn.to_q(hidden_states))
        key, value = heads(copies(attn.to_k(hidden_states))), heads(copies(attn.to_v(hidden_states)))
        weights = (query @ key.transpose(-1, -2) * attn.scale).softmax(-1)
        return attn.to_out[0]((weights @ value).transpose(1, 2).flatten(2))


def plain_unet(network: MultiViewUNet, unet_config: dict[str, Any], embedded: bool) -> UNet2DConditionModel:
    """diffusers' own model with the network's weights, with or without the class embedding."""
    extra = {"class_embed_type": "projection", "projection_class_embeddings_input_dim": FEATURES} if embedded else {}
    plain = UNet2DConditionModel.from_config(unet_config | extra).eval()
    weights = network.unet.state_dict()
    plain.load_state_dict({name: weights[name] for name in plain.state_dict()})
    return plain


def plain_answer(plain: UNet2DConditionModel, latents: Tensor, timestep: Tensor, condition: Condition) -> Tensor:
    """The plain model on each view of each domain, one batch row each."""
    rows = latents.shape[1] * latents.shape[2]
    photo = condition.photo_latent[:, None, None].expand_as(latents)
    answer = plain(
        torch.cat([latents, photo], dim=3).flatten(0, 2),
        timestep.repeat_interleave(rows),
        condition.tokens.repeat_interleave(rows, dim=0),
        class_labels=view_features(condition).flatten(0, 2),
    ).sample
    return answer.view_as(latents)


def wake_colour_depth(network: MultiViewUNet) -> None:
    for parameter in colour_depth_parameters(network):
        nn.init.normal_(parameter, std=0.5)


def changed(before: Tensor, after: Tensor) -> Tensor:
    """Which (object, domain, view) differ."""
    return (before - after).abs().amax(dim=(3, 4, 5)) > 1e-5


@pytest.fixture(autouse=True)
def no_gradients() -> Any:
    with torch.no_grad():
        yield


def test_one_at_a_time_it_is_the_plain_unet(network, unet_config, latents, timestep, condition) -> None:
    ours = network(latents, timestep, condition, across_views=False)
    theirs = plain_answer(plain_unet(network, unet_config, True), latents, timestep, condition)
    torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=0)


def test_with_one_view_and_silent_colour_depth_it_is_the_plain_unet(network, unet_config, timestep, condition) -> None:
    latents = torch.randn(2, 2, 1, 4, 8, 8)
    condition = replace(condition, world_from_camera=condition.world_from_camera[:, :1])
    ours = network(latents, timestep, condition)
    theirs = plain_answer(plain_unet(network, unet_config, True), latents, timestep, condition)
    torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=0)


def test_with_a_mute_embedding_it_is_the_unet_without_one(network, unet_config, latents, timestep, condition) -> None:
    for parameter in network.unet.class_embedding.linear_2.parameters():
        parameter.zero_()
    ours = network(latents, timestep, condition, across_views=False)
    theirs = plain_answer(plain_unet(network, unet_config, False), latents, timestep, condition)
    torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=0)


def test_joint_attention_equals_keys_and_values_repeated_for_each_view(network, latents, timestep, condition) -> None:
    joint = network(latents, timestep, condition)
    alone = network(latents, timestep, condition, across_views=False)
    for block in network.modules():
        if isinstance(block, MultiViewBlock):
            block.attn1.set_processor(RepeatedViews(latents.shape[2]))
    torch.testing.assert_close(network(latents, timestep, condition, across_views=False), joint, atol=1e-5, rtol=0)
    assert changed(joint, alone).all()


def test_colour_and_depth_meet_in_the_middle_and_the_last_up_block_only(network) -> None:
    meeting = {
        name for name, b in network.unet.named_modules() if isinstance(b, MultiViewBlock) and b.attn_domains is not None
    }
    assert {name.split(".attentions")[0] for name in meeting} == {"mid_block", "up_blocks.2"}
    assert len(meeting) == 3  # one in the middle, two in the up block


def test_colour_depth_attention_equals_full_attention_over_the_pair(network, latents, timestep, condition) -> None:
    """Against a plain softmax in which each domain's queries see its own and the other's tokens."""
    block = next(b for b in network.modules() if isinstance(b, MultiViewBlock) and b.attn_domains is not None)
    wake_colour_depth(network)
    seen: dict[str, Tensor] = {}
    block.norm_domains.register_forward_hook(lambda _, __, out: seen.update(normed=out))
    block.attn_domains.register_forward_hook(lambda _, __, out: seen.update(out=out))
    network(latents, timestep, condition)
    normed, attn = seen["normed"].unflatten(0, latents.shape[:3]), block.attn_domains
    tokens = normed.shape[3]
    for domain, own in enumerate(normed.unbind(1)):
        both = torch.cat([normed[:, 0], normed[:, 1]], dim=2)
        query, key, value = attn.to_q(own), attn.to_k(both), attn.to_v(both)
        query, key, value = (x.unflatten(-1, (attn.heads, -1)).transpose(2, 3) for x in (query, key, value))
        weights = (query @ key.transpose(-1, -2) * attn.scale).softmax(-1)
        expected = attn.to_out[0]((weights @ value).transpose(2, 3).flatten(3)).flatten(0, 1)
        actual = seen["out"][:, domain * tokens : (domain + 1) * tokens]
        torch.testing.assert_close(actual, expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("views", range(1, 13))
def test_any_number_of_views(network, timestep, views: int) -> None:
    poses = torch.stack([torch.tensor(c.world_from_camera, dtype=torch.float32) for c in load_cameras(None)])[:views]
    condition = Condition(torch.randn(1, 4, 8, 8), torch.randn(1, 5, 12), poses[None], torch.tensor([[0, 1]]))
    latents = torch.randn(1, 2, views, 4, 8, 8)
    answer = network(latents, timestep[:1], condition)
    assert answer.shape == latents.shape
    last = latents.clone()
    last[:, 0, -1] += 1
    touched = changed(network(last, timestep[:1], condition), answer)
    assert touched[0, 0].all()
    assert not touched[0, 1].any()


def test_the_order_of_views_does_not_matter(network, latents, timestep, condition) -> None:
    wake_colour_depth(network)
    order = torch.tensor([2, 0, 1])
    turned = replace(condition, world_from_camera=condition.world_from_camera[:, order])
    torch.testing.assert_close(
        network(latents[:, :, order], timestep, turned),
        network(latents, timestep, condition)[:, :, order],
        atol=1e-5,
        rtol=0,
    )


def test_a_camera_changes_its_view_and_through_joint_attention_the_others(
    network, latents, timestep, condition
) -> None:
    poses = condition.world_from_camera.clone()
    poses[0, 1] = torch.tensor(load_cameras(None)[8].world_from_camera)
    moved = replace(condition, world_from_camera=poses)
    alone = [network(latents, timestep, c, across_views=False) for c in (condition, moved)]
    assert changed(*alone).tolist() == [[[False, True, False]] * 2, [[False] * 3] * 2]
    joint = [network(latents, timestep, c) for c in (condition, moved)]
    assert changed(*joint).tolist() == [[[True] * 3] * 2, [[False] * 3] * 2]


@pytest.mark.parametrize("awake", [False, True])
def test_a_task_changes_its_domain_and_once_awake_the_other(network, latents, timestep, condition, awake) -> None:
    if awake:
        wake_colour_depth(network)
    asked = replace(condition, tasks=torch.tensor([[0, 0], [0, 1]]))
    touched = changed(network(latents, timestep, condition), network(latents, timestep, asked))
    assert touched.tolist() == [[[awake] * 3, [True] * 3], [[False] * 3] * 2]
    unheard = [network(latents, timestep, c, across_domains=False) for c in (condition, asked)]
    assert not changed(*unheard)[0, 0].any()


def test_the_other_domain_is_heard_in_the_same_view(network, latents, timestep, condition) -> None:
    wake_colour_depth(network)
    other = latents.clone()
    other[0, 1, 2] += 1  # depth of the last view
    before, after = (network(x, timestep, condition, across_views=False) for x in (latents, other))
    assert changed(before, after).tolist() == [[[False, False, True]] * 2, [[False] * 3] * 2]


def test_swapping_the_domains_with_their_tasks_swaps_the_answers(network, latents, timestep, condition) -> None:
    wake_colour_depth(network)
    swapped = replace(condition, tasks=condition.tasks.flip(1))
    torch.testing.assert_close(
        network(latents.flip(1), timestep, swapped), network(latents, timestep, condition).flip(1), atol=1e-5, rtol=0
    )


def test_one_domain_alone_is_what_it_is_beside_another_that_is_not_heard(network, latents, timestep, condition) -> None:
    depth = replace(condition, tasks=condition.tasks[:, 1:])
    torch.testing.assert_close(
        network(latents[:, 1:], timestep, depth, across_domains=False),
        network(latents, timestep, condition, across_domains=False)[:, 1:],
        atol=1e-5,
        rtol=0,
    )


def test_photo_and_timestep_belong_to_their_object(network, latents, timestep, condition) -> None:
    answer = network(latents, timestep, condition)
    for other in (
        replace(condition, tokens=condition.tokens * torch.tensor([1.0, 2.0])[:, None, None]),
        replace(condition, photo_latent=condition.photo_latent * torch.tensor([1.0, 2.0])[:, None, None, None]),
    ):
        touched = changed(answer, network(latents, timestep, other))
        assert not touched[0].any()
        assert touched[1].all()
    touched = changed(answer, network(latents, torch.tensor([700, 30]), condition))
    assert not touched[0].any()
    assert touched[1].all()


def test_positions_tell_where_a_token_is(unet_config, latents, timestep, condition) -> None:
    """Attention alone cannot tell a picture from its tokens in another order; with positions it can."""
    for positions in (False, True):
        torch.manual_seed(0)
        network = MultiViewUNet(unet_config, positions).eval()
        block = next(b for b in network.modules() if isinstance(b, MultiViewBlock))
        seen: list[Tensor] = []
        block.attn1.register_forward_pre_hook(lambda _, args, seen=seen: seen.append(args[0]))
        network(torch.zeros_like(latents), timestep, replace(condition, photo_latent=condition.photo_latent * 0))
        first_view = seen[0][0, :64]
        spread = torch.cdist(first_view, first_view) + torch.eye(64)
        assert (spread.min() > 0.05) == positions


def test_bf16_agrees_with_float32(network, latents, timestep, condition) -> None:
    wake_colour_depth(network)
    expected = network(latents, timestep, condition)
    rough = network.to(torch.bfloat16)(latents.bfloat16(), timestep, condition).float()
    assert (rough - expected).abs().mean() < 0.05 * expected.abs().mean()


def test_checkpointing_gives_the_same_gradients(network, latents, timestep, condition) -> None:
    wake_colour_depth(network)
    network.train()
    gradients = []
    for _ in range(2):
        network.zero_grad()
        with torch.enable_grad():
            network(latents, timestep, condition).square().mean().backward()
        gradients.append([p.grad.clone() for p in network.parameters()])
        network.unet.enable_gradient_checkpointing()
    torch.testing.assert_close(gradients[0], gradients[1])
    assert all(gradient.abs().max() > 0 for gradient in gradients[0])


def test_fresh_additions_hear_cameras_and_keep_colour_and_depth_apart(network) -> None:
    wake_colour_depth(network)
    embedding = network.unet.class_embedding
    for parameter in embedding.parameters():
        parameter.fill_(torch.nan)
    reset_additions(network)
    one, other = embedding(torch.eye(FEATURES)[:2])
    assert (one - other).abs().max() > 1e-3
    blocks = [b for b in network.modules() if isinstance(b, MultiViewBlock) and b.attn_domains is not None]
    for block in blocks:
        assert block.attn_domains(torch.randn(1, 4, *block.norm_domains.normalized_shape)).abs().max() == 0


def test_guidance_extrapolates_from_the_answer_without_the_photo(network, latents, condition) -> None:
    timestep = torch.tensor([500, 500])
    with_photo, without = network(latents, timestep, condition), network(latents, timestep, without_photo(condition))
    torch.testing.assert_close(guided(network, condition)(latents, 500), with_photo)
    torch.testing.assert_close(
        guided(network, condition, 3.0)(latents, 500), without + 3 * (with_photo - without), atol=1e-4, rtol=1e-4
    )
