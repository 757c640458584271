"""Plans: each parameter follows its distribution, moves no other, and is reproducible."""

from __future__ import annotations

import decimal
import hashlib
import math
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from operator import attrgetter

import mpmath
import pytest
from helpers.datasets import Settings
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.config.distributions import Distribution
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core import fixed_point
from unprocess_gen.core.random_streams import PARAMETERS, purpose, stream_key
from unprocess_gen.planning import noise_profile, parameters
from unprocess_gen.planning import plan as planning
from unprocess_gen.planning.draws import DRAW_COUNT, Draw
from unprocess_gen.planning.parameters import draw_parameter as draw
from unprocess_gen.planning.plan import TwoNumberLevel, plan_camera, plan_image, plan_pairs
from unprocess_gen.simulation.facts import Facts
from unprocess_gen.simulation.kernels.draws import draws
from unprocess_gen.simulation.plan import NUMBERS, Plan
from unprocess_gen.simulation.reference import colour

SHA = hashlib.sha256(b"a photograph").hexdigest()
FIRST, LAST = 2.0**-53, 1 - 2.0**-53
"""Smallest and largest uniform of a stream."""

UNIFORMS = [FIRST, 1e-9, 0.25, 0.5, LAST, *draws(12345, 200, purpose(PARAMETERS))[1].tolist()]
uniforms = st.integers(0, 2**52 - 1).map(lambda k: (k + 0.5) / 2**52)


def plan_of(settings: Settings, *overrides: str, sha: str = SHA, occurrence: int = 0) -> Plan:
    config = settings(*overrides)
    validate_config(config)
    return plan_image(config, sha, occurrence)


def named(uniform: float = 0.5, **chosen: float) -> list[float]:
    by_counter = {Draw[name.upper()]: value for name, value in chosen.items()}
    return [by_counter.get(counter, uniform) for counter in range(DRAW_COUNT)]  # type: ignore[call-overload]


# Distributions --------------------------------------------------------------------------------------------------------

GAIN = Distribution("truncated_normal", (0.8, 0.1, 0.5, 1.1))
LITERAL = Distribution("inverse_truncated_normal", (0.8, 0.1, 0.5, 1.1))
SHOT = Distribution("log_uniform", (0.0001, 0.012))
READ = Distribution("log_linear_in_a", (2.18, 1.2, 0.26))


def normal_cdf(z: mpmath.mpf) -> mpmath.mpf:
    return mpmath.erfc(-z / mpmath.sqrt(2)) / 2


def normal_quantile(p: mpmath.mpf) -> mpmath.mpf:
    return mpmath.sqrt(2) * mpmath.erfinv(2 * p - 1)


def by_mpmath(law: Distribution, uniform: float, a: float) -> mpmath.mpf:
    """Evaluate a distribution with mpmath, to 40 digits."""
    u = mpmath.mpf(uniform)
    numbers = [mpmath.mpf(number) for number in law.numbers]
    if law.kind == "log_uniform":
        low, high = numbers
        return low * (high / low) ** u
    if law.kind == "log_linear_in_a":
        slope, intercept, std = numbers
        return mpmath.exp(slope * mpmath.log(mpmath.mpf(a)) + intercept + std * normal_quantile(u))
    mean, std, low, high = numbers
    bottom, top = (normal_cdf((limit - mean) / std) for limit in (low, high))
    value = mean + std * normal_quantile(bottom + u * (top - bottom))
    return 1 / value if law.kind == "inverse_truncated_normal" else value


