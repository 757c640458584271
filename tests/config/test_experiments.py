"""Experiment configs of ``+experiment=``: their values against the sources; they run and can be overridden."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.cases import slow_except
from helpers.commands import RunMain
from helpers.datasets import Make, Settings
from helpers.photographs import fill, pixels
from helpers.promise_report import Figure
from helpers.published import CRVD
from PIL import Image

from unprocess_gen import RawPairs
from unprocess_gen.config.option_files import conf_dir
from unprocess_gen.core.arrays import Srgb
from unprocess_gen.sources import synthetic
from unprocess_gen.sources.loader import downscaled

RECIPE = "experiment"
RECIPES = sorted(path.stem for path in (conf_dir() / RECIPE).glob("*.yaml") if not path.stem.startswith("raw_"))
"""Recipes for photographs and light; those for raw frames are tested with raw sources."""


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a folder of one image, just large enough for a patch of 256 after downscaling, and light."""
    folder = tmp_path_factory.mktemp("photos")
    (folder / "clip").mkdir()
    Image.fromarray(pixels(1, 512, 512)).save(folder / "clip/0.png")
    np.save(folder / "clip/0.npy", pixels(1, 300, 300) / np.float32(32))
    return folder


PAIRS = {"brooks2019_training": 16, "rvdd_like": 2, "hdr_scenes": 4, "ntire_burst_sr": 4 * 14, "bracket_hdr": 2 * 7}
"""Pairs of the image, of recipes that make more than one."""


@pytest.mark.parametrize("recipe", slow_except(("brooks2019_training", "crvd_like"), RECIPES))
def test_experiment_runs_unmodified(recipe: str, clip: Path, run_main: RunMain, tmp_path: Path) -> None:
    assert run_main(f"+{RECIPE}={recipe}", f"source.root={clip}", "n_jobs=1", "out=ds").code == 0
    assert len(RawPairs(tmp_path / "ds")) == PAIRS.get(recipe, 1)


# Demo of the article --------------------------------------------------------------------------------------------------


def test_ipol_demo_has_the_defaults_of_the_article(settings: Settings) -> None:
    """Section 5: the average values of Brooks et al., gamma 2.2, the convex camera, RGGB, IMX385 at ISO 3200."""
    config = settings(f"+{RECIPE}=ipol_demo")
    gains = config.gains
    assert (gains.red, gains.blue, gains.inverse_rgb) == ((1.9 + 2.4) / 2, (1.5 + 1.9) / 2, 0.8)
    assert (gains.highlight, gains.threshold) == ("per_channel", 0.9)  # section 2, function f
    assert (config.camera.law, config.isp.tone, config.isp.gamma) == ("convex", "smoothstep", 2.2)
    assert (config.sensor.pattern, config.sensor.black_level_dn, config.sensor.white_level_dn) == ("RGGB", 240, 4095)
    # generate_raw_from_RGB.py of the author's RVDD: (8.0034·u - 2043.51144).clip(0), black level in u
    noise = config.noise
    assert (noise.a, noise.b, noise.black, noise.law) == (8.0034, -2043.51144, "included", "gaussian")
    assert (config.output.dtype, config.output.layout) == ("uint16", "mosaic")  # 16-bit integers


def test_rvdd_has_the_lines_of_its_author(settings: Settings) -> None:
    """generate_raw_from_RGB.py: (8.0034·u - 2043.51144).clip(0) and (28.3015·u - 6307.62081).clip(0); GBRG; dither."""
    config = settings(f"+{RECIPE}=rvdd_like")
    lines = [(level["a"], level["b"]) for level in config.noise.levels]
    assert lines == [(8.0034, -2043.51144), (28.3015, -6307.62081)]
    assert (config.noise.black, config.noise.negative_variance) == ("included", "clip")
    assert (config.sensor.pattern, config.gains.highlight, config.source.dequantize) == ("GBRG", "none", "dither")
    assert config.source.clips


# Brooks et al. --------------------------------------------------------------------------------------------------------


def test_brooks_distributions_are_those_of_the_script(settings: Settings) -> None:
    """unprocess.py: random_gains(), random_noise_levels(), safe_invert_gains(), mosaic(); train.py: image_size."""
    config = settings(f"+{RECIPE}=brooks2019_training")
    gains, noise = config.gains, config.noise
    assert (gains.red, gains.blue) == (("uniform", 1.9, 2.4), ("uniform", 1.5, 1.9))
    assert gains.inverse_rgb == ("truncated_normal", 0.8, 0.1, 0.5, 1.1)  # the script: not truncated
    assert (gains.highlight, gains.threshold) == ("gray_mean", 0.9)
    assert (noise.a, noise.b) == (("log_uniform", 0.0001, 0.012), ("log_linear_in_a", 2.18, 1.2, 0.26))
    assert (noise.units, noise.law) == ("normalized", "gaussian")
    assert (config.camera.law, config.isp.tone, config.isp.gamma) == ("convex", "smoothstep", 2.2)
    assert (config.sensor.pattern, config.sensor.clip) == ("RGGB", "none")
    assert (config.source.downscale, config.source.patch[:2]) == (2, ("random", 256))
    assert (config.output.dtype, config.output.layout) == ("float32", "packed")


