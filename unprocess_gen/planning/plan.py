"""Draw every parameter of an image once, and record them in a `Plan`.

A pair is a pure function of pixels and plan. Draws come from the stream ``parameters`` of the image
(`core.random_streams`), with one counter for each name in `PARAMETERS`; so a draw that is not used moves no other.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from unprocess_gen.config.accuracy import choose_methods, is_steep
from unprocess_gen.config.distributions import draw_parameter, parse_drawn
from unprocess_gen.config.interpretation import (
    accuracy_budget,
    dequantize_method,
    effect_switch,
    gain_distributions,
    is_normalised,
    is_physical,
    noise_distributions,
    noise_levels,
    uses_physics,
)
from unprocess_gen.config.limits import EXPOSURE_RATIO
from unprocess_gen.config.schema import CameraConfig, Config
from unprocess_gen.core.random_streams import parameter_uniforms, stream_key
from unprocess_gen.core.types import Facts, Plan
from unprocess_gen.planning.effect_contributions import signal_range
from unprocess_gen.planning.effect_selection import NOT_ROUNDED, Prediction, select_effects
from unprocess_gen.planning.noise_profile import plan_physics
from unprocess_gen.simulation.reference import colour
from unprocess_gen.simulation.reference.sensor import noise_in_dn

PARAMETERS = (
    *("weight_0", "weight_1", "weight_2", "weight_3", "choice", "red", "blue", "inverse_rgb", "a", "b"),
    *("iso", "exposure_s", "temperature_c", "exposure_ratio", "read_shape", "read_std", "row_std", "column_std"),
    "sensor_unit",
)
"""Names of the draws; the position is the counter in the stream. All datasets depend on it: append, never reorder."""

NOISE_PARAMETERS = ("a", "b", "iso", "read_shape", "read_std", "row_std", "column_std")
"""Parameters that every noise level draws separately."""


def plan_image(config: Config, source_sha256: str, occurrence: int = 0, facts: Facts | None = None) -> Plan:
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

    Returns
    -------
    Plan
        All parameters of the pair.

    Raises
    ------
    ValueError
        If the noise profile is physical and ``facts`` is None.
    """
    return plan_with_reasons(config, source_sha256, occurrence, facts)[0]


