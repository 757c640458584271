"""Draw the built-in synthetic pictures, which are the source if ``source.root`` is null.

A picture has a name, ``<kind>-<number>``, and depends on it only: blake2b of the name keys a Philox stream, and a
painter turns the stream into linear light, ``[3, H, W]`` float64, 0 at black and 1 at display white. It takes about
100 ms and 30 MB on one core.

A name gives the same bytes on every machine. Therefore only exact operations are used: integers, comparisons, look-ups,
and ``+ - * / sqrt floor`` on float64, each as one elementwise ufunc, which IEEE 754 rounds in one way. Sines, powers,
sums, matrix products and image libraries are not: their last bit depends on CPU, build and version. Angles are
therefore rational points of the unit circle, falloffs are rational functions, and the transfer curve is a square root.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Pixel = TypeVar("Pixel", bound=np.generic)

KINDS = ("dead_leaves", "colour_chart", "highlights")

DEFAULT_COUNT = 10

FRAMES_PER_CLIP = 8
"""Frames of a picture that is a clip."""

PAN = (2, 4)
"""Rows and columns by which the camera moves on from frame to frame."""

DEFAULT_SIZE = (512, 768)

SIZES = {"dead_leaves-1": (481, 641)}
"""Height and width that differ from the default, with odd sides."""


def list_names(limit: int | None, clips: bool = False) -> tuple[str, ...]:
    """Names of the first ``limit`` pictures, kinds alternating; None: ten.

    With ``clips``, names ``<kind>-<number>/<frame>`` of the first ``limit`` frames; None: all of ten clips.
    """
    if clips:
        names = list_names(None if limit is None else -(-limit // FRAMES_PER_CLIP))
        return tuple(f"{clip}/{frame:04}" for clip in names for frame in range(FRAMES_PER_CLIP))[:limit]
    count = DEFAULT_COUNT if limit is None else limit
    return tuple(f"{KINDS[i % len(KINDS)]}-{i // len(KINDS)}" for i in range(count))


NAMES = list_names(None)


def picture(name: str) -> NDArray[np.uint8]:
    """Draw a picture: uint8 ``[H, W, 3]``, display-referred R, G, B, C-contiguous.

    A frame of a clip (``<kind>-<number>/<frame>``) is a window of the picture, which moves by `PAN`.
    """
    return _window(name, _drawn)


def _window(name: str, draw: Callable[[str], NDArray[Pixel]]) -> NDArray[Pixel]:
    """Cut the window of a frame from a picture, if it is a clip."""
    clip, slash, frame = name.partition("/")
    pixels = draw(clip)
    if not slash:
        return pixels.copy()
    if frame not in map("{:04}".format, range(FRAMES_PER_CLIP)):
        raise ValueError(f"frame {frame!r} of a synthetic picture: expected 0000 to {FRAMES_PER_CLIP - 1:04}")
    (top, left), last = (int(frame) * step for step in PAN), FRAMES_PER_CLIP - 1
    height, width = (side - last * step for side, step in zip(pixels.shape, PAN, strict=False))
    return pixels[top : top + height, left : left + width].copy()


def scene(name: str) -> NDArray[np.float32]:
    """Draw the light of a picture: float32 ``[H, W, 3]``, scene-linear sRGB, 1 at display white and more above it."""
    return _window(name, _light)


@lru_cache(maxsize=1)
def _light(name: str) -> NDArray[np.float32]:
    """Draw the light of a picture, once for all frames of its clip."""
    light, _ = _painted(name)
    return np.ascontiguousarray(np.maximum(light, 0.0).transpose(1, 2, 0), np.float32)


@lru_cache(maxsize=1)
def _drawn(name: str) -> NDArray[np.uint8]:
    """Draw a picture, once for all frames of its clip."""
    return _encode(*_painted(name))


def _painted(name: str) -> tuple[Float, _Draws]:
    """Paint the light of a picture; a number has one spelling, so that a picture has one name."""
    match = re.fullmatch(r"(.*)-(?:0|[1-9][0-9]*)", name)
    if match is None or match[1] not in KINDS:
        raise ValueError(
            f"synthetic picture {name!r}: expected <kind>-<number>, the kind one of {', '.join(KINDS)} "
            "and the number 0 or more without leading zeros"
        )
    draws, (height, width) = _Draws(name), SIZES.get(name, DEFAULT_SIZE)
    return PAINTERS[match[1]](draws, height, width), draws


class _Draws:
    """Random stream of one picture: raw Philox words, since NumPy may change its distributions."""

    def __init__(self, name: str) -> None:
        digest = hashlib.blake2b(name.encode("utf-8"), digest_size=16).digest()
        self._philox = np.random.Philox(key=int.from_bytes(digest, "little"))

    def below(self, bound: int, count: int) -> NDArray[np.int64]:
        """Draw ``count`` integers from 0 to ``bound`` - 1."""
        words = self._philox.random_raw(count) >> np.uint64(32)
        return ((words * np.uint64(bound)) >> np.uint64(32)).astype(np.int64)

    def between(self, low: float, high: float, *shape: int) -> Float:
        """Draw float64 in [``low``, ``high``)."""
        words = self._philox.random_raw(int(np.prod(shape))) >> np.uint64(11)
        return low + (high - low) * (words.astype(np.float64) / float(1 << 53)).reshape(shape)

    def octets(self, shape: tuple[int, ...]) -> Float:
        """Draw float64 multiples of 1/256 in [0, 1), eight per random word: cheap enough for every pixel."""
        size = int(np.prod(shape))
        words = self._philox.random_raw(-(-size // 8)).astype("<u8")
        return words.view(np.uint8)[:size].reshape(shape) / 256.0


def _encode(light: Float, draws: _Draws) -> NDArray[np.uint8]:
    """Convert linear light ``[3, H, W]`` to codes ``[H, W, 3]``, with dither below one code step against banding.

    A value that equals a code keeps it: flat patches stay flat, black stays 0 and white 255.
    """
    codes = np.sqrt(_unit(light)) * 255.0 + draws.octets(light.shape)
    return np.ascontiguousarray(np.floor(codes).astype(np.uint8).transpose(1, 2, 0))


def _colour(*light: float) -> Float:
    """Linear R, G, B as ``[3, 1, 1]``."""
    return np.array(light)[:, None, None]


def _unit(value: Float) -> Float:
    return np.minimum(np.maximum(value, 0.0), 1.0)


def _smooth(value: Float) -> Float:
    """Cubic from 0 to 1 with zero slope at both ends."""
    t = _unit(value)
    return t * t * (3.0 - 2.0 * t)


def _cover(canvas: Float, light: Float, alpha: Float) -> None:
    """Blend ``light`` over ``canvas`` ``[3, H, W]`` by ``alpha`` ``[H, W]`` in 0 .. 1."""
    canvas += (light - canvas) * alpha


def _noise(draws: _Draws, height: int, width: int, cell: tuple[int, int]) -> Float:
    """Value noise ``[H, W]`` in [-1, 1] on a lattice of ``cell`` = (rows, columns) pixels."""
    lattice = draws.between(-1.0, 1.0, height // cell[0] + 2, width // cell[1] + 2)
    return _stretch(_stretch(lattice, height, cell[0]).T, width, cell[1]).T


def _stretch(lattice: Float, length: int, cell: int) -> Float:
    """Interpolate the first axis of ``lattice`` to ``length`` samples, ``cell`` of them between two points."""
    position = np.arange(length)
    low = position // cell
    weight = _smooth((position % cell) / float(cell))[:, None]
    return lattice[low] + (lattice[low + 1] - lattice[low]) * weight


# Dead leaves: opaque shapes with power-law sizes that occlude one another, the classic model of natural images.

LEAVES = np.array([0x804A26, 0xAB6C2F, 0xC49246, 0x6E3422, 0x943C28, 0x5C6030, 0x3A562E, 0xD6BA84, 0x3A2822, 0xECDEBE])
"""Codes of the leaves, from dark brown to cream, as 24-bit R, G, B."""


class _Leaf(NamedTuple):
    """Leaf: centre, half length, width over length, direction ``(ux, uy)`` and contrast of texture."""

    y: float
    x: float
    radius: float
    slim: float
    ux: float
    uy: float
    contrast: float


def _dead_leaves(draws: _Draws, height: int, width: int) -> Float:
    """Draw large leaves first, so that no gap is left, then all sizes."""
    large, count = height * width // 2600, height * width // 2600 + height * width // 210
    low = np.where(np.arange(count) < large, 45.0, 4.5)
    # density 1/r³: every octave covers the same area, and the inverse needs a square root only
    radii = 1.0 / np.sqrt(1.0 / 16900.0 + (1.0 / (low * low) - 1.0 / 16900.0) * draws.between(0.0, 1.0, count))
    slope = draws.between(-1.0, 1.0, count)
    norm = 1.0 + slope * slope
    places = draws.between(0.0, float(height), count), draws.between(0.0, float(width), count)
    direction = (1.0 - slope * slope) / norm, 2.0 * slope / norm
    columns = *places, radii, draws.between(0.45, 1.0, count), *direction, draws.between(-0.16, 0.16, count)
    shown = (LEAVES[draws.below(len(LEAVES), count), None] >> np.array([16, 8, 0]) & 255) / 255.0
    colours = shown * shown * draws.between(0.25, 1.25, count, 1) * draws.between(0.85, 1.15, count, 3)
    texture = _noise(draws, height, width, (3, 3)) + _noise(draws, height, width, (11, 11))
    canvas = np.full((3, height, width), 0.02)
    for row, colour in zip(zip(*(column.tolist() for column in columns), strict=True), colours, strict=True):
        _drop(canvas, texture, _Leaf(*row), colour)
    return canvas - 0.004


def _drop(canvas: Float, texture: Float, leaf: _Leaf, colour: Float) -> None:
    """Draw one lens-shaped leaf: it darkens the surroundings of its rim and hides what is below it."""
    reach = leaf.radius * 1.45
    top, left = max(0, int(leaf.y - reach)), max(0, int(leaf.x - reach))
    window = (slice(top, int(leaf.y + reach) + 2), slice(left, int(leaf.x + reach) + 2))
    below, grain = canvas[:, *window], texture[window]
    dy = (np.arange(top, top + grain.shape[0]) - leaf.y)[:, None] / leaf.radius
    dx = (np.arange(left, left + grain.shape[1]) - leaf.x)[None, :] / leaf.radius
    along, across = dx * leaf.ux + dy * leaf.uy, (dy * leaf.ux - dx * leaf.uy) / leaf.slim
    level = along * along + np.abs(across)  # 1 at the rim
    below *= 1.0 - 0.5 * _unit((1.9 - level) / 0.9)
    gain = 1.0 - 0.2 * dx - 0.28 * dy + leaf.contrast * grain
    _cover(below, gain * _colour(*colour), _unit((1.0 - level) * (leaf.radius * leaf.slim * 0.5) + 0.5))


# Colour chart: patches of all hues, ramps of gray and of dark gray, bars and a zone plate on a dark board.

BAR_PERIODS = (24, 18, 14, 10, 8, 6, 5, 4, 3, 2)


def _colour_chart(draws: _Draws, height: int, width: int) -> Float:
    y, x = np.ogrid[0.0:height, 0.0:width]
    canvas = 0.2 + 0.02 * _noise(draws, height, width, (2, 2)) + np.zeros((3, 1, 1))
    margin = width // 16
    canvas[:, margin // 2 : height - margin // 2, margin : width - margin] = 0.012
    left, right = margin + 18, width - margin - 18
    ramps, bars, bottom = height * 5 // 8, height * 3 // 4, height - margin // 2 - 12
    _patches(canvas[:, margin // 2 + 12 : ramps - 8, left:right], draws)
    t = np.arange(right - left) / float(right - left - 1)
    canvas[:, ramps : ramps + 26, left:right] = t * t
    canvas[:, ramps + 32 : bars - 8, left:right] = t * t * 0.02
    side = bottom - bars
    groups = np.arange(right - left - side - 10) * len(BAR_PERIODS) // (right - left - side - 10)
    periods = np.array(BAR_PERIODS)[groups]
    is_black = np.arange(len(periods)) % periods < periods // 2
    canvas[:, bars:bottom, left : right - side - 10] = np.where(is_black, 0.004, 0.8)
    dy, dx = y[:side] - side / 2, x[:, :side] - side / 2
    phase = (dx * dx + dy * dy) / (2.0 * side)
    wave = 4.0 * (phase - np.floor(phase)) * (1.0 - phase + np.floor(phase))  # parabolas that look like a sine
    canvas[:, bars:bottom, right - side : right] = 0.02 + 0.78 * wave * wave
    dy, dx = (y / height - draws.between(0.3, 0.6, 1)), (x / width - draws.between(0.25, 0.75, 1))
    warm = float(draws.between(-0.05, 0.05, 1)[0])
    return canvas * _colour(1.0 + warm, 1.0, 1.0 - warm) * (1.12 / (1.0 + 0.45 * (dx * dx + dy * dy)))


def _patches(canvas: Float, draws: _Draws) -> None:
    """Draw 6 x 4 patches: three rows of hues, pure, pale and dark, in random order, and a row of grays."""
    hues = np.array([(1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1), (1, 0, 1)], dtype=np.float64)
    rows = [low + (high - low) * hues for low, high in ((0.02, 0.75), (0.3, 0.6), (0.01, 0.12))]
    hue_patches = np.concatenate(rows) * draws.between(0.7, 1.0, 18, 3)
    grays = np.repeat([(0.9,), (0.5,), (0.25,), (0.1,), (0.04,), (0.015,)], 3, axis=1)
    order = np.argsort(draws.between(0.0, 1.0, 18), kind="stable")
    for i, light in enumerate(np.concatenate([hue_patches[order], grays])):
        row, column = divmod(i, 6)
        y0, y1 = (canvas.shape[1] * (row + k) // 4 for k in (0, 1))
        x0, x1 = (canvas.shape[2] * (column + k) // 6 for k in (0, 1))
        canvas[:, y0 + 5 : y1 - 5, x0 + 5 : x1 - 5] = _colour(*light)


# Highlights: colours driven past what a display can show, one channel at a time or all three.

SUN = (3.0 / 7.0, -6.0 / 7.0, 2.0 / 7.0)
"""Unit vector towards the sun, in rationals: right, up and to the viewer (y points down)."""

BALLS = (
    *((1.05, 0.055, 0.055), (0.05, 0.85, 0.12), (0.05, 0.12, 1.05), (1.0, 0.72, 0.02), (0.95, 0.05, 0.62)),
    *((0.02, 0.75, 0.95), (0.006, 0.006, 0.007)),
)
"""Colours of the balls in full light; a display shows the red one as about (255, 60, 60)."""

PLACES = ((0.60, 0.22, 0.085), (0.57, 0.43, 0.075), (0.61, 0.66, 0.085), (0.78, 0.33, 0.125), (0.76, 0.57, 0.12),
          (0.84, 0.80, 0.14), (0.87, 0.12, 0.13))  # fmt: skip
"""Row, column and radius of the balls, as fractions of the sides."""


def _highlights(draws: _Draws, height: int, width: int) -> Float:
    """Draw a sky from blue to white with clipped clouds and the sun, and glossy balls on a dark wooden table."""
    y, x = np.ogrid[0.0:height, 0.0:width]
    horizon = height * 7 // 16
    t = _unit(y / horizon)
    canvas = _colour(0.10, 0.26, 0.68) + _colour(0.62, 0.58, 0.27) * t * (0.4 + 0.6 * t) + np.zeros((height, width))
    cloud = np.zeros((height, width))
    for cell in (60, 24, 10, 4):
        cloud += _noise(draws, height, width, (cell, 2 * cell)) * (cell / 60.0)
    _cover(canvas, _colour(1.02, 1.0, 0.98), 0.95 * _smooth((cloud - 0.05) / 0.9))
    dy, dx = y / height - draws.between(0.14, 0.22, 1), (x / width - draws.between(0.72, 0.86, 1)) * 1.5
    square = (dx * dx + dy * dy) * 490.0
    canvas += _colour(1.0, 0.93, 0.75) * (5.0 / (1.0 + square * square) + 0.5 / (1.0 + square / 6.0))
    near = (y[horizon:] - horizon) / float(height - horizon)
    grain = 1.0 + 0.22 * _noise(draws, height, width, (3, 120)) + 0.12 * _noise(draws, height, width, (9, 60))
    canvas[:, horizon:] = _colour(0.16, 0.075, 0.035) * (grain[horizon:] * (0.1 + near))
    order = np.argsort(draws.between(0.0, 1.0, len(BALLS)), kind="stable")
    for which, (row, column, size) in zip(order.tolist(), PLACES, strict=True):
        _ball(canvas, (y - row * height) / (size * height), (x - column * width) / (size * height), BALLS[which])
    return canvas


def _ball(canvas: Float, y: Float, x: Float, colour: tuple[float, ...]) -> None:
    """Draw a glossy ball and its shadow away from the sun; ``y`` and ``x`` are in radii from its centre."""
    down, aside = (y - 0.86) / 0.36, (x + 0.62) / 1.25
    shadow = down * down + aside * aside
    canvas *= 1.0 - 0.9 / (1.0 + shadow * shadow)
    square = x * x + y * y
    z = np.sqrt(np.maximum(1.0 - square, 0.0))
    lit = x * SUN[0] + y * SUN[1] + z * SUN[2]
    gloss = 1.0 - (lit + z) / np.sqrt(2.0 + 2.0 * SUN[2])
    spark = 1.0 / (1.0 + 220.0 * np.maximum(gloss, 0.0))
    diffuse = 0.10 + 1.15 * np.maximum(lit, 0.0) + 0.22 * np.maximum(y, 0.0)
    shown = _colour(*colour) * diffuse + 3.0 * spark * spark * spark
    _cover(canvas, shown, _unit((1.0 - square) * 30.0 + 0.5))


PAINTERS = dict(zip(KINDS, (_dead_leaves, _colour_chart, _highlights), strict=True))