@pytest.mark.parametrize(
    "law",
    [
        GAIN,
        LITERAL,
        SHOT,
        READ,
        Distribution("truncated_normal", (1.0, 0.25, 0.9, 2.5)),
        Distribution("truncated_normal", (2.0, 0.1, 1.4, 2.6)),
        Distribution("log_uniform", (1e-12, 3.0)),
        Distribution("log_linear_in_a", (-1.5, 0.0, 2.0)),
        Distribution("log_linear_in_a", (2.18, 1.2, 0.0)),
    ],
    ids=lambda law: f"{law.kind} {law.numbers}",
)
def test_draw_is_correctly_rounded_quantile_of_its_distribution(law: Distribution) -> None:
    """Half a unit in the last place; both sides have 24 digits or more, so only near ties could differ."""
    with mpmath.workdps(40):
        for uniform in UNIFORMS:
            exact = by_mpmath(law, uniform, a=0.0037)
            found = draw(law, uniform, 0.0037)
            assert abs(mpmath.mpf(found) - exact) <= mpmath.mpf(math.ulp(found)) * (0.5 + 1e-8), uniform


@given(uniforms, st.floats(0.01, 10), st.floats(1e-6, 10))
def test_uniform_draw_is_linear_within_three_roundings(uniform: float, low: float, width: float) -> None:
    high = low + width
    exact = Fraction(low) + Fraction(uniform) * (Fraction(high) - Fraction(low))
    slack = (2 * (Fraction(high) - Fraction(low)) + exact) / 2**53
    assert abs(Fraction(draw(Distribution("uniform", (low, high)), uniform)) - exact) <= slack * (
        1 + Fraction(1, 10**6)
    )


@pytest.mark.parametrize("uniform", [FIRST, 0.5, LAST])
@pytest.mark.parametrize(
    ("law", "low", "high"),
    [
        (Distribution("uniform", (1.9, 2.4)), 1.9, 2.4),
        (Distribution("uniform", (1.5, 1.9)), 1.5, 1.9),
        (GAIN, 0.5, 1.1),
        (LITERAL, 1 / 1.1, 2.0),
        (SHOT, 0.0001, 0.012),
        (Distribution("log_uniform", (1e-300, 1e300)), 1e-300, 1e300),
        (Distribution("truncated_normal", (1.0, 0.1, 1.5, 1.6)), 1.5, 1.6),
        (Distribution("truncated_normal", (1.0, 0.1, 0.4, 0.5)), 0.4, 0.5),
    ],
    ids=lambda value: f"{value.kind} {value.numbers}" if isinstance(value, Distribution) else "",
)
def test_draw_is_within_limits_for_any_uniform(law: Distribution, low: float, high: float, uniform: float) -> None:
    assert low <= draw(law, uniform) <= high


@given(uniforms)
def test_paper_literal_gain_is_inverse_of_brooks_gain(uniform: float) -> None:
    """Both are rounded once, so their product is within two half units in the last place of 1."""
    product = Fraction(draw(GAIN, uniform)) * Fraction(draw(LITERAL, uniform))
    assert abs(product - 1) <= Fraction(2, 2**53) * (1 + Fraction(1, 10**6))


# Cameras --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("uniform", "camera"), [(FIRST, 0), (0.25 - FIRST, 0), (0.25 + FIRST, 1), (0.75 - FIRST, 2), (LAST, 3)]
)
def test_choice_is_the_quarter_that_contains_the_uniform(settings: Settings, uniform: float, camera: int) -> None:
    name, weights, _ = plan_camera(settings("camera=choice").camera, named(choice=uniform))
    assert name == list(colour.CAMERAS)[camera]
    assert weights.index(1.0) == camera


SONY = colour.rgb2cam(colour.CAMERAS["sony_a7r"])
MIXED = colour.rgb2cam(colour.mix(tuple(colour.CAMERAS.values()), (0.25, 0.5, 0, 0.25)))


