"""Command line: exit codes, one line for every mistake, help, and each verb."""

from __future__ import annotations

import errno
import os
import re
import shlex
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest
import yaml
from helpers.cases import slow_except
from helpers.commands import RunMain, messages
from helpers.datasets import Make
from helpers.photographs import fill, pixels
from helpers.promise_report import Figure
from PIL import Image

from unprocess_gen import __version__
from unprocess_gen.cli.arguments import STANDARD, Verb
from unprocess_gen.cli.exit_codes import EXIT_CODES
from unprocess_gen.cli.help import global_help
from unprocess_gen.cli.verbs import VERBS
from unprocess_gen.config.option_files import ADDED_GROUPS, conf_dir, option_summary
from unprocess_gen.config.schema import GROUPS, Config
from unprocess_gen.config.settings import settings_of
from unprocess_gen.core.errors import SourceError, UnprocessGenError

REFUSED = [
    (["seed=1,2"], r"seed=1,2: several values; expected one; .*add --multirun; for a list, write seed=\[1,2\]"),
    (["word"], r"word: no such verb; expected generate, .*build, calibrate, camera, score or settings key=value"),
    (["camera=convex", "word"], r"generate: word: expected a setting key=value"),
    (["--out", "x"], r"generate: --out: no such flag; expected .*; out is a setting: write out=…"),
    (["--help", "verfy"], r"--help verfy: no such verb or group; expected one of generate, .*; did you mean verify"),
    (["camera=/my/own.yaml"], r"camera=/my/own.yaml: .*; for a file of your own, .* --config-dir FOLDER camera=own"),
    (["--multrun", "seed=1,2"], r"generate: --multrun: no such flag; .*; did you mean --multirun\?"),
    (["verify", "ds", "--regenrate", "2"], r"verify: --regenrate: no such flag; .*; did you mean --regenerate\?"),
    (["verify", "ds", "--regenerate"], r"verify: --regenerate: expected one argument"),
    (["verify", "ds", "--regenerate", "-2"], r"verify: --regenerate: -2: expected an integer of 0 or more"),
    (["replay", "ds", "--keys="], r"replay: --keys: a value is missing"),
    (["verify"], r"verify: expected DIR, the folder of a dataset or of a sweep"),
    (["--config-dir", "/no/such"], r"--config-dir /no/such: no such folder"),
    (["--config-name", "other"], r".*'other'"),
    (["source.root=/no/such"], r"source.root=/no/such: no such folder"),
    (["out="], r"out='': expected the name of a folder"),
    (["out=ftp://x/y"], r"out=ftp://x/y: expected the name of a folder or a URL s3://, gs:// or az://"),
    (["preview", "ds", "--to", "s3://x/y"], r"preview: --to: s3://x/y: expected a local path"),
    (["-m", "camera=nope"], r"camera=nope: no such option"),
    (["--cfg"], r"generate: -c/--cfg: expected one argument; see gen-dataset generate --help"),
    (["--cfg", "x"], r"generate: -c/--cfg: .*'x' .*job"),
    (["-m", "hydra.sweeper.params.seed=1,2"], r"hydra.sweeper.params.seed=1,2: Hydra's own settings are fixed"),
    (["again", "/no/such", "out=x"], r"again: /no/such: no such folder; expected the folder of a dataset"),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "sentence"), REFUSED, ids=[" ".join(arguments) for arguments, _ in REFUSED])
def test_mistake_gives_one_line_exit_code_2_and_no_files(
    arguments: list[str], sentence: str, run_main: RunMain, tmp_path: Path, figure: Figure
) -> None:
    done = run_main(*arguments)
    assert (done.code, done.out) == (2, "")
    assert re.match("gen-dataset: " + sentence, done.err), done.err
    assert done.err.count("\n") == 1 and done.err.endswith("\n")
    assert list(tmp_path.iterdir()) == []
    figure("mistakes", f"exit code {done.code}, {done.err.count(chr(10))} line, {len(list(tmp_path.iterdir()))} files")