def clean_planes_of_brooks(srgb: Srgb, row: dict[str, Any]) -> np.ndarray:
    """Apply the formulas of the script to pixels and the parameters of a row; float64 ``[4, H/2, W/2]``."""
    x = srgb / np.iinfo(srgb.dtype).max
    light = np.maximum(0.5 - np.sin(np.arcsin(1 - 2 * x) / 3), 1e-8) ** 2.2
    rgb2cam = np.array([[row[f"rgb2cam_{i}{j}"] for j in range(3)] for i in range(3)])
    light = light @ rgb2cam.T
    k = np.array([1 / row["red_gain"], 1, 1 / row["blue_gain"]]) * row["inverse_rgb_gain"]
    mask = (np.maximum(light.mean(axis=-1, keepdims=True) - 0.9, 0) / 0.1) ** 2
    light = np.clip(light * np.maximum(mask + (1 - mask) * k, k), 0, 1)
    red, of_red, of_blue, blue = light[::2, ::2, 0], light[::2, 1::2, 1], light[1::2, ::2, 1], light[1::2, 1::2, 2]
    return np.stack([red, of_red, of_blue, blue])


@pytest.fixture(scope="module")
def brooks(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("recipes") / "brooks"
    make(None, out, f"+{RECIPE}=brooks2019_training", "source.limit=3", "source.patch=[random,128,4]")
    return out


def test_clean_planes_match_the_formulas_of_brooks(brooks: Path, figure: Figure) -> None:
    """Within float32 rounding: half a unit in the last place of 1, ten times that for the constants of the script."""
    scenes = {row["source"]: downscaled(synthetic.picture(row["source"]), 2) for *_, row in RawPairs(brooks)}
    errors = []
    for clean, _, row in RawPairs(brooks):
        y, x = row["patch_y"], row["patch_x"]
        srgb = scenes[row["source"]][y : y + 128, x : x + 128]
        errors.append(np.abs(clean - clean_planes_of_brooks(srgb, row)).max())
    assert max(errors) < 2**-25 * 10
    figure("experiments", f"{len(errors)} patches within {max(errors):.1g} of the published formulas")


def test_noise_follows_brooks_and_exceeds_both_limits(brooks: Path) -> None:
    """Residuals over √(shot·x + read) are standard normals: mean and variance within five standard errors."""
    lowest = highest = 0.5
    for clean, noisy, row in RawPairs(brooks):
        shot, read = row["a_dn"] / 3855, row["b_dn2"] / 3855**2  # white less black
        assert 0.0001 <= shot <= 0.012
        assert abs(np.log(read) - (2.18 * np.log(shot) + 1.2)) < 0.26 * 6.4  # no normal is drawn farther out
        standard = (noisy.astype(np.float64) - clean) / np.sqrt(shot * clean + read)
        assert abs(standard.mean()) < 5 / np.sqrt(standard.size)
        assert abs(standard.var() - 1) < 5 * np.sqrt(2 / standard.size)
        lowest, highest = min(lowest, float(noisy.min())), max(highest, float(noisy.max()))
    assert lowest < 0
    assert highest > 1


# CRVD and ELD ---------------------------------------------------------------------------------------------------------


def test_each_crvd_like_clip_has_one_of_five_isos(run_main: RunMain, tmp_path: Path) -> None:
    for clip in range(4):
        fill(tmp_path / f"photos/clip{clip}", 2, first=2 * clip)
    assert run_main(f"+{RECIPE}=crvd_like", f"source.root={tmp_path / 'photos'}", "out=ds", "n_jobs=1").code == 0
    isos: dict[str, set[float]] = {}
    for clean, _, row in RawPairs(tmp_path / "ds"):
        assert (row["pattern"], row["black_level_dn"], row["white_level_dn"]) == ("GBRG", 240, 4095)
        assert (row["dn_per_e"], round(row["read_std_dn"] ** 2, 6)) == CRVD[int(row["iso"])]
        assert clean.dtype == np.uint16
        isos.setdefault(row["clip"], set()).add(row["iso"])
    assert len(isos) == 4
    assert {len(of_clip) for of_clip in isos.values()} == {1}
    assert len(set.union(*isos.values())) > 1


def test_crvd_like_supports_every_iso_twice(make: Make, tmp_path: Path) -> None:
    """Reproduces what synthesize_noise.py generates."""
    (tmp_path / "photos/clip").mkdir(parents=True)
    Image.fromarray(pixels(0, 16, 16)).save(tmp_path / "photos/clip/0.png")
    levels = "noise.levels=[1600,3200,6400,12800,25600]"
    make(tmp_path / "photos", tmp_path / "ds", f"+{RECIPE}=crvd_like", levels, "noise.draws=2")
    assert [row["iso"] for *_, row in RawPairs(tmp_path / "ds")] == [iso for iso in CRVD for _ in range(2)]


@pytest.mark.slow
def test_eld_low_light_has_isos_and_factors_of_its_dataset(make: Make, tmp_path: Path) -> None:
    """Section 5 of the paper: ISO 800, 1600, 3200; factors 100 and 200. K of the release: Kmin 0.415039 at ISO 100."""
    fill(tmp_path / "photos", 6)
    make(tmp_path / "photos", tmp_path / "ds", f"+{RECIPE}=eld_low_light")
    rows = [row for *_, row in RawPairs(tmp_path / "ds")]
    assert {row["iso"] for row in rows} == {800, 1600, 3200}
    assert {row["exposure_ratio"] for row in rows} == {100, 200}
    for row in rows:
        on_this_sensor = (16383 - 1024) / (16150 - 400)
        assert row["dn_per_e"] == pytest.approx(0.415039 * row["iso"] / 100 * on_this_sensor, rel=1e-6)
        assert row["noise"] == "nikon_d850"
