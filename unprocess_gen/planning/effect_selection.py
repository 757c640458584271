"""Which effects a scene calls for: what each contributes, what hides it, and the decision, in words with numbers.

An effect is predicted in every statistic it acts on: single pixels, row means, column means, the mean of a colour
plane, each of one frame and of the mean over a clip's frames, where patterns of the body stay and noise does not; as
what differs between them at random, and as an offset that all share. Each prediction is divided by the noise
that would hide it there, that of the effects that stay on, at the lowest and at the highest signal that the image can
have: in between no sum of them is larger. Under ``auto`` effects are left out, from the weakest on, as long as all that
is left out stays within the tolerance in each statistic; random parts add in quadrature, offsets as they are (the idea
is imSim's: thresholds in units of the noise). Hot and dead pixels that stand out by more than a standard deviation are
too rare for that and counted instead: they are called for where 0.1 of them are expected in a frame.

All arithmetic here is + - × ÷ √ and `decimal`, and of the pixels only whole numbers are known (`records.Facts`): the
decision is the same on every machine and in every tier.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from decimal import Decimal, localcontext

import numpy as np

from unprocess_gen.config.interpretation import (
    EFFECT_NUMBERS,
    effect_switch,
    is_normalised,
    is_physical,
    missing_number,
)
from unprocess_gen.config.schema import Config
from unprocess_gen.core.tone_curves import linear_table
from unprocess_gen.core.types import Facts, Physics, Srgb
from unprocess_gen.simulation.reference import colour
from unprocess_gen.simulation.reference.noise import EFFECTS

CALLED_COUNT = 0.1
"""Rare outliers are simulated where this many are expected in a frame."""

STATISTICS = (
    *("pixel", "row mean", "column mean", "plane mean"),
    *("clip's pixel", "clip's row", "clip's column", "clip's plane"),
)
"""Of one frame; then the same of the mean over all frames of a clip. A photograph is a clip of one."""

FIXED = frozenset({"prnu", "hot_pixels", "column", "black_error", "dead_pixels"})
"""Patterns of the body, which a clean frame can have too: nothing but its rounding hides them there."""

BEFORE_WELL = frozenset({"prnu", "shot", "dark_current", "hot_pixels"})
"""What a full well cuts."""

COST_NS = {
    "heteroscedastic": 1.8, "prnu": 3.3, "shot": 9.5, "dark_current": 15.5, "hot_pixels": 1.0, "full_well": 0.1,
    "read": 1.8, "row": 0.1, "column": 0.1, "black_error": 0.1, "dead_pixels": 1.1, "quantise": 0.3,
}  # fmt: skip
"""What an effect costs, nanoseconds a pixel, as measured on one machine with AVX2 (`tests/bench_scenes.py`).

