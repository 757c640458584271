"""The noise of a source is estimated in the raw domain, recorded in the manifest, and stated by ``plan``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, Settings
from PIL import Image

from unprocess_gen.core.arrays import Srgb
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.planning.effect_selection import facts_of
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.planning.source_noise import noise_ratio, source_noise_dn, tile_noise
from unprocess_gen.simulation.pair import reference_pair
from unprocess_gen.simulation.plan import Plan, SourcePlan
from unprocess_gen.sources.loader import downscaled


@pytest.fixture(scope="module")
def plan(settings: Settings) -> Plan:
    return plan_image(settings("camera=sony_a7r", "noise=imx385_iso3200"), "a" * 64)


@pytest.fixture(scope="module")
def linear(settings: Settings) -> Plan:
    """Return a plan in which a code is a fixed number of DN."""
    config = settings("isp=linear", "camera=identity", "gains=unity", "noise=none", "sensor=generic_12bit")
    return plan_image(config, "a" * 64)


def noisy_gray(std: float, size: tuple[int, int] = (400, 500), seed: int = 1) -> Srgb:
    """Return a horizontal gradient with white noise of a standard deviation in 8-bit codes."""
    gradient = np.linspace(90, 150, size[1])[None, :, None]
    noise = np.random.default_rng(seed).normal(0, std, (*size, 3))
    return np.rint(257 * (gradient + noise)).astype(np.uint16)


@pytest.mark.parametrize("std", [0.5, 2, 8])
def test_estimate_is_the_standard_deviation_of_known_noise(linear: Plan, std: float) -> None:
    expected = std / 255 * (linear.sensor.white_level_dn - linear.sensor.black_level_dn)
    assert source_noise_dn(noisy_gray(std), linear) == pytest.approx(expected, rel=0.1)


def test_estimate_is_the_noise_of_the_clean_frame(plan: Plan) -> None:
    srgb = np.rint(np.random.default_rng(2).normal(120, 3, (256, 256, 3))).astype(np.uint8)
    green = reference_pair(srgb, plan).clean[::2, 1::2]
    assert source_noise_dn(srgb, plan) == pytest.approx(green.std(), rel=0.1)


def test_noise_of_light_that_the_exposure_brings_below_white_counts(settings: Settings) -> None:
    config = settings("source.kind=linear", "scene.ev=-3", "camera=sony_a7r", "noise=imx385_iso3200")
    light = np.random.default_rng(2).normal(3, 0.1, (256, 256, 3)).astype(np.float32)
    facts = facts_of(light, source=SourcePlan(1, "off", primaries="srgb"))
    planned = plan_image(config, "a" * 64, facts=facts)
    green = reference_pair(light, planned).clean[::2, 1::2]
    assert source_noise_dn(light, planned) == pytest.approx(green.std(), rel=0.1)


def test_estimate_is_the_same_on_every_machine(plan: Plan) -> None:
    deep = np.random.default_rng(4).integers(30_000, 31_000, (200, 300, 3)).astype(np.uint16)
    assert source_noise_dn(deep, plan) == 6.189
    assert source_noise_dn((deep // 257).astype(np.uint8), plan) == 6.582


def test_texture_in_half_of_the_tiles_is_ignored(linear: Plan) -> None:
    srgb = noisy_gray(2)
    textured = srgb.copy()
    textured[:200] += np.random.default_rng(3).integers(0, 20_000, (200, 500, 3)).astype(np.uint16)
    found = source_noise_dn(textured, linear)
    assert found is not None
    assert found < 1.1 * (source_noise_dn(srgb, linear) or 0)


def test_downscaling_by_two_halves_white_noise(linear: Plan) -> None:
    srgb = noisy_gray(4, (800, 800))
    full, half = (source_noise_dn(one, linear) or 0 for one in (srgb, downscaled(srgb, 2)))
    assert half == pytest.approx(full / 2, rel=0.08)


@pytest.mark.parametrize(
    "srgb",
    [
        np.zeros((100, 100, 3), np.uint8),
        np.full((100, 100, 3), 65535, np.uint16),
        np.full((31, 400, 3), 128, np.uint8),
    ],
    ids=["black", "white", "too small"],
)
def test_source_without_a_usable_tile_has_no_estimate(srgb: Srgb, plan: Plan) -> None:
    assert source_noise_dn(srgb, plan) is None
    assert noise_ratio(srgb, plan) is None


def test_ratio_compares_with_simulated_noise_at_the_same_signal(plan: Plan, linear: Plan) -> None:
    srgb = noisy_gray(2)
    tiles = tile_noise(srgb, plan)
    signal_dn = float(np.median(tiles.signal_dn))
    expected = float(np.median(tiles.std_dn)) / np.sqrt(plan.noise.a_dn * signal_dn + plan.noise.b_dn2)
    assert noise_ratio(srgb, plan) == pytest.approx(expected, rel=0.1)
    assert noise_ratio(srgb, linear) is None  # no noise is simulated


# ------------------------------------------------------------------------------------------------------------ datasets


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with two noisy photographs and one that is too small."""
    folder = tmp_path_factory.mktemp("noisy") / "p"
    folder.mkdir()
    for name, std, size in (("a", 1, (100, 120)), ("b", 6, (100, 120)), ("c", 1, (16, 16))):
        Image.fromarray((noisy_gray(std, size) // 257).astype(np.uint8)).save(folder / f"{name}.png")
    return folder


@pytest.fixture(scope="module")
def made(folder: Path, make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "ds"
    make(folder, out, "source.patch=[random, 16, 2]", "noise.draws=2", "camera=identity")
    return out


def test_rows_of_an_image_share_its_estimate(made: Path) -> None:
    values = [row["source_noise_dn"] for row in read_rows(made / "manifest.csv")]
    assert len(values) == 12
    assert values[:4] == values[:1] * 4 and values[4:8] == values[4:5] * 4 and values[8:] == [None] * 4
    assert float(values[4] or 0) > 4 * float(values[0] or 0) > 0


def test_scenes_have_no_estimate(make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=1")
    assert [row["source_noise_dn"] for row in read_rows(tmp_path / "ds/manifest.csv")] == [None]
    assert "source_noise_dn" not in json.loads((tmp_path / "ds/dataset.json").read_text())["shards"][0]


def test_plan_states_noisy_sources(folder: Path, run_main: RunMain) -> None:
    done = run_main("plan", f"source.root={folder}", "camera=identity", "gains=unity", "noise=imx385_iso1600")
    assert done.code == 0
    line = next(line for line in done.out.splitlines() if line.startswith("source "))
    assert "the noise of 1 of 2 sources exceeds a fifth of the simulated noise" in line
    assert "source.downscale=2" in done.out
    assert "exceeds a fifth" not in run_main("plan", "source.limit=1").out
