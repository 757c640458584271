"""Model a frame for the planner: the range of its signal, what effects contribute to it, and the noise that masks it.

All arithmetic is + - × ÷ √ and `decimal`, and the pixels enter as integers only (`simulation.facts.Facts`): predictions
are the same on every machine and in every tier. Derivations: ``docs/design/effect_selection.md``.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from operator import add, mul

from unprocess_gen.core.sequences import add_in_order
from unprocess_gen.simulation.effects import BY_NAME, EFFECTS
from unprocess_gen.simulation.effects.prediction import MEAN_ABS_NORMAL, Contribution, FrameFacts
from unprocess_gen.simulation.effects.quantise import VARIANCE_DN2
from unprocess_gen.simulation.facts import Facts
from unprocess_gen.simulation.plan import MOST_LIGHT, CameraPlan, IspPlan, Physics, SensorPlan, SourcePlan
from unprocess_gen.simulation.profiles import light_tables
from unprocess_gen.simulation.reference.colour import Matrix, from_primaries

MASKING = tuple(effect for effect in EFFECTS if effect.masks)
"""Random effects of single pixels, which mask others."""

FIXED, RARE, BEFORE_WELL = (
    frozenset(effect.name for effect in EFFECTS if getattr(effect, property_))
    for property_ in ("is_fixed", "has_outliers", "is_before_well")
)
"""Names of the effects with these properties; only of rare pixels the contribution depends on the masking noise."""


@dataclass(frozen=True, slots=True)
class SignalRange:
    """The lowest and highest signal that a site of an image can have, DN above black."""

    dark_dn: float
    bright_dn: float


def signal_range(facts: Facts, isp: IspPlan, camera: CameraPlan, exposure: float, span_dn: float) -> SignalRange:
    """Return the signal range of an image with any colours between its lowest and highest code, DN above black.

    Every treatment of highlights maps light i to at least k·i and at most i·max(1, k), where k is the inverse gain.
    """
    tables = light_tables(facts.profile, isp.tone, isp.gamma, facts.codes)
    ends = int(facts.dark_code), int(facts.bright_code)
    (r0, g0, b0), (r1, g1, b1) = ([float(table[code]) for table in tables] for code in ends)
    rgb2cam = from_primaries(camera.rgb2cam, facts.profile.to_srgb)
    lowest, highest = math.inf, -math.inf
    for channel, k in enumerate(camera.inverse_gains):
        r, g, b = rgb2cam[3 * channel : 3 * channel + 3]
        least = r * (r0 if r > 0 else r1) + g * (g0 if g > 0 else g1) + b * (b0 if b > 0 else b1)
        most = r * (r1 if r > 0 else r0) + g * (g1 if g > 0 else g0) + b * (b1 if b > 0 else b0)
        lowest, highest = min(lowest, least * k), max(highest, most * max(k, 1.0))
    return SignalRange(max(min(lowest * exposure, 1.0), 0.0) * span_dn, min(highest * exposure, 1.0) * span_dn)


def linear_signal_range(
    facts: Facts, matrix: Matrix, gains: tuple[float, float, float], exposure: float, sensor: SensorPlan
) -> SignalRange:
    """Return the signal range of a linear source between its lowest and highest value, DN above black.

    Light above white has noise too; the highest signal is the one at which the converter ends.
    """
    low, high = facts.dark_code, facts.bright_code
    most = min((sensor.limits_dn[1] - sensor.black_level_dn) / sensor.span_dn, MOST_LIGHT)
    lights = []
    for channel, gain in enumerate(gains):
        row = matrix[3 * channel : 3 * channel + 3]
        for is_least in (True, False):
            light = add_in_order(entry * (low if (entry > 0) == is_least else high) for entry in row)
            lights.append(min(max(light * (gain * exposure), 0.0), most) * sensor.span_dn)
    return SignalRange(min(lights), max(lights))


def raw_signal_range(facts: Facts, source: SourcePlan, exposure: float, span_dn: float) -> SignalRange:
    """Return the signal range of a raw source between its lowest and highest code in any plane, DN above black."""
    levels = list(zip(*source.code_levels, strict=True))
    lowest, highest = (
        choose((code - black) / (white - black) for black, white in levels)
        for choose, code in ((min, facts.dark_code), (max, facts.bright_code))
    )
    return SignalRange(*(min(max(min(light, 1.0) * exposure, 0.0), 1.0) * span_dn for light in (lowest, highest)))


class AtLevel:
    """Results at one signal that several predictions share: most images have the darkest signal 0."""

    def __init__(self) -> None:
        self.variances: list[tuple[str, float]] = []
        self.contributions: dict[tuple[str, float], tuple[Contribution, list[float]]] = {}
        self.squares: dict[tuple[tuple[str, ...], frozenset[str]], list[float]] = {}


class FrameModel(FrameFacts):
    """Predictions for a frame; effects are given by their names.

    ``at_dark`` has results of a model that differs in ``signals`` only, at the signal 0.
    """

    def __init__(
        self,
        physics: Physics,
        facts: Facts,
        signals: SignalRange,
        black_level_dn: float,
        converter_dn: float = math.inf,
        at_dark: AtLevel | None = None,
    ) -> None:
        super().__init__(physics, facts, black_level_dn, converter_dn)
        self._roots = tuple(map(math.sqrt, self.counts))
        full_dn = physics.full_well_e * physics.dn_per_e
        self._levels = signals.dark_dn, signals.bright_dn
        self._levels_in_well = min(signals.dark_dn, full_dn), min(signals.bright_dn, full_dn)
        self._known: dict[float, AtLevel] = defaultdict(AtLevel, {0.0: at_dark or AtLevel()})

    def levels(self, on: frozenset[str]) -> tuple[float, float]:
        """The two signals at which effects are predicted, DN above black; between them no ratio is larger."""
        return self._levels_in_well if "full_well" in on else self._levels

    def masking_variance(self, effect: str, level_dn: float, on: frozenset[str]) -> float:
        """Variance of a pixel at a signal due to all random effects in ``on`` except ``effect``, DN²."""
        rounding = VARIANCE_DN2 if "quantise" in on and effect != "quantise" else 0.0
        if self.physics.fixed_pattern_in_clean and effect in FIXED:
            return rounding
        variance = 0.0
        for name, effect_dn2 in self._variances_at(level_dn):
            if name in on and name != effect:
                variance += effect_dn2
        return rounding + variance

    def _variances_at(self, level_dn: float) -> list[tuple[str, float]]:
        """Variance of a pixel due to each of `MASKING` at a signal, DN²."""
        known = self._known[level_dn]
        if not known.variances:
            known.variances = [(effect.name, effect.variance(self, level_dn)) for effect in MASKING]
        return known.variances

    def contribution(self, effect: str, level_dn: float, masking: float) -> tuple[Contribution, list[float]]:
        """Contribution of an effect where the other noise has the variance ``masking``, and its variances by count."""
        contributions, key = self._known[level_dn].contributions, (effect, masking if effect in RARE else 0.0)
        known = contributions.get(key)
        if known is None:
            predicted = BY_NAME[effect].contribution(self, level_dn, masking)
            known = contributions[key] = predicted, [*map(mul, predicted.variances, self.counts)]
        return known

    def squares(self, effects: tuple[str, ...], level_dn: float, on: frozenset[str]) -> list[float]:
        """Square of the ratio of several effects together to the masking noise, in each statistic.

        Variances add; offsets add linearly.
        """
        known, key = self._known[level_dn].squares, (effects, on)
        if key not in known:
            known[key] = self._squares(effects, level_dn, on)
        return known[key]

    def _squares(self, effects: tuple[str, ...], level_dn: float, on: frozenset[str]) -> list[float]:
        squares: list[float] = []
        offsets: list[float] = []
        before_well = 0.0
        for effect in effects:
            masking = self.masking_variance(effect, level_dn, on)
            contribution, weighted = self.contribution(effect, level_dn, masking)
            own = _ratios(weighted, masking)
            squares = [*map(add, squares, own)] if squares else own
            if contribution.offset_dn:
                size = abs(contribution.offset_dn)
                own = _ratios([size * root for root in self._roots], math.sqrt(masking))
                offsets = [*map(add, offsets, own)] if offsets else own
            if effect in BEFORE_WELL:
                before_well += contribution.variances[0]
        if before_well and "full_well" in on and (lost_dn := self._lost_in_well(before_well, level_dn, on)):
            masking = self.masking_variance("full_well", level_dn, on)
            own = [lost_dn * math.sqrt(ratio_to_noise(count, masking)) for count in self.counts]
            offsets = [*map(add, offsets, own)] if offsets else own
        if offsets:
            return [square + offset * offset for square, offset in zip(squares, offsets, strict=True)]
        return squares

    def _lost_in_well(self, variance: float, level_dn: float, on: frozenset[str]) -> float:
        """Drop of the mean signal due to clipping ``variance`` at the full well, DN.

        At a signal that fills the well the upper half of the distribution is cut, which lowers the mean of a normal
        distribution by σ/√(2π).
        """
        if self.contribution("full_well", level_dn, 0.0)[0].offset_dn == 0:
            return 0.0
        other = 0.0
        for name, effect_dn2 in self._variances_at(level_dn):
            if name in on and name in BEFORE_WELL:
                other += effect_dn2
        return MEAN_ABS_NORMAL / 2 * (math.sqrt(other + variance) - math.sqrt(other))

    def ratio(self, effects: tuple[str, ...], level_dn: float, on: frozenset[str]) -> float:
        """Largest ratio of several effects together at a signal, over all statistics."""
        return math.sqrt(max(self.squares(effects, level_dn, on)))

    def outliers(self, effect: str, on: frozenset[str]) -> float:
        """Expected number of pixels per frame that an effect moves by more than one standard deviation."""
        if effect not in RARE:
            return 0.0
        levels = ((level_dn, self.masking_variance(effect, level_dn, on)) for level_dn in self.levels(on))
        shares = [BY_NAME[effect].outliers(self, level_dn, masking) for level_dn, masking in levels]
        return self.facts.width * self.facts.height * max(shares)


def ratio_to_noise(size: float, noise: float) -> float:
    """``size / noise``; without noise, 0 for no size and infinity otherwise."""
    return size / noise if noise else math.inf if size else 0.0


def _ratios(sizes: list[float], noise: float) -> list[float]:
    """`ratio_to_noise` of each size."""
    return [size / noise for size in sizes] if noise else [ratio_to_noise(size, noise) for size in sizes]
