"""Frames of a camera are compared with the profile of a dataset: planted differences are named, and no others."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.captures import BLACK, WHITE, Numbers, draw
from helpers.commands import RunMain

import unprocess_gen as ug
from unprocess_gen.config.schema import Config
from unprocess_gen.reports.against import compare_frames

SETTINGS = ["noise=mine", "scene.iso=800", "sensor=generic_14bit", f"sensor.black_level_dn={BLACK}"]
PROFILE = f"""name: mine
scatter: "off"
units: dn
black: subtracted
bits: 14
black_level_dn: {BLACK}
white_level_dn: {WHITE}
branches:
  - {{iso: [800, 800], dn_per_e: 2.0, read_law: gaussian, read_std_dn: 5.0, row_std_dn: 1.2, black_error_dn: 0.5}}
"""


CHANGES = {
    "read_std_dn": Numbers(read_std_dn=5.5),
    "row_std_dn": Numbers(row_std_dn=0.0),
    "black_error_dn": Numbers(black_error_dn=2.5),
    "dn_per_e": Numbers(dn_per_e=2.06),
}


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Config:
    folder = tmp_path_factory.mktemp("conf")
    (folder / "noise").mkdir()
    (folder / "noise" / "mine.yaml").write_text(PROFILE)
    return ug.load_config(SETTINGS, folder)


def verdicts(config: Config, frames: Path) -> dict[str, bool]:
    """True for numbers of the sensor that differ."""
    compared = compare_frames(config, frames).numbers
    return {found.measured.name: found.differs for found in compared if found.measured.site is None}


def test_two_numbers_are_compared(tmp_path: Path) -> None:
    """The two numbers agree; what they do not describe is missing in the profile."""
    plain = ["noise=heteroscedastic", "noise.a=2", "noise.b=26.44", "sensor=generic_14bit"]
    config = ug.load_config([*plain, f"sensor.black_level_dn={BLACK}"])
    frames = draw(tmp_path / "frames", Numbers(black_error_dn=0), 0)
    found = verdicts(config, frames)
    assert (found["dn_per_e"], found["b_dn2"], found["row_std_dn"]) == (False, False, True)
    assert any(
        "the profile lacks it: effect row" in str(difference)
        for difference in compare_frames(config, frames).differences
    )


def test_gain_of_darks_alone_is_not_compared(config: Config, tmp_path: Path) -> None:
    folder = draw(tmp_path / "frames", Numbers(), 0)
    lines = [line for line in (folder / "captures.csv").read_text().splitlines() if "flat" not in line]
    (folder / "captures.csv").write_text("\n".join(lines))
    found = verdicts(config, folder)
    assert "dn_per_e" not in found and not found["read_std_dn"]


@pytest.mark.parametrize("flags", ["--against frames --noise", "--against no_folder"])
def test_wrong_use_is_refused(flags: str, run_main: RunMain, dataset: Path) -> None:
    done = run_main("verify", dataset, *flags.split())
    assert (done.code, len(done.err.splitlines())) == (2, 1), done.err


def test_frames_of_another_iso_are_refused(config: Config, tmp_path: Path) -> None:
    folder = draw(tmp_path / "frames", Numbers(), 0)
    (folder / "captures.csv").write_text((folder / "captures.csv").read_text().replace(",800,", ",1600,"))
    with pytest.raises(ug.ConfigError, match="the frames are of ISO 1600"):
        compare_frames(config, folder)


@pytest.mark.slow
@pytest.mark.parametrize("number", [*CHANGES, "none"])
def test_planted_differences_are_named_in_all_of_20_runs(number: str, config: Config, tmp_path: Path) -> None:
    for seed in range(20):
        found = compare_frames(config, draw(tmp_path / f"{seed}", CHANGES.get(number, Numbers()), seed, 256))
        named = {difference.measured.name for difference in found.differences}
        assert named == ({number} if number in CHANGES else set()), (seed, list(map(str, found.differences)))
