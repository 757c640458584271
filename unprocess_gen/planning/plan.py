"""Draw every parameter of an image once, and record them in a `Plan`.

A pair is a pure function of pixels and plan. Draws come from the stream ``parameters`` of the image
(`core.random_streams`), with one counter for each name in `PARAMETERS`; so a draw that is not used moves no other.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from unprocess_gen.config.accuracy import choose_methods, is_steep
from unprocess_gen.config.distributions import draw_parameter, parse_drawn
from unprocess_gen.config.interpretation import (
    accuracy_budget,
    dequantize_method,
    effect_switch,
    gain_distributions,
    has_float_clean,
    is_normalised,
    is_physical,
    noise_distributions,
    noise_levels,
    saturated_as,
    uses_dark_frames,
    uses_physics,
)
from unprocess_gen.config.limits import EXPOSURE_RATIO
from unprocess_gen.config.schema import CameraConfig, Config
from unprocess_gen.config.snapshot import restored, snapshot
from unprocess_gen.core.random_streams import dark_frame_words, parameter_uniforms, stream_key
from unprocess_gen.core.types import FLOAT32, DarkFrames, Facts, Plan, inverse_gains
from unprocess_gen.planning.effect_contributions import SignalRange, signal_range
from unprocess_gen.planning.effect_selection import (
    NOT_ROUNDED,
    Prediction,
    Selection,
    effect_rules,
    select_effects,
)
from unprocess_gen.planning.noise_profile import PhysicalNoise
from unprocess_gen.simulation.reference import colour
from unprocess_gen.simulation.reference.sensor import noise_in_dn

PARAMETERS = (
    *("weight_0", "weight_1", "weight_2", "weight_3", "choice", "red", "blue", "inverse_rgb", "a", "b"),
    *("iso", "exposure_s", "temperature_c", "exposure_ratio", "read_shape", "read_std", "row_std", "column_std"),
    *("sensor_unit", "column_temporal_std"),
)
"""Names of the draws; the position is the counter in the stream. All datasets depend on it: append, never reorder."""

NOISE_PARAMETERS = ("a", "b", "iso", "read_shape", "read_std", "row_std", "column_std", "column_temporal_std")
"""Parameters that every noise level draws separately."""


def plan_image(
    config: Config,
    source_sha256: str,
    occurrence: int = 0,
    facts: Facts | None = None,
    dark_frames: DarkFrames | None = None,
) -> Plan:
    """Draw every parameter of one image, at the first noise level.

    All draws are functions of ``config.seed``, ``source_sha256`` and ``occurrence``.

    Parameters
    ----------
    config : Config
        A configuration that `validate_config` accepts.
    source_sha256 : str
        Hex digest of the bytes of the source.
    occurrence : int
        Number of identical files before this one.
    facts : Facts or None
        `effect_selection.facts_of` the pixels; needed by physical noise profiles only.
    dark_frames : DarkFrames or None
        Frames from which noise is sampled; needed with ``noise.dark_frames`` only.

    Returns
    -------
    Plan
        All parameters of the pair.

    Raises
    ------
    ValueError
        If the noise profile is physical and ``facts`` is None, or the dark frames of the config are not given.
    """
    plan, _ = next(_planner(config).levels(config.seed, source_sha256, occurrence, facts, dark_frames))
    return plan if dark_frames is None or facts is None else with_dark_frame(plan, dark_frames, facts)


def plan_pairs(
    config: Config,
    source_sha256: str,
    occurrence: int = 0,
    facts: Facts | None = None,
    frame: int = 0,
    dark_frames: DarkFrames | None = None,
) -> tuple[Plan, ...]:
    """Draw the parameters of all pairs of one image: each noise level, and each draw of the noise at that level.

    Parameters
    ----------
    config : Config
        A configuration that `validate_config` accepts.
    source_sha256 : str
        Hex digest of the bytes of the source. For a frame of a clip, of the clip: its frames share their parameters.
    occurrence : int
        Number of identical sources before this one.
    facts : Facts or None
        `effect_selection.facts_of` the pixels; needed by physical noise profiles only.
    frame : int
        Number of the frame in its clip; each frame has its own noise. 0 for a photograph.
    dark_frames : DarkFrames or None
        Frames from which noise is sampled; needed with ``noise.dark_frames`` only.

    Returns
    -------
    tuple of Plan
        Level by level, and draw by draw within a level. The pairs share their clean frame.

    Raises
    ------
    ValueError
        If the noise profile is physical and ``facts`` is None, or the dark frames of the config are not given.
    """
    levels = _planner(config).levels(config.seed, source_sha256, occurrence, facts, dark_frames)
    plans = with_draws(config, (plan for plan, _ in levels), frame)
    return plans if dark_frames is None or facts is None else with_dark_frames(plans, dark_frames, facts)


def with_draws(config: Config, levels: Iterable[Plan], frame: int = 0) -> tuple[Plan, ...]:
    """Return a plan for each draw of the noise at each level.

    Parameters
    ----------
    config : Config
        ``noise.draws`` is the number of draws.
    levels : iterable of Plan
        One plan for each noise level, of draw 0 and frame 0.
    frame : int
        Number of the frame in its clip.

    Returns
    -------
    tuple of Plan
        Draw by draw within each level.
    """
    return tuple(
        replace(plan, draw=draw, frame=frame) if draw or frame else plan
        for plan in levels
        for draw in range(config.noise.draws)
    )


def with_dark_frames(plans: Sequence[Plan], dark_frames: DarkFrames, facts: Facts) -> tuple[Plan, ...]:
    """Choose the dark frame of each pair of an image.

    The first is chosen at random for each image, and the frames of a clip, the levels and the draws take the next ones
    in turn. All use the same part of the frames, so that the fixed pattern of the camera does not move.

    Parameters
    ----------
    plans : sequence of Plan
        Plans of one image: every draw of every level.
    dark_frames : DarkFrames
        The frames.
    facts : Facts
        Size of the image.

    Returns
    -------
    tuple of Plan
        The plans with the columns of dark frames.
    """
    return tuple(
        with_dark_frame(plan, dark_frames, facts, plan.frame * len(plans) + number) for number, plan in enumerate(plans)
    )


def with_dark_frame(plan: Plan, dark_frames: DarkFrames, facts: Facts, number: int = 0) -> Plan:
    """Choose the dark frame of one pair.

    Parameters
    ----------
    plan : Plan
        The plan of the pair.
    dark_frames : DarkFrames
        The frames.
    facts : Facts
        Size of the image.
    number : int
        Number of the pair among those of its image or clip.

    Returns
    -------
    Plan
        The plan with the columns of dark frames. The part of the frame lies inside it if the image fits.
    """
    chosen, row, column = dark_frame_words(plan.stream_key)
    count = len(dark_frames.frames)
    frame = dark_frames.frames[((chosen * count >> 32) + number) % count]
    shift = _even_place(row, frame.height, facts.height), _even_place(column, frame.width, facts.width)
    shading = dark_frames.shading
    return replace(
        plan,
        dark_frame=frame.sha256,
        dark_shift=shift,
        dark_black_dn=dark_frames.black_dn if shading is None else shading.black_dn,
        dark_scale=dark_frames.scale,
        dark_shading="" if shading is None else shading.sha256,
    )


def _even_place(word: int, available: int, needed: int) -> int:
    """Return an even place, drawn with a random word: any place at which a part of this length begins inside."""
    places = (available - needed) // 2 + 1 if available >= needed else available // 2
    return 2 * (word * places >> 32)


PlanAndPredictions = tuple[Plan, tuple[Prediction, ...]]
"""A plan, and a prediction for every effect of a physical profile; no predictions for a profile with two numbers."""


def plan_levels(
    config: Config,
    source_sha256: str,
    occurrence: int = 0,
    facts: Facts | None = None,
    dark_frames: DarkFrames | None = None,
) -> tuple[PlanAndPredictions, ...]:
    """Draw the parameters of one image at every noise level, with the predictions behind the selected effects.

    Parameters
    ----------
    config : Config
        A configuration that `validate_config` accepts.
    source_sha256 : str
        Hex digest of the bytes of the source.
    occurrence : int
        Number of identical sources before this one.
    facts : Facts or None
        `effect_selection.facts_of` the pixels; needed by physical noise profiles only.
    dark_frames : DarkFrames or None
        Frames from which noise is sampled; needed with ``noise.dark_frames`` only.

    Returns
    -------
    tuple of (Plan, tuple of Prediction)
        One for each noise level; no predictions for a profile with two numbers.
    """
    levels = _planner(config).levels(config.seed, source_sha256, occurrence, facts, dark_frames)
    return tuple((plan, () if selection is None else selection.predictions()) for plan, selection in levels)


# --------------------------------------------------------------------------------------------------------- one config


def _planner(config: Config) -> Planner:
    """Return the planner of a config's content: a config that was changed has another one."""
    content = snapshot(config)
    return Planner(config) if content is None else _planner_of(content)


