"""Predict the contribution of each sensor effect to the statistics of a frame, and the noise that masks it.

A contribution has a random part and an offset common to all pixels. Both are predicted in every statistic: single
pixels and row, column and colour-plane means, of one frame and of the mean over the frames of a clip. The mean over a
clip keeps fixed patterns and averages out temporal noise.

All arithmetic is + - × ÷ √ and `decimal`, and the pixels enter as integer facts only (`core.types.Facts`): predictions
are the same on every machine and in every tier. Derivations: ``docs/design/effect_selection.md``.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from decimal import Decimal, localcontext
from operator import add, mul
from typing import NamedTuple

import numpy as np

from unprocess_gen.core.tone_curves import linear_table
from unprocess_gen.core.types import Facts, Physics
from unprocess_gen.simulation.reference import colour
from unprocess_gen.simulation.reference.noise import illumination_at

STATISTICS = (
    *("pixel", "row mean", "column mean", "plane mean"),
    *("clip's pixel", "clip's row", "clip's column", "clip's plane"),
)
"""Statistics of one frame, then the same of the mean over the frames of a clip. A photograph is a clip of one frame.
Rows record these names."""

FIXED_PATTERNS = frozenset({"prnu", "hot_pixels", "column", "black_error", "dead_pixels"})
"""Effects that are the same in all frames of a camera body. Clean frames may contain them; then only the rounding of
the clean frame masks them."""

BEFORE_WELL = frozenset({"prnu", "shot", "dark_current", "hot_pixels"})
"""Effects that act before the full well limits the electrons of a pixel."""

QUANTISATION_VARIANCE = 1 / 12
"""Variance of rounding to integers, DN²."""

MEAN_ABS_NORMAL = 0.7978845608028654
"""Mean absolute value of a standard normal deviate, √(2/π)."""

SHADING_PLACES = 64
"""Squares of the distance from the centre at which lens shading is predicted."""

FARTHEST_NORMAL, FARTHEST_HOT = 6.4, 7.7
"""Largest normal deviate in standard deviations, and largest hot-pixel current in means, of a 32-bit uniform."""


@dataclass(frozen=True, slots=True)
class SignalRange:
    """Hold the lowest and highest signal that a site of an image can have, DN above black."""

    dark_dn: float
    bright_dn: float


def signal_range(
    facts: Facts,
    tone: str,
    gamma: float | str,
    gains: tuple[float, float, float],
    exposure: float,
    span_dn: float,
    rgb2cam: colour.Matrix = colour.IDENTITY,
) -> SignalRange:
    """Return the signal range of an image with any colours between its lowest and highest code.

    Every treatment of highlights maps light i to at least k·i and at most i·max(1, k), where k is the inverse gain.

    Parameters
    ----------
    facts : Facts
        Lowest and highest code of the image.
    tone, gamma : str, float or str
        Curves of the camera; see `tone_curves.linear_table`.
    gains : tuple of float
        Inverse gains k of red, green and blue.
    exposure : float
        Factor by which the scene is darkened.
    span_dn : float
        White level minus black level, DN.
    rgb2cam : Matrix
        Nine numbers, row by row, from linear sRGB to the camera.

    Returns
    -------
    SignalRange
        Limits within 0 and ``span_dn``.
    """
    curve = linear_table(tone, gamma, facts.codes)
    low, high = float(curve[facts.dark_code]), float(curve[facts.bright_code])
    lowest, highest = math.inf, -math.inf
    for channel, k in enumerate(gains):
        r, g, b = rgb2cam[3 * channel : 3 * channel + 3]
        least = r * (low if r > 0 else high) + g * (low if g > 0 else high) + b * (low if b > 0 else high)
        most = r * (high if r > 0 else low) + g * (high if g > 0 else low) + b * (high if b > 0 else low)
        lowest, highest = min(lowest, least * k), max(highest, most * max(k, 1.0))
    return SignalRange(max(min(lowest * exposure, 1.0), 0.0) * span_dn, min(highest * exposure, 1.0) * span_dn)


def ratio_to_noise(size: float, noise: float) -> float:
    """Return ``size / noise``; without noise, 0 for no size and infinity otherwise."""
    return size / noise if noise else math.inf if size else 0.0


def ratios_to_noise(sizes: Iterable[float], noise: float) -> list[float]:
    """Return `ratio_to_noise` of each size."""
    return [size / noise for size in sizes] if noise else [ratio_to_noise(size, noise) for size in sizes]


PerStatistic = Sequence[float]
"""One value for each of `STATISTICS`, or for the first half of them if there is one frame."""


class Contribution(NamedTuple):
    """Hold what an effect contributes: a variance in each statistic, DN², and an offset of all pixels, DN."""

    variances: PerStatistic
    offset_dn: float = 0.0


class FrameModel:
    """Hold what predictions depend on, and results that several predictions share.

    All frames of a photograph are one, so its statistics are the first half of `STATISTICS`; the other half would have
    the same values.

    Parameters
    ----------
    physics : Physics
        Numbers of the sensor.
    facts : Facts
        Size and number of frames.
    signals : SignalRange
        Signal range of the image.
    black_level_dn : float
        Black level of the sensor, DN.

    Attributes
    ----------
    per_frame, counts : PerStatistic
        Number of sites that each statistic is a mean of, in one frame and in all frames of the clip.
    roots : PerStatistic
        Square root of each of ``counts``.
    """

    def __init__(self, physics: Physics, facts: Facts, signals: SignalRange, black_level_dn: float) -> None:
        self.physics, self.facts, self.black_level_dn = physics, facts, black_level_dn
        width, height, frames = facts.width, facts.height, float(facts.frames)
        sites = 1.0, float(width), float(height), float((width + 1) // 2 * ((height + 1) // 2))
        self.per_frame: PerStatistic = sites if facts.frames == 1 else (*sites, *sites)
        self.counts: PerStatistic = (*sites, *(count * frames for count in self.per_frame[4:]))
        self.roots: PerStatistic = tuple(map(math.sqrt, self.counts))
        full_dn = physics.full_well_e * physics.dn_per_e
        self._levels = signals.dark_dn, signals.bright_dn
        self._levels_in_well = min(signals.dark_dn, full_dn), min(signals.bright_dn, full_dn)
        self._known: dict[tuple[str, float, float], _Ratios] = {}
        self._known_variances: dict[float, list[tuple[str, float]]] = {}

    def levels(self, on: frozenset[str]) -> tuple[float, float]:
        """Return the two signals at which effects are predicted, DN above black; between them no ratio is larger."""
        return self._levels_in_well if "full_well" in on else self._levels

    def masking_variance(self, effect: str, level_dn: float, on: frozenset[str]) -> float:
        """Return the variance of a pixel at a signal due to all random effects in ``on`` except ``effect``, DN²."""
        rounding = QUANTISATION_VARIANCE if "quantise" in on and effect != "quantise" else 0.0
        if effect in FIXED_PATTERNS and self.physics.fixed_pattern_in_clean:
            return rounding
        variance = 0.0
        for name, of_effect in self._variances(level_dn):
            if name in on and name != effect:
                variance += of_effect
        return rounding + variance

    def _variances(self, level_dn: float) -> list[tuple[str, float]]:
        """Return the variance of a pixel due to each of `VARIANCES` at a signal, DN²."""
        found = self._known_variances.get(level_dn)
        if found is None:
            found = [(name, of_physics(self.physics, level_dn)) for name, of_physics in VARIANCES.items()]
            self._known_variances[level_dn] = found
        return found

    def _ratios_of(self, effect: str, level_dn: float, masking: float) -> _Ratios:
        """Return the ratios of one effect to a masking noise at a signal."""
        known = self._known.get((effect, level_dn, masking))
        if known is None:
            contribution = CONTRIBUTIONS[effect](self, level_dn, masking)
            squares = ratios_to_noise(map(mul, contribution.variances, self.counts), masking)
            offset_dn, offsets = abs(contribution.offset_dn), None
            if offset_dn:
                offsets = ratios_to_noise([offset_dn * root for root in self.roots], math.sqrt(masking))
            known = _Ratios(contribution, squares, offsets)
            self._known[effect, level_dn, masking] = known
        return known

    def contribution(self, effect: str, level_dn: float, masking: float) -> Contribution:
        """Return what an effect contributes at a signal, where the other noise has the variance ``masking``, DN²."""
        return self._ratios_of(effect, level_dn, masking).contribution

    def ratios(self, effects: Iterable[str], level_dn: float, on: frozenset[str]) -> PerStatistic:
        """Return the ratio of several effects together to the masking noise, in each statistic.

        Variances add; offsets add linearly.
        """
        return tuple(map(math.sqrt, self._squares(effects, level_dn, on)))

    def _squares(self, effects: Iterable[str], level_dn: float, on: frozenset[str]) -> list[float]:
        """Return the square of each of `ratios`."""
        squares: list[float] = []
        offsets: list[float] | None = None
        before_well = 0.0
        for effect in effects:
            of_effect = self._ratios_of(effect, level_dn, self.masking_variance(effect, level_dn, on))
            squares = list(map(add, squares, of_effect.squares)) if squares else of_effect.squares
            if of_effect.offsets is not None:
                offsets = of_effect.offsets if offsets is None else list(map(add, offsets, of_effect.offsets))
            if effect in BEFORE_WELL:
                before_well += of_effect.contribution.variances[0]
        if before_well and "full_well" in on:
            masking = self.masking_variance("full_well", level_dn, on)
            lost_dn = self.lost_in_well(before_well, level_dn, on)
            if lost_dn:
                lost = [lost_dn * math.sqrt(ratio_to_noise(count, masking)) for count in self.counts]
                offsets = lost if offsets is None else list(map(add, offsets, lost))
        if offsets is None:
            return squares
        return [square + offset * offset for square, offset in zip(squares, offsets, strict=True)]

    def lost_in_well(self, variance: float, level_dn: float, on: frozenset[str]) -> float:
        """Return by how much ``variance`` before the full well lowers the mean signal behind it, DN.

        At a signal that fills the well the upper half of the distribution is cut, which lowers the mean of a normal
        distribution by σ/√(2π).
        """
        if self.contribution("full_well", level_dn, 0.0).offset_dn == 0:
            return 0.0
        other = 0.0
        for name, of_effect in self._variances(level_dn):
            if name in on and name in BEFORE_WELL:
                other += of_effect
        return MEAN_ABS_NORMAL / 2 * (math.sqrt(other + variance) - math.sqrt(other))

    def ratio(self, effects: Sequence[str], on: frozenset[str]) -> float:
        """Return the largest ratio of several effects together, over all statistics and both signals."""
        dark_dn, bright_dn = self.levels(on)
        return math.sqrt(max(*self._squares(effects, dark_dn, on), *self._squares(effects, bright_dn, on)))

    def outliers(self, effect: str, on: frozenset[str]) -> float:
        """Return the expected number of pixels per frame that an effect moves by more than one standard deviation."""
        if effect not in OUTLIERS:
            return 0.0
        shares = [OUTLIERS[effect](self, level, self.masking_variance(effect, level, on)) for level in self.levels(on)]
        return self.facts.width * self.facts.height * max(shares)


class _Ratios(NamedTuple):
    """Hold a contribution, and its ratios to the masking noise in each statistic.

    ``squares``: of its variances; ``offsets``: of its offset, None without one.
    """

    contribution: Contribution
    squares: list[float]
    offsets: list[float] | None


VARIANCES: dict[str, Callable[[Physics, float], float]] = {
    "shot": lambda physics, level_dn: physics.dn_per_e * level_dn,
    "dark_current": lambda physics, level_dn: physics.dn_per_e * physics.dn_per_e * physics.dark_e,
    "read": lambda physics, level_dn: physics.read_std_dn * physics.read_std_dn,
}
"""Variance of each random effect of single pixels, DN², at a signal in DN above black."""


def _independent(
    frame: FrameModel, variance: float, offset_dn: float = 0.0, fixed_variance: float = 0.0
) -> Contribution:
    """Return the contribution of an effect that is independent from pixel to pixel.

    ``variance``: of the part that is new in every frame; ``fixed_variance``: of the part that all frames share.
    """
    if fixed_variance:
        pairs = zip(frame.counts, frame.per_frame, strict=True)
        variances = [variance / count + fixed_variance / sites for count, sites in pairs]
    elif variance:
        variances = [variance / count for count in frame.counts]
    else:
        variances = [0.0] * len(frame.counts)
    return Contribution(variances, offset_dn)


def _prnu(frame: FrameModel, level_dn: float, masking: float) -> Contribution:
    """Predict PRNU as a change of the mean of the shot noise.

    Poisson counts of nearby means differ by √(|Δλ| + Δλ²) even for equal uniforms.
    """
    physics = frame.physics
    change_e = physics.prnu_std * level_dn / physics.dn_per_e
    squared = physics.dn_per_e * physics.dn_per_e
    return _independent(frame, squared * MEAN_ABS_NORMAL * change_e, fixed_variance=squared * change_e * change_e)


def _shot(frame: FrameModel, level_dn: float, masking: float) -> Contribution:
    return _independent(frame, VARIANCES["shot"](frame.physics, level_dn))


def _dark_current(frame: FrameModel, level_dn: float, masking: float) -> Contribution:
    physics = frame.physics
    offset_dn = physics.dn_per_e * physics.dark_e if physics.dark_offset == "kept" else 0.0
    return _independent(frame, VARIANCES["dark_current"](physics, level_dn), offset_dn)


def _hot_pixels(frame: FrameModel, level_dn: float, masking: float) -> Contribution:
    """Predict hot pixels: a Poisson count with exponentially distributed mean m has the mean square m + 2m²."""
    physics = frame.physics
    mean_dn = physics.dn_per_e * physics.hot_pixel_e
    mean_square = (physics.dn_per_e + 2 * mean_dn) * mean_dn
    return _inconspicuous(frame, physics.hot_pixel_share, mean_dn, mean_square, masking)


def _dead_pixels(frame: FrameModel, level_dn: float, masking: float) -> Contribution:
    """Predict dead pixels: they read 0 DN, which is below black."""
    depth_dn = frame.black_level_dn + level_dn
    return _inconspicuous(frame, frame.physics.dead_pixel_share, depth_dn, depth_dn * depth_dn, masking)


def _inconspicuous(frame: FrameModel, share: float, mean_dn: float, mean_square: float, masking: float) -> Contribution:
    """Return the contribution of rare pixels up to one standard deviation each; larger ones count as outliers."""
    fixed_variance = share * min(mean_square, masking)
    return _independent(frame, 0.0, share * min(mean_dn, math.sqrt(masking)), fixed_variance)


def _full_well(frame: FrameModel, level_dn: float, masking: float) -> Contribution:
    """Predict the full well by the most that any pixel can lose."""
    physics = frame.physics
    if physics.full_well_e == 0:
        return _independent(frame, 0.0)
    signal_e = level_dn / physics.dn_per_e * (1 + FARTHEST_NORMAL * physics.prnu_std)
    reach_e = _reach(signal_e) + _reach(physics.dark_e) + _reach(FARTHEST_HOT * physics.hot_pixel_e)
    return _independent(frame, 0.0, max(reach_e - physics.full_well_e, 0.0) * physics.dn_per_e)


def _reach(mean_e: float) -> float:
    """Return an upper limit of the Poisson counts of 2**32 uniforms, electrons."""
    return mean_e + 7 * math.sqrt(mean_e) + 12 if mean_e else 0.0


def _read(frame: FrameModel, level_dn: float, masking: float) -> Contribution:
    return _independent(frame, VARIANCES["read"](frame.physics, level_dn))


def _row(frame: FrameModel, level_dn: float, masking: float) -> Contribution:
    """Predict row offsets; correlation r divides the number of independent rows of a mean by (1 + r) / (1 - r)."""
    physics, height = frame.physics, frame.facts.height
    variance = physics.row_std_dn * physics.row_std_dn
    rows, rows_of_plane = float(height), float(max(height // 2, 1))
    if physics.row_correlation > 0:
        together = (1 + physics.row_correlation) / (1 - physics.row_correlation)
        rows, rows_of_plane = max(rows / together, 1.0), max(rows_of_plane / together, 1.0)
    return Contribution(_new_in_each_frame(frame, (variance, variance, variance / rows, variance / rows_of_plane)))


def _new_in_each_frame(frame: FrameModel, variances: tuple[float, float, float, float]) -> PerStatistic:
    """Return variances in one frame, followed by those in the mean of a clip."""
    frames = frame.facts.frames
    return variances if frames == 1 else (*variances, *(each / frames for each in variances))


def _of_columns(frame: FrameModel, std_dn: float) -> tuple[float, float, float, float]:
    """Return the variances of independent offsets of columns in the statistics of one frame."""
    variance, width = std_dn * std_dn, frame.facts.width
    return variance, variance / width, variance, variance / max(width // 2, 1)


def _column(frame: FrameModel, level_dn: float, masking: float) -> Contribution:
    per_frame = _of_columns(frame, frame.physics.column_std_dn)
    return Contribution(per_frame if frame.facts.frames == 1 else (*per_frame, *per_frame))


def _column_temporal(frame: FrameModel, level_dn: float, masking: float) -> Contribution:
    return Contribution(_new_in_each_frame(frame, _of_columns(frame, frame.physics.column_temporal_std_dn)))


def _lens_shading(frame: FrameModel, level_dn: float, masking: float) -> Contribution:
    """Predict lens shading by the light that the darkest place loses."""
    places = illumination_at(np.arange(SHADING_PLACES + 1) / SHADING_PLACES, frame.physics.lens_shading)
    return _independent(frame, 0.0, level_dn * float(1 - places.min()))


def _gain_by_colour(frame: FrameModel, level_dn: float, masking: float) -> Contribution:
    """Predict gains by colour as a change of the shot noise: the standard deviation differs by a factor √gain."""
    shot_dn = math.sqrt(VARIANCES["shot"](frame.physics, level_dn))
    most_dn = shot_dn * max(abs(math.sqrt(gain) - 1) for gain in frame.physics.gain_by_colour)
    return _independent(frame, most_dn * most_dn)


def _black_error(frame: FrameModel, level_dn: float, masking: float) -> Contribution:
    return _independent(frame, 0.0, max(abs(error) for error in frame.physics.black_error_dn))


def _quantise(frame: FrameModel, level_dn: float, masking: float) -> Contribution:
    return _independent(frame, QUANTISATION_VARIANCE)


CONTRIBUTIONS: dict[str, Callable[[FrameModel, float, float], Contribution]] = {
    "lens_shading": _lens_shading,
    "prnu": _prnu,
    "shot": _shot,
    "dark_current": _dark_current,
    "hot_pixels": _hot_pixels,
    "full_well": _full_well,
    "gain_by_colour": _gain_by_colour,
    "read": _read,
    "row": _row,
    "column": _column,
    "column_temporal": _column_temporal,
    "black_error": _black_error,
    "dead_pixels": _dead_pixels,
    "quantise": _quantise,
}
"""Contribution of each effect; arguments: frame, signal in DN above black, variance of the masking noise in DN²."""


def _share_of_bright_hot_pixels(frame: FrameModel, level_dn: float, masking: float) -> float:
    """Return the fraction of pixels that are hot and exceed one standard deviation.

    Counts with exponentially distributed mean m are geometrically distributed: P(N >= k) = (m / (1 + m))**k.
    """
    physics = frame.physics
    least = math.floor(math.sqrt(masking) / physics.dn_per_e) + 1
    return _share_of_counts(physics.hot_pixel_share, physics.hot_pixel_e, least)


@functools.lru_cache(maxsize=256)
def _share_of_counts(share: float, mean_e: float, least: int) -> float:
    """Return the fraction of pixels that are hot and have at least so many electrons."""
    with localcontext(prec=20):
        mean = Decimal(mean_e)
        if not mean:
            return 0.0
        return float(Decimal(share) * (least * (mean / (1 + mean)).ln()).exp())


def _share_of_dead_pixels(frame: FrameModel, level_dn: float, masking: float) -> float:
    depth_dn = frame.black_level_dn + level_dn
    return frame.physics.dead_pixel_share if depth_dn * depth_dn > masking else 0.0


OUTLIERS: dict[str, Callable[[FrameModel, float, float], float]] = {
    "hot_pixels": _share_of_bright_hot_pixels,
    "dead_pixels": _share_of_dead_pixels,
}
"""Fraction of pixels that an effect moves by more than one standard deviation; arguments as in `CONTRIBUTIONS`."""
