"""Each kind of damage does what it says and no more: its strength, the mask, and what is left alone."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt, gaussian_filter
from skimage.data import astronaut

from mv3d_cli.capture.examples.augmentation import augmented, blurred, compressed, exposed, masked_badly

SIZE = 200
DAMAGES = [exposed, blurred, masked_badly, compressed]
SEEDS = st.integers(0, 2**32 - 1)


def rng_of(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def disc(radius: float, size: int = SIZE) -> np.ndarray:
    y, x = np.indices((size, size)) + 0.5 - size / 2
    return np.hypot(x, y) < radius


@pytest.fixture(scope="module")
def cutout() -> np.ndarray:
    """A photo cut out with a soft edge; beyond it the colours are whatever they were."""
    color = cv2.resize(astronaut(), (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    alpha = gaussian_filter(disc(60) * 255.0, 1.0).round()
    alpha[alpha < 5] = 0
    return np.dstack([color, alpha]).astype(np.uint8)


def flat(color: tuple[int, int, int], mask: np.ndarray) -> np.ndarray:
    """One colour where the mask is, transparent black elsewhere."""
    return (np.array([*color, 255]) * mask[..., None]).astype(np.uint8)


@pytest.mark.parametrize("damage", [*DAMAGES, augmented])
def test_a_damage_is_told_by_its_numbers(cutout: np.ndarray, damage) -> None:
    before = cutout.copy()
    results = [damage(cutout, rng_of(seed)) for seed in (0, *range(10))]
    assert np.array_equal(cutout, before)
    assert np.array_equal(results[0], results[1])
    assert len({result.tobytes() for result in results[1:]}) >= 3
    assert all(result.shape == cutout.shape and result.dtype == np.uint8 for result in results)


@pytest.mark.parametrize("damage", DAMAGES)
def test_what_is_shown_stays_like_the_photo(cutout: np.ndarray, damage) -> None:
    """Within the object: a little off on any draw, and seldom not at all; a mask's error does not reach that far."""
    inside = disc(50)
    before = cutout[inside][:, :3].astype(int)
    off = [np.abs(damage(cutout, rng_of(seed))[inside][:, :3] - before).mean() for seed in range(20)]
    assert max(off) < 45
    assert (np.median(off) > 0.5) == (damage is not masked_badly)


@pytest.mark.parametrize("damage", [exposed, compressed])
def test_exposure_and_compression_leave_alpha_alone(cutout: np.ndarray, damage) -> None:
    for seed in range(5):
        assert np.array_equal(damage(cutout, rng_of(seed))[..., 3], cutout[..., 3])


@settings(deadline=None, max_examples=60)
@given(SEEDS)
def test_exposure_is_a_rising_curve_within_half_a_stop(seed: int) -> None:
    """All greys at once; half a stop, contrast and (three deviations of) white balance bound what becomes of them."""
    grey = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 4, axis=2)
    after = exposed(grey, rng_of(seed))[0, :, :3].astype(float)
    assert (np.diff(after, axis=0) >= 0).all()
    assert not after[0].any()
    unit = np.arange(256)[:, None] / 255
    slack = 1.15 ** (1 / 2.2)
    assert (after <= 255 * unit**0.85 * 2 ** (0.5 / 2.2) * slack + 0.5).all()
    assert (after >= np.minimum(255 * unit**1.18 * 2 ** (-0.5 / 2.2) / slack, 255) - 0.5).all()


def test_exposure_brightens_as_often_as_it_darkens_and_tints() -> None:
    grey = np.full((1, 1, 4), 128, np.uint8)
    after = np.stack([exposed(grey, rng_of(seed))[0, 0, :3].astype(int) for seed in range(300)])
    means = after.mean(axis=1)
    assert 0.4 < (means > 128).mean() < 0.6
    assert means.min() < 108
    assert means.max() > 148
    assert 0.5 < np.ptp(after, axis=1).mean() < 10


@pytest.mark.parametrize("seed", range(6))
def test_blur_conserves_alpha_and_light(cutout: np.ndarray, seed: int) -> None:
    after = blurred(cutout, rng_of(seed)).astype(float)
    before = cutout.astype(float)
    assert after[..., 3].sum() == pytest.approx(before[..., 3].sum(), rel=1e-3)
    for channel in range(3):
        light = (after[..., channel] * after[..., 3]).sum()
        assert light == pytest.approx((before[..., channel] * before[..., 3]).sum(), rel=3e-3)