@pytest.mark.parametrize(
    ("overrides", "name", "weights", "rgb2cam"),
    [
        *(([f"camera={name}"], name, [name == other for other in colour.CAMERAS], colour.rgb2cam(matrix))
          for name, matrix in colour.CAMERAS.items()),
        (["camera.weights=[1,2,0,1]"], "convex", [0.25, 0.5, 0, 0.25], MIXED),
        (["camera=identity"], "identity", [0] * 4, colour.IDENTITY),
        (["camera=custom", f"camera.xyz2cam={[*colour.CAMERAS['sony_a7r']]}"], "custom", [0] * 4, SONY),
    ],
)  # fmt: skip
def test_camera_has_the_weights_and_the_matrix_of_its_option(
    settings: Settings, overrides: list[str], name: str, weights: list[float], rgb2cam: colour.Matrix
) -> None:
    camera = plan_of(settings, *overrides).camera
    assert (camera.camera, [*camera.weights], camera.rgb2cam) == (name, weights, rgb2cam)


@pytest.mark.parametrize("weights", ["null", "[1,2,0,1]", "[0,0,1,0]"])
def test_compiled_and_plain_matrices_of_a_mix_are_equal(settings: Settings, weights: str) -> None:
    """Redrawn plans compile it; other plans do not wait for the compiler."""
    camera = settings(f"camera.weights={weights}").camera
    for key in range(100):
        uniforms = draws(key, DRAW_COUNT, purpose(PARAMETERS))[1].tolist()
        assert plan_camera(camera, uniforms, is_compiled=True) == plan_camera(camera, uniforms)


# Draws and names ------------------------------------------------------------------------------------------------------


def test_counters_of_draws_never_change() -> None:
    names = "weight_0 weight_1 weight_2 weight_3 choice red blue inverse_rgb a b iso exposure_s temperature_c"
    assert [draw.name.lower() for draw in sorted(Draw)] == [
        *names.split(), "exposure_ratio", "sensor_unit", "light", "cct", "light_distance", "ev",
    ]  # fmt: skip
    assert {name: number.counter for name, number in NUMBERS.items() if number.counter >= 0} == {
        "read_std_dn": 1, "row_std_dn": 2, "column_std_dn": 3, "column_temporal_std_dn": 4,
    }  # fmt: skip


def test_each_parameter_uses_the_uniform_of_its_name(settings: Settings) -> None:
    plan = plan_of(settings, "noise=brooks2019")
    u = draws(plan.stream_key, DRAW_COUNT, purpose(PARAMETERS))[1].tolist()
    assert plan.camera.red_gain == draw(Distribution("uniform", (1.9, 2.4)), u[Draw.RED])
    assert plan.camera.blue_gain == draw(Distribution("uniform", (1.5, 1.9)), u[Draw.BLUE])
    assert plan.camera.inverse_rgb_gain == draw(GAIN, u[Draw.INVERSE_RGB])
    a = draw(SHOT, u[Draw.A])
    assert plan.noise.a_dn == a * 3855.0
    assert plan.noise.b_dn2 == draw(READ, u[Draw.B], a) * 3855.0 * 3855.0
    assert plan.camera.weights[0] == u[Draw.WEIGHT_0] / (
        u[Draw.WEIGHT_0] + u[Draw.WEIGHT_1] + u[Draw.WEIGHT_2] + u[Draw.WEIGHT_3]
    )


GAIN_DRAWS = ("camera.red_gain", "camera.blue_gain", "camera.inverse_rgb_gain")
NOISE_DRAWS = ("noise.a_dn", "noise.b_dn2")
CAMERA_DRAWS = ("camera.camera", "camera.weights", "camera.rgb2cam")


