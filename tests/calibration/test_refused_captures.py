"""Captures that cannot carry the measurement are refused with a reason, and nothing is written."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from helpers.captures import Camera, record
from helpers.commands import RunMain

HEADER = "file,kind,iso,exposure_s,level,black_level_dn,white_level_dn,bits,pattern"
SHAPE = (96, 128)
LEVELS = (100.0, 300.0, 600.0, 900.0)
GAIN, BLACK, READ = 1.5, 256, 3.0


@dataclass(frozen=True)
class Shot:
    """A frame to write: kind, signal in DN, number, and what captures.csv says about it."""

    kind: str
    signal: float
    number: int
    iso: float = 100
    bits: int = 12

    def pixels(self) -> np.ndarray:
        """Draw a frame: Poisson counts, read noise, rounding."""
        rng = np.random.default_rng([round(self.signal), self.number, round(self.iso)])
        counts = rng.poisson(self.signal / GAIN, SHAPE) * GAIN
        return np.clip(np.rint(BLACK + counts + rng.normal(0, READ * self.iso / 100, SHAPE)), 0, 4095)


Change = Callable[[Shot, np.ndarray], np.ndarray]


def shots(darks: int = 4, levels: tuple[float, ...] = LEVELS) -> Iterator[Shot]:
    yield from (Shot("dark", 0, number) for number in range(darks))
    yield from (Shot("flat", level, number) for level in levels for number in range(2))


def write(
    folder: Path, shots: Iterator[Shot], change: Change = lambda shot, pixels: pixels, suffix: str = ".npy"
) -> Path:
    folder.mkdir()
    lines = [HEADER]
    for place, shot in enumerate(shots):
        name, pixels = f"{place:02d}{suffix}", change(shot, shot.pixels()).astype(np.uint16)
        if suffix == ".npy":
            np.save(folder / name, pixels)
        else:
            cv2.imwrite(str(folder / name), pixels)
        level = f"{shot.signal:g}" if shot.kind == "flat" else ""
        lines.append(f"{name},{shot.kind},100,0.01,{level},{BLACK},{2**shot.bits - 1},{shot.bits},RGGB")
    (folder / "captures.csv").write_text("\n".join(lines) + "\n")
    return folder


def smoothed(shot: Shot, pixels: np.ndarray) -> np.ndarray:
    return np.rint((4 * pixels + np.roll(pixels, 2, 0) + np.roll(pixels, 2, 1)) / 6)


def flickering(shot: Shot, pixels: np.ndarray) -> np.ndarray:
    return BLACK + (pixels - BLACK) * (1 + 0.05 * (shot.number % 2)) if shot.kind == "flat" else pixels


def banded(shot: Shot, pixels: np.ndarray) -> np.ndarray:
    rows = 1 + 0.05 * np.sin(np.arange(SHAPE[0])[:, None] / 5 + 2 * shot.number)
    return BLACK + (pixels - BLACK) * rows if shot.kind == "flat" else pixels


def vignetted(shot: Shot, pixels: np.ndarray) -> np.ndarray:
    y, x = (np.linspace(-1, 1, length) for length in SHAPE)
    return BLACK + (pixels - BLACK) * (1 - 0.5 * (y[:, None] ** 2 + x**2)) if shot.kind == "flat" else pixels


FAULTS: dict[str, tuple[Change, str]] = {
    "clipped black": (lambda shot, pixels: np.maximum(pixels, BLACK), "black is clipped"),
    "missing codes": (lambda shot, pixels: np.floor(pixels / 4) * 4, "never occur"),
    "noise reduction": (smoothed, "noise reduction"),
    "flicker": (flickering, "differs by"),
    "bands": (banded, "flickers"),
    "vignetting": (vignetted, "even light"),
    "light in darks": (lambda shot, pixels: np.minimum(pixels + 250 * (shot.kind == "dark"), 4095), "without light"),
    "saturated": (lambda shot, pixels: np.where(shot.kind == "flat", 4095, pixels), "0 levels"),
    "several ISOs": (
        lambda shot, pixels: replace(shot, iso=300).pixels() if (shot.kind, shot.number) == ("dark", 1) else pixels,
        "of one ISO and exposure",
    ),
    "several exposures": (
        lambda shot, pixels: replace(shot, signal=2 * shot.signal).pixels() if shot.number == 1 else pixels,
        "one exposure in steady light",
    ),
    "twins": (
        lambda shot, pixels: replace(shot, number=0).pixels() if shot.kind == "flat" else pixels,
        "has the bytes",
    ),
    "too few bits": (
        lambda shot, pixels: BLACK + np.rint((pixels - BLACK) / 16 + 0.3),
        "rounding hides it",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_is_refused(fault: str, run_main: RunMain, tmp_path: Path) -> None:
    change, reason = FAULTS[fault]
    refused(run_main, write(tmp_path / "captures", shots(), change), reason)


def refused(run_main: RunMain, folder: Path, reason: str) -> None:
    done = run_main("calibrate", folder, "--to", folder.parent / "mine.yaml")
    assert (done.code, len(done.err.splitlines())) == (2, 1), done.err
    assert reason in done.err
    assert not list(folder.parent.glob("mine.*"))


def test_8_bits_are_refused(run_main: RunMain, tmp_path: Path) -> None:
    folder = write(tmp_path / "captures", shots(), lambda shot, pixels: np.rint(pixels / 16))
    text = (folder / "captures.csv").read_text()
    (folder / "captures.csv").write_text(text.replace(f",{BLACK},4095,12,", ",16,255,8,"))
    refused(run_main, folder, "at 8 bits; expected 1 DN or more")


FEW = {
    "no darks": (shots(darks=0), "darks"),
    "one dark": (shots(darks=1), "fewer than 2 darks"),
    "three levels": (shots(levels=LEVELS[:3]), "3 levels"),
    "no dark level": (shots(levels=(900, 1200, 1500, 1800)), "below 10%"),
}


@pytest.mark.parametrize("few", FEW)
def test_too_few_frames_are_refused(few: str, run_main: RunMain, tmp_path: Path) -> None:
    chosen, reason = FEW[few]
    refused(run_main, write(tmp_path / "captures", chosen), reason)


def test_sound_frames_are_accepted(run_main: RunMain, tmp_path: Path) -> None:
    folder = write(tmp_path / "captures", shots(), suffix=".tif")
    done = run_main("calibrate", folder, "--to", tmp_path / "mine.yaml")
    assert done.code == 0, done.err
    profile = yaml.safe_load((tmp_path / "mine.yaml").read_text(encoding="utf-8"))
    assert profile["name"] == "mine"
    assert (profile["dark_e_per_s"], profile["full_well_e"]) == (None, None)
    assert "dark_e_per_s is null: the captures do not show it" in done.err


LINES = {
    "kind": ("00.npy,light,100,,", "kind=light"),
    "iso": ("00.npy,dark,fast,,", "iso=fast"),
    "missing file": ("99.npy,dark,100,,", "no such frame"),
    "no ISO": ("00.npy,dark,,,", "iso is empty"),
    "column twice": ("", "occurs twice"),
}


@pytest.mark.parametrize("line", LINES)
def test_wrong_line_of_list_is_refused(line: str, run_main: RunMain, tmp_path: Path) -> None:
    folder = write(tmp_path / "captures", shots())
    text, reason = LINES[line]
    (folder / "captures.csv").write_text(f"file,kind,iso,exposure_s,level{',iso' * (not text)}\n{text}\n")
    refused(run_main, folder, reason)


def test_list_that_contradicts_metadata_is_refused(run_main: RunMain, tmp_path: Path) -> None:
    folder = record(tmp_path / "captures", Camera("sony_a7s2", 1600, 64), darks=1, levels=(0.1,), flats=1)
    text = (folder / "captures.csv").read_text()
    (folder / "captures.csv").write_text(text.replace("dark,1600", "dark,800"))
    refused(run_main, folder, "iso=800: the metadata")