@pytest.mark.parametrize("size", [100, 400])
def test_blur_reaches_no_further_than_a_two_hundredth(size: int) -> None:
    """The edge of a half plane becomes the Gaussian's integral: its slope's variance is the deviation's square."""
    half = flat((200, 100, 50), np.indices((size, size))[1] >= size // 2)
    deviations = []
    for seed in range(30):
        slope = np.diff(blurred(half, rng_of(seed))[0, :, 3].astype(float)) / 255
        place = np.arange(size - 1) - (size / 2 - 1)
        assert slope.sum() == pytest.approx(1)
        deviations.append(np.sqrt((slope * place**2).sum()))
    assert max(deviations) <= size / 200 + 0.02
    assert max(deviations) > 0.75 * size / 200
    assert min(deviations) < 0.4 * size / 200


def test_blur_takes_no_colour_from_what_is_transparent() -> None:
    red = flat((200, 10, 30), disc(50))
    red[~disc(50)] = (0, 255, 0, 0)  # green that is not shown
    spread = [blurred(red, rng_of(seed)) for seed in range(8)]
    shown = [after[..., 3] > 2 for after in spread]
    assert max(mask.sum() for mask in shown) > 1.04 * disc(50).sum()
    for after, mask in zip(spread, shown, strict=True):
        assert np.abs(after[mask][:, :3].astype(int) - (200, 10, 30)).max() <= 1


@settings(deadline=None, max_examples=60)
@given(SEEDS, st.sampled_from([100, 256, 400]))
def test_a_mask_errs_by_no_more_than_a_hundredth(seed: int, size: int) -> None:
    mask = disc(0.3 * size, size)
    after = masked_badly(flat((90, 160, 230), mask), rng_of(seed))
    now, reach = after[..., 3] > 0, size / 100 + 0.5  # a disc of whole pixels
    assert set(np.unique(after[..., 3])) == {0, 255}
    if now.sum() < mask.sum():
        assert not (now & ~mask).any()
        assert distance_transform_edt(mask)[mask & ~now].max() <= reach
    else:
        assert not (mask & ~now).any()
        assert 1 <= distance_transform_edt(~mask)[now & ~mask].max() <= reach


def test_masks_are_too_wide_as_often_as_too_tight(cutout: np.ndarray) -> None:
    before = (cutout[..., 3] > 127).sum()
    wider = [(masked_badly(cutout, rng_of(seed))[..., 3] > 127).sum() > before for seed in range(100)]
    assert 35 < sum(wider) < 65


def test_around_a_mask_that_is_too_wide_one_colour_shows() -> None:
    mask = disc(40)
    pixels = flat((90, 160, 230), mask)
    pixels[~mask] = (1, 2, 3, 0)  # never seen: it was not behind the object
    behind = set()
    for seed in range(30):
        after = masked_badly(pixels, rng_of(seed))
        around = (after[..., 3] > 0) & ~mask
        kept = (after[..., 3] > 0) & mask
        assert (after[kept][:, :3] == (90, 160, 230)).all()
        colors = np.unique(after[around][:, :3], axis=0)
        assert len(colors) <= 1
        behind |= {tuple(color) for color in colors}
    assert len(behind) > 5
    assert (1, 2, 3) not in behind


def test_half_covered_pixels_of_a_wide_mask_are_blended() -> None:
    pixels = flat((0, 0, 0), disc(40))
    pixels[..., :3] = 250
    pixels[100, 100:] = (250, 250, 250, 51)  # a fifth of it
    for seed in range(10):
        after = masked_badly(pixels, rng_of(seed))
        if after[100, 110, 3] < 255:
            continue
        around = (after[..., 3] > 0) & (pixels[..., 3] == 0)
        behind = after[around][0, :3].astype(float)
        assert after[100, 110, :3] == pytest.approx(0.2 * 250 + 0.8 * behind, abs=0.51)


def test_compression_is_jpeg_on_a_white_page() -> None:
    """An opaque grey picture: some quality in the range gives these very bytes."""
    grey = astronaut()[:64, 100:164, 1]
    opaque = np.dstack([grey, grey, grey, np.full_like(grey, 255)])
    possible = set()
    for quality in range(40, 96):
        data = cv2.imencode(".jpg", opaque[..., :3], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        possible.add(cv2.imdecode(data, cv2.IMREAD_COLOR).tobytes())
    seen = {np.ascontiguousarray(compressed(opaque, rng_of(seed))[..., :3]).tobytes() for seed in range(40)}
    assert seen <= possible
    assert len(seen) > 20


def test_compression_keeps_the_edge_and_what_is_not_shown(cutout: np.ndarray) -> None:
    """No white creeps into half-covered pixels, and under zero alpha the colours stay."""
    pixels = flat((40, 90, 60), np.ones((SIZE, SIZE), bool))
    pixels[..., 3] = cutout[..., 3]
    for seed in range(5):
        after = compressed(pixels, rng_of(seed))
        hidden, half = pixels[..., 3] == 0, (pixels[..., 3] > 100) & (pixels[..., 3] < 255)
        assert np.array_equal(after[hidden], pixels[hidden])
        assert np.abs(after[half][:, :3].astype(int).mean(axis=0) - (40, 90, 60)).max() < 12


def test_each_damage_strikes_half_of_the_photos(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stand-ins note that they were called, and in which order."""
    struck: list[list[str]] = []

    def noting(name: str):
        def damage(pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
            struck[-1].append(name)
            return pixels + np.uint8(1)

        return damage

    for damage in DAMAGES:
        monkeypatch.setattr(f"mv3d_cli.capture.examples.augmentation.{damage.__name__}", noting(damage.__name__))
    rng, blank = rng_of(0), np.zeros((1, 1, 4), np.uint8)
    for _ in range(800):
        struck.append([])
        assert augmented(blank, rng)[0, 0, 0] == len(struck[-1])
    names = [damage.__name__ for damage in DAMAGES]
    assert all(each == [name for name in names if name in each] for each in struck)
    for name in names:
        assert sum(name in each for each in struck) == pytest.approx(400, abs=60)
    assert len({tuple(each) for each in struck}) == 16