@functools.lru_cache(maxsize=64)
def _planner_of(content: bytes) -> Planner:
    return Planner(restored(content))


class Planner:
    """Draw plans for the images of one configuration, which is interpreted once.

    Parsing distributions, choosing methods and interpreting the noise profile take longer than all draws of an image.

    Parameters
    ----------
    config : Config
        A configuration that `validate_config` accepts, and that does not change. Its seed is not used.
    """

    def __init__(self, config: Config) -> None:
        self._camera, self._needs_dark_frames = config.camera, uses_dark_frames(config.noise)
        self._red, self._blue, self._inverse_rgb = gain_distributions(config.gains)
        self._exposure_ratio = parse_drawn("scene.exposure_ratio", config.scene.exposure_ratio, EXPOSURE_RATIO)
        levels = [replace(config, noise=noise) for noise in noise_levels(config.noise)]
        self._is_physical = is_physical(config.noise)
        self._levels = [PhysicalLevel(one) if self._is_physical else TwoNumberLevel(one) for one in levels]
        budget, counts_electrons = accuracy_budget(config.accuracy), uses_physics(config.noise)
        self._methods, self._steep_methods = (
            choose_methods(budget, counts_electrons, is_normalised(config), steep or has_float_clean(config))
            for steep in (False, True)
        )
        self._recorded: dict[str, Any] = {
            "downscale": config.source.downscale,
            "dequantize": dequantize_method(config.source),
            "scene": config.scene.name,
            "tone": config.isp.tone,
            "gamma": "srgb" if config.isp.gamma == "srgb" else float(config.isp.gamma),
            "highlight": config.gains.highlight,
            "highlight_threshold": config.gains.threshold,
            "pattern": config.sensor.pattern,
            "bits": config.sensor.bits,
            "black_level_dn": config.sensor.black_level_dn,
            "white_level_dn": config.sensor.white_level_dn,
            "sensor_clip": config.sensor.clip,
            "saturated": saturated_as(config),
            "noise": config.noise.name,
            "noise_law": config.noise.law,
            "accuracy": config.accuracy.name,
            "law_distance": config.accuracy.law_distance,
            "dtype": config.output.dtype,
            "layout": config.output.layout,
            "clean_dtype": FLOAT32 if has_float_clean(config) else "",
        }

    def levels(
        self,
        seed: int,
        source_sha256: str,
        occurrence: int = 0,
        facts: Facts | None = None,
        dark_frames: DarkFrames | None = None,
    ) -> Iterator[tuple[Plan, Selection | None]]:
        """Yield the plan of one image at each noise level, and the selection of effects of a physical profile.

        Parameters
        ----------
        seed : int
            Seed of the dataset.
        source_sha256, occurrence, facts, dark_frames : str, int, Facts or None, DarkFrames or None
            As for `plan_pairs`.

        Yields
        ------
        plan : Plan
            Of draw 0 and frame 0.
        selection : Selection or None
            None for a profile with two numbers.

        Raises
        ------
        ValueError
            If the noise profile is physical and ``facts`` is None, or the dark frames of the config are not given.
        """
        if self._needs_dark_frames and dark_frames is None:
            raise ValueError("noise.dark_frames: the plan needs the dark frames")
        if self._is_physical and facts is None:
            raise ValueError("a physical profile needs the facts of the pixels")
        key = stream_key(seed, source_sha256, occurrence)
        uniforms = dict(zip(PARAMETERS, parameter_uniforms(key, len(PARAMETERS)), strict=True))
        clean = self._clean(uniforms)
        image = Image(seed, key, facts, _signals(clean, facts) if self._is_physical and facts else None, dark_frames)
        for number, level in enumerate(self._levels):
            if number:
                at_level = dict(zip(PARAMETERS, parameter_uniforms(key, len(PARAMETERS), number), strict=True))
                uniforms |= {name: at_level[name] for name in NOISE_PARAMETERS}
            noise, selection = level.draw(image, uniforms)
            plan = Plan(seed=seed, stream_key=key, methods=self._methods, level=number, **clean, **noise)
            if self._steep_methods != self._methods and is_steep(plan):
                plan = replace(plan, methods=self._steep_methods)
            yield plan, selection

    def _clean(self, uniforms: Mapping[str, float]) -> dict[str, Any]:
        """Return the fields of a plan that all noise levels of an image share."""
        camera, weights, rgb2cam = plan_camera(self._camera, uniforms)
        return {
            "exposure_ratio": draw_parameter(self._exposure_ratio, uniforms["exposure_ratio"]),
            "camera": camera,
            "weights": weights,
            "rgb2cam": rgb2cam,
            "red_gain": draw_parameter(self._red, uniforms["red"]),
            "blue_gain": draw_parameter(self._blue, uniforms["blue"]),
            "inverse_rgb_gain": draw_parameter(self._inverse_rgb, uniforms["inverse_rgb"]),
            **self._recorded,
        }