Shown, and never decided by. Shot noise: 4 where a pixel has many electrons, 15 below 6, as dark current. PRNU: of a
body that was not seen just before. 0.1: less than could be measured.
"""


def facts_of(srgb: Srgb, frames: int = 1) -> Facts:
    """Return the whole numbers that a plan may know of decoded pixels, ``[H, W, 3]``, of a clip of ``frames``."""
    height, width = srgb.shape[:2]
    return Facts(width, height, int(np.iinfo(srgb.dtype).max) + 1, int(srgb.min()), int(srgb.max()), frames)


def facts_for(config: Config, srgb: Srgb, frames: int = 1) -> Facts | None:
    """Return `facts_of` where the plan asks for them: of a physical profile."""
    return facts_of(srgb, frames) if is_physical(config.noise) else None


@dataclass(frozen=True, slots=True)
class Light:
    """Limits of what the sensor can see of an image, DN above black: no site is darker or brighter."""

    dark_dn: float
    bright_dn: float


def light_of(
    facts: Facts,
    tone: str,
    gamma: float | str,
    gains: tuple[float, float, float],
    exposure: float,
    span_dn: float,
    rgb2cam: colour.Matrix = colour.IDENTITY,
) -> Light:
    """Return limits for any colour made of codes between the lowest and the highest of the image.

    Whatever is done about highlights, light i comes to at least k·i and at most i·max(1, k) behind an inverse gain k.
    """
    curve = linear_table(tone, gamma, facts.codes)
    low, high = float(curve[facts.dark_code]), float(curve[facts.bright_code])
    rows = [rgb2cam[at : at + 3] for at in (0, 3, 6)]
    lowest = min(sum(one * (low if one > 0 else high) for one in row) * k for row, k in zip(rows, gains, strict=True))
    highest = max(
        sum(one * (high if one > 0 else low) for one in row) * max(k, 1.0) for row, k in zip(rows, gains, strict=True)
    )
    return Light(max(min(lowest * exposure, 1.0), 0.0) * span_dn, min(highest * exposure, 1.0) * span_dn)


@dataclass(frozen=True, slots=True)
class Prediction:
    """What was decided about one effect, and why.

    ``predicted_dn`` and ``hidden_dn``: its size in the statistic where it shows best, and what hides it there.
    ``outliers``: how many pixels are expected to stand out by more than a standard deviation in a frame. ``why``: the
    comparison, or what the settings say where it is not the image that decides (``said``).
    """

    effect: str
    statistic: str
    predicted_dn: float
    hidden_dn: float
    outliers: float
    simulated: bool
    said: bool
    why: str

    @property
    def reason(self) -> str:
        """What a manifest says of an effect that is skipped."""
        if self.said:
            return self.why
        return f"{self.predicted_dn:.3g} DN in the {self.statistic} are {self.why}"

    @property
    def ratio(self) -> float:
        """The prediction in units of the noise that hides it."""
        return _over(self.predicted_dn, self.hidden_dn)


def _over(size: float, noise: float) -> float:
    return size / noise if noise else math.inf if size else 0.0


def decide(config: Config, physics: Physics, facts: Facts, light: Light) -> tuple[Prediction, ...]:
    """Return a prediction for every effect of a physical profile, in the order light meets them."""
    said = {effect: _said(config, effect) for effect in EFFECTS}
    scene = Scene(physics, facts, light, float(config.sensor.black_level_dn))
    free = [effect for effect, one in said.items() if one is None]
    on = frozenset([*free, *(effect for effect, one in said.items() if one is not None and one.on)])
    on = leave_out(config.effects.tolerance, scene, on, free)
    return tuple(_prediction(effect, scene, on, said[effect], config.effects.tolerance) for effect in EFFECTS)


NOT_ROUNDED = "float output is not rounded"
"""Why frames in float32 do not have ``quantise``."""


@dataclass(frozen=True, slots=True)
class Said:
    """What the settings decide about an effect, and why."""

    on: bool
    reason: str


def _said(config: Config, effect: str) -> Said | None:
    """Return what the settings decide about an effect; None where the image must decide."""
    switch = effect_switch(config.effects, effect)
    if effect == "quantise":
        return (
            Said(False, NOT_ROUNDED)
            if is_normalised(config)
            else Said(True, "integer output is always rounded and clipped")
        )
    if switch == "off":
        return Said(False, "switched off")
    number = missing_number(config.noise, effect)
    if number is not None:
        return Said(False, f"noise={config.noise.name} gives no {number}")
    if switch == "on":
        return Said(True, "switched on")
    assumed = next((key for key in EFFECT_NUMBERS.get(effect, ()) if key in config.noise.assumed), None)
    if assumed is not None:
        return Said(False, f"{assumed} is assumed, no source gives it: on only where switched on")
    return None


Sizes = tuple[float, ...]
"""A value for each of `STATISTICS`."""


@dataclass(frozen=True, slots=True)
class Size:
    """What an effect contributes: variances in DN² for each of `STATISTICS`, and an offset in DN that all share."""

    variances: Sizes
    offset_dn: float = 0.0


@dataclass(frozen=True, slots=True)
class Scene:
    """What predictions are made from: the sensor's numbers, the frame's size, how bright it is, the black level."""

    physics: Physics
    facts: Facts
    light: Light
    black_level_dn: float

    def levels(self, on: frozenset[str]) -> tuple[float, float]:
        """Return the signals at which effects are judged, DN above black."""
        full_dn = self.physics.full_well_e * self.physics.dn_per_e if "full_well" in on else math.inf
        return min(self.light.dark_dn, full_dn), min(self.light.bright_dn, full_dn)

    @property
    def counts(self) -> Sizes:
        """Return how many sites each statistic is a mean over."""
        width, height, frames = self.facts.width, self.facts.height, float(self.facts.frames)
        counts = 1.0, float(width), float(height), float((width + 1) // 2 * ((height + 1) // 2))
        return *counts, *(count * frames for count in counts)

    def hiding_variance(self, effect: str, level_dn: float, on: frozenset[str]) -> float:
        """Return the variance of a pixel at a signal, DN², of the random effects that are on, but for the effect."""
        rounding = QUANTISATION_VARIANCE if "quantise" in on - {effect} else 0.0
        if effect in FIXED and self.physics.fixed_pattern_in_clean:
            return rounding
        return rounding + sum(VARIANCES[one](self.physics, level_dn) for one in VARIANCES if one in on - {effect})

    def ratios(self, effects: Iterable[str], level_dn: float, on: frozenset[str]) -> Sizes:
        """Return what effects come to together in each statistic, over the noise that hides it there."""
        squares, offsets = [0.0] * len(STATISTICS), [0.0] * len(STATISTICS)
        before_well = 0.0
        for effect in effects:
            hiding = self.hiding_variance(effect, level_dn, on)
            size = SIZES[effect](self, level_dn, hiding)
            before_well += size.variances[0] if effect in BEFORE_WELL else 0.0
            for at, count in enumerate(self.counts):
                squares[at] += _over(size.variances[at] * count, hiding)
                offsets[at] += _over(abs(size.offset_dn) * math.sqrt(count), math.sqrt(hiding))
        if before_well and "full_well" in on:
            hiding = self.hiding_variance("full_well", level_dn, on)
            lost_dn = self.lost_in_well(before_well, level_dn, on)
            for at, count in enumerate(self.counts):
                offsets[at] += lost_dn * math.sqrt(_over(count, hiding)) if lost_dn else 0.0
        return tuple(math.sqrt(square + offset * offset) for square, offset in zip(squares, offsets, strict=True))

    def lost_in_well(self, variance: float, level_dn: float, on: frozenset[str]) -> float:
        """Return by how much more variance before a full well lowers the mean of what comes out, DN.

        At a signal that fills it the half above is cut: of a normal, σ/√(2π).
        """
        if SIZES["full_well"](self, level_dn, 0.0).offset_dn == 0:
            return 0.0
        other = sum(VARIANCES[one](self.physics, level_dn) for one in VARIANCES if one in on & BEFORE_WELL)
        return MEAN_ABS_NORMAL / 2 * (math.sqrt(other + variance) - math.sqrt(other))

    def ratio(self, effects: Sequence[str], on: frozenset[str]) -> float:
        """Return the largest of `ratios`, at whichever level."""
        return max(max(self.ratios(effects, level_dn, on)) for level_dn in self.levels(on))

    def outliers(self, effect: str, on: frozenset[str]) -> float:
        """Return how many outliers above one standard deviation an effect is expected to leave in a frame."""
        if effect not in OUTLIERS:
            return 0.0
        shares = (OUTLIERS[effect](self, level, self.hiding_variance(effect, level, on)) for level in self.levels(on))
        return self.facts.width * self.facts.height * max(shares)


def leave_out(tolerance: float, scene: Scene, on: frozenset[str], free: Sequence[str]) -> frozenset[str]:
    """Return the effects that stay on when of the ``free`` ones the weakest are left out, together.

    The first that cannot be left out ends it. So a greater tolerance never simulates more.
    """

    def strength(effect: str) -> tuple[bool, float, str]:
        return scene.outliers(effect, on) >= CALLED_COUNT, scene.ratio([effect], on - {effect}), effect

    left_out: list[str] = []
    for effect in sorted(free, key=strength):
        left_out.append(effect)
        rest = on - {effect}
        if any(scene.outliers(one, rest) >= CALLED_COUNT for one in left_out):
            break
        if scene.ratio(left_out, rest) > tolerance:
            break
        on = rest
    return on


def _prediction(effect: str, scene: Scene, on: frozenset[str], said: Said | None, tolerance: float) -> Prediction:
    """Describe an effect at the level and in the statistic where it shows best; of equals, in the plainest."""
    level_dn = max(scene.levels(on - {effect}), key=lambda level: max(scene.ratios([effect], level, on)))
    ratios = scene.ratios([effect], level_dn, on)
    at = next(n for n, ratio in enumerate(ratios) if ratio >= max(ratios) * (1 - 1e-9))
    hiding = scene.hiding_variance(effect, level_dn, on)
    size = SIZES[effect](scene, level_dn, hiding)
    predicted_dn = math.sqrt(size.variances[at] + size.offset_dn * size.offset_dn)
    simulated, outliers = effect in on, scene.outliers(effect, on)
    why = f"{ratios[at]:.3g} of the noise there"
    if effect in OUTLIERS:
        why += f", {outliers:.3g} outliers"
    if simulated and ratios[at] <= tolerance and outliers < CALLED_COUNT:
        why += ", too much beside what is left out"
    why += f" (tolerance {tolerance:g})"
    hidden_dn = math.sqrt(hiding / scene.counts[at])
    return Prediction(
        effect, STATISTICS[at], predicted_dn, hidden_dn, outliers, simulated, bool(said), said.reason if said else why
    )


# -------------------------------------------------------------------------------------------------- the predictions

QUANTISATION_VARIANCE = 1 / 12

VARIANCES: dict[str, Callable[[Physics, float], float]] = {
    "shot": lambda physics, level_dn: physics.dn_per_e * level_dn,
    "dark_current": lambda physics, level_dn: physics.dn_per_e * physics.dn_per_e * physics.dark_e,
    "read": lambda physics, level_dn: physics.read_std_dn * physics.read_std_dn,
}
"""What hides: the random effects of single pixels, DN² at a signal in DN above black."""


def _independent(scene: Scene, variance: float, offset_dn: float = 0.0, fixed_variance: float = 0.0) -> Size:
    """Return the size of what differs from pixel to pixel, beside an offset that they share.

    ``variance`` is of what is new in every frame, ``fixed_variance`` of what stays.
    """
    frames = scene.counts[: len(scene.counts) // 2]
    return Size(
        tuple(
            variance / count + fixed_variance / sites
            for count, sites in zip(scene.counts, (*frames, *frames), strict=True)
        ),
        offset_dn,
    )


def _prnu(scene: Scene, level_dn: float, hiding: float) -> Size:
    """As a change of the shot noise's mean: nearby Poisson counts differ by √(|Δλ| + Δλ²) even at common uniforms."""
    physics = scene.physics
    change_e = physics.prnu_std * level_dn / physics.dn_per_e
    squared = physics.dn_per_e * physics.dn_per_e
    return _independent(scene, squared * MEAN_ABS_NORMAL * change_e, fixed_variance=squared * change_e * change_e)


