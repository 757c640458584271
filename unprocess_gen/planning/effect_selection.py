"""Decide which sensor effects to simulate, and record the numbers behind each decision.

`frame_model` predicts the ratio of each effect to the masking noise: shot, dark-current, read and rounding
noise of the other effects that stay on. Under ``auto``, the weakest effects are omitted while all omitted ones together
stay within the tolerance in every statistic. Random parts add in quadrature, offsets linearly. The idea is imSim's:
thresholds in units of the noise. Read noise stays where it fills the codes between electrons (`effects.read`).

Hot and dead pixels above one standard deviation of the masking noise are too rare for a variance. They are counted
instead, and simulated if at least `MIN_OUTLIERS` are expected per frame.

Fixed patterns are decided for a body in a scene: for a frame of `BODY_FRAME` that has all the light of the scene. So a
body has its pattern in all images or in none.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from unprocess_gen.config import interpretation
from unprocess_gen.config.distributions import lowest
from unprocess_gen.config.limits import EXPOSURE_RATIO
from unprocess_gen.config.schema import Config
from unprocess_gen.core.arrays import Srgb, last_code
from unprocess_gen.planning.frame_model import FIXED, RARE, AtLevel, FrameModel, SignalRange, ratio_to_noise
from unprocess_gen.simulation.effects import BY_NAME, PHYSICAL_EFFECTS
from unprocess_gen.simulation.effects.prediction import STATISTICS
from unprocess_gen.simulation.facts import Facts, RawParts
from unprocess_gen.simulation.plan import Physics, SourcePlan
from unprocess_gen.simulation.profiles import UNCONVERTED, Profile

MIN_OUTLIERS = 0.1
"""Expected outliers per frame from which hot and dead pixels are simulated."""


BODY_FRAME = 4000, 6000
"""Height and width of the frame for which the fixed patterns of a body are decided, pixels."""
BODY_CLIP = 100
"""Frames of a clip for which they are decided."""


def facts_of(
    srgb: Srgb,
    frames: int = 1,
    raw: RawParts | None = None,
    source: SourcePlan | None = None,
    profile: Profile = UNCONVERTED,
) -> Facts:
    """Return the facts about decoded pixels that planning may use; ``frames`` is the length of the clip."""
    height, width = srgb.shape[:2]
    codes = last_code(srgb) + 1 if srgb.dtype.kind == "u" else 0
    return Facts(width, height, codes, srgb.min().item(), srgb.max().item(), frames, raw, source, profile)


def facts_for(
    config: Config,
    srgb: Srgb,
    frames: int = 1,
    raw: RawParts | None = None,
    source: SourcePlan | None = None,
    profile: Profile = UNCONVERTED,
) -> Facts | None:
    """Return `facts_of` the pixels for a physical noise profile, a raw or a linear source; others need none."""
    is_needed = interpretation.is_physical(config.noise) or raw is not None or source is not None
    return facts_of(srgb, frames, raw, source, profile) if is_needed else None


class Prediction(NamedTuple):
    """Decision about one effect, and why, in the statistic where the effect is strongest against the masking noise."""

    effect: str
    statistic: str  # one of `STATISTICS`
    predicted_dn: float  # contribution in that statistic
    masking_dn: float
    outliers: float  # expected pixels per frame that the effect moves by more than one standard deviation
    simulated: bool
    forced: bool  # the configuration decided, not the image
    why: str  # the comparison with the tolerance, or the reason in the configuration
    kept_for: str  # why the effect is simulated although the noise hides it; empty for others

    @property
    def reason(self) -> str:
        """Reason that rows record for a skipped effect."""
        if self.forced:
            return self.why
        return f"{self.predicted_dn:.3g} DN in the {self.statistic} are {self.why}"

    @property
    def ratio(self) -> float:
        """Ratio of the contribution to the masking noise."""
        return ratio_to_noise(self.predicted_dn, self.masking_dn)


NOT_ROUNDED = "float output is not rounded"
"""Reason for which float32 frames skip ``quantise``."""


IN_DARK_FRAMES = "contained in the dark frames"
"""Reason for which effects of the read-out are skipped if their noise is sampled from dark frames."""


class ForcedDecision(NamedTuple):
    """Decision of the configuration to turn an effect on or off, and its reason."""

    on: bool
    reason: str


def _forced_decision(config: Config, name: str) -> ForcedDecision | None:
    """Return the decision of the configuration about an effect; None if the image decides.

    The first rule that holds decides. Rows record the reasons of effects that are off, so bytes depend on them.
    """
    effect, switch = BY_NAME[name], interpretation.effect_switch(config.effects, name)
    sampled = interpretation.uses_dark_frames(config.noise)
    missing = interpretation.missing_number(config.noise, name)
    assumed = next((key for key in interpretation.needed_numbers(name) if key in config.noise.assumed), None)
    rules: tuple[tuple[bool, bool, str], ...] = (
        (sampled and name == "read", True, "sampled from dark frames"),
        (sampled and effect.is_in_dark_frames, False, IN_DARK_FRAMES),
        (name == "quantise" and interpretation.is_normalised(config), False, NOT_ROUNDED),
        (name == "quantise", True, "integer output is always rounded and clipped"),
        (switch == "off", False, "switched off"),
        (missing is not None, False, f"noise={config.noise.name} gives no {missing}"),
        (switch == "on", True, "switched on"),
        (effect.in_both_frames, True, "part of the clean frame"),  # no noise hides it, and the levels share it
        (assumed in config.noise.unsourced, False, "no source gives its number: on if switched on"),
    )
    return next((ForcedDecision(on, reason) for holds, on, reason in rules if holds), None)


class EffectRules:
    """Decisions of a configuration about the effects of its physical noise profile, the same for all images.

    ``forced`` has a decision for each of `PHYSICAL_EFFECTS`, or None if the image (``temporal``) or the body
    (``patterns``) decides.
    """

    def __init__(self, config: Config) -> None:
        noise, sensor, effects = config.noise, config.sensor, PHYSICAL_EFFECTS
        ratio = lowest(EXPOSURE_RATIO.parse("scene.exposure_ratio", config.scene.exposure_ratio))
        self.forced = {effect: _forced_decision(config, effect) for effect in effects}
        self.on = frozenset(effect for effect, decision in self.forced.items() if decision is None or decision.on)
        free = [effect for effect, decision in self.forced.items() if decision is None]
        self.patterns = [effect for effect in free if effect in FIXED]
        self.temporal = [effect for effect in free if effect not in FIXED]
        self.tolerance, self.black_level_dn = config.effects.tolerance, float(sensor.black_level_dn)
        self.assumed = {effect: interpretation.assumed_numbers(noise, effect) for effect in effects}
        self._named: dict[frozenset[str], tuple[tuple[str, ...], tuple[str, ...]]] = {}
        self.dark_frames = interpretation.uses_dark_frames(noise)  # in place of `read`, whose variance they have
        unclipped = sensor.clip == interpretation.UNCLIPPED
        self.converter_dn = math.inf if unclipped else 2.0**sensor.bits - 1 - sensor.black_level_dn  # above black
        self.body_light_dn = min(1 / ratio, 1.0) * (sensor.white_level_dn - sensor.black_level_dn)  # most of the scene

    def named(self, on: frozenset[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of simulated effects, in the order of image formation, and of the assumed numbers that they use."""
        if on not in self._named:
            replaced = {"read": "dark_frame"} if self.dark_frames else {}
            names = [replaced.get(effect, effect) for effect in PHYSICAL_EFFECTS if effect in on]
            used = dict.fromkeys(key for effect in names for key in self.assumed.get(effect, ()))
            self._named[on] = (*names,), (*used,)
        return self._named[on]

    def frame(self, physics: Physics, facts: Facts, signals: SignalRange, at_dark: AtLevel | None = None) -> FrameModel:
        """Model of a frame of the sensor."""
        return FrameModel(physics, facts, signals, self.black_level_dn, self.converter_dn, at_dark)

    def select_patterns(self, physics: Physics, is_clip: bool) -> BodySelection | None:
        """Decide about the fixed patterns of a body for all of its images; None if the configuration has decided."""
        if not self.patterns:
            return None
        height, width = BODY_FRAME
        facts = Facts(width, height, codes=256, dark_code=0, bright_code=255, frames=BODY_CLIP if is_clip else 1)
        frame = self.frame(physics, facts, SignalRange(0.0, self.body_light_dn))
        on = omit_weakest(self.tolerance, frame, self.on, [*self.patterns, *self.temporal])
        omitted = [effect for effect in self.patterns if effect not in on]
        reasons = {effect: _prediction(effect, frame, on, None, self.tolerance).reason for effect in omitted}
        return BodySelection(frame, on, reasons)

    def select_effects(
        self,
        physics: Physics,
        facts: Facts,
        signals: SignalRange,
        body: BodySelection | None,
        at_dark: AtLevel | None = None,
    ) -> Selection:
        """Decide about every effect for one image, after those of its ``body``; ``at_dark`` as for `FrameModel`."""
        frame, omitted = self.frame(physics, facts, signals, at_dark), [*body.reasons] if body else []
        on = omit_weakest(self.tolerance, frame, self.on.difference(omitted), self.temporal, omitted)
        return Selection(self, frame, on, body)


