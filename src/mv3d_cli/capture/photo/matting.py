"""The cut-out of a photo's object: from its alpha channel, or found against a background that is seen at the border.

The background's colours are learnt from the photo's border: a smooth surface for walls and sheets of paper that lie
in uneven light; clusters for clutter. Before a smooth background the object is what differs from it. Among clutter it
is looked for in the middle, in what differs from the border's colours and cannot be reached from the border without
crossing edges (geodesic saliency, Wei et al. 2012). GrabCut (Rother et al. 2004) draws the outline on a small copy of
the photo, a guided filter (He et al. 2010) brings it to the photo's own pixels. Colours are CIE Lab where compared.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int32, UInt8
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

SIDE = 384  # pixels: of the reduced photo, on which the outline is found
_RING = 0.025  # of the longest side: the border from which the background is learnt
_USED = 0.01  # of a photo's pixels are transparent at least, where the alpha channel means something
_SHADE = 0.45  # how much a difference in lightness counts beside one in hue: shadows fall on backgrounds
_CLEAR = 9.0  # Lab units from a smooth background that are certainly something else
_SMOOTH = 2.0  # Lab units: greatest median deviation of a smooth background's border
_ROUGH = 5.0  # the same of one that is a carpet, a lawn, sand
_EVEN = 0.85  # share of the border that lies on a smooth background, at least
_MIDDLE = 0.8  # of the way to the border: where the object is looked for among clutter
_DULL = 0.3  # share of the middle that is taken to be background there
_SMALL = 0.05  # of the largest part's area: lesser parts are specks
_PIXELS_AT_ONCE = 2**21

Mask = Bool[np.ndarray, "height width"]


def alpha_of(photo: UInt8[np.ndarray, "height width 4"]) -> UInt8[np.ndarray, "height width"]:
    """The object's opacity at the photo's pixels: as given, where an alpha channel is used, or found by `matted`.

    It is 0 everywhere where nothing is found.
    """
    given = photo[..., 3]
    if (given < 128).mean() >= _USED:
        return given.copy()
    return matted(photo[..., :3])


def matted(photo: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width"]:
    """The opacity of what stands out of the background; 0 everywhere where nothing does."""
    scale = min(1.0, SIDE / max(photo.shape[:2]))
    size = [max(2, round(length * scale)) for length in photo.shape[1::-1]]
    small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA)
    mask = _cut(small)
    if not mask.any():
        return np.zeros(photo.shape[:2], np.uint8)
    return _refined(photo, small, mask)


def _cut(photo: UInt8[np.ndarray, "height width 3"]) -> Mask:
    """The object in a small photo."""
    top, bottom, left, right = bars(photo)
    mask = np.zeros(photo.shape[:2], bool)
    inside = photo[top:bottom, left:right]
    if min(inside.shape[:2]) >= 8:
        mask[top:bottom, left:right] = _cut_inside(inside)
    return mask


def bars(photo: UInt8[np.ndarray, "height width 3"]) -> tuple[int, int, int, int]:
    """Rows [top, bottom) and columns [left, right) of the picture proper, between bars of one colour that were put
    at its sides to make it square. A bar ends all along its length at once, which a plain background does not."""
    rows, columns = photo.astype(np.int16), photo.astype(np.int16).transpose(1, 0, 2)
    return _bar(rows), len(rows) - _bar(rows[::-1]), _bar(columns), len(columns) - _bar(columns[::-1])


def _bar(lines: np.ndarray) -> int:
    """Lines of the bar at the beginning, with two that its edge blurs; 0: there is none."""
    differs = np.abs(lines - np.median(lines[0], axis=0)).max(axis=-1) > 12
    plain = differs.mean(axis=1) < 0.02
    count = int(np.argmin(plain))
    after = differs[count + 1 : count + 4]
    return count + 2 if count and after.size and after.mean() > 0.9 else 0


def _cut_inside(photo: UInt8[np.ndarray, "height width 3"]) -> Mask:
    """The object of a photo that fills its picture."""
    lab = cv2.cvtColor(photo.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    ring = _ring(lab.shape[:2])
    distance, deviation = _distance(lab, ring)
    if deviation < _SMOOTH:
        likely = distance > _CLEAR
        cut = _grabbed(photo, likely, distance > 3 * _CLEAR, distance < _CLEAR / 2) if likely.any() else likely
        return _parts(_without_flaws(_without_blur(cut, distance), distance), _SMALL)
    salient = _salience(lab, distance)
    middle = _from_middle(distance.shape) < _MIDDLE
    likely = middle & (salient > np.quantile(salient[middle], _DULL))
    if deviation < _ROUGH:
        likely |= distance > _CLEAR
    none = ring & (distance < np.quantile(distance[ring], 0.9))
    return _parts(_without_flaws(_grabbed(photo, likely, np.zeros_like(ring), none), None), 4 * _SMALL)


def _ring(shape: tuple[int, int]) -> Mask:
    """The picture's border."""
    width = max(2, round(max(shape) * _RING))
    ring = np.ones(shape, bool)
    ring[width:-width, width:-width] = False
    return ring