@pytest.mark.parametrize(
    ("arguments", "job"), [(("verify", "ds"), ""), (("seed=1",), ""), (("-m", "seed=1"), "seed=1: ")]
)
def test_place_without_permission_gives_one_line_and_exit_code_5(
    arguments: tuple[str, ...], job: str, run_main: RunMain, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object, **__: object) -> NoReturn:
        raise PermissionError(errno.EACCES, "Permission denied", "ds/dataset.json")

    monkeypatch.setattr("unprocess_gen.cli.checks.dataset_folder", refused)
    monkeypatch.setattr("unprocess_gen.pipeline.generate.generate", refused)
    message = "ds/dataset.json: Permission denied; expected read and write permissions"
    assert run_main(*arguments) == (5, "ds: 0 of 1\n" if job else "", f"gen-dataset: {job}{message}\n")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["source.root=empty"], "source.root=empty: no file matches source.include="),
        (["out=file/ds"], "out=file/ds: cannot be written (Not a directory); choose another out"),
        (["out=file"], "out=file: is a file; expected a folder; choose another out"),
    ],
)
def test_useless_folders_are_refused_and_nothing_written(
    arguments: list[str], sentence: str, run_main: RunMain, tmp_path: Path
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").touch()
    done = run_main("source.limit=1", *arguments)
    assert (done.code, done.err.count("\n"), sentence in done.err) == (2, 1, True), done.err
    assert sorted(os.listdir(tmp_path)) == ["empty", "file"]


# Help and printed settings --------------------------------------------------------------------------------------------


HELP = global_help(VERBS)


@pytest.mark.parametrize("arguments", [("--help",), ("-h",), ("camera=nope", "--help")])
def test_help_lists_verbs_whatever_else_is_given(arguments: tuple[str, ...], run_main: RunMain) -> None:
    assert run_main(*arguments) == (0, HELP, "")
    assert run_main("--version") == (0, f"unprocess_gen {__version__}\n", "")


@pytest.mark.parametrize("verb", VERBS.values(), ids=VERBS)
def test_every_verb_answers_help_with_its_own_arguments(verb: Verb, run_main: RunMain, tmp_path: Path) -> None:
    done = run_main(verb.name, "--help", "word", "--flag")
    assert (done.code, done.err) == (0, "")
    for name in [*verb.keys, *(name for flag in (*verb.flags, *STANDARD) for name in flag.names)]:
        assert re.search(rf"(?<!\S){re.escape(name)}\b", done.out), name
    assert ("--multirun" in done.out) == verb.composes
    assert max(map(len, done.out.splitlines())) <= 100
    assert list(tmp_path.iterdir()) == []


def test_help_names_every_group_and_top_level_setting() -> None:
    listed = [re.match(r"  (\w+)(?: |=)", line) for line in HELP.splitlines()]
    names = [match[1] for match in listed if match]
    assert {name for name in names if hasattr(Config(), name)} == {*GROUPS, *settings_of(Config)}


@pytest.mark.parametrize("group", [*GROUPS, *ADDED_GROUPS])
def test_help_of_a_group_explains_its_options_and_keys(group: str, run_main: RunMain) -> None:
    done = run_main("--help", group)
    assert (done.code, done.err) == (0, "")
    text = " ".join(done.out.split())
    for file in (conf_dir() / group).glob("*.yaml"):
        assert option_summary(group, file.stem) in text or file.stem == "default"
    for name, setting in settings_of(GROUPS[group]).items() if group in GROUPS else ():
        assert f"{name}=" in text and setting.meaning in text and str(setting.limit) in text
    assert max(map(len, done.out.splitlines())) <= 100


def test_help_of_a_word_describes_the_verb_or_group(run_main: RunMain) -> None:
    assert run_main("--help", "verify") == run_main("verify", "--help")
    both = run_main("-h", "accuracy").out
    assert both.startswith(run_main("accuracy", "--help").out) and "accuracy=exact" in both
    assert run_main("--help", "-q").out == HELP
    for setting in ("noise.iso", "noise=sony_a7s2"):
        assert run_main("--help", setting) == run_main("--help", "noise")
    assert run_main("--help", "split=null").out.startswith("  split=null")


def test_help_and_errors_name_the_same_exit_codes() -> None:
    codes = {int(code) for text in EXIT_CODES for code in text.split(", ")}
    errors = (UnprocessGenError, *UnprocessGenError.__subclasses__())
    assert {error.exit_code for error in errors if error is not SourceError} <= codes
    assert {128 + number for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM, signal.SIGPIPE)} <= codes
    assert all(meaning in " ".join(HELP.split()) for meaning in EXIT_CODES.values())


