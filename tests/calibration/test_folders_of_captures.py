"""Descriptions of captures as other programs write them."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.captures import Numbers, Shot, draw, with_levels

from unprocess_gen.calibration.calibrate import calibrate
from unprocess_gen.calibration.captures import EMVA_ISO, read_captures
from unprocess_gen.core.errors import ConfigError, MachineError

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


def test_header_may_have_capitals_and_spaces(tmp_path: Path) -> None:
    folder = captures(tmp_path)
    known = read_captures(folder)
    first, rest = (folder / "captures.csv").read_text(encoding="utf-8").split("\n", 1)
    (folder / "captures.csv").write_text(f"{first.title()}\n{rest}".replace(",", ", ").replace("\n", "\r"))
    assert read_captures(folder) == known


@pytest.mark.parametrize(
    ("line", "problem"), [('"d.npy,dark,100', "unexpected end of data"), ("d.npy,dark,0,5", "has more than 3 cells")]
)
def test_a_line_that_is_no_row_is_refused_in_one_line(line: str, problem: str, tmp_path: Path) -> None:
    (tmp_path / "captures.csv").write_text(f"file,kind,iso\n{line}\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=problem) as refused:
        read_captures(tmp_path)
    assert "\n" not in str(refused.value)


def test_a_link_to_nothing_is_not_left_out_in_silence(tmp_path: Path) -> None:
    (tmp_path / "dark.npy").symlink_to("nowhere")
    with pytest.raises((ConfigError, MachineError), match=r"dark\.npy"):
        read_captures(tmp_path)


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
