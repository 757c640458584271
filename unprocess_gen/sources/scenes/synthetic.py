"""Generate the built-in scenes, which are the source if ``source.root`` is null.

A scene has a name, ``<kind>-<number>``, and depends on it only: blake2b of the name keys a Philox stream, and a painter
turns the stream into linear light. No picture files are shipped.

A name gives the same bytes on every machine, so that datasets of scenes can be pinned by their hashes. Therefore only
exact operations are used: integers, comparisons, look-ups, and ``+ - * / sqrt floor`` on float64, each as one
elementwise ufunc, which IEEE 754 rounds in one way. Sines, powers, sums, matrix products and image libraries are not:
their last bit depends on CPU, build and version. Angles are therefore rational points of the unit circle, falloffs are
rational functions, and the transfer curve is a square root.

A painter returns ``[3, H, W]`` float64, where 0 is black and 1 is display white; brighter values clip. A scene takes
about 100 ms and 30 MB on one core.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Codes = tuple[int, int, int]

SYNTHETIC_KINDS = ("dead_leaves", "colour_chart", "gradients", "night_lamps", "highlights")

DEFAULT_COUNT = 10


def listing(limit: int | None) -> tuple[str, ...]:
    """Return the names of the first ``limit`` scenes (None: ten); kinds alternate."""
    count = DEFAULT_COUNT if limit is None else limit
    return tuple(f"{SYNTHETIC_KINDS[i % len(SYNTHETIC_KINDS)]}-{i // len(SYNTHETIC_KINDS)}" for i in range(count))


FRAMES_PER_CLIP = 8
"""Frames of a scene that is a clip."""

PAN = (2, 4)
"""Rows and columns by which the camera moves on from frame to frame."""


def clip_listing(limit: int | None) -> tuple[str, ...]:
    """Return the names of the first ``limit`` frames (None: all of ten clips), ``<kind>-<number>/<frame>``."""
    clips = listing(None if limit is None else -(-limit // FRAMES_PER_CLIP))
    return tuple(f"{clip}/{frame:04}" for clip in clips for frame in range(FRAMES_PER_CLIP))[:limit]


SCENES = listing(None)

DEFAULT_SIZE = (512, 768)

SCENE_SIZES = {
    "dead_leaves-1": (481, 641),
    "gradients-1": (427, 639),
    "night_lamps-1": (767, 511),
}
"""Heights and widths that differ from the default, with odd sides and a portrait, as real folders have them."""


def scene(name: str) -> NDArray[np.uint8]:
    """Draw scene ``name`` (``<kind>-<number>``): uint8 ``[H, W, 3]``, display-referred R, G, B, C-contiguous.

    A frame of a clip (``<kind>-<number>/<frame>``) is a window of the scene, which moves by `PAN`.
    """
    clip, slash, frame = name.partition("/")
    if not slash:
        return _draw(name)
    if frame not in map("{:04}".format, range(FRAMES_PER_CLIP)):
        raise ValueError(f"frame {frame!r} of a synthetic scene: expected 0000 to {FRAMES_PER_CLIP - 1:04}")
    pixels = _drawn(clip)
    first = (int(frame) * step for step in PAN)
    rows, columns = (
        slice(start, start + side - (FRAMES_PER_CLIP - 1) * step)
        for start, side, step in zip(first, pixels.shape, PAN, strict=False)
    )
    return np.ascontiguousarray(pixels[rows, columns])


@lru_cache(maxsize=1)
def _drawn(name: str) -> NDArray[np.uint8]:
    """Draw a scene once for all frames of its clip."""
    return _draw(name)


def _draw(name: str) -> NDArray[np.uint8]:
    kind = _kind(name)
    draws = _Draws(name)
    height, width = SCENE_SIZES.get(name, DEFAULT_SIZE)
    return _encode(PAINTERS[kind](draws, height, width), draws)


def _kind(name: str) -> str:
    """Return the kind in a name; a number has one spelling only, so that a picture has one name."""
    match = re.fullmatch(r"(.*)-(?:0|[1-9][0-9]*)", name)
    if match is None or match[1] not in SYNTHETIC_KINDS:
        raise ValueError(
            f"synthetic scene {name!r}: expected <kind>-<number>, the kind one of {', '.join(SYNTHETIC_KINDS)} "
            "and the number 0 or more without leading zeros"
        )
    return match[1]


class _Draws:
    """Hold the random stream of one scene; it uses raw Philox words, since NumPy may change its distributions."""

    def __init__(self, name: str) -> None:
        digest = hashlib.blake2b(name.encode("utf-8"), digest_size=16).digest()
        self._philox = np.random.Philox(key=int.from_bytes(digest, "little"))

    def _raw(self, count: int) -> NDArray[np.uint64]:
        return self._philox.random_raw(count)

    def below(self, bound: int, count: int) -> NDArray[np.int64]:
        """Return ``count`` integers from 0 to ``bound`` - 1."""
        return (((self._raw(count) >> np.uint64(32)) * np.uint64(bound)) >> np.uint64(32)).astype(np.int64)

    def between(self, low: float, high: float, count: int) -> Float:
        """Return ``count`` float64 in [``low``, ``high``)."""
        unit = (self._raw(count) >> np.uint64(11)).astype(np.float64) / float(1 << 53)
        return low + (high - low) * unit

    def one(self, low: float, high: float) -> float:
        """Return one float in [``low``, ``high``)."""
        return float(self.between(low, high, 1)[0])

    def pick(self, bound: int) -> int:
        """Return one integer from 0 to ``bound`` - 1."""
        return int(self.below(bound, 1)[0])

    def order(self, count: int) -> list[int]:
        """Return a permutation of 0 to ``count`` - 1."""
        return [int(i) for i in np.argsort(self._raw(count), kind="stable")]

    def octets(self, shape: tuple[int, ...]) -> Float:
        """Return float64 multiples of 1/256 in [0, 1); eight per random word, cheap enough for every pixel."""
        size = int(np.prod(shape))
        words = self._raw(-(-size // 8)).astype("<u8")
        return words.view(np.uint8)[:size].reshape(shape) / 256.0


def _encode(light: Float, draws: _Draws) -> NDArray[np.uint8]:
    """Convert linear light ``[3, H, W]`` to codes ``[H, W, 3]``, with dither below one code step against banding.

    A value that equals a code keeps it: flat patches stay flat, black stays 0 and white 255.
    """
    codes = np.minimum(np.maximum(light, 0.0), 1.0)
    np.sqrt(codes, out=codes)
    codes *= 255.0
    codes += draws.octets(light.shape)
    return np.ascontiguousarray(np.floor(codes).astype(np.uint8).transpose(1, 2, 0))


def _light(codes: tuple[Codes, ...]) -> Float:
    """Return display codes as linear light ``[N, 3]``; inverse of the curve in `_encode`."""
    shown = np.array(codes, dtype=np.float64) / 255.0
    return shown * shown


def _grid(height: int, width: int) -> tuple[Float, Float]:
    """Return pixel coordinates ``[H, 1]`` and ``[1, W]``, which broadcast."""
    return np.arange(height, dtype=np.float64)[:, None], np.arange(width, dtype=np.float64)[None, :]


def _unit(value: Float) -> Float:
    return np.minimum(np.maximum(value, 0.0), 1.0)


def _smooth(value: Float) -> Float:
    """Return the cubic from 0 to 1 with zero slope at both ends."""
    t = _unit(value)
    return t * t * (3.0 - 2.0 * t)


def _cover(canvas: Float, colour: Float, alpha: Float) -> None:
    """Blend ``colour`` (``[3]`` or ``[3, H, W]``) over ``canvas`` ``[3, H, W]`` by ``alpha`` ``[H, W]`` in 0 .. 1."""
    canvas += (_planes(colour) - canvas) * alpha


def _planes(colour: Float) -> Float:
    return colour[:, None, None] if colour.ndim == 1 else colour


def _box(y: Float, x: Float, top: float, left: float, bottom: float, right: float) -> Float:
    """Return the fraction of each pixel that an axis-aligned rectangle covers."""
    rows = _unit(np.minimum(y - top, bottom - y) + 0.5)
    columns = _unit(np.minimum(x - left, right - x) + 0.5)
    return rows * columns


def _noise(draws: _Draws, height: int, width: int, cell: tuple[int, int]) -> Float:
    """Return value noise ``[H, W]`` in [-1, 1] on a lattice of ``cell`` = (rows, columns) pixels."""
    rows, columns = height // cell[0] + 2, width // cell[1] + 2
    lattice = draws.between(-1.0, 1.0, rows * columns).reshape(rows, columns)
    return _stretch(_stretch(lattice, height, cell[0]).T, width, cell[1]).T


def _stretch(lattice: Float, length: int, cell: int) -> Float:
    """Interpolate the first axis of ``lattice`` to ``length`` samples, ``cell`` of them between two points."""
    position = np.arange(length)
    low = position // cell
    weight = _smooth((position % cell) / float(cell))[:, None]
    return lattice[low] + (lattice[low + 1] - lattice[low]) * weight


# Dead leaves: opaque shapes with power-law sizes that occlude one another, the classic model of natural images.

LEAF_PALETTES: tuple[tuple[Codes, ...], ...] = (
    (
        (128, 74, 38), (171, 108, 47), (196, 146, 70), (110, 52, 34), (148, 60, 40), (92, 96, 48),
        (126, 122, 64), (70, 58, 44), (214, 186, 132), (58, 40, 34), (160, 132, 96), (236, 222, 190),
    ),
    (
        (122, 118, 110), (154, 148, 136), (92, 94, 100), (184, 176, 160), (70, 66, 64), (138, 112, 92),
        (108, 120, 128), (216, 208, 194), (46, 48, 54), (150, 128, 108), (96, 110, 96), (242, 238, 230),
    ),
    (
        (58, 86, 46), (92, 118, 58), (128, 146, 78), (40, 62, 44), (76, 102, 84), (160, 168, 96),
        (96, 84, 56), (196, 196, 140), (34, 40, 30), (170, 92, 110), (214, 170, 180), (240, 236, 214),
    ),
)  # fmt: skip
"""Autumn, pebbles, undergrowth."""

LEAF_SHAPES: tuple[Callable[[Float, Float], Float], ...] = (
    lambda p, q: p * p + q * q,
    lambda p, q: p * p + np.abs(q),
    lambda p, q: np.maximum(p * p, q * q),
)
"""Level functions in a leaf's coordinates, 1 on the rim: ellipse, lens, rectangle."""