def test_flags_are_accepted_at_any_position_and_cfg_writes_nothing(run_main: RunMain, tmp_path: Path) -> None:
    own = (conf_dir() / "noise/none.yaml").read_text().replace("name: none", "name: own")
    (tmp_path / "mine/noise").mkdir(parents=True)
    (tmp_path / "mine/noise/own.yaml").write_text(own)
    done = run_main("seed=7", "-cd", "mine", "noise=own", "--cfg", "job", "camera=sony_a7r")
    loaded = yaml.safe_load(done.out)
    names = [loaded[group]["name"] for group in ("noise", "camera")]
    assert (done.code, loaded["seed"], names, "hydra" in loaded) == (0, 7, ["own", "sony_a7r"], False)
    assert os.listdir(tmp_path) == ["mine"]


# generate -------------------------------------------------------------------------------------------------------------


def test_default_settings_write_ds_only(run_main: RunMain, tmp_path: Path) -> None:
    done = run_main("n_jobs=1")
    assert done.code == 0, done.err
    after = "next: gen-dataset preview ds --to ds_sheets"
    assert re.fullmatch(rf"ds: 10 pairs, [\d.]+ MB, [\d.]+ s, 0 failed; {after}\n", done.out)
    files = ["ds", "ds/config.yaml", "ds/dataset.json", "ds/manifest.csv", "ds/shards"]
    files += [f"ds/shards/shard-0000{number}.tar" for number in range(2)]
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")) == files


def test_more_failed_photographs_than_allowed_give_exit_code_3(run_main: RunMain, tmp_path: Path) -> None:
    (fill(tmp_path / "p", 2) / "empty.png").touch()
    done = run_main("source.root=p", "n_jobs=1")
    assert (done.code, "2 pairs, " in done.out) == (3, True)
    assert "1 failed (1 empty; see ds/manifest.csv), more than source.max_failed=0; " in done.out

    done = run_main("source.root=p", "n_jobs=1")
    assert (done.code, "ds is complete: 2 pairs" in done.out) == (3, True)
    assert run_main("source.root=p", "n_jobs=1", "source.max_failed=1").code == 0
    (tmp_path / "p/other.png").touch()
    assert run_main("source.root=p", "n_jobs=1", "source.max_failed=1", "out=two").code == 3


# plan -----------------------------------------------------------------------------------------------------------------


def test_plan_prints_converted_noise_parameters(run_main: RunMain, photos: Path) -> None:
    text = run_main("plan", f"source.root={photos}", "sensor=generic_14bit", "noise=imx385_iso1600").out
    scale = (16383 - 1024) / (4095 - 240)
    assert f"a_dn {3.513262 * scale:.6g}, b_dn2 {11.917691 * scale**2:.6g}" in text


# again ----------------------------------------------------------------------------------------------------------------


def test_again_regenerates_the_same_dataset(
    run_main: RunMain, dataset: Path, photos: Path, make: Make, tree_hash: Callable[[Path], str], tmp_path: Path
) -> None:
    make(None, tmp_path / "old", "source.limit=2", "noise=brooks2019", "seed=5", "gains.red=2")  # needs no source
    for folder, source in ((dataset, [f"source.root={photos}"]), (tmp_path / "old", [])):
        out = tmp_path / f"again_{folder.name}"
        done = run_main("again", folder, *source, f"out={out}", "n_jobs=1", "executor.no_workers_s=5")
        assert (done.code, done.out.splitlines()[-1]) == (0, f"the same as {folder}, bit for bit"), done.err
        assert tree_hash(out) == tree_hash(folder)


