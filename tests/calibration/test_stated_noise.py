"""NoiseProfile tags of DNG files become a noise profile."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.captures import Camera, estimates
from helpers.commands import RunMain

import unprocess_gen as ug
from unprocess_gen.dataset.dng import encode
from unprocess_gen.simulation.effects import dark_variance_dn2

ISOS = (100, 200, 400, 1600, 3200, 25600)
FLOAT32 = 2.0**-24
WHITE, BLACK = 4095, 256
Law = dict[int, tuple[float, float]]


def stated(folder: Path, law: Law, black: int = BLACK, white: int = WHITE) -> Path:
    """Write DNG files without pixels worth reading, each with an ISO and S, O of its NoiseProfile."""
    import tifffile

    folder.mkdir()
    for iso, numbers in law.items():
        tags = [
            (50706, "B", 4, (1, 4, 0, 0)), (50714, "I", 1, black), (50717, "I", 1, white),
            (34855, "H", 1, iso), (51041, "d", len(numbers), numbers),
        ]  # fmt: skip
        tifffile.imwrite(folder / f"{iso}.dng", np.zeros((32, 32), np.uint16), photometric=32803, extratags=tags)
    return folder


def profile_of(tmp_path: Path) -> Path:
    path = tmp_path / "mine" / "noise" / "mine.yaml"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def numbers_at(profile: Path, *isos: float) -> list[tuple[float, float]]:
    """Return gain and read noise at some ISOs, in DN of the profile."""
    config = ug.load_config(["noise=mine", f"scene.iso={isos[0]}", "sensor=generic_14bit"], profile.parents[1])
    sensor, noise, numbers = config.sensor, config.noise, []
    scale = (noise.white_level_dn - noise.black_level_dn) / (sensor.white_level_dn - sensor.black_level_dn)
    for iso in isos:
        scene = dataclasses.replace(config.scene, iso=iso)
        plan = ug.plan_image(np.zeros((32, 32, 3), np.uint8), dataclasses.replace(config, scene=scene))
        numbers.append((plan.physics.dn_per_e * scale, plan.physics.read_std_dn * scale))
    return numbers


@pytest.mark.slow
def test_tags_of_own_files_give_back_their_numbers(run_main: RunMain, tmp_path: Path) -> None:
    folder, profile, expected = tmp_path / "dng", profile_of(tmp_path), {}
    folder.mkdir()
    for iso in ISOS:
        pair = Camera("sony_a7s2", iso, side=32).pair(0.2, 0.001, 0)
        for name in ("noisy", "clean"):  # the clean frame has no noise, and no tag
            (folder / f"{iso}.{name}.dng").write_bytes(encode(pair.noisy, pair.row, name))
        expected[iso] = pair.plan.physics.dn_per_e, dark_variance_dn2(pair.plan)
    done = run_main("calibrate", folder, "--from", "noise_profile", "--to", profile)
    assert done.code == 0, done.err
    assert "6 of 12" in done.err
    for (gain, read), (iso, (a, b)) in zip(numbers_at(profile, *ISOS), expected.items(), strict=True):
        assert gain == pytest.approx(a, rel=FLOAT32)
        assert read**2 == pytest.approx(b, rel=FLOAT32)
        assert estimates(profile)["b_dn2", iso, None]["value"] == pytest.approx(b, rel=FLOAT32)
    settings = ["--config-dir", profile.parents[1], "noise=mine"]
    done = run_main("plan", "--numbers", *settings, "scene.iso=100", "source.limit=1")
    assert "calibrate --from noise_profile" in done.out
    assert "the tags state none" in done.out
    done = run_main("plan", *settings, "scene.iso=1800")  # the gain mode changes
    assert (done.code, "100 to 1600, 3200 to 25600" in done.err) == (2, True)


def test_gain_between_isos_is_interpolated(run_main: RunMain, tmp_path: Path) -> None:
    """ln a is linear in ln ISO."""
    folder = stated(tmp_path / "dng", {100: (1e-5, 1e-9), 200: (1.9e-5, 2e-9), 400: (4.5e-5, 5e-9)})
    profile = profile_of(tmp_path)
    assert run_main("calibrate", folder, "--from", "noise_profile", "--to", profile).code == 0
    span = WHITE - BLACK
    (first, _), (between, _) = numbers_at(profile, 200, 150)
    assert first == pytest.approx(1.9e-5 * span, rel=FLOAT32)
    assert between == pytest.approx(1e-5 * 1.9 ** math.log2(1.5) * span, rel=FLOAT32)


def test_tags_of_published_numbers_give_published_noise(run_main: RunMain, tmp_path: Path) -> None:
    """S, O and levels of a Sony A7R IV at ISO 100, as Adobe's converter writes them."""
    folder, profile = stated(tmp_path / "dng", {100: (2.649e-5, 8.906e-9)}, 512, 16383), profile_of(tmp_path)
    done = run_main("calibrate", folder, "--from", "noise_profile", "--to", profile)
    assert done.code == 0, done.err
    found = estimates(profile)
    assert found["dn_per_e", 100, None]["value"] == pytest.approx(0.420, abs=5e-4)
    assert found["b_dn2", 100, None]["value"] == pytest.approx(2.24, abs=5e-3)


@pytest.mark.parametrize(
    ("law", "problem"),
    [
        ({100: (2e-5, 1e-9), 200: (1e-5, 2e-9)}, "200.dng: NoiseProfile at ISO 200: the variance of R has"),
        ({100: (1e-5, 3e-9), 200: (2e-5, 2e-9), 400: (4e-5, 1e-9)}, "400.dng: NoiseProfile at ISO 400: again less"),
        ({100: (-1e-5, 1e-9)}, "100.dng: NoiseProfile of R: variance = -1e-05"),
        ({100: (1e-5, 1e-9, 1e-5)}, "100.dng: NoiseProfile has 3 values"),
        ({100: ()}, "none of 1 raw files has a NoiseProfile tag"),
    ],
)  # fmt: skip
def test_implausible_laws_are_refused(law: Any, problem: str, run_main: RunMain, tmp_path: Path) -> None:
    profile = profile_of(tmp_path)
    if not law[100]:
        law = {}
        stated(tmp_path / "dng", {})
        (tmp_path / "dng" / "100.dng").write_bytes(b"no TIFF")
    else:
        stated(tmp_path / "dng", law)
    done = run_main("calibrate", tmp_path / "dng", "--from", "noise_profile", "--to", profile)
    assert (done.code, problem in done.err, done.err.count("\n"), profile.exists()) == (2, True, 1, False), done.err
