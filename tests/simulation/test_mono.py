"""A sensor without colour filters records the mean of the three channels (`sensor.pattern=MONO`)."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.configs import composed
from helpers.photographs import pixels

import unprocess_gen as ug
from unprocess_gen.simulation.pair import make_pair, reference_pair
from unprocess_gen.simulation.reference.unprocess import camera_light

SRGB = pixels(3, 33, 70)
NOISES = (("noise=imx385_iso3200",), ("noise=sony_a7s2", "scene=night"), ("noise=canon_70d", "effects.all=on"))


def test_clean_frames_are_the_rounded_mean_of_the_channels() -> None:
    settings = ("noise=none", "camera=sony_a7r", "gains.highlight=none")
    colour, mono = (ug.make_pair(SRGB, composed(*settings, f"sensor.pattern={name}")) for name in ("RGGB", "MONO"))
    light = camera_light(SRGB, colour.plan)
    expected = light.mean(axis=2) * colour.plan.sensor.span_dn + colour.plan.sensor.black_level_dn
    np.testing.assert_allclose(mono.clean, expected, rtol=0, atol=0.5 + 1e-9)


def test_weights_are_a_third_each_without_matrix_and_gains() -> None:
    plan = ug.plan_image(SRGB, composed("camera=identity", "gains=unity", "sensor.pattern=MONO"))
    assert plan.camera.rgb2cam == pytest.approx((1 / 3,) * 9, abs=1e-15)
    assert plan.camera.inverse_gains == (1, 1, 1)


@pytest.mark.parametrize("noise", NOISES, ids=" ".join)
def test_kernels_equal_the_reference(noise: tuple[str, ...]) -> None:
    plan = ug.plan_image(SRGB, composed(*noise, "camera=convex", "sensor.pattern=MONO"))
    made, expected = make_pair(SRGB, plan), reference_pair(SRGB, plan)
    np.testing.assert_array_equal(made.clean, expected.clean)
    np.testing.assert_array_equal(made.noisy, expected.noisy)


def test_grays_are_developed_to_their_codes() -> None:
    grays = np.repeat(np.arange(256, dtype=np.uint8), 12).reshape(-1, 48, 1).repeat(3, axis=2)
    pair = ug.make_pair(grays, composed("noise=none", "sensor=generic_16bit", "sensor.pattern=MONO"))
    np.testing.assert_array_equal(ug.develop(pair.clean, pair.row), grays)


def test_every_verb_handles_a_monochrome_dataset(run_main: RunMain, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    for number in range(2):
        cv2.imwrite(str(tmp_path / f"photos/{number}.png"), pixels(number, 96, 128))
    settings = ("source.root=photos", "noise=sony_a7s2", "scene=night", "sensor.pattern=MONO", "n_jobs=1")
    assert "pattern   MONO: no colour filters" in run_main("plan", *settings).out
    assert run_main(*settings, "out=mono").code == 0
    assert run_main("verify", "mono", "--noise", "--regenerate=2").out.splitlines()[0].endswith(" 0 wrong")
    assert run_main("preview", "mono", "--to", "sheets", "--stages").code == 0
    assert run_main("report", "mono").code == 0
    refused = run_main("dng", "mono", "--keys=0", "--to", "dng")
    assert (refused.code, "pattern=MONO: has no colour filters" in refused.err) == (2, True)
    live, stored = ug.LivePairs("mono", targets=["linear_rgb"])[1], ug.RawPairs("mono")[1]
    np.testing.assert_array_equal(live.noisy, stored.noisy)
    assert np.ptp(live.targets["linear_rgb"], axis=2).max() == 0
    even = stored.noisy[:4, :6]
    np.testing.assert_array_equal(ug.pack(even, "MONO")[1], even[::2, 1::2])
    for name in ("00000000.png", "00000000.stages.png"):
        sheet = cv2.imread(str(tmp_path / "sheets" / name))
        shown = sheet[:, sheet.shape[1] * 3 // 4 :]  # the last column shows raw and developed frames, or the matrix
        assert np.ptp(shown.astype(int), axis=2).max() == 0