MEAN_ABS_NORMAL = 0.7978845608028654
"""√(2/π): the mean distance of a standard normal from 0."""


def _shot(scene: Scene, level_dn: float, hiding: float) -> Size:
    return _independent(scene, VARIANCES["shot"](scene.physics, level_dn))


def _dark_current(scene: Scene, level_dn: float, hiding: float) -> Size:
    physics = scene.physics
    offset_dn = physics.dn_per_e * physics.dark_e if physics.dark_offset == "kept" else 0.0
    return _independent(scene, VARIANCES["dark_current"](physics, level_dn), offset_dn)


def _hot_pixels(scene: Scene, level_dn: float, hiding: float) -> Size:
    """A Poisson count whose mean is exponentially distributed about m has the mean square m + 2m²."""
    physics = scene.physics
    mean_dn = physics.dn_per_e * physics.hot_pixel_e
    mean_square = (physics.dn_per_e + 2 * mean_dn) * mean_dn
    return _inconspicuous(scene, physics.hot_pixel_share, mean_dn, mean_square, hiding)


def _dead_pixels(scene: Scene, level_dn: float, hiding: float) -> Size:
    """They read 0, which is below black."""
    depth_dn = scene.black_level_dn + level_dn
    return _inconspicuous(scene, scene.physics.dead_pixel_share, depth_dn, depth_dn * depth_dn, hiding)


