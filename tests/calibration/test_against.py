"""Frames of a camera are compared with the profile of a dataset: planted differences are named, and no others."""

from __future__ import annotations

import csv
import dataclasses
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


@pytest.fixture(scope="module")
def out(config: Config, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset of one pair with the profile."""
    folder = tmp_path_factory.mktemp("against") / "ds"
    source = dataclasses.replace(config.source, limit=1)
    ug.generate(dataclasses.replace(config, out=str(folder), n_jobs=1, source=source))
    return folder


def test_differences_are_named_in_sentences_and_a_list(out: Path, run_main: RunMain, tmp_path: Path) -> None:
    listed = tmp_path / "list.csv"
    done = run_main("verify", out, "--against", draw(tmp_path / "same", Numbers(), 0))
    assert (done.code, "0 wrong" in done.out) == (0, True), done.err
    other = draw(tmp_path / "other", Numbers(2.2, 5.5, 0.0, 2.5, prnu_std=0.02), 0)
    done = run_main("verify", out, "--against", other, "--to", listed)
    assert done.code == 4
    rows = {(row["number"], row["iso"], row["site"]): row for row in csv.DictReader(listed.read_text().splitlines())}
    assert rows["read_std_dn", "800", ""]["verdict"] == "differs"
    assert float(rows["read_std_dn", "800", ""]["difference_percent"]) == pytest.approx(10, abs=1.5)
    assert rows["row_std_dn", "800", ""]["verdict"] == "missing in the frames"
    assert rows["column_std_dn", "800", ""]["verdict"] == "agrees"
    for text in (
        "ISO 800: dn_per_e of the frames is",
        "the profile lacks it: effect prnu",
        "ISO 800: read_std_dn of the frames is 5.",
        "ISO 800: black_error_dn of the frames is 2.",
        "the camera does not show it",
    ):
        assert text in done.err


def test_two_numbers_are_compared(tmp_path: Path) -> None:
    """The two numbers agree; what they do not describe is missing in the profile."""
    plain = ["noise=heteroscedastic", "noise.a=2", "noise.b=26.44", "sensor=generic_14bit"]
    config = ug.load_config([*plain, f"sensor.black_level_dn={BLACK}"])
    found = compare_frames(config, draw(tmp_path / "frames", Numbers(black_error_dn=0), 0))
    verdicts = {one.measured.name: one.verdict for one in found.numbers if one.measured.site is None}
    assert (verdicts["dn_per_e"], verdicts["b_dn2"], verdicts["row_std_dn"]) == (
        "agrees",
        "agrees",
        "missing in the profile",
    )


def test_gain_of_darks_alone_is_not_compared(config: Config, tmp_path: Path) -> None:
    folder = draw(tmp_path / "frames", Numbers(), 0)
    lines = [line for line in (folder / "captures.csv").read_text().splitlines() if "flat" not in line]
    (folder / "captures.csv").write_text("\n".join(lines))
    verdicts = {one.measured.name: one.verdict for one in compare_frames(config, folder).numbers}
    assert (verdicts["dn_per_e"], verdicts["read_std_dn"]) == ("not compared", "agrees")


@pytest.mark.parametrize(
    "flags", ["--to list.csv", "--against frames --noise", "--against no_folder", "--against frames --to ds/list.csv"]
)
def test_wrong_use_is_refused(flags: str, run_main: RunMain, out: Path) -> None:
    done = run_main("verify", out, *flags.replace("ds/", f"{out}/").split())
    assert (done.code, len(done.err.splitlines())) == (2, 1), done.err


def test_frames_of_another_iso_are_refused(config: Config, tmp_path: Path) -> None:
    folder = draw(tmp_path / "frames", Numbers(), 0)
    (folder / "captures.csv").write_text((folder / "captures.csv").read_text().replace(",800,", ",1600,"))
    with pytest.raises(ug.ConfigError, match="the frames are of ISO 1600"):
        compare_frames(config, folder)


@pytest.mark.slow
@pytest.mark.parametrize("number", [*CHANGES, "none"])
def test_planted_differences_are_named_in_all_of_100_runs(number: str, config: Config, tmp_path: Path) -> None:
    for seed in range(100):
        found = compare_frames(config, draw(tmp_path / f"{seed}", CHANGES.get(number, Numbers()), seed, 256))
        named = {one.measured.name for one in found.differences}
        assert named == ({number} if number in CHANGES else set()), (seed, [str(one) for one in found.differences])
