"""A simulated camera is measured; real frames give the published numbers; the profile is used as it was written."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers.captures import Camera, Numbers, Shot, draw, estimates, record, with_levels
from helpers.commands import RunMain

from unprocess_gen.calibration.calibrate import calibrate
from unprocess_gen.calibration.captures import read_captures
from unprocess_gen.reports.formatting import short_number

EMVA = next(
    (folder for parent in Path(__file__).parents if (folder := parent / "shared/data/emva1288_ccd").is_dir()), None
)


@pytest.fixture
def calibrated(run_main: RunMain, tmp_path: Path) -> Any:
    """Return a function that calibrates a folder and returns the profile."""

    def calibrate(folder: Path, *flags: str, name: str = "mine") -> Path:
        profile = tmp_path / "mine" / "noise" / f"{name}.yaml"
        profile.parent.mkdir(parents=True, exist_ok=True)
        done = run_main("calibrate", folder, "--to", profile, *flags)
        assert done.code == 0, done.err
        return profile

    return calibrate


@pytest.mark.slow
def test_profile_is_used_as_it_was_written(calibrated: Any, run_main: RunMain, tmp_path: Path) -> None:
    """Noise of data made with it passes the check, and its captures agree with it."""
    folder, out = tmp_path / "captures", tmp_path / "ds"
    profile = calibrated(with_levels(draw(folder, Numbers(), 0)))
    settings = ["--config-dir", profile.parents[1], "noise=mine", "sensor=generic_14bit", "source.limit=1"]
    assert run_main(*settings, "scene.iso=800", f"out={out}", "n_jobs=1").code == 0
    assert run_main("verify", out, "--noise").code == 0
    assert run_main("plan", *settings, "scene.iso=1600").code == 2  # one ISO is not extrapolated
    done = run_main("verify", out, "--against", folder)
    assert (done.code, "0 wrong" in done.out) == (0, True), done.err
    other = with_levels(draw(tmp_path / "other", Numbers(2.2, 5.5, 0.0, 2.5, prnu_std=0.02), 0))
    done = run_main("verify", out, "--against", other)
    assert done.code == 4
    for text in ("dn_per_e of the frames is 2.", "lacks it: effect prnu", "black_error_dn of the frames is 2."):
        assert text in done.err


def test_flats_of_a_simulated_body_have_all_codes(calibrated: Any, tmp_path: Path) -> None:
    """Shot noise hides the size of the read noise of this body, but not the steps between its electrons."""
    camera = Camera("nikon_d850", 800, 256, effects="auto")
    profile = calibrated(record(tmp_path / "captures", camera, darks=4, levels=(0.05, 0.1, 0.2, 0.3)))
    gain = estimates(profile)["dn_per_e", 800.0, None]
    low, high = gain["interval"]
    assert abs(gain["value"] - camera.truth["dn_per_e"]) <= high - low  # four standard errors


@pytest.mark.parametrize("light", [(1.0, 1.0, 1.0), (0.7, 1.0, 0.4)], ids=["neutral", "coloured"])
def test_numbers_of_the_body_are_measured(light: tuple[float, float, float], calibrated: Any, tmp_path: Path) -> None:
    """Gains by colour and dark current agree with the true values in their errors, if levels reach the full well."""
    gains = (1.1, 1.0, 0.9)
    numbers = Numbers(4.0, 5.0, 0.0, gains=gains, full_well_e=2000.0, dark_e_per_s=20.0, prnu_std=0.01, light=light)
    numbers = replace(numbers, hot_share=0.004, hot_e_per_s=50.0)
    darks = [Shot(0.0, seconds, 32.0) for seconds in (0.01, 1.0, 4.0) for _ in range(3)]
    lights = (0.03, 0.08, 0.13, 0.18, 0.23, 0.28, 0.4, 0.7)
    shots = [*darks, *(Shot(light) for light in lights for _ in range(2))]
    profile = calibrated(with_levels(draw(tmp_path / "captures", numbers, 0, shots=shots)))
    found, written = estimates(profile), yaml.safe_load(profile.read_text(encoding="utf-8"))
    for name, true in (
        *(("dark_e_per_s", 80.0), ("prnu_std", 0.01)),
        *(("hot_pixel_share", 0.004), ("hot_pixel_e_per_s", 200.0)),
    ):
        row = found[name, None, None]
        low, high = (row["value"] + 2 * (end - row["value"]) for end in row["interval"])  # 4 standard errors
        assert low <= true <= high, row
    mean = sum((gains[0], 2 * gains[1], gains[2])) / 4
    if light == (1.0, 1.0, 1.0):  # less light leaves the gains of the planes equal within their errors
        assert written["gain_by_colour"] == pytest.approx([gain / mean for gain in gains], rel=0.03)
    assert written["dark_reference_c"] == 32


@pytest.mark.parametrize(("read_std_dn", "column_std_dn"), [(0.45, 0.0), (1.0, 0.4)])
def test_fixed_pattern_is_neither_read_nor_column_noise(
    read_std_dn: float, column_std_dn: float, calibrated: Any, tmp_path: Path
) -> None:
    """A fixed pattern almost as strong as the noise is separated from it, above rounding and below."""
    truth = {"read_std_dn": read_std_dn, "dsnu_std_dn": 0.8 * read_std_dn, "column_std_dn": column_std_dn}
    numbers = Numbers(0.1, row_std_dn=0.0, **truth)
    found = estimates(calibrated(with_levels(draw(tmp_path / "captures", numbers, 0, side=192))))
    for name, true in {"dn_per_e": 0.1, **truth}.items():
        row = found[name, 800, None]
        low, high = (row["value"] + 2 * (end - row["value"]) for end in row["interval"])  # 4 standard errors
        assert low <= true <= high, row
        assert max(high - true, true - low) < 0.15 * max(true, read_std_dn), row  # no wide interval hides an error
    assert abs(found["read_shape", 800, None]["value"] - 0.1349) < 0.02


@pytest.mark.parametrize("share", [0.001, 0.01, 0.1])
@pytest.mark.parametrize("strength_e", [25.0, 100.0])
def test_hot_pixels_change_no_other_number(share: float, strength_e: float, tmp_path: Path) -> None:
    """Their strengths reach from below the noise of darks to above that of flats."""
    numbers = Numbers(prnu_std=0.005, hot_share=share, hot_e_per_s=100 * strength_e)
    found = calibrate(read_captures(with_levels(draw(tmp_path / "captures", numbers, 1, side=192))))
    result = found.isos[0]
    wanted = {"dn_per_e": 2.0, "read_std_dn": 5.0, "row_std_dn": 1.2, "column_std_dn": 0.0, "dsnu_std_dn": 0.0}
    numbers_found = [*((result[name], true) for name, true in wanted.items()), (found.shared["prnu_std"], 0.005)]
    for number, true in numbers_found:
        assert number is not None
        assert abs(number.value - true) <= 4 * max(number.high - number.value, number.value - number.low) / 1.96
    assert share < 0.01 or any("are hot or dead" in note for note in found.captures.notes)


def two_isos(folder: Path) -> Path:
    """Draw captures of ISO 800 and 1600."""
    captures = with_levels(draw(folder / "captures", Numbers(), 0, side=64))
    other = with_levels(draw(folder / "other", Numbers(4.0, 9.0), 1, side=64))
    lines = (other / "captures.csv").read_text(encoding="utf-8").splitlines()[1:]
    with (captures / "captures.csv").open("a", encoding="utf-8") as file:
        file.writelines(f"../other/{line.replace(',800,', ',1600,')}\n" for line in lines)
    return captures


@pytest.mark.slow
def test_page_shows_curves_then_estimates_with_intervals(calibrated: Any, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    profile = calibrated(two_isos(tmp_path), "--report", str(page))
    text, gain = page.read_text(encoding="utf-8"), estimates(profile)["dn_per_e", 800, None]
    assert all(short_number(value, 4) in text for value in (gain["value"], *gain["interval"]))
    assert text.count("<img ") == 9 and "photon transfer, ISO 800" in text
    headings = ("Against ISO", "<h2>ISO 800", "<h2>ISO 1600", "Notes", "Estimates")
    places = [text.index(heading) for heading in headings]
    assert places == sorted(places)


def test_folder_without_list_is_read_by_metadata(calibrated: Any, tmp_path: Path) -> None:
    """Names state the kind, metadata the rest, flats of nearly the same light are a level: the numbers of the list."""
    levels = (0.03, 0.08, 0.16, 0.25)
    folder = record(tmp_path / "captures", Camera("sony_a7s2", 3200, side=64), darks=3, flats=3, levels=levels)
    listed = estimates(calibrated(folder))
    (folder / "captures.csv").unlink()
    (folder / "._dark_0.dng").write_bytes(b"\0\5\x16\7")  # as a Mac writes it next to each file of a memory card
    (folder / "@eaDir" / "flat.dng").mkdir(parents=True)
    assert estimates(calibrated(folder)) == listed


def test_memory_does_not_grow_with_the_number_of_frames(tmp_path: Path) -> None:
    peaks, side = [], 96
    for darks in (4, 12):
        shots = [*[Shot(0.0)] * darks, *(Shot(light) for light in (0.05, 0.1, 0.2, 0.3) for _ in range(2))]
        folder = with_levels(draw(tmp_path / f"{darks}", Numbers(), 0, side, shots))
        tracemalloc.start()
        calibrate(read_captures(folder))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + 4 * 2 * side**2  # four frames of uint16


@pytest.mark.skipif(EMVA is None, reason="the real frames of EMVA 1288 are not on this machine")
def test_real_frames_give_published_numbers() -> None:
    """K: 0.283 to 0.291 by the range of the fit, and less in bright flats; row noise 0.505 DN."""
    assert EMVA is not None
    found = calibrate(read_captures(EMVA))
    gain = found.isos[0]["dn_per_e"]
    assert gain.low <= 0.283 <= 0.291 <= gain.high
    assert found.isos[0]["row_std_dn"].value == pytest.approx(0.505, rel=0.05)
    assert any("the gain differs by -3" in note for note in found.captures.notes)