def test_again_refuses_missing_and_changed_sources(run_main: RunMain, make: Make, tmp_path: Path) -> None:
    for folder, seed in (("p", 1), ("changed", 2), ("longer", 1)):
        (tmp_path / folder).mkdir()
        Image.fromarray(pixels(seed, 9, 14)).save(tmp_path / folder / "a.bmp")
    (tmp_path / "longer/a.bmp").write_bytes((tmp_path / "p/a.bmp").read_bytes() + b"0")
    fill(tmp_path / "missing", 2)
    make(tmp_path / "p", tmp_path / "old")
    problems = {
        "missing": "is missing from missing",
        "longer": "has 451 bytes in longer",
        "changed": "has the SHA-",
    }
    for folder, problem in problems.items():
        assert not (tmp_path / "new").exists()  # the others are found before anything is written
        done = run_main("again", "old", f"source.root={folder}", "out=new", "n_jobs=1")
        assert (done.code, f"source a.bmp: {problem}" in done.err) == (5, True), done.err
    fill(tmp_path / "p", 1, first=7)
    done = run_main("again", "old", "source.root=p", "out=another", "n_jobs=1")
    assert (done.code, "another/manifest.csv: differs from old/manifest.csv" in done.err) == (4, True)


def test_again_of_synthetic_pictures_refuses_a_source_root(run_main: RunMain, make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "old", "source.limit=1")
    done = run_main("again", "old", f"source.root={fill(tmp_path / 'p', 1)}", "out=new")
    assert (done.code, "expected no root" in done.err, (tmp_path / "new").exists()) == (2, True, False)


# One spelling in every verb -------------------------------------------------------------------------------------------


@pytest.fixture
def moved(make: Make, tmp_path: Path) -> Path:
    """Return the folder ``ds`` of a dataset; its photographs, two good ones and a bad one, are in ``moved``.

    ``dataset.json`` records another folder, which does not exist.
    """
    fill(tmp_path / "photos", 1)
    (tmp_path / "photos/001.png").touch()
    Image.fromarray(np.arange(32 * 32 * 3, dtype=np.uint8).reshape(32, 32, 3)).save(tmp_path / "photos/002.png")
    make(tmp_path / "photos", tmp_path / "ds")
    (tmp_path / "photos").rename(tmp_path / "moved")
    return Path("ds")


TAKES_SOURCE = {
    "verify": ("--regenerate", "9"),
    "replay": (),
    "report": ("--to", "page.html"),
    "preview": ("--to", "sheets"),
    "again": ("out=copy", "n_jobs=1", "source.max_failed=1"),
}


@pytest.mark.parametrize("place", ["given", "recorded"])
@pytest.mark.parametrize("verb", slow_except(("verify", "again"), TAKES_SOURCE))
def test_sources_are_given_by_a_setting_or_recorded(
    verb: str, place: str, moved: Path, run_main: RunMain, tmp_path: Path
) -> None:
    if place == "recorded":
        (tmp_path / "moved").rename(tmp_path / "photos")
    done = run_main(verb, moved, *TAKES_SOURCE[verb], *(["source.root=moved"] if place == "given" else []))
    assert (done.code, "omitted" in done.err) == (0, False), done.err


def test_again_needs_a_source_if_none_is_recorded(moved: Path, run_main: RunMain, tmp_path: Path) -> None:
    (tmp_path / "ds/dataset.json").unlink()
    done = run_main("again", moved, "out=new")
    assert (done.code, done.err.count("\n"), (tmp_path / "new").exists()) == (2, 1, False)
    assert "expected that folder; give source.root=" in done.err


