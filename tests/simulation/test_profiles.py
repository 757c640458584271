"""Photographs of other primaries and curves: light by own formulas, the same in every tier, and white stays white."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from helpers.configs import composed
from helpers.photographs import pixels

import unprocess_gen as ug
from unprocess_gen.planning.effect_selection import facts_of
from unprocess_gen.planning.frame_model import signal_range
from unprocess_gen.simulation.pair import make_pair, reference_pair
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.profiles import Curve, Profile, light_tables
from unprocess_gen.simulation.reference.primaries import PRIMARIES, primaries2srgb
from unprocess_gen.simulation.reference.unprocess import camera_light

GAMMA: Curve = (1.8, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
P3 = Profile("Display P3", primaries2srgb(PRIMARIES["p3"]))
WIDE = Profile("wide", primaries2srgb(PRIMARIES["rec2020"]), (GAMMA, None, bytes(range(0, 256, 5))))
PICTURE = pixels(3, 33, 70)
PRIMARY = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255], [0, 0, 0]]], np.uint8)


def planned(profile: Profile, *overrides: str, picture: np.ndarray = PICTURE) -> Plan:
    return ug.plan_image(picture, composed(*overrides)).decoded(profile)


@pytest.mark.parametrize("code", [0, 1, 9, 100, 254, 255])
@pytest.mark.parametrize(("tone", "gamma"), [("smoothstep", 2.2), ("none", "srgb"), ("none", 1)])
def test_tables_are_those_of_the_formula(code: int, tone: str, gamma: float | str) -> None:
    with mpmath.workdps(30):
        light = (mpmath.mpf(code) / 255) ** mpmath.mpf(1.8)
        encoded = mpmath.mpf("1.055") * light ** (1 / mpmath.mpf("2.4")) - mpmath.mpf("0.055")
        value = mpmath.mpf("12.92") * light if light <= 0.0031308 else encoded
        if tone == "smoothstep":
            value = mpmath.mpf(0.5) - mpmath.sin(mpmath.asin(1 - 2 * value) / 3)
        expected = light if gamma == "srgb" else value ** mpmath.mpf(gamma)
    assert light_tables(WIDE, tone, gamma, 256)[0][code] == pytest.approx(float(expected), rel=1e-12, abs=1e-24)


def test_colours_outside_srgb_reach_the_camera_unclipped() -> None:
    plan = planned(P3, "camera=sony_a7r", "gains=unity", "isp=srgb", "noise=none", picture=PRIMARY)
    camera, to_srgb = np.reshape(plan.camera.rgb2cam, (3, 3)), np.reshape(primaries2srgb(PRIMARIES["p3"]), (3, 3))
    expected = PRIMARY / 255 @ (camera @ to_srgb).T  # their codes are 0 and 255, so curves do not matter
    np.testing.assert_allclose(camera_light(PRIMARY, plan), expected, atol=1e-14)
    clipped = np.clip(PRIMARY / 255 @ to_srgb.T, 0, 1) @ camera.T
    assert np.abs(expected - clipped).max() > 0.02


def test_white_stays_exactly_white() -> None:
    for profile in (P3, WIDE):
        for camera in ("convex", "nexus_6p"):
            assert (camera_light(PRIMARY, planned(profile, f"camera={camera}", "gains=unity"))[0, 3] == 1).all()


CASES = (
    ("noise=imx385_iso3200",),
    ("noise=sony_a7s2", "scene=night", "camera=convex"),
    ("noise=none", "gains.highlight=gray_mean"),
    ("source.dequantize=dither", "isp=srgb"),
    ("sensor.pattern=MONO", "camera=convex"),
    ("output.dtype=float32", "scene.exposure_ratio=20"),
)


@pytest.mark.parametrize("overrides", CASES, ids=" ".join)
def test_kernels_equal_the_reference(overrides: tuple[str, ...]) -> None:
    is_dithered = "source.dequantize=dither" in overrides  # the table of 65,536 codes of a curve takes seconds
    for profile, picture in ((P3, PICTURE), (P3, PICTURE.astype(np.uint16) * 257), (WIDE, PICTURE)):
        plan = planned(P3 if is_dithered else profile, *overrides)
        made, expected = make_pair(picture, plan), reference_pair(picture, plan)
        np.testing.assert_array_equal(made.clean, expected.clean)
        np.testing.assert_array_equal(made.noisy, expected.noisy)
        assert made.counts == expected.counts


def test_fast_frames_differ_by_a_dn_at_most() -> None:
    exact, fast = (make_pair(PICTURE, planned(WIDE, f"accuracy={tier}")).clean for tier in ("exact", "fast"))
    assert np.abs(exact.astype(int) - fast).max() <= 1


def test_all_sites_are_within_the_signal_range() -> None:
    for profile in (P3, WIDE):
        plan = planned(profile, "camera=sony_a7r")
        light = signal_range(facts_of(PRIMARY, profile=profile), plan.isp, plan.camera, 1.0, 1.0)
        found = np.clip(camera_light(PRIMARY, plan), 0, 1)
        assert light.dark_dn <= found.min() and found.max() <= light.bright_dn + 1e-12


def test_pictures_are_developed_to_srgb() -> None:
    flat = np.full((16, 16, 3), (200, 120, 60), np.uint8)
    plan = planned(P3, "camera=sony_a7r", "isp=srgb", "noise=none", "sensor=generic_16bit", picture=flat)
    developed = ug.develop(make_pair(flat, plan).clean, plan)
    light = np.reshape(primaries2srgb(PRIMARIES["p3"]), (3, 3)) @ light_tables(P3, "none", "srgb", 256)[0][flat[0, 0]]
    expected = 255 * (1.055 * light ** (1 / 2.4) - 0.055)
    assert np.abs(developed[8, 8] - expected).max() <= 1
    assert np.abs(flat[0, 0] - expected).max() > 5


def test_plans_of_rows_need_the_profile_of_the_source() -> None:
    plan = planned(Profile("Display P3"))
    with pytest.raises(ValueError, match="profile='Display P3': only its name is known"):
        make_pair(PICTURE, plan)
