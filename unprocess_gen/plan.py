"""The plan of an image: every parameter, drawn once. After this nothing is random; all is a function of (pixels, plan).

Draws come from the image's own stream ``parameters`` (`streams`), a counter for each name in `PARAMETERS`, so a draw
that is not needed moves no other. What needs an exponential, a logarithm or a quantile is computed in `decimal` and
rounded once, since no libm gives the same last bit everywhere; that costs up to a millisecond an image.
"""

from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal, localcontext

from unprocess_gen import colour
from unprocess_gen.config import CameraConfig, Config, gain_laws, noise_laws
from unprocess_gen.records import Law, Plan
from unprocess_gen.sensor import noise_in_dn
from unprocess_gen.streams import parameter_uniforms, stream_key
from unprocess_gen.tables import DIGITS, normal_cdf, normal_quantile

PARAMETERS = ("weight_0", "weight_1", "weight_2", "weight_3", "choice", "red", "blue", "inverse_rgb", "a", "b")
"""The number of each draw in the image's stream. Part of every dataset ever made: append, never reorder."""

METHODS = ("curve:exact_table", "pair:fused_float64", "normal:inverse_cdf_table")
"""How the stages are computed; the row names them."""


def plan_image(config: Config, source_sha256: str, occurrence: int = 0) -> Plan:
    """Draw every parameter of one image.

    ``source_sha256`` is the hex digest of the source's bytes and ``occurrence`` the number of identical files before
    it; together with ``config.seed`` they decide all draws. ``config`` has passed `config.check`.
    """
    key = stream_key(config.seed, source_sha256, occurrence)
    uniforms = dict(zip(PARAMETERS, parameter_uniforms(key, len(PARAMETERS)), strict=True))
    camera, weights, rgb2cam = plan_camera(config.camera, uniforms)
    red, blue, inverse_rgb = gain_laws(config.gains)
    a_dn, b_dn2 = plan_noise(config, uniforms)
    span_dn = config.sensor.white_level_dn - config.sensor.black_level_dn
    effects, skipped = plan_effects(config.noise.name, a_dn, b_dn2, span_dn)
    return Plan(
        seed=config.seed,
        stream_key=key,
        camera=camera,
        weights=weights,
        rgb2cam=rgb2cam,
        red_gain=draw(red, uniforms["red"]),
        blue_gain=draw(blue, uniforms["blue"]),
        inverse_rgb_gain=draw(inverse_rgb, uniforms["inverse_rgb"]),
        tone=config.isp.tone,
        gamma="srgb" if config.isp.gamma == "srgb" else float(config.isp.gamma),
        highlight=config.gains.highlight,
        highlight_threshold=config.gains.threshold,
        pattern=config.sensor.pattern,
        bits=config.sensor.bits,
        black_level_dn=config.sensor.black_level_dn,
        white_level_dn=config.sensor.white_level_dn,
        sensor_clip=config.sensor.clip,
        noise=config.noise.name,
        a_dn=a_dn,
        b_dn2=b_dn2,
        effects=effects,
        skipped=skipped,
        accuracy="exact",
        methods=METHODS,
    )


# ---------------------------------------------------------------------------------------------------------- camera

Weights = tuple[float, float, float, float]


def plan_camera(camera: CameraConfig, uniforms: dict[str, float]) -> tuple[str, Weights, colour.Matrix]:
    """Return the camera's name, the weights of the four known cameras in it, and the matrix from RGB to camera."""
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
    """Return four uniforms over their sum (Brooks et al. 2019, random_ccm())."""
    u0, u1, u2, u3 = (uniforms[f"weight_{i}"] for i in range(4))
    total = u0 + u1 + u2 + u3
    return u0 / total, u1 / total, u2 / total, u3 / total


# ----------------------------------------------------------------------------------------------------------- noise


def plan_noise(config: Config, uniforms: dict[str, float]) -> tuple[float, float]:
    """Draw the noise level and convert it to the sensor's DN."""
    noise, sensor = config.noise, config.sensor
    a_law, b_law = noise_laws(noise)
    a = draw(a_law, uniforms["a"])
    b = draw(b_law, uniforms["b"], a)
    return noise_in_dn(
        a,
        b,
        units=noise.units or "",
        black=noise.black or "",
        profile_levels_dn=(noise.black_level_dn or 0, noise.white_level_dn or 0),
        sensor_levels_dn=(sensor.black_level_dn, sensor.white_level_dn),
    )


def plan_effects(noise: str, a_dn: float, b_dn2: float, span_dn: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the effects that are simulated, in order, and those skipped, each with its reason.

    ``span_dn`` is white less black: where the variance is nowhere above 0 in it, there is no noise to simulate.
    """
    if a_dn * span_dn + b_dn2 <= 0:
        return ("quantise",), (f"heteroscedastic: noise={noise} has no variance (a_dn={a_dn!r}, b_dn2={b_dn2!r})",)
    return ("heteroscedastic", "quantise"), ()


# ------------------------------------------------------------------------------------------------------------ draws


def draw(law: Law, uniform: float, a: float = 0.0) -> float:
    """Return the value of a law at a uniform in (0, 1); ``a`` is what ``log_linear_in_a`` depends on."""
    return LAWS[law.kind](uniform, a, *law.numbers)


def _constant(u: float, a: float, value: float) -> float:
    return value


def _uniform(u: float, a: float, low: float, high: float) -> float:
    return low + u * (high - low)


def _log_uniform(u: float, a: float, low: float, high: float) -> float:
    with localcontext(prec=DIGITS):
        bottom, top = Decimal(low).ln(), Decimal(high).ln()
        return float((bottom + Decimal(u) * (top - bottom)).exp())


def _truncated(u: float, mean: float, std: float, low: float, high: float) -> Decimal:
    """A normal draw that lies in [low, high]: the quantile of a uniform between their probabilities."""
    bottom, top = (normal_cdf((Decimal(limit) - Decimal(mean)) / Decimal(std)) for limit in (low, high))
    value = Decimal(mean) + Decimal(std) * normal_quantile(bottom + Decimal(u) * (top - bottom))
    return min(max(value, Decimal(low)), Decimal(high))


def _truncated_normal(u: float, a: float, mean: float, std: float, low: float, high: float) -> float:
    with localcontext(prec=DIGITS):
        return float(_truncated(u, mean, std, low, high))


def _inverse_truncated_normal(u: float, a: float, mean: float, std: float, low: float, high: float) -> float:
    with localcontext(prec=DIGITS):
        return float(1 / _truncated(u, mean, std, low, high))


def _log_linear_in_a(u: float, a: float, slope: float, intercept: float, std: float) -> float:
    """ln b = slope · ln a + intercept + std · n (Brooks et al. 2019, random_noise_levels(); natural logarithms)."""
    with localcontext(prec=DIGITS):
        line = Decimal(slope) * Decimal(a).ln() + Decimal(intercept)
        return float((line + Decimal(std) * normal_quantile(Decimal(u))).exp())


LAWS: dict[str, Callable[..., float]] = {
    "constant": _constant,
    "uniform": _uniform,
    "log_uniform": _log_uniform,
    "truncated_normal": _truncated_normal,
    "inverse_truncated_normal": _inverse_truncated_normal,
    "log_linear_in_a": _log_linear_in_a,
}
"""What each law does with a uniform in (0, 1)."""
