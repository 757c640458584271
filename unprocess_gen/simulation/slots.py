"""Define the slots of a noisy frame: what reference and kernels simulate, whatever effects ask for it.

An effect of the sensor fills one slot or more (`plan_slots`). Reference and kernels know the slots and no effect, so a
new effect that fits a slot touches neither. Light meets the slots in this order:

    light factor → electron factor → counts of light → counts of one rate → defects → limit of the well
    → gain by plane → noise of a site → offsets by row, column and plane → offsets by site → dead pixels

An empty slot has its default. Fixed patterns belong to a sensor unit; all frames that are simulated in one pass share
them (`Patterns`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from unprocess_gen.core.random_streams import Words, words


class RadialFactor(NamedTuple):
    """Factor on the light that depends on the distance from the centre of the frame.

    ``coefficients`` are those of r², r⁴ and r⁶, with r = 1 in the corners of a frame of ``frame_size``.
    """

    coefficients: tuple[float, float, float]
    frame_size: tuple[int, int]


class NormalPattern(NamedTuple):
    """Fixed value of each pixel of a sensor unit: max(mean + std·n, least) for a normal deviate n, float32."""

    body_key: int
    stream: int
    std: float
    mean: float = 0.0
    least: float = -math.inf


class BrightPixels(NamedTuple):
    """Share of the pixels of a sensor unit with additional electrons, chosen by words of ``stream``.

    Their means are exponentially distributed with mean ``mean_e``; words of draw 1 select them. Each frame has Poisson
    counts of these means, from words of the same stream.
    """

    body_key: int
    stream: int
    share: float
    mean_e: float


class DeadSlot(NamedTuple):
    """Share of the pixels of a sensor unit that read ``value_dn``, chosen by words of ``stream``."""

    body_key: int
    stream: int
    share: float
    value_dn: float = 0.0


class Patterns(NamedTuple):
    """Fixed patterns that all frames of a pass share."""

    light: RadialFactor | None = None  # in the clean frame too
    electrons: NormalPattern | None = None  # factor on the electrons of light, or on a clean frame's light
    sites_dn: NormalPattern | None = None  # offsets by site; the clean frame can contain them
    bright: BrightPixels | None = None
    dead: DeadSlot | None = None


class UnitWords(NamedTuple):
    """Random words of a sensor unit: their key and stream."""

    key: int
    stream: int


class FrameWords(NamedTuple):
    """Random words of a frame in one epoch: their key, stream, level, draw and frame."""

    key: int
    stream: int
    level: int
    draw: int
    frame: int


def draw_words(stream: UnitWords | FrameWords, shape: tuple[int, int], origin: tuple[int, int] = (0, 0)) -> Words:
    """Random words of a sensor unit or of a frame, [H, W]; ``origin`` is their place in the full frame."""
    numbers = stream._asdict()
    return words(numbers.pop("key"), numbers.pop("stream"), shape, origin=origin, **numbers)


class ColumnOffsets(NamedTuple):
    """Offsets of columns, DN: ``std_dn`` times normal deviates of these words."""

    words: UnitWords | FrameWords
    std_dn: float


class RowOffsets(NamedTuple):
    """Offsets of rows, DN: ``std_dn`` times normal deviates.

    Neighbouring rows have the correlation ``correlation`` (`reference.noise.autoregressive`), and deviates of
    ``words``. For independent rows, kernels use ``stream`` with the key and counters of the frame.
    """

    stream: int
    std_dn: float
    correlation: float = 0.0
    words: FrameWords | None = None


class UniformCounts(NamedTuple):
    """Poisson counts of the rate ``rate_e`` at every site, less ``removed_e``."""

    stream: int
    rate_e: float
    removed_e: float


class SiteNoise(NamedTuple):
    """Noise of each site: ``std_dn`` times a deviate of a quantile table (`lookup_tables.quantile_table`)."""

    stream: int
    std_dn: float
    distribution: str = "gaussian"
    shape: float = 0.0


class Slots(NamedTuple):
    """The filled slots of a frame; values by plane are of the sites (0, 0), (0, 1), (1, 0), (1, 1) of its tile."""

    black_dn: float
    dn_per_e: float
    patterns: Patterns = Patterns()
    light_stream: int = 0  # of the counts of light; 0 if the electrons are their mean
    uniform: UniformCounts | None = None
    full_well_e: float = math.inf  # of a plane whose relative gain is 1
    plane_gains: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)  # relative to dn_per_e
    noise: SiteNoise | None = None
    rows: RowOffsets | None = None
    fixed_columns: ColumnOffsets | None = None
    columns: ColumnOffsets | None = None
    planes_dn: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    has_site_offsets: bool = False  # of its own (`dark_frame.dark_frame_offsets`)

    @property
    def depends_on_epoch(self) -> bool:
        """True if a slot has words of the frame, so that each epoch has other slots."""
        return any(type(member) is FrameWords for slot in self if isinstance(slot, tuple) for member in slot)