def plan_pairs(
    config: Config, source_sha256: str, occurrence: int = 0, facts: Facts | None = None, frame: int = 0
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

    Returns
    -------
    tuple of Plan
        Level by level, and draw by draw within a level. The pairs share their clean frame.

    Raises
    ------
    ValueError
        If the noise profile is physical and ``facts`` is None.
    """
    levels = plan_levels(config, source_sha256, occurrence, facts)
    return with_draws(config, [plan for plan, _ in levels], frame)


def with_draws(config: Config, levels: Iterable[Plan], frame: int = 0) -> tuple[Plan, ...]:
    """Return a plan for each draw of the noise at each level.

    Parameters
    ----------
    config : Config
        ``noise.draws`` is the number of draws.
    levels : iterable of Plan
        One plan for each noise level.
    frame : int
        Number of the frame in its clip.

    Returns
    -------
    tuple of Plan
        Draw by draw within each level.
    """
    return tuple(replace(plan, draw=draw, frame=frame) for plan in levels for draw in range(config.noise.draws))


PlanAndPredictions = tuple[Plan, tuple[Prediction, ...]]
"""A plan, and a prediction for every effect of a physical profile; no predictions for a profile with two numbers."""


def plan_levels(
    config: Config, source_sha256: str, occurrence: int = 0, facts: Facts | None = None
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

    Returns
    -------
    tuple of (Plan, tuple of Prediction)
        One for each noise level; no predictions for a profile with two numbers.
    """
    levels = range(len(noise_levels(config.noise)))
    return tuple(plan_with_reasons(config, source_sha256, occurrence, facts, level) for level in levels)


def plan_with_reasons(
    config: Config, source_sha256: str, occurrence: int = 0, facts: Facts | None = None, level: int = 0
) -> PlanAndPredictions:
    """Draw the parameters of one image at one noise level, with the predictions behind the selected effects.

    Parameters are those of `plan_levels`, and the number of the level.
    """
    key = stream_key(config.seed, source_sha256, occurrence)
    uniforms = dict(zip(PARAMETERS, parameter_uniforms(key, len(PARAMETERS)), strict=True))
    if level:
        at_level = dict(zip(PARAMETERS, parameter_uniforms(key, len(PARAMETERS), level), strict=True))
        uniforms |= {name: at_level[name] for name in NOISE_PARAMETERS}
    config = replace(config, noise=noise_levels(config.noise)[level])
    plan = _plan(config, key, uniforms, level)
    if not is_physical(config.noise):
        return plan, ()
    if facts is None:
        raise ValueError("a physical profile needs the facts of the pixels")
    physics = plan_physics(config, uniforms, key)
    span_dn = float(plan.white_level_dn - plan.black_level_dn)
    signals = signal_range(facts, plan.tone, plan.gamma, plan.inverse_gains, plan.exposure, span_dn, plan.rgb2cam)
    predictions = select_effects(config, physics, facts, signals)
    return (
        replace(
            plan,
            physics=physics,
            a_dn=physics.dn_per_e,
            b_dn2=physics.read_std_dn * physics.read_std_dn,
            effects=tuple(each.effect for each in predictions if each.simulated),
            skipped=tuple(f"{each.effect}: {each.reason}" for each in predictions if not each.simulated),
        ),
        predictions,
    )


def _plan(config: Config, key: int, uniforms: dict[str, float], level: int) -> Plan:
    """Return the plan without the numbers and effects of a physical profile."""
    camera, weights, rgb2cam = plan_camera(config.camera, uniforms)
    red, blue, inverse_rgb = gain_distributions(config.gains)
    exposure_ratio = parse_drawn("scene.exposure_ratio", config.scene.exposure_ratio, EXPOSURE_RATIO)
    a_dn, b_dn2 = (0.0, 0.0) if is_physical(config.noise) else plan_noise(config, uniforms)
    span_dn = config.sensor.white_level_dn - config.sensor.black_level_dn
    effects, skipped = plan_effects(config, a_dn, b_dn2, span_dn)
    plan = Plan(
        seed=config.seed,
        stream_key=key,
        downscale=config.source.downscale,
        dequantize=dequantize_method(config.source),
        scene=config.scene.name,
        exposure_ratio=draw_parameter(exposure_ratio, uniforms["exposure_ratio"]),
        camera=camera,
        weights=weights,
        rgb2cam=rgb2cam,
        red_gain=draw_parameter(red, uniforms["red"]),
        blue_gain=draw_parameter(blue, uniforms["blue"]),
        inverse_rgb_gain=draw_parameter(inverse_rgb, uniforms["inverse_rgb"]),
        tone=config.isp.tone,
        gamma="srgb" if config.isp.gamma == "srgb" else float(config.isp.gamma),
        highlight=config.gains.highlight,
        highlight_threshold=config.gains.threshold,
        pattern=config.sensor.pattern,
        bits=config.sensor.bits,
        black_level_dn=config.sensor.black_level_dn,
        white_level_dn=config.sensor.white_level_dn,
        sensor_clip=config.sensor.clip,
        saturated=config.sensor.saturated,
        noise=config.noise.name,
        noise_law=config.noise.law,
        a_dn=a_dn,
        b_dn2=b_dn2,
        effects=effects,
        skipped=skipped,
        accuracy=config.accuracy.name,
        methods=(),
        law_distance=config.accuracy.law_distance,
        level=level,
        dtype=config.output.dtype,
        layout=config.output.layout,
    )
    counts_electrons, normalised = uses_physics(config.noise), is_normalised(config)
    return replace(
        plan, methods=choose_methods(accuracy_budget(config.accuracy), counts_electrons, normalised, is_steep(plan))
    )


# ---------------------------------------------------------------------------------------------------------- camera

Weights = tuple[float, float, float, float]


def plan_camera(camera: CameraConfig, uniforms: dict[str, float]) -> tuple[str, Weights, colour.Matrix]:
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


def convex_weights(uniforms: dict[str, float]) -> Weights:
    """Return four uniforms, each divided by their sum (Brooks et al. 2019, random_ccm())."""
    u0, u1, u2, u3 = (uniforms[f"weight_{i}"] for i in range(4))
    total = u0 + u1 + u2 + u3
    return u0 / total, u1 / total, u2 / total, u3 / total


# ----------------------------------------------------------------------------------------------------------- noise


def plan_noise(config: Config, uniforms: dict[str, float]) -> tuple[float, float]:
    """Draw the two numbers of a noise profile and convert them to the sensor's DN: (a_dn, b_dn2)."""
    noise, sensor = config.noise, config.sensor
    a_distribution, b_distribution = noise_distributions(noise)
    a = draw_parameter(a_distribution, uniforms["a"])
    b = draw_parameter(b_distribution, uniforms["b"], a)
    return noise_in_dn(
        a,
        b,
        units=noise.units or "",
        black=noise.black or "",
        profile_levels_dn=(noise.black_level_dn or 0, noise.white_level_dn or 0),
        sensor_levels_dn=(sensor.black_level_dn, sensor.white_level_dn),
    )


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