def _inconspicuous(scene: Scene, share: float, mean_dn: float, mean_square: float, hiding: float) -> Size:
    """Return the size of rare pixels as far as they do not stand out: each up to one standard deviation."""
    fixed_variance = share * min(mean_square, hiding)
    return _independent(scene, 0.0, share * min(mean_dn, math.sqrt(hiding)), fixed_variance)


def _full_well(scene: Scene, level_dn: float, hiding: float) -> Size:
    """The most that any pixel can lose."""
    physics = scene.physics
    if physics.full_well_e == 0:
        return _independent(scene, 0.0)
    signal_e = level_dn / physics.dn_per_e * (1 + FARTHEST_NORMAL * physics.prnu_std)
    reach_e = sum(_reach(mean_e) for mean_e in (signal_e, physics.dark_e, FARTHEST_HOT * physics.hot_pixel_e))
    return _independent(scene, 0.0, max(reach_e - physics.full_well_e, 0.0) * physics.dn_per_e)


FARTHEST_NORMAL, FARTHEST_HOT = 6.4, 7.7
"""No normal and no hot pixel is drawn farther out (`tables`), in standard deviations and in means."""


def _reach(mean_e: float) -> float:
    """Return a number of electrons that no Poisson count of 2**32 is above."""
    return mean_e + 7 * math.sqrt(mean_e) + 12 if mean_e else 0.0


