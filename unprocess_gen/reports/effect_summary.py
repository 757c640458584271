"""Describe in sentences and a table which effects a run simulates and which it leaves out, for the verb ``plan``."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from unprocess_gen.config.interpretation import assumed_numbers, missing_number, uses_dark_frames
from unprocess_gen.config.schema import BRANCH_FIELDS, Config, NoiseConfig
from unprocess_gen.config.values import value_range, value_text
from unprocess_gen.core.types import DarkFrames, Plan
from unprocess_gen.planning.effect_selection import MIN_OUTLIERS, Prediction
from unprocess_gen.reports.formatting import counted, short_number
from unprocess_gen.simulation.effects import BY_NAME, REPLACED
from unprocess_gen.simulation.effects.dark_current import HEAT

Predictions = Sequence[Sequence[Prediction]]
"""For each noise level of each image, the prediction of every effect."""


# ---------------------------------------------------------------------------------------------------------- sentences


def effect_sentences(config: Config, predictions: Predictions) -> list[str]:
    """Return sentences on what is simulated, what is too small to see, and what is left out though it would show."""
    effects = [
        EffectOverview(config, of_effect)
        for of_effect in zip(*predictions, strict=True)
        if of_effect[0].effect != "quantise"
    ]
    sampled = [one.name for one in effects if one.sampled]
    effects = [one for one in effects if not one.sampled]
    simulated = [one.simulated_text for one in effects if one.count]
    left_out = [one for one in effects if not one.count and not one.missing]
    small = [f"{one.name} ({one.size_text})" for one in left_out if not one.shows]
    visible = [f"{one.name} ({one.size_text}; {one.strongest.reason})" for one in left_out if one.shows]
    missing = [_with_key(one.name, one.missing) for one in effects if one.missing]
    sentences = [
        f"Simulated: {_listed(simulated)}.",
        f"Left out, too small to see: {_listed(small)}.",
        f"Left out though it would show: {_listed(visible)}.",
    ]
    if sampled:
        sentences.append(f"Contained in the dark frames: read, {_listed(sampled)}.")
    return [*sentences, f"Left out, as the profile gives no number: {_listed(missing)}."] if missing else sentences


def _with_key(effect: str, key: str) -> str:
    """Return an effect with the key of its number, unless both have the same name."""
    return effect if key == effect else f"{effect} ({key})"


def _listed(texts: Iterable[str]) -> str:
    return ", ".join(texts) or "none"


@dataclass(frozen=True)
class EffectOverview:
    """Summarize the predictions of one effect over all images and noise levels."""

    config: Config
    predictions: Sequence[Prediction]

    @property
    def name(self) -> str:
        """Return the name of the effect."""
        return self.predictions[0].effect

    @property
    def strongest(self) -> Prediction:
        """Return the prediction of the image in which the effect is strongest; simulated ones first."""
        return max(self.predictions, key=lambda one: (one.simulated, one.outliers >= MIN_OUTLIERS, one.ratio))

    @property
    def count(self) -> int:
        """Return for how many images and levels the effect is simulated."""
        return sum(one.simulated for one in self.predictions)

    @property
    def missing(self) -> str | None:
        """Return the number that the profile lacks; None if the effect could be simulated."""
        return missing_number(self.config.noise, self.name)

    @property
    def sampled(self) -> bool:
        """Return whether dark frames contain the effect."""
        return uses_dark_frames(self.config.noise) and self.name in REPLACED

    @property
    def shows(self) -> bool:
        """Return whether the effect exceeds the tolerance or has visible outliers."""
        one = self.strongest
        return one.ratio > self.config.effects.tolerance or one.outliers >= MIN_OUTLIERS

    @property
    def size_text(self) -> str:
        """Return how strong the effect is: outliers, or its ratio to the noise."""
        one = self.strongest
        if BY_NAME[self.name].has_outliers:
            return _pixels(one.outliers)
        return f"{short_number(one.ratio)} of the noise" if math.isfinite(one.ratio) else "no other noise"

    @property
    def simulated_text(self) -> str:
        """Return the name, its assumed number, and the number of images unless it is simulated in all of them."""
        notes = assumed_text(self.config.noise, self.name)
        images = len(self.predictions)
        if self.count < images:
            notes += f"{'; ' if notes else ''}in {self.count} of {images} images"
        return f"{self.name} ({notes})" if notes else self.name


def _pixels(outliers: float) -> str:
    if outliers < MIN_OUTLIERS:
        return "no visible pixel" if outliers < 1e-6 else f"{short_number(outliers)} visible pixels per frame"
    return f"{short_number(outliers, 3)} visible pixels per frame"


ASSUMED_TEXTS: dict[str, Callable[[NoiseConfig], str]] = {
    "dark_e_per_s": lambda noise: f"{noise.dark_e_per_s:g} e⁻/s at {noise.dark_reference_c:g} °C",
    "dark_reference_c": lambda noise: f"measured at {noise.dark_reference_c:g} °C",
    "dark_doubling_c": lambda noise: f"doubled every {noise.dark_doubling_c:g} °C",
    "hot_pixel_share": lambda noise: f"{1e6 * (noise.hot_pixel_share or 0):g} in a million",
    "hot_pixel_e_per_s": lambda noise: f"{noise.hot_pixel_e_per_s:g} e⁻/s at {noise.dark_reference_c:g} °C",
    "dead_pixel_share": lambda noise: f"{1e6 * (noise.dead_pixel_share or 0):g} in a million",
    "full_well_e": lambda noise: f"{noise.full_well_e:,.0f} e⁻",
    "row_std_dn": lambda noise: f"{noise.branches[0].row_std_dn} DN",
    "column_std_dn": lambda noise: f"{noise.branches[0].column_std_dn} DN",
    "black_error_dn": lambda noise: "offsets of the black level",
}
"""Value of a number that a profile may mark as assumed; others are shown as `_key_text` does."""


def assumed_text(noise: NoiseConfig, effect: str) -> str:
    """Return the assumed numbers of an effect, such as ``assumed 0.5 %``; empty if all are published."""
    keys = assumed_numbers(noise, effect)
    if effect == "hot_pixels":  # the dark current names the temperature and the doubling
        keys = tuple(key for key in keys if key not in HEAT)
    values = [ASSUMED_TEXTS[key](noise) if key in ASSUMED_TEXTS else _key_text(noise, key) for key in keys]
    return f"assumed {', '.join(values)}" if values else ""


def _key_text(noise: NoiseConfig, key: str) -> str:
    """Relative standard deviations in percent, electrons with their unit, other numbers with their key."""
    if key.endswith("_std"):
        return f"{100 * (getattr(noise, key) or 0):g} %"
    if key.endswith("_std_e"):
        return f"{getattr(noise, key):g} e⁻"
    value = value_text(getattr(noise.branches[0] if key in BRANCH_FIELDS else noise, key))
    return f"{key}={value if len(value) <= LONGEST_VALUE else '…'}"


LONGEST_VALUE = 20
"""Characters of the longest assumed value that is shown."""

# --------------------------------------------------------------------------------------------------------------- table


def effect_table(config: Config, predictions: Predictions) -> list[str]:
    """Return one line per effect: the image in which it is strongest, and how often it is simulated.

    Hot and dead pixels are judged by the number of pixels that exceed the noise, other effects by their ratio to
    the noise that hides them.
    """
    lines = [_TABLE_LINE.format("effect", "adds", "seen in", "noise there", "ratio", "images", "ns/pixel", "decision")]
    for of_effect in zip(*predictions, strict=True):
        overview = EffectOverview(config, of_effect)
        one = overview.strongest
        adds, seen, noise, ratio = f"{one.predicted_dn:.3g} DN", one.statistic, f"{one.masking_dn:.3g} DN", one.ratio
        if BY_NAME[overview.name].has_outliers:
            pixels = one.outliers if one.outliers >= 1e-6 else 0
            adds, seen, noise, shown = f"{pixels:.3g} pixels", "outliers", "", ""
        else:
            shown = f"{ratio:.3g}" if math.isfinite(ratio) else "no noise"
        images, cost = f"{overview.count} of {len(of_effect)}", f"{BY_NAME[overview.name].cost_ns:.1f}"
        line = _TABLE_LINE.format(overview.name, adds, seen, noise, shown, images, cost, _decision(overview))
        lines.append(line.rstrip())
    return lines


_TABLE_LINE = "{:16}{:>13}  {:14}{:>11}{:>10}  {:9}{:>9}  {}"


def _decision(overview: EffectOverview) -> str:
    one, tolerance = overview.strongest, overview.config.effects.tolerance
    if one.forced:
        return one.why
    if not one.simulated:
        return "too small to see"
    if one.outliers >= MIN_OUTLIERS:
        return "visible pixels"
    return "visible" if one.ratio > tolerance else "too much together with the omitted effects"


# ------------------------------------------------------------------------------------------------- scene and warnings


def scene_sentence(config: Config, plans: Sequence[Plan]) -> str:
    """Return the scene, and what of it the noise profile uses."""
    physics = [plan.noise.physics for plan in plans if plan.noise.physics is not None]
    scene, noise = config.scene, config.noise
    if physics:
        iso, seconds = value_range([one.iso for one in physics]), value_range([one.exposure_s for one in physics])
        celsius = value_range([one.temperature_c for one in physics])
    else:
        iso, seconds, celsius = (_written(value) for value in (scene.iso, scene.exposure_s, scene.temperature_c))
    ratio = value_range([plan.scene.exposure_ratio for plan in plans], 4)
    text = f"{plans[0].scene.name}: ISO {iso}, {seconds} s, {celsius} °C, light divided by {ratio}"
    if not physics:
        return f"{text}; {noise.name} uses only the light, and ignores ISO, time and temperature"
    used: list[str] = ["light"]
    ignored: list[str] = []
    (ignored if noise.iso is not None else used).append("ISO")
    heated = [name for name in ("dark_current", "hot_pixels") if missing_number(noise, name) is None]
    (used if heated else ignored).extend(("time", "temperature"))
    uses = f"{', '.join(used[:-1])} and {used[-1]}" if len(used) > 1 else used[0]
    rest = f", and ignores {' and '.join(ignored)}" if ignored else ""
    rest += " (noise.iso is used)" if noise.iso is not None else ""
    return f"{text}; {noise.name} uses {uses}{rest}"


def _written(value: object) -> str:
    """Return a number of the config, or the numbers of a distribution."""
    if isinstance(value, list | tuple):
        numbers = [f"{one:g}" for one in value if isinstance(one, int | float)]
        return " to ".join(numbers) if value and value[0] == "uniform" else ", ".join(numbers)
    return f"{value:g}" if isinstance(value, int | float) else str(value)


POSTERISED_BELOW = 256
"""Levels between black and the white of a darkened scene below which ``plan`` warns: fewer than 8-bit codes."""


def rounding_psnr_db(span_dn: float, exposure_ratio: float) -> float:
    """Return the PSNR at which the rounding of clean frames ends every comparison with them.

    The rounding error is uniform in ±½ DN, so its mean square is 1/12 DN². White of the darkened scene is
    ``span_dn / exposure_ratio`` above black. A denoiser that returned the unrounded mean would have
    20 log10(√12 · span / ratio).
    """
    return 20 * math.log10(math.sqrt(12) * span_dn / exposure_ratio)


def posterisation_warning(plans: Sequence[Plan], levels: Sequence[int]) -> str | None:
    """Return a warning if rounded clean frames have few levels."""
    spans = [(plan.sensor.white_level_dn - plan.sensor.black_level_dn, plan.scene.exposure_ratio) for plan in plans]
    if not levels or min(span / ratio for span, ratio in spans) >= POSTERISED_BELOW:
        return None
    limits = [rounding_psnr_db(span, ratio) for span, ratio in spans]
    bound = value_range([round(limit, 1) for limit in limits])
    return (
        f"clean frames are rounded to {value_range(levels)} levels; compared with them no denoiser exceeds a PSNR of "
        f"{bound} dB (peak: white of the darkened scene); output.clean_dtype=float32 keeps the unrounded mean"
    )


NOISY_SOURCE = 0.2
"""Noise of a source, relative to the simulated noise, above which ``plan`` counts it: it adds 2 % to the total."""


def source_noise_sentences(ratios: Sequence[float], downscale: int) -> list[str]:
    """Return how many sources bring visible noise into the clean frame, and the remedy."""
    if not ratios:
        return []
    noisy = sum(ratio > NOISY_SOURCE for ratio in ratios)
    text = (
        f"the noise of {noisy} of {len(ratios)} sources exceeds a fifth of the simulated noise "
        f"({value_range(ratios, 2)} of it)"
    )
    remedy = f"; it stays in the clean frame: source.downscale={2 * downscale} averages it" if noisy else ""
    return [text + remedy]


def dark_frames_sentence(config: Config, dark_frames: DarkFrames) -> str:
    """Return what `plan` says about dark frames."""
    sizes = sorted({f"{frame.width} x {frame.height}" for frame in dark_frames.frames})
    text = (
        f"{counted(len(dark_frames.frames), 'dark frame')} in {config.noise.dark_frames}: {', '.join(sizes)} pixels, "
        f"{_subtracted(dark_frames)}, standard deviation {math.sqrt(dark_frames.variance_dn2):.4g} DN"
    )
    return text if dark_frames.scale == 1 else f"{text} on this sensor (times {dark_frames.scale:.6g})"


def _subtracted(dark_frames: DarkFrames) -> str:
    """Return what is subtracted from dark frames: their black level, their mean, or a map and what that leaves."""
    shading, black = dark_frames.shading, f"black level {dark_frames.black_dn:g} DN"
    if shading is None:
        return black
    if not shading.file:
        return "their mean is subtracted"
    content = f"its DN are above the {black}" if shading.black_dn else "its DN include the black level"
    return f"the map {shading.file} ({content}) is subtracted, which leaves a median of {shading.residual_dn:.3g} DN"
