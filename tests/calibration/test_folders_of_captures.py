"""Descriptions of captures as other programs write them."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.captures import Numbers, Shot, draw, with_levels

from unprocess_gen.calibration.calibrate import calibrate
from unprocess_gen.calibration.captures import EMVA_ISO, read_captures

LEVELS = (0.03, 0.06, 0.09, 0.12)


def captures(folder: Path, *more: Shot) -> Path:
    shots = [*[Shot(0.0)] * 4, *(Shot(light) for light in LEVELS for _ in range(2)), *more]
    return with_levels(draw(folder / "captures", Numbers(), 0, 96, shots))


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_list_of_a_spreadsheet_is_read(delimiter: str, tmp_path: Path) -> None:
    folder = captures(tmp_path)
    known = read_captures(folder)
    text = (folder / "captures.csv").read_text(encoding="utf-8").replace(",", delimiter)
    comma = "," if delimiter == ";" else "."
    (folder / "captures.csv").write_text(
        text.replace(f"{delimiter}0.01{delimiter}", f"{delimiter}0{comma}01{delimiter}")
    )
    assert read_captures(folder) == known


def test_each_series_of_an_emva_description_is_its_own(tmp_path: Path) -> None:
    """The spatial series states exposure and photons of a temporal one, and has 4 % more light (EMVA 1288, set 003)."""
    folder = captures(tmp_path, *[Shot(LEVELS[1] * 1.04)] * 4)
    (folder / "captures.csv").unlink()
    series = [("d 10000000", range(4))]
    series += [(f"b 10000000 {light}", range(4 + 2 * step, 6 + 2 * step)) for step, light in enumerate(LEVELS)]
    series += [(f"b 10000000 {LEVELS[1]}", range(12, 16))]
    lines = [
        "v 3.0",
        "n 14 96 96",
        *(line for head, places in series for line in (head, *(f"i {n}.npy" for n in places))),
    ]
    (folder / "EMVA1288_Data.txt").write_text("\n".join(lines) + "\n")
    found = read_captures(folder)
    assert sorted(map(len, found.groups("flat", EMVA_ISO))) == [2, 2, 2, 2, 4]
    assert calibrate(found).isos[0].iso == EMVA_ISO