def _distance(lab: Float[np.ndarray, "height width 3"], ring: Mask) -> tuple[Float[np.ndarray, "height width"], float]:
    """How far each colour is from the background's, and how far that is from smooth."""
    surface, deviation, share = _surface(lab, ring)
    distance = _apart(lab - surface)
    if deviation < _ROUGH and share > _EVEN:
        return distance, deviation
    colors = lab[ring]
    count = 6
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 20, 0.5)
    cv2.setRNGSeed(0)
    _, labels, centres = cv2.kmeans(colors, count, np.empty(0), criteria, 2, cv2.KMEANS_PP_CENTERS)  # type: ignore[call-overload]
    shares = np.bincount(labels.ravel(), minlength=count) / len(labels)
    for centre in centres[shares > 0.06]:
        distance = np.minimum(distance, _apart(lab - centre))
    return distance, np.inf


def _surface(lab: np.ndarray, ring: Mask) -> tuple[np.ndarray, float, float]:
    """The quadratic surface through most of the border's colours, their median deviation from it, and the share of
    the border that lies on it (least squares, reweighted by Cauchy's function)."""
    height, width = ring.shape
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1).astype(np.float32)
    known, colors = terms[ring], lab[ring]
    centre = np.median(colors, axis=0)
    off = np.linalg.norm(colors - centre, axis=1)
    weight = 1 / (1 + (off / max(np.median(off), 1.0)) ** 2)
    solution = np.zeros((6, 3))
    for _ in range(12):
        root = np.sqrt(weight)[:, None]
        solution = np.linalg.lstsq(known * root, colors * root, rcond=None)[0]
        off = np.linalg.norm(colors - known @ solution, axis=1)
        weight = 1 / (1 + (off / max(np.median(off), 1.0)) ** 2) ** 2
    return (terms @ solution).astype(np.float32), float(np.median(off)), float((off < _CLEAR).mean())


def _apart(difference: np.ndarray) -> np.ndarray:
    """Lab units, in which lightness counts less."""
    return np.sqrt((_SHADE * difference[..., 0]) ** 2 + (difference[..., 1:] ** 2).sum(axis=-1))


def _salience(lab: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """How much each pixel of a cluttered photo looks like the object; greater is likelier."""
    prior = np.exp(-(_from_middle(distance.shape) ** 2) / 0.7)
    colored = cv2.GaussianBlur(distance.astype(np.float32), (0, 0), max(distance.shape) / 128)
    barrier = _geodesic(lab)
    return (colored / (np.quantile(colored, 0.95) + 1e-6) + barrier / (np.quantile(barrier, 0.95) + 1e-6)) * prior


def _geodesic(lab: np.ndarray, side: int = 96) -> np.ndarray:
    """The least sum of steps in colour on any way from the border, at each pixel."""
    height, width = lab.shape[:2]
    scale = side / max(height, width)
    rows, columns = max(4, round(height * scale)), max(4, round(width * scale))
    small = cv2.medianBlur(cv2.resize(lab, (columns, rows), interpolation=cv2.INTER_AREA), 3)
    index = np.arange(rows * columns).reshape(rows, columns)
    pairs, costs = [], []
    for a, b, first, second in (
        (index[:, :-1], index[:, 1:], small[:, :-1], small[:, 1:]),
        (index[:-1], index[1:], small[:-1], small[1:]),
        (index[:-1, :-1], index[1:, 1:], small[:-1, :-1], small[1:, 1:]),
        (index[1:, :-1], index[:-1, 1:], small[1:, :-1], small[:-1, 1:]),
    ):
        pairs.append(np.stack([a.ravel(), b.ravel()]))
        costs.append(np.maximum(np.linalg.norm(first - second, axis=-1) - 6, 0).ravel() + 1e-3)
    ends = np.concatenate(pairs, axis=1)
    graph = coo_array((np.concatenate(costs), (ends[0], ends[1])), shape=(index.size, index.size)).tocsr()
    far = dijkstra(graph, directed=False, indices=_at_border(index), min_only=True)
    return cv2.resize(far.reshape(rows, columns).astype(np.float32), (width, height))


def _from_middle(shape: tuple[int, ...]) -> np.ndarray:
    """How far each pixel is from the middle, where the borders' middles are at 1."""
    y, x = np.meshgrid(*(np.linspace(-1, 1, length) for length in shape), indexing="ij")
    return np.hypot(x, y)


def _grabbed(photo: np.ndarray, likely: Mask, sure: Mask, none: Mask) -> Mask:
    """GrabCut from what is likely the object; `sure` is it in any case, `none` is not."""
    labels = np.where(likely, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[none] = cv2.GC_BGD
    labels[sure] = cv2.GC_FGD
    if not (labels & 1).any() or (labels & 1).all():
        return likely
    cv2.setRNGSeed(0)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    everything = (0, 0, photo.shape[1], photo.shape[0])
    cv2.grabCut(np.ascontiguousarray(photo[..., ::-1]), labels, everything, *models, 4, cv2.GC_INIT_WITH_MASK)
    return (labels & 1).astype(bool)


def _without_blur(mask: Mask, distance: np.ndarray) -> Mask:
    """The mask without pixels of its outline that are more of a smooth background's colour than of the object's."""
    kernel = np.ones((5, 5), np.uint8)
    outline = mask & ~cv2.erode(mask.astype(np.uint8), kernel).astype(bool)
    return mask & ~(outline & (distance < 0.5 * cv2.dilate(distance, kernel)))


def _without_flaws(mask: Mask, distance: np.ndarray | None) -> Mask:
    """The mask without holes that show no background: those that are small, and where distances from a smooth
    background are known, those of other colours."""
    count, labels = labelled(~mask, 4)
    areas = np.bincount(labels.ravel(), minlength=count)
    filled = areas < (0.002 if distance is not None else 0.01) * mask.sum()
    if distance is not None:
        typical = np.asarray(ndimage.median(distance, labels, np.arange(count)))
        filled |= typical > _CLEAR
    filled[0] = False  # the object itself
    filled[_at_border(labels)] = False
    return mask | filled[labels]


def _parts(mask: Mask, least: float) -> Mask:
    """The mask without parts smaller than that share of the largest, or half of it where they are cut by the frame."""
    count, labels = labelled(mask, 8)
    areas = np.bincount(labels.ravel(), minlength=count).astype(np.float64)
    areas[0] = 0
    bounds = np.full(count, least * areas.max())
    bounds[_at_border(labels)] = 0.5 * areas.max()
    bounds[0] = np.inf
    return (areas >= bounds)[labels]


def labelled(mask: Mask, neighbours: int) -> tuple[int, Int32[np.ndarray, "height width"]]:
    """The number of labels, and the mask's connected parts, labelled from 1; the rest is 0."""
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=neighbours)
    return count, np.asarray(labels, np.int32)


def _at_border(labels: np.ndarray) -> np.ndarray:
    """The labels that the picture's border crosses."""
    return np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))


