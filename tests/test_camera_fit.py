"""Camera noise fitted to pairs: known numbers are found again, within their intervals."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.cases import slow_except
from helpers.commands import RunMain

import unprocess_gen as ug

Pair = tuple[np.ndarray, np.ndarray]
CAMERA = ("gains=fixed", "camera=nexus_6p")
TRUTHS = {
    "srgb": ({"a": 8, "b": 200}, {"demosaic": "malvar"}),
    "gamma22": ({"a": 12, "b": 150}, {"demosaic": "malvar", "chroma_nr": 1.5}),
    "smoothstep_gamma22": ({"a": 15, "b": 600}, {"demosaic": "bilinear"}),
}
"""Curves, and numbers and options with each."""


def scene(number: int, side: int = 96, ends: tuple[float, float] = (-10, 265), top: int = 255) -> np.ndarray:
    """Return a smooth picture of all levels from one side to the other, with some colour."""
    width = side + 8 * number
    tint = np.random.default_rng(number).uniform(-30, 30, (4, 4, 3)).astype(np.float32)
    picture = np.linspace(*ends, width)[:, None] + cv2.resize(tint, (width, side))
    return (np.clip(picture, 0, 255) * (top / 255)).astype(np.uint8 if top == 255 else np.uint16)


def simulated(isp: str, pictures: list[np.ndarray], seed: int = 5) -> list[Pair]:
    """Return noisy and clean pictures of the truth with a curve."""
    numbers, options = TRUTHS[isp]
    words = ["noise=heteroscedastic", *(f"noise.{name}={value}" for name, value in numbers.items())]
    noise = ug.CameraNoise([*CAMERA, *words, f"isp={isp}"], seed=seed, **options)
    return [noise(picture, index)[::-1] for index, picture in enumerate(pictures)]


def contains(fit: ug.CameraFit, name: str, truth: float, factor: float = 1.0) -> bool:
    """True if the interval of a number, widened by a factor, contains its true value."""
    number = fit.numbers[name]
    return abs(truth - number.value) <= factor * max(number.high - number.value, number.value - number.low)


@pytest.mark.parametrize("isp", slow_except(("srgb",), TRUTHS))
def test_known_numbers_are_found_within_their_intervals(isp: str) -> None:
    fit = ug.CameraNoise.fit(simulated(isp, [scene(n, 128) for n in range(4)]), CAMERA)
    numbers, options = TRUTHS[isp]
    assert fit.choice == (f"isp={isp}", "camera=nexus_6p", f"demosaic={options['demosaic']}")
    assert fit.resampled == "4 pairs"
    truth = {"a_dn": numbers["a"], "b_dn2": numbers["b"], "chroma_nr": options.get("chroma_nr", 0), "luma_nr": 0}
    for name, value in truth.items():  # 95 % each; the seed is fixed
        assert contains(fit, name, value), (name, fit.numbers[name])


def test_simulated_noise_has_the_statistics_of_the_pairs() -> None:
    fit = ug.CameraNoise.fit(simulated("srgb", [scene(n) for n in range(2)]), [*CAMERA, "isp=srgb"])
    for name, (real, model) in fit.table.items():
        assert abs(real.value - model.value) <= 1.5 * (real.high - real.low + model.high - model.low) / 2, name
    picture = scene(7, 128)
    clean, noisy = fit.noise(seed=9)(picture, index=3)
    ((expected, truth),) = simulated("srgb", [picture])
    ratio = (noisy.astype(float) - clean).std() / (expected.astype(float) - truth).std()
    assert ratio == pytest.approx(1, abs=0.05)
    assert (fit.noise(strength=0)(picture, index=3)[1] == clean).all()


def test_noise_without_shot_noise_is_fitted_for_all_cameras() -> None:
    noise = ug.CameraNoise([*CAMERA, "isp=srgb", "noise=heteroscedastic", "noise.a=0", "noise.b=3000"])
    clean, noisy = noise(scene(0, 64, (120, 230)), index=4)
    fit = ug.CameraNoise.fit([(noisy, clean)], ["gains=fixed", "isp=srgb"])
    assert fit.choice[1] == "camera=nexus_6p"
    assert fit.numbers["a_dn"].value == 0
    assert contains(fit, "b_dn2", 3000)


def test_one_pair_of_16_bits_is_resampled_by_tiles() -> None:
    fit = ug.CameraNoise.fit(simulated("srgb", [scene(0, 160, top=65535)]), [*CAMERA, "isp=srgb"])
    assert (fit.resampled, fit.choice[2]) == ("25 tiles", "demosaic=malvar")
    assert "luma_nr" not in fit.numbers
    assert contains(fit, "a_dn", 8, 1.5)
    assert contains(fit, "b_dn2", 200, 1.5)


def test_dark_and_saturated_pixels_do_not_count() -> None:
    """Noise of levels that cut it off is not the noise of others: whatever is there changes nothing."""
    (pair,) = simulated("srgb", [scene(0, 128)])
    outside = ((pair[1] < 8) | (pair[1] > 247)).any(axis=2)
    changed = pair[0].copy()
    changed[outside] = 90
    fits = [ug.CameraNoise.fit([(noisy, pair[1])], [*CAMERA, "isp=srgb"]) for noisy in (pair[0], changed)]
    assert outside.mean() > 0.05
    assert fits[0].numbers == fits[1].numbers


@pytest.mark.slow
def test_narrow_levels_do_not_exclude_curves() -> None:
    wide, narrow = (
        ug.CameraNoise.fit(simulated("srgb", [scene(n, 128, ends) for n in range(2)]), CAMERA)
        for ends in ((-10, 265), (90, 150))
    )
    assert not any("smoothstep" in choice for choice in (*wide.choice, *wide.alike))
    assert {"isp=gamma22 camera=nexus_6p demosaic=malvar", "isp=srgb camera=nexus_6p demosaic=malvar"} <= {
        *narrow.alike,
        " ".join(narrow.choice),
    }


@pytest.mark.slow
def test_the_camera_is_found() -> None:
    pairs = simulated("srgb", [scene(n, 128) for n in range(3)])
    assert ug.CameraNoise.fit(pairs, ["gains=fixed", "isp=srgb"]).choice[1] == "camera=nexus_6p"


REAL = next(
    (folder for parent in Path(__file__).parents if (folder := parent / "shared/data/real_pairs_srgb").is_dir()), None
)


@pytest.mark.slow
@pytest.mark.skipif(REAL is None, reason="needs real pairs of phones, which are not distributed")
@pytest.mark.parametrize(("patches", "camera"), [("N/3200/GP", "nexus_6p"), ("N/400/G4", "sony_rx100")])
def test_real_noise_of_phones_has_the_colours_of_the_model(patches: str, camera: str) -> None:
    """Correlation R-G within 0.1 of the real one, lag 1 of Y within 0.08, deviations within a tenth in the median."""
    assert REAL is not None
    folder = REAL / "sidd_patches" / patches
    pairs = [
        tuple(cv2.imread(str(folder / kind / file.name))[..., ::-1] for kind in ("samples_noisy", "samples_gts"))
        for file in sorted((folder / "samples_noisy").glob("*.png"))[:4]
    ]
    fit = ug.CameraNoise.fit(pairs)
    assert fit.choice[1:] == (f"camera={camera}", "demosaic=malvar")
    difference = {name: model.value - real.value for name, (real, model) in fit.table.items()}
    assert abs(difference["correlation R-G"]) < 0.1
    assert abs(difference["correlation G-B"]) < 0.1
    assert abs(difference["lag 1 of Y"]) < 0.08
    ratios = [model.value / real.value for name, (real, model) in fit.table.items() if "std" in name]
    assert np.median(np.abs(np.log(ratios))) < 0.1


FLAT = np.full((64, 64, 3), 100, np.uint8)
NOISY = np.clip(FLAT + np.random.default_rng(0).normal(0, 3, FLAT.shape), 0, 255).astype(np.uint8)


GRAY = np.repeat(np.linspace(40, 200, 64).astype(np.uint8)[:, None, None], 64, axis=1).repeat(3, axis=2)
DOTS = np.random.default_rng(1).integers(0, 9, (64, 64, 1)).astype(np.uint8)


@pytest.mark.parametrize(
    ("pairs", "problem"),
    [
        ([], "pairs: no pair; expected a list of pairs"),
        ((NOISY, FLAT), "pairs: lengths of the pairs are 64, 64; expected a list of pairs"),
        ([(GRAY + DOTS, GRAY)], "with noise in luma and chroma"),
        ([(NOISY, FLAT[:-1])], "pairs[0]: noisy is uint8 [64, 64, 3], clean uint8 [63, 64, 3]; expected"),
        ([(NOISY, FLAT), (NOISY.astype(np.uint16), FLAT)], "pairs[1]: noisy is uint16 [64, 64, 3], clean uint8"),
        ([(FLAT, FLAT)], "pairs[0]: noisy equals clean"),
        ([(NOISY, FLAT)], "levels of luma with enough pixels and noise: 96 to 111; expected 2 bands or more"),
        ([(FLAT + 1, FLAT)], "levels of luma with enough pixels and noise: 96 to 111"),
        ([(FLAT // 99, FLAT // 50)], "levels of luma with enough pixels and noise: none"),
    ],
)
def test_pairs_that_show_no_noise_are_refused(pairs: list[Pair], problem: str) -> None:
    with pytest.raises(ug.ConfigError) as error:
        ug.CameraNoise.fit(pairs)
    assert problem in str(error.value)
    assert "\n" not in str(error.value)


def test_other_arguments_are_refused() -> None:
    for config, options, problem in (
        ("isp=srgb", {}, "config is a str; expected a list"),
        (ug.load_config([]), {}, "config is a Config; expected a list"),
        (["noise=none"], {"chroma_nr": 2}, "noise=none, chroma_nr: is fitted"),
    ):
        with pytest.raises(ug.ConfigError, match=problem):
            ug.CameraNoise.fit([(NOISY, FLAT)], config, **options)
    with pytest.raises(ValueError, match="expected uint8 or uint16"):
        ug.CameraNoise.fit([(NOISY / 255, FLAT / 255)])


def write(folder: Path, names: dict[str, np.ndarray]) -> Path:
    folder.mkdir(exist_ok=True)
    for name, picture in names.items():
        cv2.imwrite(str(folder / name), picture[..., ::-1])
    return folder


def test_command_line_writes_a_profile_that_runs(run_main: RunMain, tmp_path: Path) -> None:
    ((noisy, clean),) = simulated("srgb", [scene(0)])
    folder = write(tmp_path / "pairs", {"1_real.png": noisy, "1_mean.png": clean})
    (tmp_path / "mine" / "noise").mkdir(parents=True)
    done = run_main("calibrate", folder, "--srgb", "--to", "mine/noise/fitted.yaml")
    assert done.code == 0, done.err
    assert "correlation R-G" in done.out
    listed = {line["name"]: line["value"] for line in json.loads((tmp_path / "mine/noise/fitted.json").read_text())}
    usage = done.out.partition("use it with --config-dir mine ")[2].partition("; in CameraNoise with demosaic=")[0]
    assert set(usage.split()) >= {"noise=fitted", "gains=fixed"}
    assert f"they hold with {usage.removeprefix('noise=fitted ')}" in (tmp_path / "mine/noise/fitted.yaml").read_text()
    config = ug.load_config(usage.split(), config_dir=tmp_path / "mine")
    assert (config.noise.a, config.noise.b) == (listed["a_dn"], listed["b_dn2"])
    again = run_main("calibrate", folder, "--srgb", "--to", "mine/noise/fitted.yaml")
    assert again.out == done.out


def test_pairs_have_three_forms_of_names_or_a_list(tmp_path: Path) -> None:
    from unprocess_gen.calibration.picture_pairs import read_picture_pairs

    names = ("a_noisy.png", "a_clean.png", "b_real.png", "b_mean.png", "1_NOISY_SRGB_010.PNG", "1_GT_SRGB_010.PNG")
    folder = write(tmp_path / "pairs", {name: FLAT + number for number, name in enumerate(names)})
    values = {(int(noisy[0, 0, 0]), int(clean[0, 0, 0])) for noisy, clean in read_picture_pairs(folder)[0]}
    assert values == {(100, 101), (102, 103), (104, 105)}
    with (folder / "pairs.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("clean", "group", "noisy"), (names[4], "any", names[1])])
    ((noisy, clean),) = read_picture_pairs(folder)[0]
    assert (noisy[0, 0, 0], clean[0, 0, 0]) == (101, 104)


@pytest.mark.parametrize(
    ("files", "table", "problem"),
    [
        ({}, None, "contains no picture"),
        ({"a.png": FLAT}, None, "a.png: has no partner; expected a name with _noisy or _clean, or list"),
        ({"a_noisy.png": FLAT}, None, "a_noisy.png: has no partner; expected"),
        ({"a_mean.png": FLAT}, None, "a_mean.png: has no partner; expected"),
        ({"a.png": FLAT}, "noisy,clean\na.png,b.png\n", "pairs.csv, line 2: a.png,b.png: expected files that exist"),
        ({"a.png": FLAT}, "file,kind\na.png,noisy\n", "pairs.csv: column 'noisy' is missing"),
        ({"a.png": FLAT}, "noisy,clean,sort\n", "pairs.csv: column 'sort' is missing, is unknown"),
        ({"a_noisy.png": NOISY, "a_clean.png": FLAT}, None, "levels of luma"),
    ],
)
def test_folders_without_pairs_are_refused(
    files: dict[str, Any], table: str | None, problem: str, run_main: RunMain, tmp_path: Path
) -> None:
    folder = write(tmp_path / "pairs", files)
    if table is not None:
        (folder / "pairs.csv").write_text(table)
    done = run_main("calibrate", folder, "--srgb", "--to", "fitted.yaml")
    assert (done.code, problem in done.err, done.err.count("\n")) == (2, True, 1), done.err
    assert not list(tmp_path.glob("fitted.*"))


def test_flags_that_exclude_each_other_are_refused(run_main: RunMain, tmp_path: Path) -> None:
    for flags in (("--report", "a.html"), ("--from", "noise_profile")):
        done = run_main("calibrate", tmp_path, "--srgb", "--to", "fitted.yaml", *flags)
        assert (done.code, "exclude each other" in done.err) == (2, True), done.err
