"""Completion of command lines: candidates, and the scripts in real shells."""

from __future__ import annotations

import os
import pty
import select
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from helpers.commands import COMMAND, RunMain

from unprocess_gen.cli.completion import FILES, FOLDERS, SHELLS, WORDS, complete
from unprocess_gen.cli.verbs import VERBS

CANDIDATES = [
    ("gen-dataset ver", ["verify"]),
    ("gen-dataset s", ["scene.", "scene=", "seed=", "self_test=", "sensor.", "sensor=", "source.", "split=", "status"]),
    ("gen-dataset body=s", ["body=sony_a7s2"]),
    ("gen-dataset camera=sony", ["camera=sony_a7r", "camera=sony_a7s2", "camera=sony_rx100"]),
    ("gen-dataset plan isp=", ["isp=gamma22", "isp=linear", "isp=smoothstep_gamma22", "isp=srgb"]),
    ("gen-dataset plan gains.r", ["gains.red="]),
    ("gen-dataset camera=convex source.recursive=", ["source.recursive=false", "source.recursive=true"]),
    ("gen-dataset effects.prnu=o", ["effects.prnu=off", "effects.prnu=on"]),
    ("gen-dataset output.dtype=", ["output.dtype=float32", "output.dtype=uint16"]),
    ("gen-dataset -m camera=sony_a7r,nex", ["camera=sony_a7r,nexus_6p"]),
    ("gen-dataset -m camera=sony_a7r,sony", ["camera=sony_a7r,sony_a7s2", "camera=sony_a7r,sony_rx100"]),
    ("gen-dataset -m output.dtype=uint16,", ["output.dtype=uint16,float32"]),
    ("gen-dataset +exp", ["+experiment="]),
    ("gen-dataset +experiment=ipol", ["+experiment=ipol_demo"]),
    ("gen-dataset --mul", ["--multirun"]),
    ("gen-dataset --cfg ", ["all", "hydra", "job"]),
    ("gen-dataset --vers", ["--version"]),
    ("gen-dataset verify --r", ["--regenerate", "--repair"]),
    ("gen-dataset verify ds --log", ["--log-file"]),
    ("gen-dataset again ds o", ["out=", "output.frames="]),
    ("gen-dataset again ds so", ["source.max_failed=", "source.root="]),
    ("gen-dataset completion ", ["bash", "zsh"]),
    ("gen-dataset 'camera=nex", ["camera=nexus_6p"]),
]  # fmt: skip


@pytest.mark.parametrize(("line", "candidates"), CANDIDATES)
def test_words_are_completed(line: str, candidates: list[str]) -> None:
    assert complete(line) == (WORDS, candidates)


@pytest.mark.parametrize(
    ("line", "kind"),
    [
        ("gen-dataset out=", FOLDERS),
        ("gen-dataset source.root=ph", FILES),
        ("gen-dataset --config-dir ", FILES),
        ("gen-dataset verify ", FOLDERS),
        ("gen-dataset verify d", FOLDERS),
        ("gen-dataset replay ", FILES),
        ("gen-dataset replay ds --to ", FOLDERS),
        ("gen-dataset report ds --source=", WORDS),
        ("gen-dataset report ds --source ", FOLDERS),
        ("gen-dataset preview ds source.root=", FOLDERS),
    ],
)
def test_names_of_files_and_folders_are_left_to_the_shell(line: str, kind: str) -> None:
    assert complete(line) == (kind, [])


def test_every_verb_and_its_flags_are_completed() -> None:
    assert set(VERBS) <= set(complete("gen-dataset ")[1])
    for verb in VERBS.values():
        flags = complete(f"gen-dataset {verb.name} -")[1]
        assert {flag for argument in verb.arguments for flag in argument.flags} <= set(flags)
        assert {"--help", "--quiet"} <= set(flags)


def test_options_below_config_dir_are_completed(tmp_path: Path) -> None:
    (tmp_path / "noise").mkdir()
    (tmp_path / "noise/quiet.yaml").touch()
    for flag in (f"--config-dir {tmp_path}", f"-cd={tmp_path}"):
        assert complete(f"gen-dataset {flag} noise=qu") == (WORDS, ["noise=quiet"])


@pytest.mark.parametrize("arguments", [(), ("fish",), ("bash", "zsh"), ("bsh",)])
def test_unknown_shell_is_refused_in_one_line(arguments: tuple[str, ...], run_main: RunMain) -> None:
    done = run_main("completion", *arguments)
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert "expected bash or zsh" in done.err


# Real shells ----------------------------------------------------------------------------------------------------------


class Terminal:
    """An interactive shell on a pseudo-terminal."""

    def __init__(self, command: list[str], folder: Path) -> None:
        self.process, self._at = pty.fork()
        if self.process == 0:
            os.chdir(folder)
            os.environ.update(TERM="dumb", PS1="> ", PATH=f"{COMMAND.parent}:{os.environ['PATH']}")
            os.execvp(command[0], command)

    def typed(self, text: str, wanted: str, seconds: float = 30) -> str:
        """Type text, and return what the shell shows up to ``wanted``."""
        os.write(self._at, text.encode())
        shown, until = "", time.monotonic() + seconds
        while wanted not in shown and time.monotonic() < until:
            if select.select([self._at], [], [], 0.1)[0]:
                shown += os.read(self._at, 4096).decode(errors="replace")
        return shown

    def close(self) -> None:
        """End the shell."""
        with suppress(ProcessLookupError):
            os.kill(self.process, 9)
        os.waitpid(self.process, 0)
        os.close(self._at)


@pytest.fixture(params=SHELLS)
def terminal(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Terminal]:
    """Return an interactive shell that evaluated its completion script."""
    shell = str(request.param)
    if shutil.which(shell) is None:
        pytest.skip(f"needs {shell}")
    options = {"bash": ["--norc", "--noprofile", "-i"], "zsh": ["-f", "-i"]}[shell]
    opened = Terminal([shell, *options], tmp_path)
    if shell == "zsh":
        opened.typed(
            "unsetopt zle_bracketed_paste 2>/dev/null; autoload -Uz compinit && compinit -u; echo in'it'\n", "init"
        )
    opened.typed(f"eval \"$(gen-dataset completion {shell})\"; echo re'ady'\n", "ready")
    yield opened
    opened.close()


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")
def test_tab_completes_verbs_flags_settings_and_options(terminal: Terminal, tmp_path: Path) -> None:
    (tmp_path / "a_sweep" / "camera=sony_a7r").mkdir(parents=True)
    assert "ify " in terminal.typed("gen-dataset ver\t", "ify ")
    assert "enerate " in terminal.typed("--reg\t", "enerate ")
    terminal.typed("\x15", "")
    assert "us_6p" in terminal.typed("gen-dataset camera=nex\t", "us_6p")
    terminal.typed("\x15", "")
    assert "weep/" in terminal.typed("gen-dataset out=a_s\t", "weep/")