@pytest.mark.parametrize(
    ("override", "unmoved"),
    [
        ("camera=sony_a7r", GAIN_DRAWS + NOISE_DRAWS),
        ("camera=choice", GAIN_DRAWS + NOISE_DRAWS),
        ("camera=identity", GAIN_DRAWS + NOISE_DRAWS),
        ("gains=unity", CAMERA_DRAWS + NOISE_DRAWS),
        ("gains.red=2.0", ("camera.blue_gain", "camera.inverse_rgb_gain", *CAMERA_DRAWS, *NOISE_DRAWS)),
        ("gains.inverse_rgb=0.8", ("camera.red_gain", "camera.blue_gain", *CAMERA_DRAWS, *NOISE_DRAWS)),
        ("noise=none", CAMERA_DRAWS + GAIN_DRAWS),
        ("noise.b=0.001", ("noise.a_dn", *CAMERA_DRAWS, *GAIN_DRAWS)),
        ("sensor=generic_14bit", CAMERA_DRAWS + GAIN_DRAWS),
        ("isp=srgb", CAMERA_DRAWS + GAIN_DRAWS + NOISE_DRAWS),
    ],
)
def test_unused_draw_moves_no_other(settings: Settings, override: str, unmoved: tuple[str, ...]) -> None:
    before = plan_of(settings, "noise=brooks2019")
    after = plan_of(settings, *([] if override.startswith("noise=") else ["noise=brooks2019"]), override)
    assert after != before
    for name in unmoved:
        assert attrgetter(name)(after) == attrgetter(name)(before), name


DRAWN = (*GAIN_DRAWS, *NOISE_DRAWS, "camera.weights", "stream_key")


@pytest.mark.parametrize("other", ["seed", "photograph", "occurrence"])
def test_other_seed_source_or_occurrence_changes_every_draw(settings: Settings, other: str) -> None:
    before = plan_of(settings, "noise=brooks2019")
    after = plan_of(
        settings,
        "noise=brooks2019",
        *(["seed=1"] if other == "seed" else []),
        sha=hashlib.sha256(b"another").hexdigest() if other == "photograph" else SHA,
        occurrence=int(other == "occurrence"),
    )
    for name in DRAWN:
        assert attrgetter(name)(after) != attrgetter(name)(before), name


def test_stream_key_is_derived_from_seed_and_source(settings: Settings) -> None:
    plan = plan_of(settings, "seed=7", occurrence=2)
    assert (plan.seed, plan.stream_key) == (7, stream_key(7, SHA, 2))


# Noise ----------------------------------------------------------------------------------------------------------------


def test_profile_is_unchanged_on_its_own_sensor(settings: Settings) -> None:
    plan = plan_of(settings, "noise=imx385_iso3200")
    assert (plan.noise.noise, plan.noise.a_dn, plan.noise.b_dn2) == ("imx385_iso3200", 6.955588, 38.117816)


def test_profile_is_converted_to_the_sensor_once(settings: Settings) -> None:
    """Slope times s, intercept times s², s = 15359/3855; two conversions would give s² and s⁴."""
    config = settings("noise=imx385_iso3200", "sensor=generic_14bit")
    s = Fraction(15359, 3855)
    a, b = TwoNumberLevel(config).two_numbers(named())
    assert abs(Fraction(a) / (Fraction(6.955588) * s) - 1) <= Fraction(21, 10) / 2**53
    assert abs(Fraction(b) / (Fraction(38.117816) * s * s) - 1) <= Fraction(41, 10) / 2**53
    plan = plan_image(config, SHA)
    assert (plan.noise.a_dn, plan.noise.b_dn2) == (a, b)


def test_heteroscedastic_numbers_are_in_dn_of_the_sensor(settings: Settings) -> None:
    for sensor in ("imx385_12bit", "generic_10bit", "generic_16bit"):
        plan = plan_of(settings, "noise=heteroscedastic", "noise.a=1.25", "noise.b=7.5", f"sensor={sensor}")
        assert (plan.noise.a_dn, plan.noise.b_dn2) == (1.25, 7.5)


# Recorded values ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("a", "b"), [(0.0, 0.0), (0.0, -3.0), (0.001, -1e6)])
def test_noise_without_variance_is_skipped_with_reason(settings: Settings, a: float, b: float) -> None:
    plan = plan_of(settings, "noise=heteroscedastic", f"noise.a={a}", f"noise.b={b}", "noise.negative_variance=clip")
    assert plan.noise.effects == ("quantise",)
    (reason,) = plan.noise.skipped
    assert reason.startswith("heteroscedastic: noise=heteroscedastic has no variance")