def _refined(
    photo: UInt8[np.ndarray, "height width 3"],
    small: UInt8[np.ndarray, "rows columns 3"],
    mask: Bool[np.ndarray, "rows columns"],
) -> UInt8[np.ndarray, "height width"]:
    """The small photo's mask at the photo's pixels, soft where colours are mixed: the guided filter's linear model,
    fitted on the small photo, looked at in strips of the large one. Far from the outline the mask stays as it is."""
    radius = max(2, round(max(mask.shape) / 96))
    model = _linear_model(small.astype(np.float32) / 255, mask.astype(np.float32), radius)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    solid = mask.astype(np.uint8)
    known = np.dstack([cv2.erode(solid, kernel), cv2.dilate(solid, kernel)]).astype(np.float32)
    planes = np.dstack([model, known])
    height, width = photo.shape[:2]
    scale_x, scale_y = mask.shape[1] / width, mask.shape[0] / height
    alpha = np.empty((height, width), np.uint8)
    rows = max(1, _PIXELS_AT_ONCE // width)
    for top in range(0, height, rows):
        strip = photo[top : top + rows].astype(np.float32) / 255
        place = np.array([[scale_x, 0, scale_x / 2 - 0.5], [0, scale_y, (top + 0.5) * scale_y - 0.5]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        size = (width, len(strip))
        here = np.dstack(
            [
                cv2.warpAffine(plane, place, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
                for plane in cv2.split(planes)
            ]
        )
        value = (here[..., :3] * strip).sum(axis=-1) + here[..., 3]
        value = ((value - 0.5) * 1.4 + 0.5).clip(here[..., 4], here[..., 5])
        alpha[top : top + rows] = np.round(value.clip(0, 1) * 255)
    return alpha


def _linear_model(guide: np.ndarray, mask: np.ndarray, radius: int, epsilon: float = 1e-3) -> np.ndarray:
    """(a, b) in four channels, so that the mask is about a . colour + b around each pixel (guided filter, eq. 14)."""

    def mean(values: np.ndarray) -> np.ndarray:
        return cv2.blur(values, (2 * radius + 1, 2 * radius + 1))

    middle, share = mean(guide), mean(mask)
    products = mean((guide[..., :, None] * guide[..., None, :]).reshape(*mask.shape, 9)).reshape(*mask.shape, 3, 3)
    covariance = products - middle[..., :, None] * middle[..., None, :] + epsilon * np.eye(3, dtype=np.float32)
    together = mean(guide * mask[..., None]) - middle * share[..., None]
    slope = np.linalg.solve(covariance, together[..., None])[..., 0]
    return mean(np.dstack([slope, share - (slope * middle).sum(axis=-1)]).astype(np.float32))
