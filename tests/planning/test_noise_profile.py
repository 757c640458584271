"""Numbers of physical noise profiles on the sensor in use, against mpmath and the formulas of their sources."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import mpmath
import numpy as np
import pytest
from helpers.configs import with_branch
from helpers.datasets import Settings
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.config.interpretation import provenance_at
from unprocess_gen.config.iso_forms import value_at
from unprocess_gen.config.schema import PHYSICAL_NUMBERS, BranchConfig, Config, ProvenanceConfig, replaced
from unprocess_gen.config.serialization import dataset_yaml, parse_dataset_yaml
from unprocess_gen.config.settings import settings_of
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.planning.draws import DRAW_COUNT, Draw
from unprocess_gen.planning.noise_profile import PhysicalNoise, evaluate
from unprocess_gen.simulation.plan import Physics

COUNTERS = {draw.name.lower(): int(draw) for draw in Draw}
NAMES = [next((name for name, place in COUNTERS.items() if place == n), "") for n in range(DRAW_COUNT)]
"""Names of the draws by their counters."""

SAME_SENSOR = {
    "imx385": (12, 240, 4095),
    "sony_a7s2": (14, 512, 16300),
    "nikon_d850": (14, 400, 16150),
    "canon_5d4": (14, 512, 16383),
    "canon_70d": (14, 2048, 15303),
    "canon_700d": (14, 2048, 15303),
    "oppo_reno10x": (10, 64, 1023),
}
"""Bits, black and white level of each calibration; on this sensor DN need no conversion."""


def on_its_own_sensor(settings: Settings, noise: str, iso: float, *overrides: str) -> Config:
    """Return a config on the sensor of the calibration."""
    bits, black, white = SAME_SENSOR[noise]
    config = settings(f"noise={noise}", f"noise.iso={iso}", *overrides)
    sensor = replace(config.sensor, bits=bits, black_level_dn=black, white_level_dn=white)
    config = replace(config, sensor=sensor)
    validate_config(config)
    return config


def physics(config: Config, key: int = 0, **uniforms: float) -> Physics:
    profile = PhysicalNoise(config)
    return profile.physics(profile.draw([uniforms.get(name, 0.5) for name in NAMES], key, config.seed))


def close(value: float, expected: Any, rel: float = 1e-15) -> bool:
    return bool(mpmath.almosteq(mpmath.mpf(value), expected, rel_eps=rel, abs_eps=0))


# Forms ----------------------------------------------------------------------------------------------------------------

uniforms = st.integers(0, 2**52 - 1).map(lambda k: (k + 0.5) * 2.0**-52)


@given(iso=st.floats(1, 1e6), slope=st.floats(-2, 2), intercept=st.floats(-3, 3), std=st.floats(0, 1), u=uniforms)
def test_line_is_linear_in_logarithms_with_normal_scatter(
    iso: float, slope: float, intercept: float, std: float, u: float
) -> None:
    with mpmath.workdps(40):
        normal = mpmath.sqrt(2) * mpmath.erfinv(2 * mpmath.mpf(u) - 1)
        middle = slope * mpmath.log(iso) + intercept
        assert close(evaluate(["line", slope, intercept, std], iso, u), mpmath.exp(middle + std * normal))
        assert close(evaluate(["line", slope, intercept], iso, u), mpmath.exp(middle))


ISOS = [(100.0, 1.0), (200.0, 1.5), (800.0, 4.0), (6400.0, 20.0)]


@pytest.mark.parametrize(("iso", "value"), ISOS)
def test_table_by_iso_gives_its_values(iso: float, value: float) -> None:
    assert evaluate(["by_iso", *itertools.chain(*ISOS)], iso) == value
    assert math.isclose(value_at(["by_iso", *itertools.chain(*ISOS)], iso), value)


@given(iso=st.floats(200, 800))
def test_standard_deviation_between_two_isos_is_interpolated_in_logarithms(iso: float) -> None:
    with mpmath.workdps(40):
        share = mpmath.log(mpmath.mpf(iso) / 200) / mpmath.log(4)
        expected = mpmath.mpf(1.5) * (mpmath.mpf(4) / 1.5) ** share
        assert close(evaluate(["by_iso", *itertools.chain(*ISOS)], iso), expected)
        assert close(value_at(["by_iso", *itertools.chain(*ISOS)], iso), expected, 1e-12)


def test_shapes_and_black_errors_between_two_isos_are_interpolated_linearly(settings: Settings) -> None:
    shapes = ["by_iso", 100, 0.1, 400, -0.3, 6400, -0.1]
    errors = ["by_iso", 100, 0.0, 400, [4.0, 8.0, -4.0, 0.0], 6400, [4.0, 8.0, -4.0, 2.0]]
    config = on_its_own_sensor(settings, "canon_70d", 100)
    for iso, shape, error in ((100, 0.1, (0, 0, 0, 0)), (200, -0.1, (2, 4, 0, -2)), (1600, -0.2, (4, 8, 1, -4))):
        made = physics(with_branch(replaced(config, {"noise.iso": iso}), read_shape=shapes, black_error_dn=errors))
        assert math.isclose(made.read_shape, shape, abs_tol=1e-16)
        assert made.black_error_dn == pytest.approx(error, abs=1e-15)  # sites of RGGB from R, G1, B, G2


COLOURS = {"RGGB": ("R", "G1", "G2", "B"), "BGGR": ("B", "G2", "G1", "R")}
COLOURS |= {"GRBG": ("G1", "R", "B", "G2"), "GBRG": ("G2", "B", "R", "G1")}
"""Colours of the sites (0, 0), (0, 1), (1, 0), (1, 1); G1 is the green of the red rows."""


@pytest.mark.parametrize("pattern", COLOURS)
@pytest.mark.parametrize("table", [False, True])
def test_black_errors_follow_the_pattern(settings: Settings, pattern: str, table: bool) -> None:
    errors = {"R": 1.0, "G1": 2.0, "B": 3.0, "G2": 4.0}
    config = replaced(on_its_own_sensor(settings, "canon_70d", 800), {"sensor.pattern": pattern})
    four = list(errors.values())
    made = physics(with_branch(config, black_error_dn=["by_iso", 100, four, 6400, four] if table else four))
    assert made.black_error_dn == tuple(errors[colour] for colour in COLOURS[pattern])


# Scatter --------------------------------------------------------------------------------------------------------------


def scatter_of(settings: Settings, *overrides: str, bodies: int = 1) -> list[tuple[float, ...]]:
    """Return the read and row noise of 40 images, of as many bodies as given."""
    config = with_branch(settings("noise=canon_70d", *overrides), read_std_dn=["line", 0.486806, 1.46427, 0.382006])
    images = [physics(config, image, sensor_unit=(image % bodies + 0.5) / bodies) for image in range(40)]
    return [(made.read_std_dn, made.row_std_dn) for made in images]


@pytest.mark.parametrize(("units", "bodies"), [("1", 1), ("4", 4), ("image", 40)])
def test_a_unit_has_the_same_deviates_at_all_isos(units: str, bodies: int, settings: Settings) -> None:
    """The noise of every body rises with the ISO, by the factor of the line."""
    low, high = (
        np.array(scatter_of(settings, "noise.scatter=unit", f"sensor.units={units}", f"noise.iso={iso}", bodies=bodies))
        for iso in (400, 3200)
    )
    assert len(np.unique(low, axis=0)) == bodies
    np.testing.assert_allclose((high / low).std(axis=0), 0, atol=1e-13)
    assert (high > low).all()


@pytest.mark.parametrize("profile", ["canon_5d4", "canon_70d", "canon_700d", "nikon_d850", "sony_a7s2", "oppo_reno10x"])
def test_by_default_a_profile_has_the_noise_of_its_line(profile: str, settings: Settings) -> None:
    """Read noise does not depend on the seed, nor fall as the ISO rises within a gain mode."""
    config = settings(f"noise={profile}")
    for branch in config.noise.branches:
        isos = np.geomspace(branch.iso[0], branch.iso[1] - 1, 9)
        stds = [
            {physics(replaced(config, {"noise.iso": float(iso), "seed": seed})).read_std_dn for seed in range(3)}
            for iso in isos
        ]
        assert all(len(same) == 1 for same in stds)
        assert (np.diff([min(same) for same in stds]) > 0).all()


def test_without_scatter_lines_remain(settings: Settings) -> None:
    (numbers,) = set(scatter_of(settings, "noise.scatter=off", "noise.iso=3200"))
    expected = mpmath.exp(0.486806 * mpmath.log(3200) + 1.46427) * (4095 - 240) / (15303 - 2048)
    assert close(numbers[0], expected, 1e-14)


# Profiles in conf/ ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("noise", "iso", "shape", "by_colour"),
    [
        ("nikon_d850", 100, -0.1143, (-0.174, -0.194, -0.164, -0.177)),
        ("nikon_d850", 800, -0.2286, (-2.757, -1.628, -2.169, -1.078)),
        ("nikon_d850", 6400, -0.1429, (0.937, 1.489, 1.129, 1.691)),
        ("canon_5d4", 1600, 0.0571, (0.956, 0.067, 0.898, 0.218)),
        ("canon_70d", 6400, -0.0857, (3.321, 3.430, 1.207, 0.087)),
        ("canon_700d", 3200, -0.1286, (0.516, 1.512, 0.152, -0.617)),
        ("sony_a7s2", 3200, -0.0349, (-1.347, -1.371, -1.349, -1.366)),
        ("sony_a7s2", 25600, -0.0909, (4.073, 3.857, 4.296, 4.096)),
        ("imx385", 25600, 0.015, (-12.669,) * 4),
    ],
)
def test_tables_of_eld_are_used_at_their_full_stops(
    settings: Settings, noise: str, iso: int, shape: float, by_colour: tuple[float, ...]
) -> None:
    """Row 2·log2(ISO / 100) of G_shape and color_bias; 0.1 used the last row at ISO 6400 and others in between."""
    made = physics(on_its_own_sensor(settings, noise, iso))
    red, green_1, blue, green_2 = by_colour
    assert made.read_shape == shape
    assert made.black_error_dn == (red, green_1, green_2, blue)


@pytest.mark.parametrize("noise", SAME_SENSOR)
def test_every_number_of_a_profile_has_a_source_and_an_uncertainty(settings: Settings, noise: str) -> None:
    profile = settings(f"noise={noise}").noise
    needed = {
        (name, tuple(branch.iso))
        for branch in profile.branches
        for name in settings_of(BranchConfig)
        if name not in ("iso", "read_law") and getattr(branch, name) not in (None, 0.0)
    }
    every = (min(branch.iso[0] for branch in profile.branches), max(branch.iso[1] for branch in profile.branches))
    needed |= {(name, every) for name in PHYSICAL_NUMBERS if getattr(profile, name) is not None}
    needed |= {("black_level_dn", every), ("white_level_dn", every)}
    for name, (low, high) in needed:
        assert any(
            name in one.numbers and (not one.iso or one.iso[0] <= low <= high <= one.iso[1])
            for one in profile.provenance
        ), (name, low, high)
    assert all(one.source and one.uncertainty for one in profile.provenance)


@pytest.mark.parametrize("noise", SAME_SENSOR)
def test_profile_is_converted_by_the_ratio_of_ranges(settings: Settings, noise: str) -> None:
    iso = 1600
    _, black, white = SAME_SENSOR[noise]
    own = physics(on_its_own_sensor(settings, noise, iso))
    here = physics(settings(f"noise={noise}", "noise.iso=1600"))
    scale = (4095 - 240) / (white - black)
    for name in ("dn_per_e", "read_std_dn", "row_std_dn"):
        assert getattr(here, name) == getattr(own, name) * scale
    assert here.black_error_dn == tuple(error * scale for error in own.black_error_dn)
    for name in ("prnu_std", "dark_e", "hot_pixel_e", "full_well_e", "read_shape"):
        assert getattr(here, name) == getattr(own, name)


# Draws ----------------------------------------------------------------------------------------------------------------


def test_each_number_of_the_scene_is_drawn_from_its_own_uniform(settings: Settings) -> None:
    config = on_its_own_sensor(settings, "canon_70d", 800)
    config = replaced(
        config, {"scene.exposure_s": ["log_uniform", 0.01, 1.0], "scene.temperature_c": ["uniform", 10, 30]}
    )
    middle = physics(config)
    moves = {
        "exposure_s": {"exposure_s", "dark_e", "hot_pixel_e"},
        "temperature_c": {"temperature_c", "dark_e", "hot_pixel_e"},
        "iso": set(),
    }
    for uniform, moved in moves.items():
        other = physics(config, **{uniform: 0.9})
        fields = Physics.__struct_fields__
        assert {name for name in fields if getattr(other, name) != getattr(middle, name)} == moved, uniform


@pytest.mark.parametrize(
    ("law", "uniform", "iso"),
    [
        ("3200", 0.3, 3200.0),
        ("[choice,400,800,1600]", 0.1, 400.0),
        ("[choice,400,800,1600]", 0.99, 1600.0),
        ("[uniform,400,1200]", 0.25, 600.0),
        ("[log_uniform,400,1600]", 0.5, 800.0),
    ],
)
def test_iso_is_drawn_from_its_distribution(settings: Settings, law: str, uniform: float, iso: float) -> None:
    config = settings("noise=sony_a7s2", f"noise.iso={law}")
    validate_config(config)
    assert math.isclose(physics(config, iso=uniform).iso, iso, rel_tol=1e-15)


HEAT = ("noise.dark_e_per_s=1", "noise.dark_reference_c=25", "noise.dark_doubling_c=7", "noise.hot_pixel_e_per_s=50")


@pytest.mark.parametrize(("celsius", "times"), [(25, 1.0), (32, 2.0), (39, 4.0), (18, 0.5), (28.5, math.sqrt(2))])
def test_dark_current_doubles_with_temperature(settings: Settings, celsius: float, times: float) -> None:
    scene = f"scene.temperature_c={celsius}", "scene.exposure_s=4"
    made = physics(settings("noise=imx385", "noise.iso=1600", *HEAT, *scene))
    assert math.isclose(made.dark_e, 4 * times, rel_tol=1e-15)
    assert math.isclose(made.hot_pixel_e, 200 * times, rel_tol=1e-15)


def test_images_share_a_number_of_bodies(settings: Settings) -> None:
    config = settings("noise=imx385", "noise.iso=1600", "sensor.units=3")
    made = [physics(config, key, sensor_unit=(key + 0.5) / 30) for key in range(30)]
    assert [one.sensor_unit for one in made] == [str(key // 10) for key in range(30)]
    assert len({one.body_key for one in made}) == 3
    assert len({(one.sensor_unit, one.body_key) for one in made}) == 3


def test_body_depends_on_seed_and_camera_but_not_on_iso(settings: Settings) -> None:
    config = settings("noise=canon_70d", "noise.iso=1600", "sensor.units=1")
    body = physics(config).body_key
    assert physics(replace(config, noise=replace(config.noise, iso=100))).body_key == body
    assert physics(replace(config, seed=1)).body_key != body
    assert physics(settings("noise=canon_700d", "noise.iso=1600", "sensor.units=1")).body_key != body


# Refused profiles -----------------------------------------------------------------------------------------------------


def assert_refused(config: Config, message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        validate_config(config)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ("noise=imx385", "scene=daylight"),
            "scene.iso=100: noise=imx385 is calibrated for ISO 1600, 3200, 6400, 12800, 25600; give noise.iso=…",
        ),
        (
            ("noise=sony_a7s2", "noise.iso=1800"),
            "noise.iso=1800: noise=sony_a7s2 is calibrated for ISO 100 to 1600, 2000 to 25600",
        ),
        (
            ("noise=sony_a7s2", "noise.iso=[uniform,1000,3000]"),
            "noise.iso=[uniform, 1000, 3000]: noise=sony_a7s2 is calibrated for ISO 100 to 1600, 2000 to 25600; "
            "expected a distribution within one of these ranges",
        ),
        (("noise=imx385", "noise.iso=[uniform,1600,3200]"), "noise.iso=[uniform, 1600, 3200]: noise=imx385 is"),
        (("noise=nikon_d850", "noise.iso=99"), "noise.iso=99: noise=nikon_d850 is calibrated for ISO 100 to 6400"),
        (("noise=imx385_iso3200", "noise.iso=1600"), "noise.iso=1600: noise=imx385_iso3200 holds for one ISO"),
        (("noise=nikon_d850", "noise.a=1"), "noise.a=1: noise=nikon_d850 is a physical profile; expected null"),
        (("noise=nikon_d850", "effects.quantise=off"), "effects.quantise=off: integer output is always rounded"),
        (("noise=nikon_d850", "effects.heteroscedastic=on"), "noise=nikon_d850 offers the physical effects"),
        (("noise=imx385_iso3200", "effects.shot=on"), "noise=imx385_iso3200 offers heteroscedastic only"),
        (("noise=nikon_d850", "noise.assumed=[gain]"), "noise.assumed=gain: expected one of prnu_std, "),
        (
            ("noise=heteroscedastic", "noise.law=poisson", "noise.a=1e-6", "noise.b=1"),
            "noise.a=1e-06: noise.law=poisson counts up to 1e+09 electrons, so a must be 0, or at least 3.855e-06",
        ),
        (("noise=nikon_d850", "sensor.units=0"), "sensor.units=0: expected image, or a number of bodies"),
    ],
)
def test_inconsistent_physical_profiles_are_refused(
    settings: Settings, overrides: tuple[str, ...], message: str
) -> None:
    assert_refused(settings(*overrides), message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"read_std_dn": ["cubic", 1]},
            "branches[0].read_std_dn=[cubic, 1]: expected a number of 0 or more, up to 1e+09, or a form",
        ),
        ({"read_std_dn": ["line", 1]}, "line takes 2 or 3 finite numbers"),
        ({"read_std_dn": ["line", 9.0, 0.0, 0.0]}, "exceeds 1e+09 within the ISO range; expected slope, intercept"),
        ({"read_std_dn": -1}, "branches[0].read_std_dn=-1: expected a number of 0 or more"),
        ({"read_std_dn": None}, "branches[0].read_std_dn=null: expected a number of 0 or more"),
        ({"dn_per_e": 0}, "branches[0].dn_per_e=0: expected a gain above 0"),
        ({"dn_per_e": ["line", 0, -99.0]}, "branches[0].dn_per_e=[line, 0, -99.0]: expected a gain above 0"),
        ({"read_shape": -0.5}, "branches[0].read_shape=-0.5: expected a shape of more than -0.5, where the Tukey-"),
        ({"read_law": "cauchy"}, "branches[0].read_law=cauchy: expected one of gaussian, tukey"),
        ({"black_error_dn": [1.0, 2.0]}, "expected a number, four (R, G of the red rows, B, G of the blue rows)"),
        ({"black_error_dn": ["by_iso", 400, [1, 2], 6400, 1]}, "expected a number, four (R, G of the red rows, B,"),
        ({"read_shape": ["by_iso", 400, 0.1, 6400, "x"]}, "expected a shape of more than -0.5"),
        ({"read_shape": ["by_iso", 400, 0.1, 6400, 10]}, "expected a shape of more than -0.5"),
        ({"read_std_dn": ["by_iso", 400, 1.0, 6400]}, "expected pairs of ISO and value, ISOs in ascending order"),
        ({"read_std_dn": ["by_iso", 6400, 1.0, 400, 2.0]}, "expected pairs of ISO and value, ISOs in ascending order"),
        ({"read_std_dn": ["by_iso", 400, 1.0, 6400, 0]}, "expected numbers above 0, up to 1e+09"),
        ({"row_std_dn": ["by_iso", 800, 1.0, 6400, 2.0]}, "has ISO 800 to 6400; expected values for the ISOs of the"),
        ({"read_law": "tukey_lambda", "read_shape": -0.46}, "read_shape=-0.46: draws of 32 bits lack more than 12 %"),
        (
            {"read_law": "tukey_lambda", "read_shape": ["by_iso", 1, 0.1, 6400, -0.49]},
            "expected shapes of -0.45 or more",
        ),
        ({"iso": [800, 100]}, "branches[0].iso=[800, 100]: expected the lowest and the highest ISO"),
    ],
)
def test_branch_with_invalid_numbers_is_refused(settings: Settings, change: dict[str, Any], message: str) -> None:
    config = settings("noise=nikon_d850")
    branch = replace(config.noise.branches[0], **change)
    assert_refused(replaced(config, {"noise.branches": [branch, *config.noise.branches[1:]]}), message)


@pytest.mark.parametrize(
    "overrides",
    [
        ("noise=sony_a7s2", "noise.iso=[uniform,100,1000]"),
        ("noise=nikon_d850", "noise.iso=[log_uniform,100,6400]"),
        ("noise=nikon_d850", "noise.iso=[uniform,300,500]"),
    ],
)
def test_distribution_of_isos_may_cross_branches_that_touch(settings: Settings, overrides: tuple[str, ...]) -> None:
    config = settings(*overrides)
    validate_config(config)
    for uniform in (0.01, 0.5, 0.99):
        assert physics(config, iso=uniform).read_std_dn > 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"numbers": []}, "noise.provenance[0].numbers=[]: expected at least one of black_level_dn, "),
        (
            {"numbers": ["gain"]},
            "noise.provenance[0].numbers=gain: expected one of black_level_dn, white_level_dn, dn_per",
        ),
        ({"iso": [800]}, "noise.provenance[0].iso=[800]: expected the lowest and the highest ISO, [100, 6400], or []"),
        ({"source": ""}, "noise.provenance[0].source='': expected a text"),
        ({"uncertainty": ""}, "noise.provenance[0].uncertainty='': expected a text"),
    ],
)
def test_incomplete_provenance_is_refused(settings: Settings, change: dict[str, Any], message: str) -> None:
    config = settings("noise=nikon_d850")
    statement = ProvenanceConfig(numbers=["dn_per_e"], iso=[100.0, 6400.0], source="a page", uncertainty="1 %")
    validate_config(replaced(config, {"noise.provenance": [statement]}))
    assert_refused(replaced(config, {"noise.provenance": [replace(statement, **change)]}), message)


def test_provenance_at_an_iso_is_that_of_its_branch(settings: Settings) -> None:
    noise = settings("noise=nikon_d850").noise

    def sources(*isos: float) -> list[str]:
        return [one.source for one in provenance_at(noise, isos) if "read_std_dn" in one.numbers]

    assert sources(100, 200) == ["ELD, Profile-1, Gaussian line"]
    assert sources(6400) == ["ELD, Profile-2, Gaussian line"]
    assert sources(100, 6400) == ["ELD, Profile-2, Gaussian line", "ELD, Profile-1, Gaussian line"]


@pytest.mark.parametrize("noise", SAME_SENSOR)
def test_config_yaml_records_every_table_of_a_profile(settings: Settings, noise: str) -> None:
    config = on_its_own_sensor(settings, noise, 3200)
    text = dataset_yaml(config)
    recorded, _ = parse_dataset_yaml(text)
    assert recorded.noise == replace(config.noise, provenance=[])
    assert dataset_yaml(recorded) == text
    assert "*" not in text.replace("*.", "")  # no YAML aliases, as conf/noise has
    assert physics(recorded) == physics(config)


def test_branch_without_optional_numbers_lacks_their_effects(settings: Settings) -> None:
    config = settings("noise=nikon_d850", "noise.iso=100")
    branch = BranchConfig(iso=[100, 100], dn_per_e=1.0, read_std_dn=2.0)
    config = replace(
        config, noise=replace(config.noise, branches=[branch], prnu_std=None, dark_e_per_s=None, full_well_e=None)
    )
    validate_config(config)
    made = physics(config)
    assert (made.row_std_dn, made.column_std_dn, made.black_error_dn) == (0.0, 0.0, (0.0,) * 4)
    assert (made.prnu_std, made.dark_e, made.full_well_e, made.read_shape) == (0.0, 0.0, 0.0, 0.0)