class BodySelection(NamedTuple):
    """Decision about the fixed patterns of a body, and all effects that are simulated in its largest frame."""

    frame: FrameModel
    on: frozenset[str]
    reasons: dict[str, str]  # of the patterns that are omitted


class Selection(NamedTuple):
    """Effects that are simulated for one image (``on``), and predictions for all effects on demand."""

    rules: EffectRules
    frame: FrameModel
    on: frozenset[str]
    body: BodySelection | None = None

    @property
    def effects(self) -> tuple[str, ...]:
        """The simulated effects, in the order of image formation."""
        return self.rules.named(self.on)[0]

    @property
    def assumed(self) -> tuple[str, ...]:
        """The assumed numbers that the simulated effects use."""
        return self.rules.named(self.on)[1]

    @property
    def skipped(self) -> tuple[str, ...]:
        """The other effects with the reasons that rows record; predicts only what the image decided."""
        replaced = (f"read: {IN_DARK_FRAMES}",) if self.rules.dark_frames else ()
        off = [effect for effect in PHYSICAL_EFFECTS if effect not in self.on]
        return (*replaced, *(f"{effect}: {self._reason(effect)}" for effect in off))

    def _reason(self, effect: str) -> str:
        forced = self.rules.forced[effect]
        if forced is not None:
            return forced.reason
        return self.body.reasons[effect] if self.body and effect in FIXED else self.prediction(effect).reason

    def prediction(self, effect: str) -> Prediction:
        """Prediction of one effect; ``read`` has the prediction of dark frames if they replace it."""
        frame, on = (self.frame, self.on) if self.body is None or effect not in FIXED else self.body[:2]
        prediction = _prediction(effect, frame, on, self.rules.forced[effect], self.rules.tolerance)
        return prediction._replace(effect="dark_frame") if self.rules.dark_frames and effect == "read" else prediction

    def predictions(self) -> tuple[Prediction, ...]:
        """Prediction of each of `PHYSICAL_EFFECTS`, in the order of image formation."""
        return tuple(self.prediction(effect) for effect in PHYSICAL_EFFECTS)