def _read(scene: Scene, level_dn: float, hiding: float) -> Size:
    return _independent(scene, VARIANCES["read"](scene.physics, level_dn))


def _row(scene: Scene, level_dn: float, hiding: float) -> Size:
    variance, height = scene.physics.row_std_dn * scene.physics.row_std_dn, scene.facts.height
    frame = variance, variance, variance / height, variance / max(height // 2, 1)
    return Size((*frame, *(one / scene.facts.frames for one in frame)))


def _column(scene: Scene, level_dn: float, hiding: float) -> Size:
    variance, width = scene.physics.column_std_dn * scene.physics.column_std_dn, scene.facts.width
    frame = variance, variance / width, variance, variance / max(width // 2, 1)
    return Size((*frame, *frame))


def _black_error(scene: Scene, level_dn: float, hiding: float) -> Size:
    return _independent(scene, 0.0, max(abs(error) for error in scene.physics.black_error_dn))


def _quantise(scene: Scene, level_dn: float, hiding: float) -> Size:
    return _independent(scene, QUANTISATION_VARIANCE)


SIZES: dict[str, Callable[[Scene, float, float], Size]] = {
    "prnu": _prnu,
    "shot": _shot,
    "dark_current": _dark_current,
    "hot_pixels": _hot_pixels,
    "full_well": _full_well,
    "read": _read,
    "row": _row,
    "column": _column,
    "black_error": _black_error,
    "dead_pixels": _dead_pixels,
    "quantise": _quantise,
}
"""The size of each effect at a signal in DN above black, where the noise that hides it has a variance in DN²."""


def _share_of_bright_hot_pixels(scene: Scene, level_dn: float, hiding: float) -> float:
    """Counts of exponentially distributed mean m are geometrically distributed: P(N >= k) = (m / (1 + m))**k."""
    physics = scene.physics
    least = math.floor(math.sqrt(hiding) / physics.dn_per_e) + 1
    with localcontext(prec=20):
        mean_e = Decimal(physics.hot_pixel_e)
        if not mean_e:
            return 0.0
        return float(Decimal(physics.hot_pixel_share) * (least * (mean_e / (1 + mean_e)).ln()).exp())


def _share_of_dead_pixels(scene: Scene, level_dn: float, hiding: float) -> float:
    depth_dn = scene.black_level_dn + level_dn
    return scene.physics.dead_pixel_share if depth_dn * depth_dn > hiding else 0.0


OUTLIERS: dict[str, Callable[[Scene, float, float], float]] = {
    "hot_pixels": _share_of_bright_hot_pixels,
    "dead_pixels": _share_of_dead_pixels,
}
"""The share of pixels that stand out by more than one standard deviation; arguments as for `SIZES`."""