class _Leaf(NamedTuple):
    """Hold a leaf's centre, half length, width over length, direction ``(ux, uy)``, shape and contrast of texture."""

    y: float
    x: float
    radius: float
    slim: float
    ux: float
    uy: float
    shape: int
    contrast: float


def _dead_leaves(draws: _Draws, height: int, width: int) -> Float:
    """Draw large leaves first, so that no gap is left, then all sizes."""
    palette = _light(LEAF_PALETTES[draws.pick(len(LEAF_PALETTES))])
    area = height * width
    radii = np.concatenate([_radii(draws, 45.0, 150.0, area // 2600), _radii(draws, 4.5, 130.0, area // 210)])
    texture = _noise(draws, height, width, (3, 3)) + _noise(draws, height, width, (11, 11))
    canvas = np.empty((3, height, width))
    canvas[:] = _planes(palette[3])
    leaves = _leaves(draws, radii, height, width)
    colours = palette[draws.below(len(palette), len(radii))] * draws.between(0.25, 1.25, len(radii))[:, None]
    colours *= draws.between(0.85, 1.15, colours.size).reshape(colours.shape)
    for leaf, colour in zip(leaves, colours, strict=True):
        _drop(canvas, texture, leaf, colour)
    return canvas - 0.004


def _radii(draws: _Draws, low: float, high: float, count: int) -> Float:
    """Return sizes with density 1/r³: every octave covers the same area, and the inverse needs a square root only."""
    return 1.0 / np.sqrt(draws.between(1.0 / (high * high), 1.0 / (low * low), count))


def _leaves(draws: _Draws, radii: Float, height: int, width: int) -> list[_Leaf]:
    count = len(radii)
    slope = draws.between(-1.0, 1.0, count)
    columns = (
        draws.between(0.0, float(height), count),
        draws.between(0.0, float(width), count),
        radii,
        draws.between(0.45, 1.0, count),
        (1.0 - slope * slope) / (1.0 + slope * slope),
        2.0 * slope / (1.0 + slope * slope),
        draws.below(len(LEAF_SHAPES), count),
        draws.between(-0.16, 0.16, count),
    )
    return [_Leaf(*row) for row in zip(*(column.tolist() for column in columns), strict=True)]


def _drop(canvas: Float, texture: Float, leaf: _Leaf, colour: Float) -> None:
    """Draw one leaf: it darkens the surroundings of its rim and hides what is below it."""
    reach = leaf.radius * 1.45
    top, left = max(0, int(leaf.y - reach)), max(0, int(leaf.x - reach))
    window = (slice(top, int(leaf.y + reach) + 2), slice(left, int(leaf.x + reach) + 2))
    below, grain = canvas[:, *window], texture[window]
    dy = (np.arange(top, top + grain.shape[0]) - leaf.y)[:, None] / leaf.radius
    dx = (np.arange(left, left + grain.shape[1]) - leaf.x)[None, :] / leaf.radius
    p = dx * leaf.ux + dy * leaf.uy
    q = (dy * leaf.ux - dx * leaf.uy) / leaf.slim
    level = LEAF_SHAPES[leaf.shape](p, q)
    inside = (1.0 - level) * (leaf.radius * leaf.slim * 0.5)
    below *= 1.0 - 0.5 * _unit((1.9 - level) / 0.9)
    gain = 1.0 - 0.2 * dx - 0.28 * dy + leaf.contrast * grain
    below += (gain * colour[:, None, None] - below) * _unit(inside + 0.5)


# Colour chart: patches, a gray ramp and a resolution pattern on a dark frame.

PATCHES: tuple[Codes, ...] = (
    (146, 62, 52), (204, 122, 58), (222, 188, 74), (98, 140, 66), (52, 106, 142), (108, 68, 122),
    (112, 80, 66), (206, 158, 134), (104, 132, 166), (84, 100, 62), (150, 144, 188), (120, 192, 178),
    (190, 40, 54), (236, 150, 40), (62, 152, 82), (34, 62, 150), (192, 76, 142), (26, 140, 168),
    (244, 244, 240), (202, 202, 200), (160, 160, 160), (120, 120, 121), (80, 80, 82), (44, 44, 46),
)  # fmt: skip
"""Six columns by four rows, chosen for this chart; the last row is gray."""

BAR_PERIODS = (24, 18, 14, 10, 8, 6, 5, 4, 3, 2)


def _colour_chart(draws: _Draws, height: int, width: int) -> Float:
    y, x = _grid(height, width)
    canvas = np.empty((3, height, width))
    canvas[:] = 0.2 + 0.02 * _noise(draws, height, width, (2, 2)) + 0.03 * _noise(draws, height, width, (90, 120))
    margin = width // 16
    _frame(canvas, y, x, margin // 2, margin, height - margin // 2, width - margin)
    left, right = margin + 18, width - margin - 18
    _patches(canvas, draws, margin // 2 + 16, left, height * 5 // 8, right)
    _ramp_strip(canvas, height * 5 // 8 + 10, left, height * 23 // 32, right)
    _resolution(canvas, y, x, height * 23 // 32 + 12, left, height - margin // 2 - 16, right)
    return canvas * _lamp(draws, y, x, height, width)


def _frame(canvas: Float, y: Float, x: Float, top: int, left: int, bottom: int, right: int) -> None:
    """Draw the dark board and its shadow on the wall."""
    dy = np.maximum(np.maximum(top + 8 - y, y - bottom - 8), 0.0)
    dx = np.maximum(np.maximum(left + 8 - x, x - right - 8), 0.0)
    canvas *= 1.0 - 0.6 / (1.0 + (dx * dx + dy * dy) / 120.0)
    _cover(canvas, np.array([0.012, 0.012, 0.013]), _box(y, x, top, left, bottom, right))


def _patches(canvas: Float, draws: _Draws, top: int, left: int, bottom: int, right: int) -> None:
    """Draw the 6 x 4 patches; hues are permuted and shifted in each chart, grays keep their order."""
    codes = np.array(PATCHES, dtype=np.int64)
    codes[:18] = np.clip(codes[draws.order(18)] + draws.below(25, 54).reshape(18, 3) - 12, 0, 255)
    for i, light in enumerate(_light(tuple(map(tuple, codes.tolist())))):
        row, column = divmod(i, 6)
        y0, y1 = (top + (bottom - top) * (row + k) // 4 for k in (0, 1))
        x0, x1 = (left + (right - left) * (column + k) // 6 for k in (0, 1))
        canvas[:, y0 + 5 : y1 - 5, x0 + 5 : x1 - 5] = _planes(light)


def _ramp_strip(canvas: Float, top: int, left: int, bottom: int, right: int) -> None:
    """Draw a smooth ramp over all grays, and below it the same in 16 steps."""
    t = np.arange(right - left - 10) / float(right - left - 11)
    steps = np.floor(np.minimum(t * 16.0, 15.0)) / 15.0
    middle = (top + bottom) // 2
    canvas[:, top:middle, left + 5 : right - 5] = t * t
    canvas[:, middle:bottom, left + 5 : right - 5] = steps * steps


def _resolution(canvas: Float, y: Float, x: Float, top: int, left: int, bottom: int, right: int) -> None:
    """Draw bars of rising frequency on the left, a slanted edge in the middle, and a zone plate on the right."""
    side = bottom - top
    plate, edge = right - 5 - side, right - 15 - 2 * side
    middle = (top + bottom) // 2
    bars = _bars(edge - 10 - left - 5)
    canvas[:, top : middle - 3, left + 5 : edge - 10] = bars
    canvas[:, middle + 3 : bottom, left + 5 : edge - 10] = bars[::-1]
    slant = _unit((x - (edge + side / 2)) + (y - (top + side / 2)) / 8.0 + 0.5)
    canvas[:, top:bottom, edge : edge + side] = (0.02 + 0.78 * slant)[top:bottom, edge : edge + side]
    dy, dx = y[top:bottom] - (top + side / 2), x[:, plate : plate + side] - (plate + side / 2)
    canvas[:, top:bottom, plate : plate + side] = 0.02 + 0.78 * _wave((dx * dx + dy * dy) / (2.0 * side))


def _bars(length: int) -> Float:
    """Return black and white bars ``[length]``, a group of equal width per period; odd periods have a wider white."""
    groups = np.minimum(np.arange(length) * len(BAR_PERIODS) // length, len(BAR_PERIODS) - 1)
    periods = np.array(BAR_PERIODS)[groups]
    return np.where(np.arange(length) % periods < periods // 2, 0.004, 0.8)


def _wave(phase: Float) -> Float:
    """Return a wave of period 1 in [0, 1], made of parabolas that look like a sine."""
    t = phase - np.floor(phase)
    arch = 4.0 * t * (1.0 - t)
    return arch * arch


def _lamp(draws: _Draws, y: Float, x: Float, height: int, width: int) -> Float:
    """Return the illumination of the chart ``[3, H, W]``: a bright side, vignetting, and a colour cast."""
    dy = (y - draws.one(0.3, 0.6) * height) / height
    dx = (x - draws.one(0.25, 0.75) * width) / width
    fall = 1.12 / (1.0 + 0.45 * (dx * dx + dy * dy))
    warm = draws.one(-0.05, 0.05)
    return _planes(np.array([1.0 + warm, 1.0, 1.0 - warm])) * fall


# Gradients: panels without edges, where banding and quantisation are visible first.


def _gradients(draws: _Draws, height: int, width: int) -> Float:
    """Draw six panels above three ramps: shadows, highlights, and all grays."""
    canvas = np.zeros((3, height, width))
    ramps_top = height * 13 // 16
    gap = 6
    for i, which in enumerate(draws.order(len(HIGHLIGHT_PANELS))):
        row, column = divmod(i, 3)
        top, bottom = gap + row * ramps_top // 2, (row + 1) * ramps_top // 2
        left, right = gap + column * (width - gap) // 3, (column + 1) * (width - gap) // 3
        shown = _unit(HIGHLIGHT_PANELS[which](draws, bottom - top, right - left))
        canvas[:, top:bottom, left:right] = shown * shown
    for i, (low, high) in enumerate(RAMPS):
        top, bottom = (ramps_top + gap + (height - ramps_top - gap) * (i + k) // len(RAMPS) for k in (0, 1))
        t = np.arange(width - 2 * gap) / float(width - 2 * gap - 1)
        shown = (low + (high - low) * t) / 255.0
        canvas[:, top : bottom - gap, gap : width - gap] = shown * shown
    return canvas


RAMPS = ((0, 40), (255, 200), (0, 255))


def _hue(t: Float) -> Float:
    """Return hue ``t`` (period 1) as R, G, B ``[3, ...]`` in [0, 1]: the colour hexagon with rounded corners."""
    offsets = np.array([0.0, 2.0, 4.0]).reshape((3,) + (1,) * t.ndim)
    turn = t / 1.0 * 6.0 - offsets + 3.0
    turn = turn - 6.0 * np.floor(turn / 6.0)
    return _smooth((2.0 - np.abs(turn - 3.0)) / 1.5 + 0.15)


def _tint(draws: _Draws, strength: float, value: float) -> Float:
    """Return a random hue ``[3]``, mixed with gray and scaled, as display values in [0, 1]."""
    return value * (1.0 - strength + strength * _hue(draws.between(0.0, 1.0, 1))[:, 0])


def _corners(draws: _Draws, height: int, width: int) -> Float:
    """Return four colours, one for each corner."""
    y, x = _grid(height, width)
    v, u = _smooth(y / height), _smooth(x / width)
    a, b, c, d = (_planes(_tint(draws, 0.6, value)) for value in (0.95, 0.7, 0.45, 0.85))
    return (a * (1.0 - u) + b * u) * (1.0 - v) + (c * (1.0 - u) + d * u) * v


def _halo(draws: _Draws, height: int, width: int) -> Float:
    """Return a bright spot on a dark ground."""
    y, x = _grid(height, width)
    dy, dx = (y - draws.one(0.35, 0.65) * height) / height, (x - draws.one(0.35, 0.65) * width) / height
    near, far = _planes(_tint(draws, 0.35, 1.06)), _planes(_tint(draws, 0.7, 0.22))
    return far + (near - far) / (1.0 + 12.0 * (dx * dx + dy * dy))


def _spectrum(draws: _Draws, height: int, width: int) -> Float:
    """Return all hues from left to right, paler towards the bottom."""
    y, x = _grid(height, width)
    strength = _smooth(1.0 - y / height) * 0.75
    return (1.0 - strength + strength * _hue(x / width + draws.one(0.0, 1.0))) * (0.55 + 0.4 * (y / height))


def _dusk(draws: _Draws, height: int, width: int) -> Float:
    """Return an evening sky."""
    y, x = _grid(height, width)
    stops = np.array([(24, 34, 74), (72, 84, 140), (190, 140, 150), (244, 176, 110), (255, 222, 160)]) / 255.0
    position = y[:, 0] / height * (len(stops) - 1.001)
    low = np.floor(position).astype(np.int64)
    sky = (stops[low] + (stops[low + 1] - stops[low]) * (position - low)[:, None]).T[:, :, None]
    dx, dy = (x - draws.one(0.2, 0.8) * width) / width, (y - 1.02 * height) / height
    return sky + _planes(np.array([0.30, 0.22, 0.10])) / (1.0 + 14.0 * (dx * dx + dy * dy)) - 0.04


def _silk(draws: _Draws, height: int, width: int) -> Float:
    """Return two tints that fold into each other."""
    cell = (height // 2 + 1, width // 2 + 1)
    fold = 0.5 + 0.5 * _noise(draws, height, width, cell)
    dark, pale = _planes(_tint(draws, 0.6, 0.3)), _planes(_tint(draws, 0.4, 0.95))
    return dark + (pale - dark) * fold + 0.12 * _noise(draws, height, width, (cell[0] // 2, cell[1] // 2))


def _pools(draws: _Draws, height: int, width: int) -> Float:
    """Return four pools of colour on middle gray."""
    y, x = _grid(height, width)
    shown = np.full((3, height, width), 0.45)
    for _ in range(4):
        dy, dx = (y - draws.one(0.1, 0.9) * height) / height, (x - draws.one(0.1, 0.9) * width) / height
        _cover(shown, _tint(draws, 0.65, draws.one(0.5, 1.0)), 0.9 / (1.0 + 20.0 * (dx * dx + dy * dy)))
    return shown


HIGHLIGHT_PANELS: tuple[Callable[[_Draws, int, int], Float], ...] = (_corners, _halo, _spectrum, _dusk, _silk, _pools)


# Night: a wet street under lamps, most of it dark, its sources brighter than white.

LAMP_LIGHTS = np.array([(1.0, 0.62, 0.24), (1.0, 0.70, 0.34), (1.0, 0.84, 0.58), (0.72, 0.88, 1.0)])
WINDOW_LIGHTS = np.array([(0.9, 0.6, 0.25), (0.7, 0.5, 0.3), (0.5, 0.32, 0.12), (0.35, 0.45, 0.6), (0.9, 0.8, 0.6)])
SIGN_LIGHTS = np.array([(1.6, 0.06, 0.10), (0.08, 0.9, 1.3), (1.3, 0.10, 0.9), (0.15, 1.3, 0.35)])


def _night_lamps(draws: _Draws, height: int, width: int) -> Float:
    y, x = _grid(height, width)
    horizon = height * 2 // 3
    canvas = _night_sky(draws, y, x, horizon)
    _skyline(canvas, draws, y, x, horizon, (0.30, 0.62), np.array([0.006, 0.007, 0.012]))
    _skyline(canvas, draws, y, x, horizon + 8, (0.12, 0.45), np.array([0.0015, 0.0017, 0.0025]))
    _road(canvas, draws, y, x, horizon)
    _sources(canvas, draws, y, x, horizon)
    return canvas - 0.0012


def _night_sky(draws: _Draws, y: Float, x: Float, horizon: int) -> Float:
    """Return deep blue at the top, the glow of a town at the horizon, and a few stars."""
    height, width = y.size, x.size
    town = 1.0 / (1.0 + 6.0 * ((y - horizon) / horizon) * ((y - horizon) / horizon))
    cloud = 1.0 + 0.35 * _noise(draws, height, width, (70, 150))
    canvas = _planes(np.array([0.004, 0.007, 0.020])) + _planes(np.array([0.040, 0.022, 0.018])) * (town * cloud)
    for _ in range(70):
        row, column = draws.pick(horizon * 2 // 3), draws.pick(width)
        brightness = draws.one(0.05, 0.75)
        canvas[:, row, column] += brightness * brightness
        canvas[:, row, max(column - 1, 0)] += 0.25 * brightness * brightness
    return canvas


def _skyline(
    canvas: Float, draws: _Draws, y: Float, x: Float, foot: int, tall: tuple[float, float], wall: Float
) -> None:
    """Draw a row of buildings along ``foot``; ``tall`` is the range of their heights as fractions of ``foot``."""
    left = -draws.pick(40)
    while left < x.size:
        right = left + 38 + draws.pick(70)
        top = foot - int(draws.one(*tall) * foot)
        canvas[:, top:foot, max(left, 0) : right] = _planes(wall)
        _windows(canvas, draws, top + 8, left + 6, foot - 6, right - 6)
        left = right + draws.pick(14)


def _windows(canvas: Float, draws: _Draws, top: int, left: int, bottom: int, right: int) -> None:
    """Draw windows in a grid of 12 x 9 pixels, a quarter of them lit."""
    rows, columns = max((bottom - top) // 12, 0), max((right - left) // 9, 0)
    for i in np.flatnonzero(draws.below(4, rows * columns) == 0).tolist():
        row, column = divmod(i, columns)
        y0, x0 = top + 12 * row, left + 9 * column
        light = WINDOW_LIGHTS[draws.pick(len(WINDOW_LIGHTS))] * draws.one(0.08, 0.7)
        canvas[:, y0 : y0 + 7, max(x0, 0) : max(x0 + 5, 0)] = _planes(light)


def _road(canvas: Float, draws: _Draws, y: Float, x: Float, horizon: int) -> None:
    """Draw wet ground: a dim, rippled mirror image of everything above the horizon, darker towards the viewer."""
    height, width = y.size, x.size
    depth = height - horizon
    ripple = _noise(draws, height, width, (3, 40))[horizon:] * (np.arange(depth) / 8.0)[:, None]
    rows = np.clip(horizon - 1 - np.arange(depth)[:, None] - np.rint(ripple).astype(np.int64), 0, horizon - 1)
    mirrored = canvas[:, rows, np.arange(width)[None, :]]
    fade = 0.30 / (1.0 + (y[horizon:] - horizon) / (0.25 * depth))
    canvas[:, horizon:] = mirrored * fade + 0.0016


def _sources(canvas: Float, draws: _Draws, y: Float, x: Float, horizon: int) -> None:
    """Draw two rows of lamps that recede to a point on the horizon, and signs between them."""
    height, width = y.size, x.size
    vanish = draws.one(0.4, 0.6) * width
    streaks = 0.75 + 0.5 * _noise(draws, height, width, (2, 26))
    colour = LAMP_LIGHTS[draws.pick(len(LAMP_LIGHTS))]
    for far in (6.5, 4.0, 2.6, 1.7):
        for side in (-1.0, 1.0):
            column = vanish + side * 0.72 * width / far
            top, foot = horizon - 0.52 * height / far, horizon + 0.30 * height / far
            thick = 5.0 / far
            post = _box(y, x, top, column - thick / 2, foot, column + thick / 2)
            _cover(canvas, np.array([0.001, 0.001, 0.001]), post)
            _glow(canvas, streaks, y, x, (top, column, foot), 11.0 / far, colour * draws.one(0.85, 1.15), horizon)
    for light in SIGN_LIGHTS[draws.order(len(SIGN_LIGHTS))]:
        top, column = horizon - draws.one(0.04, 0.22) * height, draws.one(0.08, 0.92) * width
        _glow(canvas, streaks, y, x, (top, column, horizon + (horizon - top) / 2), draws.one(1.6, 3.0), light, horizon)


def _glow(
    canvas: Float,
    streaks: Float,
    y: Float,
    x: Float,
    lamp: tuple[float, float, float],
    size: float,
    colour: Float,
    horizon: int,
) -> None:
    """Draw a lamp at ``lamp`` = (row, column, row of its foot): a core above white, a halo, a streak on wet ground."""
    dy, dx = (y - lamp[0]) / size, (x - lamp[1]) / size
    square = dx * dx + dy * dy
    near = 1.0 / (1.0 + square)
    light = 6.0 * near * near + 0.05 / (1.0 + square / 60.0)
    down = (y[horizon:] - (2.0 * lamp[2] - lamp[0])) / (9.0 * size)
    wide = 1.0 + 0.6 * dx * dx + down * down
    light[horizon:] += streaks[horizon:] * 0.9 / (wide * wide)
    canvas += _planes(colour) * light


# Highlights: colours driven past what a display can show, one channel at a time or all three.

SUN = (3.0 / 7.0, -6.0 / 7.0, 2.0 / 7.0)
"""Unit vector towards the sun, in rationals: right, up and to the viewer (y points down)."""

BALLS = np.array(
    [
        (1.05, 0.055, 0.055),
        (0.05, 0.85, 0.12),
        (0.05, 0.12, 1.05),
        (1.0, 0.72, 0.02),
        (0.95, 0.05, 0.62),
        (0.02, 0.75, 0.95),
        (0.006, 0.006, 0.007),
        (0.9, 0.9, 0.9),
    ]
)
"""Colours of the balls in full light; a display shows the red one as about (255, 60, 60)."""


def _highlights(draws: _Draws, height: int, width: int) -> Float:
    y, x = _grid(height, width)
    horizon = height * 7 // 16
    canvas = _day_sky(draws, y, x, horizon)
    _hills(canvas, draws, y, horizon)
    _table(canvas, draws, y, x, horizon)
    order = draws.order(len(BALLS))
    places = [(0.60, 0.22, 0.085), (0.57, 0.43, 0.075), (0.61, 0.66, 0.085), (0.78, 0.33, 0.125), (0.76, 0.57, 0.12),
              (0.84, 0.80, 0.14), (0.87, 0.12, 0.13)]  # fmt: skip
    for which, (row, column, size) in zip(order, places, strict=False):
        centre = (row * height, (column + draws.one(-0.015, 0.015)) * width, size * height)
        _ball(canvas, y, x, centre, BALLS[which])
    return canvas


def _day_sky(draws: _Draws, y: Float, x: Float, horizon: int) -> Float:
    """Return a sky from blue to white at the horizon, with clipped clouds, the sun and its glare."""
    height, width = y.size, x.size
    t = _unit(y / horizon)
    low, high = _planes(np.array([0.72, 0.84, 0.95])), _planes(np.array([0.10, 0.26, 0.68]))
    canvas = high + (low - high) * (t * (0.4 + 0.6 * t)) + np.zeros((height, width))
    cloud = _noise(draws, height, width, (60, 130)) + 0.5 * _noise(draws, height, width, (24, 48))
    cloud += 0.25 * _noise(draws, height, width, (10, 18)) + 0.12 * _noise(draws, height, width, (4, 7))
    _cover(canvas, np.array([1.02, 1.0, 0.98]), 0.95 * _smooth((cloud - 0.05) / 0.9))
    dy, dx = y - draws.one(0.14, 0.22) * height, x - draws.one(0.72, 0.86) * width
    square = (dx * dx + dy * dy) / (0.045 * height * 0.045 * height)
    canvas += _planes(np.array([1.0, 0.93, 0.75])) * (5.0 / (1.0 + square * square) + 0.5 / (1.0 + square / 6.0))
    return canvas


def _hills(canvas: Float, draws: _Draws, y: Float, horizon: int) -> None:
    """Draw two backlit ridges: the far one hazy, the near one almost black."""
    width = canvas.shape[2]
    for lift, rough, colour in ((0.20, 90, (0.10, 0.16, 0.24)), (0.06, 60, (0.004, 0.007, 0.002))):
        ridge = 0.07 * _noise(draws, 1, width, (1, rough)) + 0.02 * _noise(draws, 1, width, (1, rough // 5))
        top = horizon * (1.0 - lift - ridge)
        _cover(canvas, np.array(colour), _unit(y - top + 0.5))


def _table(canvas: Float, draws: _Draws, y: Float, x: Float, horizon: int) -> None:
    """Draw a wooden table up to the horizon and a sheet of white paper on it, in perspective."""
    height, width = y.size, x.size
    near = (y[horizon:] - horizon) / float(height - horizon)
    grain = 1.0 + 0.22 * _noise(draws, height, width, (3, 120)) + 0.12 * _noise(draws, height, width, (9, 60))
    canvas[:, horizon:] = _planes(np.array([0.16, 0.075, 0.035])) * (grain[horizon:] * (0.55 + 0.6 * near))
    half = width * (0.36 + 0.17 * near)
    sheet = _unit(half - np.abs(x - 0.5 * width) + 0.5) * _unit((near - 0.10) * (height - horizon) + 0.5)
    fibre = 0.93 + 0.012 * _noise(draws, height, width, (2, 2))[horizon:] + 0.14 * (x / width - 0.5)
    _cover(canvas[:, horizon:], _planes(np.array([1.0, 0.99, 0.97])) * fibre, sheet)


def _ball(canvas: Float, y: Float, x: Float, centre: tuple[float, float, float], colour: Float) -> None:
    """Draw a glossy ball at ``centre`` = (row, column, radius), with its shadow away from the sun."""
    row, column, radius = centre
    _shade(canvas, y, x, (row + 0.86 * radius, column - 0.62 * radius), (0.36 * radius, 1.25 * radius), 0.72)
    _shade(canvas, y, x, (row + 0.97 * radius, column - 0.08 * radius), (0.12 * radius, 0.50 * radius), 0.80)
    dy, dx = (y - row) / radius, (x - column) / radius
    square = dx * dx + dy * dy
    dz = np.sqrt(np.maximum(1.0 - square, 0.0))
    lit = np.maximum(dx * SUN[0] + dy * SUN[1] + dz * SUN[2], 0.0)
    gloss = 1.0 - (dx * SUN[0] + dy * SUN[1] + dz * (SUN[2] + 1.0)) / np.sqrt(2.0 + 2.0 * SUN[2])
    spark = 1.0 / (1.0 + 220.0 * np.maximum(gloss, 0.0))
    rim = (1.0 - dz) * (1.0 - dz) * (1.0 - dz)
    diffuse = 0.10 + 1.15 * lit + 0.22 * np.maximum(dy, 0.0) + 0.08 * rim
    shown = _planes(colour) * diffuse + 3.0 * spark * spark * spark + 0.05 * rim * np.maximum(-dy, 0.0)
    _cover(canvas, shown, _unit((1.0 - square) * (radius * 0.5) + 0.5))


def _shade(
    canvas: Float, y: Float, x: Float, centre: tuple[float, float], size: tuple[float, float], depth: float
) -> None:
    dy, dx = (y - centre[0]) / size[0], (x - centre[1]) / size[1]
    square = dx * dx + dy * dy
    canvas *= 1.0 - depth / (1.0 + square * square)


Painter = Callable[[_Draws, int, int], Float]

PAINTERS: dict[str, Painter] = dict(
    zip(SYNTHETIC_KINDS, (_dead_leaves, _colour_chart, _gradients, _night_lamps, _highlights), strict=True)
)