@pytest.mark.parametrize("keys", ["2", "00000002,0-2"])
@pytest.mark.parametrize("verb", ["replay", "preview", "dng"])
def test_keys_take_indices_ranges_and_keys_in_every_verb(verb: str, keys: str, moved: Path, run_main: RunMain) -> None:
    if verb == "dng":
        keys = keys.replace("0-2", "1-2")  # LibRaw opens no picture of 12 x 16 pixels
    done = run_main(verb, moved, "--keys", keys, "--to", "there", *(["source.root=moved"] if verb != "dng" else []))
    assert done.code == 0, done.err
    assert ("; 1 failed row skipped" in done.out) == ("-" in keys)


REQUIRED = {"preview": ("--to", "to"), "dng": ("--keys", "0", "--to", "to"), "again": ("out=new",)}
"""Arguments without which a verb refuses every folder."""


def test_folder_of_a_sweep_is_refused_instead_of_a_dataset(moved: Path, run_main: RunMain, tmp_path: Path) -> None:
    (tmp_path / "sweep").mkdir()
    (tmp_path / "ds").rename(tmp_path / "sweep/seed=1")
    (tmp_path / "sweep/sweep.csv").touch()
    for verb in ("replay", *REQUIRED):
        done = run_main(verb, "sweep", *REQUIRED.get(verb, ()))
        assert (done.code, done.err.count("\n"), "such as sweep/seed=1" in done.err) == (2, 1, True)


def test_verify_of_a_sweep_verifies_every_dataset(run_main: RunMain, tmp_path: Path) -> None:
    fill(tmp_path / "p", 1)
    assert run_main("-m", "seed=1,2", "source.root=p", "n_jobs=1", "out=sweep").code == 0
    lines = [f"sweep/seed={seed} is intact" for seed in (1, 2)]
    assert run_main("verify", "sweep") == (0, "\n".join([*lines, "sweep: 2 of 2 datasets are intact", ""]), "")
    (tmp_path / "sweep/seed=1/manifest.csv").write_text("")
    done = run_main("verify", "sweep", "--regenerate", "1", "source.root=p")
    assert (done.code, "sweep: 1 of 2 datasets are intact" in done.out) == (4, True)
    assert done.err.startswith("gen-dataset: sweep/seed=1: ")
    assert messages(done.err)[-1].endswith("run gen-dataset verify sweep/seed=1 --repair")


# Order and kind of words ----------------------------------------------------------------------------------------------

HINTS = [
    (("moved",), "moved: no such verb; .*; moved is a file or folder: write source.root=moved"),
    (("ds",), "ds: no such verb; .*; ds is a dataset: write gen-dataset verify ds, or another verb"),
    (("plan", "./moved"), "plan: ./moved: expected a setting key=value; ./moved is a file or folder: write source"),
    (("accuracy", "ds"), "accuracy: ds: expected a setting key=value; ds is a dataset: write gen-dataset verify ds"),
    (("again", "ds", "out=ds", "source.root=moved"), "again: out=ds: is the dataset itself; expected another folder"),
    (("replay", "ds", "source.root=nothere"), "source.root=nothere: no such folder"),
    (("preview", "ds", "--to", "sheets", "source.root=nothere"), "source.root=nothere: no such folder"),
    (("gains.red=[uniform,", "1.9,", "2.4]"), r"generate: 1.9,: .*; write 'gains.red=\[uniform, 1.9, 2.4\]' in quotes"),
    (("plan", "-m", "camera=a,", "b", "seed=1"), r"plan: b: expected .*; write 'camera=a, b' in quotes"),
    (("split={a:", "0.8,", "b:", "0.2}", "c"), r"generate: 0.8,: .*; write 'split={a: 0.8, b: 0.2}' in quotes"),
    (("split=a:0.8", "split=b:0.2"), "split=a:0.8: split is given twice; write 'split={a:0.8,b:0.2}' in quotes"),
    (("noise.levels=[a:1]", "noise.levels=[b:2]"), r"noise.levels=.*; write 'noise.levels=\[{a:1,b:2}\]' in quotes"),
    (
        ("split={a: 0.8, b: 0.3}",),
        r"split={a: 0.8, b: 0.3} \(sum 1.1\): expected null, or shares above 0 that sum to 1",
    ),
    (("camera", "sony_a7r", "source.root=p"), "camera: sony_a7r: no such file; .*, write gen-dataset camera=sony_a7r"),
    (("again", "ds"), r"again: out is missing"),
    (("again", "ds", "out=new"), r"source.root=.*/photos: no such folder"),
    (("again", "ds", "out=new", "seed=1"), r"again: seed=1: unknown argument; expected out, source.root, "),
    (("again", "ds", "out=new", "output.frames=no"), r"again: output.frames=no: expected true"),
    (("again", "ds", "out=new", "n_jobs=two"), r"n_jobs=two: expected 1 to 1024 or -1"),
    (("again", "ds", "out=new", "out=p"), r"again: out=p: out is given twice"),
    (("again", "ds", "out=new", "--source", "p"), r"again: --source: no such flag"),
]