def test_plan_contains_the_values_of_the_config(settings: Settings) -> None:
    plan = plan_of(
        settings, "sensor=generic_10bit", "sensor.pattern=GBRG", "sensor.clip=black", "isp=srgb", "gains=unity",
        "gains.threshold=0.75", "gains.highlight=gray_mean",
    )  # fmt: skip
    assert (plan.sensor.bits, plan.sensor.black_level_dn, plan.sensor.white_level_dn) == (10, 64, 1023)
    assert (plan.sensor.pattern, plan.sensor.sensor_clip) == ("GBRG", "black")
    assert (plan.isp.tone, plan.isp.gamma) == ("none", "srgb")
    assert (plan.isp.highlight, plan.isp.highlight_threshold) == ("gray_mean", 0.75)


def test_planning_imports_neither_opencv_nor_hydra() -> None:
    code = "import sys, unprocess_gen.planning.plan; print({'cv2', 'hydra', 'omegaconf'} & set(sys.modules))"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "set()\n"


# Cost -----------------------------------------------------------------------------------------------------------------

PHYSICAL_PROFILES = ("sony_a7s2", "nikon_d850", "canon_5d4", "imx385", "oppo_reno10x")


def forget_plans() -> None:
    """Drop what is kept for a config, so that its numbers are computed again."""
    planning._planners.clear()
    known = planning._planner_without_seed, noise_profile._in_table, noise_profile._linear_in_table
    for function in (*known, noise_profile._on_line):
        function.cache_clear()  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    "overrides",
    [
        ("noise=brooks2019",),
        ("noise=brooks2019", "noise.levels=3", "gains=paper_literal"),
        *((f"noise={noise}", "noise.iso=1600", "scene=night", "noise.assumed=[]") for noise in PHYSICAL_PROFILES),
        ("noise=canon_70d", "noise.iso=[log_uniform,100,6400]", "scene.exposure_s=[log_uniform,0.001,1]"),
    ],
    ids=" ".join,
)
@pytest.mark.parametrize("count", [20, pytest.param(2000, marks=pytest.mark.slow)])
def test_plans_have_the_digits_of_decimal(
    settings: Settings, overrides: tuple[str, ...], count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, facts = settings(*overrides), Facts(128, 128, 256, 3, 250)
    plans = [plan_pairs(config, f"{image:064x}", facts=facts) for image in range(count)]
    monkeypatch.setattr(parameters, "FIXED_POINT", {})
    for name in ("nearest_log_linear", "nearest_log_between", "nearest_between"):
        monkeypatch.setattr(fixed_point, name, lambda *numbers: None)
    forget_plans()
    for image, plan in enumerate(plans):
        assert plan_pairs(config, f"{image:064x}", facts=facts) == plan


@pytest.mark.parametrize("iso", [200, 1000])
def test_plans_do_not_depend_on_the_decimal_context(settings: Settings, iso: int) -> None:
    config = settings("noise=canon_5d4", f"noise.iso={iso}", "noise.assumed=[]")
    facts, narrow = Facts(128, 128, 256, 3, 250), plan_image(config, SHA, facts=Facts(128, 128, 256, 3, 250))
    forget_plans()
    with decimal.localcontext(prec=60):
        assert plan_image(config, SHA, facts=facts) == narrow


def test_plans_of_one_config_are_independent(settings: Settings) -> None:
    """What is kept for a config contains nothing of an image or a seed."""
    config, facts = settings("noise=sony_a7s2", "scene=night", "noise.assumed=[]"), Facts(128, 128, 256, 3, 250)
    first = plan_pairs(config, SHA, facts=facts)
    plan_pairs(config, "0" * 64, 3, Facts(7, 5, 65536, 100, 200, 12), 2)
    plan_pairs(replace(config, seed=9), SHA, facts=facts)
    assert plan_pairs(config, SHA, facts=facts) == first
    assert plan_pairs(replace(config, seed=9), SHA, facts=facts)[0].seed == 9