@dataclass(frozen=True, slots=True)
class Image:
    """Hold what noise levels of an image depend on, in addition to its uniforms.

    Attributes
    ----------
    seed, stream_key : int
        Seed of the dataset, and key of the image's random streams.
    facts, signals : Facts or None, SignalRange or None
        Facts about the pixels, and the signal range; needed by physical profiles only.
    dark_frames : DarkFrames or None
        Frames from which noise is sampled.
    """

    seed: int
    stream_key: int
    facts: Facts | None
    signals: SignalRange | None
    dark_frames: DarkFrames | None


def _signals(clean: Mapping[str, Any], facts: Facts) -> SignalRange:
    """Return the signal range of an image, from the fields of its plan."""
    return signal_range(
        facts,
        clean["tone"],
        clean["gamma"],
        inverse_gains(clean["red_gain"], clean["blue_gain"], clean["inverse_rgb_gain"]),
        1 / clean["exposure_ratio"],
        float(clean["white_level_dn"] - clean["black_level_dn"]),
        clean["rgb2cam"],
    )


LevelFields = tuple[dict[str, Any], Selection | None]
"""Fields of a plan that depend on the noise level, and the selection of effects of a physical profile."""


class TwoNumberLevel:
    """One noise level of a profile with two numbers.

    Parameters
    ----------
    config : Config
        The configuration, with the profile of this level.
    """

    def __init__(self, config: Config) -> None:
        self._config = config
        self._distributions = noise_distributions(config.noise)
        self._span_dn = config.sensor.white_level_dn - config.sensor.black_level_dn

    def draw(self, image: Image, uniforms: Mapping[str, float]) -> LevelFields:
        """Draw the two numbers and select the effects of an image at this level."""
        a_dn, b_dn2 = self.two_numbers(uniforms)
        effects, skipped = plan_effects(self._config, a_dn, b_dn2, self._span_dn)
        return {"a_dn": a_dn, "b_dn2": b_dn2, "effects": effects, "skipped": skipped}, None

    def two_numbers(self, uniforms: Mapping[str, float]) -> tuple[float, float]:
        """Draw the two numbers and convert them to the sensor's DN: (a_dn, b_dn2)."""
        noise, sensor = self._config.noise, self._config.sensor
        a = draw_parameter(self._distributions[0], uniforms["a"])
        b = draw_parameter(self._distributions[1], uniforms["b"], a)
        return noise_in_dn(
            a,
            b,
            units=noise.units or "",
            black=noise.black or "",
            profile_levels_dn=(noise.black_level_dn or 0, noise.white_level_dn or 0),
            sensor_levels_dn=(sensor.black_level_dn, sensor.white_level_dn),
        )


