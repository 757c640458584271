"""Targets: the scene before the mosaic, the photograph and the noise of each site, made live or stored in shards."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make

import unprocess_gen as ug
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.targets import LINEAR_RGB, TARGETS
from unprocess_gen.simulation.pair import linear_rgb, make_pair
from unprocess_gen.simulation.reference.cfa import mosaic
from unprocess_gen.simulation.reference.sensor import in_dn
from unprocess_gen.simulation.reference.unprocess import camera_light
from unprocess_gen.simulation.self_test import _PHYSICAL, GOLDEN_PLAN, golden_image

TARGET_KEYS = "output.targets=[linear_rgb]"
RECIPE = ("noise=sony_a7s2", "noise.levels=[1600,3200]", "noise.draws=2", "source.patch=[random,64,2]")
ORIGIN = (1, 57)


def plan_with(**values: object) -> ug.Plan:
    return GOLDEN_PLAN.replace(**values)


PATTERNS_IN_CLEAN = _PHYSICAL.replace(
    fixed_pattern_in_clean=True,
    gain_by_colour=(0.9, 1.0, 1.2),
    effects=(*_PHYSICAL.noise.effects, "gain_by_colour"),
)
PLANS = {
    "per channel": GOLDEN_PLAN,
    "16 bits, gray mean": plan_with(highlight="gray_mean", bits=16, black_level_dn=4096, white_level_dn=65535),
    "darkened": _PHYSICAL,
    "fixed patterns in clean": PATTERNS_IN_CLEAN,
    "float32": plan_with(clean_dtype="float32"),
}


@pytest.fixture(scope="module")
def stored(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset of one scene with a target, in patches, levels and draws."""
    out = tmp_path_factory.mktemp("targets") / "ds"
    make(None, out, *RECIPE, TARGET_KEYS, "source.limit=1")
    return out


@pytest.mark.parametrize("name", PLANS)
def test_the_mosaic_of_linear_rgb_is_the_clean_frame(name: str) -> None:
    plan = PLANS[name]
    values = linear_rgb(golden_image(), plan, ORIGIN)
    sites = mosaic(values.astype(np.float64), plan.sensor.pattern, ORIGIN).astype(np.float32)
    clean = make_pair(golden_image(), plan, ORIGIN).clean
    if plan.output.clean_normalised:
        np.testing.assert_array_equal(sites, clean)
    else:
        levels_dn = plan.sensor.black_level_dn, plan.sensor.white_level_dn
        np.testing.assert_array_equal(np.rint(in_dn(sites, levels_dn)), clean)


def test_linear_rgb_is_the_light_of_the_reference() -> None:
    light = np.clip(camera_light(golden_image(), GOLDEN_PLAN), 0, 1)
    np.testing.assert_allclose(linear_rgb(golden_image(), GOLDEN_PLAN), light, rtol=2**-23, atol=1e-15)


def test_linear_rgb_of_a_crop_is_the_crop() -> None:
    whole = linear_rgb(golden_image(), _PHYSICAL)
    np.testing.assert_array_equal(linear_rgb(golden_image()[4:, 6:], _PHYSICAL, (4, 6)), whole[4:, 6:])


def test_stored_target_is_that_of_live_pairs_and_read_by_webdataset(stored: Path) -> None:
    live, pairs = ug.LivePairs(stored, targets=TARGETS), ug.RawPairs(stored)
    assert len(pairs) == 8
    for number in (0, 3, 6):
        assert list(live[number].targets) == [*TARGETS]
        assert list(pairs[number].targets) == [LINEAR_RGB]
        made, read = live[number].targets[LINEAR_RGB], pairs[number].targets[LINEAR_RGB]
        assert read.dtype == np.float32
        np.testing.assert_array_equal(made, read)
    item = ug.RawPairs(stored, inputs="packed")[3]
    assert [item[name].shape for name in ("clean", LINEAR_RGB)] == [(4, 32, 32), (64, 64, 3)]
    wds = pytest.importorskip("webdataset")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # those of another library
        sample, _ = wds.WebDataset(str(stored / "shards/shard-00000.tar"), shardshuffle=False).decode()
    np.testing.assert_array_equal(sample["linear_rgb.npy"], pairs[0].targets[LINEAR_RGB])


def test_damaged_target_is_found_and_repaired(stored: Path, run_main: RunMain) -> None:
    shard = stored / "shards/shard-00000.tar"
    intact = shard.read_bytes()
    damaged = bytearray(intact)
    damaged[intact.index(b"00000000-p0001.linear_rgb.npy") + 2048] ^= 1
    shard.write_bytes(damaged)
    assert [damage.member for damage in ug.verify(stored)] == ["linear_rgb.npy"]
    assert run_main("verify", "--repair", str(stored)).code == 0
    assert shard.read_bytes() == intact


@pytest.mark.parametrize("value", ["[srgb]", "[linear_rgb,linear_rgb]", "linear_rgb"])
def test_wrong_targets_are_refused_in_one_line(value: str, run_main: RunMain, tmp_path: Path) -> None:
    done = run_main(f"output.targets={value}", f"out={tmp_path / 'ds'}")
    assert done.code == 2
    assert len(done.err.strip().splitlines()) == 1
    assert "output.targets" in done.err
    assert not (tmp_path / "ds").exists()


def test_lists_of_datasets_with_other_targets_are_refused(stored: Path, dataset: Path) -> None:
    with pytest.raises(ConfigError, match="targets"):
        ug.RawPairs([stored, dataset], inputs="packed")