@pytest.mark.parametrize(("arguments", "sentence"), HINTS, ids=[" ".join(arguments) for arguments, _ in HINTS])
def test_misplaced_word_is_answered_with_what_to_write(
    arguments: tuple[str, ...], sentence: str, moved: Path, run_main: RunMain, tmp_path: Path
) -> None:
    done = run_main(*arguments)
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert re.match(f"gen-dataset: {sentence}", done.err), done.err
    assert sorted(os.listdir(tmp_path)) == ["ds", "moved"]


# Paths that the user names --------------------------------------------------------------------------------------------

OUTPUTS = [
    ("replay", "DS", "--to", "DS/shards"),
    ("replay", "DS", "--to", "DS/new/deep"),
    ("preview", "DS", "--to", "DS/sheets"),
    ("dng", "DS", "--keys", "2", "--to", "DS/new"),
    ("report", "DS", "--to", "DS/page.html"),
    ("accuracy", "out=DS/accuracy"),
]


@pytest.mark.parametrize("arguments", OUTPUTS, ids=" ".join)
def test_no_verb_writes_into_a_dataset(
    arguments: tuple[str, ...], moved: Path, run_main: RunMain, tmp_path: Path
) -> None:
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / moved).rglob("*")}
    done = run_main(*(word.replace("DS", str(moved)) for word in arguments))
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert "is inside the dataset" in done.err
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / moved).rglob("*")} == before


@pytest.mark.parametrize(("folder", "sentence"), [("DIR=t4", "no such f"), ("empty", "not a dataset; expected")])
@pytest.mark.parametrize(
    "verb", slow_except(("verify", "again"), ("verify", "replay", "report", "preview", "dng", "again"))
)
def test_folder_without_a_dataset_is_refused(
    verb: str, folder: str, sentence: str, run_main: RunMain, tmp_path: Path
) -> None:
    (tmp_path / "empty").mkdir()
    done = run_main(verb, folder, *REQUIRED.get(verb, ()))
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert done.err.startswith(f"gen-dataset: {verb}: {folder}: {sentence}")


def test_files_of_the_own_dataset_do_not_count_as_unmatched(run_main: RunMain, tmp_path: Path) -> None:
    fill(tmp_path / "p", 1)
    (tmp_path / "p/notes.txt").touch()
    for _ in range(2):
        done = run_main("source.root=p", "out=p/ds", "n_jobs=1", "-q")
        assert (done.code, "1 file is not matched by source.include (1 .txt)" in done.out) == (0, True), done


def test_suggested_next_step_needs_no_extra(run_main: RunMain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for library in ("matplotlib", "jinja2", "bokeh", "rawpy", "tifffile"):
        monkeypatch.setitem(sys.modules, library, None)
    fill(tmp_path / "p", 1)
    done = run_main("source.root=p", "out=my ds", "n_jobs=1")
    step = done.out.strip().partition("; next: gen-dataset ")[2]
    assert (step, run_main(*shlex.split(step)).code) == ("preview 'my ds' --to 'my ds_sheets'", 0)