class PhysicalLevel:
    """One noise level of a physical profile.

    Parameters
    ----------
    config : Config
        The configuration, with the profile of this level.
    """

    def __init__(self, config: Config) -> None:
        self._noise = PhysicalNoise(config)
        self._rules = effect_rules(config)

    def draw(self, image: Image, uniforms: Mapping[str, float]) -> LevelFields:
        """Draw the numbers of the sensor and select the effects of an image at this level."""
        assert image.facts is not None and image.signals is not None
        physics = self._noise.draw(uniforms, image.stream_key, image.seed)
        if image.dark_frames is not None:
            read_std_dn = math.sqrt(image.dark_frames.variance_dn2)
            physics = replace(physics, read_law="gaussian", read_shape=0.0, read_std_dn=read_std_dn)
        if any(physics.lens_shading):
            physics = replace(physics, frame_size=(image.facts.height, image.facts.width))
        selection = select_effects(self._rules, physics, image.facts, image.signals)
        fields = {
            "physics": physics,
            "a_dn": physics.dn_per_e,
            "b_dn2": physics.read_std_dn * physics.read_std_dn,
            "effects": selection.effects,
            "skipped": selection.skipped,
            "assumed": selection.assumed,
        }
        return fields, selection


# ---------------------------------------------------------------------------------------------------------- camera

