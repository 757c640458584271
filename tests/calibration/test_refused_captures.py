"""Captures that cannot carry the measurement are refused with a reason, and nothing is written."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.captures import BLACK, WHITE, Camera, Numbers, Shot, draw, record, with_levels
from helpers.commands import RunMain

SIDE = 96
LEVELS = (0.03, 0.06, 0.09, 0.12)
Change = Callable[[float, int, np.ndarray], np.ndarray]
"""Function that spoils a frame, by its light, its number among equal ones, and its pixels."""


def write(folder: Path, darks: int = 4, levels: tuple[float, ...] = LEVELS, change: Change | None = None) -> Path:
    """Draw darks, and two flats of each level; return the folder."""
    shots = [*[Shot(0.0)] * darks, *(Shot(light) for light in levels for _ in range(2))]
    with_levels(draw(folder, Numbers(), 0, SIDE, shots))
    for place, shot in enumerate(shots if change else ()):
        number = place if not shot.light else (place - darks) % 2
        pixels = change(shot.light, number, np.load(folder / f"{place}.npy").astype(np.float64))
        np.save(folder / f"{place}.npy", np.clip(np.rint(pixels), 0, WHITE).astype(np.uint16))
    return folder


def scaled(pixels: np.ndarray, factor: np.ndarray | float) -> np.ndarray:
    return BLACK + (pixels - BLACK) * factor


def smoothed(light: float, number: int, pixels: np.ndarray) -> np.ndarray:
    return (4 * pixels + np.roll(pixels, 2, 0) + np.roll(pixels, 2, 1)) / 6


def banded(light: float, number: int, pixels: np.ndarray) -> np.ndarray:
    rows = 1 + 0.05 * np.sin(np.arange(SIDE)[:, None] / 5 + 2 * number)
    return scaled(pixels, rows) if light else pixels


def vignetted(light: float, number: int, pixels: np.ndarray) -> np.ndarray:
    places = np.linspace(-1, 1, SIDE) ** 2
    return scaled(pixels, 1 - 0.5 * (places[:, None] + places)) if light else pixels


FAULTS: dict[str, tuple[Change, str]] = {
    "clipped black": (lambda light, number, pixels: np.maximum(pixels, BLACK), "black is clipped"),
    "missing codes": (lambda light, number, pixels: np.floor(pixels / 4) * 4, "never occur"),
    "noise reduction": (smoothed, "noise reduction"),
    "flicker": (lambda light, number, pixels: scaled(pixels, 1 + 0.05 * number * (light > 0)), "differs by"),
    "bands": (banded, "flickers"),
    "vignetting": (vignetted, "even light"),
    "light in darks": (lambda light, number, pixels: pixels + 1000 * (light == 0), "without light"),
    "saturated": (lambda light, number, pixels: np.where(light, WHITE, pixels), "0 levels"),
    "several ISOs": (
        lambda light, number, pixels: scaled(pixels, 3 if (light, number) == (0, 1) else 1),
        "of one ISO and exposure",
    ),
    "too few bits": (lambda light, number, pixels: BLACK + np.rint((pixels - BLACK) / 24 + 0.3), "rounding hides it"),
}


def refused(run_main: RunMain, folder: Path, reason: str) -> None:
    done = run_main("calibrate", folder, "--to", folder.parent / "mine.yaml")
    assert (done.code, len(done.err.splitlines())) == (2, 1), done.err
    assert reason in done.err
    assert not list(folder.parent.glob("mine.*"))


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_is_refused(fault: str, run_main: RunMain, tmp_path: Path) -> None:
    change, reason = FAULTS[fault]
    refused(run_main, write(tmp_path / "captures", change=change), reason)


def test_frame_that_occurs_twice_is_refused(run_main: RunMain, tmp_path: Path) -> None:
    folder = write(tmp_path / "captures")
    (folder / "5.npy").write_bytes((folder / "4.npy").read_bytes())
    refused(run_main, folder, "has the bytes of 4.npy")


def test_8_bits_are_refused(run_main: RunMain, tmp_path: Path) -> None:
    folder = write(tmp_path / "captures", change=lambda light, number, pixels: pixels / 64)
    text = (folder / "captures.csv").read_text()
    (folder / "captures.csv").write_text(text.replace(f",{BLACK},{WHITE},14", ",8,255,8"))
    refused(run_main, folder, "at 8 bits; expected 1 DN or more")


@pytest.mark.parametrize(
    ("darks", "levels", "reason"),
    [
        (0, LEVELS, "darks"),
        (1, LEVELS, "fewer than 2 darks"),
        (4, LEVELS[:3], "3 levels"),
        (4, (0.2, 0.3, 0.4, 0.5), "below 10%"),
    ],
)
def test_too_few_frames_are_refused(
    darks: int, levels: tuple[float, ...], reason: str, run_main: RunMain, tmp_path: Path
) -> None:
    refused(run_main, write(tmp_path / "captures", darks, levels), reason)


def test_sound_frames_are_accepted(run_main: RunMain, tmp_path: Path) -> None:
    done = run_main("calibrate", write(tmp_path / "captures"), "--to", tmp_path / "mine.yaml")
    assert done.code == 0, done.err
    profile = yaml.safe_load((tmp_path / "mine.yaml").read_text(encoding="utf-8"))
    assert (profile["name"], profile["dark_e_per_s"]) == ("mine", None)
    assert "dark_e_per_s is null: the captures do not show it" in done.err


@pytest.mark.parametrize(
    ("cells", "reason"),
    [
        ({"kind": "light"}, "kind=light"),
        ({"iso": "fast"}, "iso=fast"),
        ({"file": "99.npy"}, "no such frame"),
        ({"iso": ""}, "iso is empty"),
        ({"bits": "0"}, "bits=0"),
        ({"speed": "1"}, "'speed' is missing, is unknown"),
    ],
)
def test_wrong_line_of_list_is_refused(cells: dict[str, str], reason: str, run_main: RunMain, tmp_path: Path) -> None:
    folder = write(tmp_path / "captures")
    rows = list(csv.DictReader((folder / "captures.csv").read_text().splitlines()))
    lines = [",".join(row) for row in ({**rows[0], **cells}, ({**rows[0], **cells}).values())]
    (folder / "captures.csv").write_text("\n".join(lines) + "\n")
    refused(run_main, folder, reason)


def test_list_that_contradicts_metadata_is_refused(run_main: RunMain, tmp_path: Path) -> None:
    folder = record(tmp_path / "captures", Camera("sony_a7s2", 1600, 64), darks=1, levels=(0.1,), flats=1)
    text = (folder / "captures.csv").read_text()
    (folder / "captures.csv").write_text(text.replace("dark,1600", "dark,800"))
    refused(run_main, folder, "iso=800: the metadata")