def omit_weakest(
    tolerance: float, frame: FrameModel, on: frozenset[str], free: Sequence[str], before: Sequence[str] = ()
) -> frozenset[str]:
    """Return the effects that remain after omitting the weakest ``free`` ones within ``tolerance``.

    ``before`` are effects that were omitted already. The others are tried from weakest to strongest. The first omission
    that exceeds the tolerance, or drops `MIN_OUTLIERS` outliers, ends the search; so a larger tolerance never simulates
    more. Effects that others need stay on (`Effect.reason_to_keep`).
    """
    omitted = list(before)
    for effect in weakest_first(frame, on, free):
        rest = on - {effect}
        omitted.append(effect)
        if any(frame.outliers(rare, rest) >= MIN_OUTLIERS for rare in omitted if rare in RARE):
            break
        if any(frame.ratio(tuple(omitted), level_dn, rest) > tolerance for level_dn in frame.levels(rest)):
            break
        if BY_NAME[effect].reason_to_keep(frame, on):
            omitted.pop()
        else:
            on = rest
    return on


def weakest_first(frame: FrameModel, on: frozenset[str], effects: Sequence[str]) -> Iterator[str]:
    """Yield effects from weakest to strongest: by outliers, then by the larger ratio at the two signals, then by name.

    The ratio at the bright signal, which differs between images, is predicted only for an effect that can be the next.
    """

    def ratio(effect: str, is_bright: bool) -> float:
        return frame.ratio((effect,), frame.levels(on - {effect})[is_bright], on - {effect})

    found = [(frame.outliers(effect, on) >= MIN_OUTLIERS, ratio(effect, False), effect, False) for effect in effects]
    heapq.heapify(found)
    while found:
        has_outliers, least, effect, is_known = heapq.heappop(found)
        if is_known:
            yield effect
        else:
            heapq.heappush(found, (has_outliers, max(least, ratio(effect, True)), effect, True))


def _prediction(
    effect: str, frame: FrameModel, on: frozenset[str], forced: ForcedDecision | None, tolerance: float
) -> Prediction:
    """Describe an effect at the signal and in the statistic where it is strongest; the first one if several are."""
    squares = ((level_dn, frame.squares((effect,), level_dn, on)) for level_dn in frame.levels(on - {effect}))
    candidates = [(level_dn, [*map(math.sqrt, own)]) for level_dn, own in squares]
    level_dn, ratios = max(candidates, key=lambda candidate: max(candidate[1]))
    index = next(n for n, ratio in enumerate(ratios) if ratio >= max(ratios) * (1 - 1e-9))
    masking = frame.masking_variance(effect, level_dn, on)
    contribution, _ = frame.contribution(effect, level_dn, masking)
    predicted_dn = math.sqrt(contribution.variances[index] + contribution.offset_dn * contribution.offset_dn)
    simulated, outliers = effect in on, frame.outliers(effect, on)
    why = f"{ratios[index]:.3g} of the noise there"
    if BY_NAME[effect].has_outliers:
        why += f", {outliers:.3g} outliers"
    kept_for = ""
    if simulated and ratios[index] <= tolerance and outliers < MIN_OUTLIERS:
        kept_for = BY_NAME[effect].reason_to_keep(frame, on) or "too much together with the omitted effects"
        why += f", {kept_for}"
    why += f" (tolerance {tolerance:g})"
    found = effect, STATISTICS[index], predicted_dn, math.sqrt(masking / frame.counts[index]), outliers, simulated
    return Prediction(*found, forced is not None, forced.reason if forced else why, kept_for)