Weights = tuple[float, float, float, float]


def plan_camera(camera: CameraConfig, uniforms: Mapping[str, float]) -> tuple[str, Weights, colour.Matrix]:
    """Return the name of the camera, the weights of the four known cameras in it, and its matrix from linear sRGB."""
    names = tuple(colour.CAMERAS)
    if camera.law == "identity":
        return camera.name, (0.0, 0.0, 0.0, 0.0), colour.IDENTITY
    if camera.law == "custom":
        return camera.name, (0.0, 0.0, 0.0, 0.0), colour.rgb2cam(colour.matrix(camera.xyz2cam or ()))
    if camera.law == "convex":
        weights = convex_weights(uniforms)
        return camera.name, weights, colour.rgb2cam(colour.mix(tuple(colour.CAMERAS.values()), weights))
    name = names[int(uniforms["choice"] * len(names))] if camera.law == "choice" else camera.name
    w0, w1, w2, w3 = (float(name == other) for other in names)
    return name, (w0, w1, w2, w3), colour.rgb2cam(colour.CAMERAS[name])


def convex_weights(uniforms: Mapping[str, float]) -> Weights:
    """Return four uniforms, each divided by their sum (Brooks et al. 2019, random_ccm())."""
    u0, u1, u2, u3 = (uniforms[f"weight_{i}"] for i in range(4))
    total = u0 + u1 + u2 + u3
    return u0 / total, u1 / total, u2 / total, u3 / total


# ----------------------------------------------------------------------------------------------------------- noise


def plan_effects(config: Config, a_dn: float, b_dn2: float, span_dn: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the simulated effects of a profile with two numbers, in order, and the skipped ones with their reasons.

    ``span_dn`` is the white level minus the black level. If the variance is 0 or less in all of it, no noise is
    simulated.
    """
    noise = config.noise.name
    rounded = not is_normalised(config)
    last = ("quantise",) if rounded else ()
    skipped = () if rounded else (f"quantise: {NOT_ROUNDED}",)  # recorded: decides bytes of datasets
    if effect_switch(config.effects, "heteroscedastic") == "off":
        return last, ("heteroscedastic: switched off", *skipped)  # recorded: decides bytes of datasets
    if a_dn * span_dn + b_dn2 <= 0:
        numbers = f"a_dn={a_dn!r}, b_dn2={b_dn2!r}"
        none = f"heteroscedastic: noise={noise} has no variance ({numbers})"  # recorded: decides bytes of datasets
        return last, (none, *skipped)
    return ("heteroscedastic", *last), skipped
