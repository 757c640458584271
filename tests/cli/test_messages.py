"""Where results and messages go, and signals: stdout, stderr, log files; full, closed and broken ones."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from helpers.cases import slow_except
from helpers.commands import RunMain, messages
from helpers.datasets import Make
from helpers.photographs import fill
from helpers.processes import WAIT_S, wait_for

from unprocess_gen.cli.messages import report
from unprocess_gen.sources.image.codec_messages import captured

COMMANDS = {
    "help": ["--help"],
    "generate": ["source.root=p", "out=ds", "n_jobs=1"],
    "verify": ["verify", "ds"],
    "report": ["report", "ds", "--to", "page.html"],
}
"""Commands that print something."""

pytestmark = pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")


@pytest.fixture(scope="module")
def folder(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with photographs ``p``, their dataset ``ds``, and ``wide``, a dataset that DNG files can hold."""
    top = tmp_path_factory.mktemp("output")
    make(fill(top / "p", 2), top / "ds")
    make(None, top / "wide", "source.limit=1")
    return top


def shell(line: str, folder: Path, *arguments: str, **more: Any) -> subprocess.CompletedProcess[str]:
    """Run a line of sh in which ``"$@"`` is the command with its arguments."""
    command = ["sh", "-c", line, "sh", sys.executable, "-m", "unprocess_gen", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=WAIT_S, check=False, **more)


FULL = "gen-dataset: stdout: cannot be written (No space left on device); redirect it elsewhere and rerun"


@pytest.mark.parametrize("name", COMMANDS)
def test_full_stdout_gives_one_line_and_exit_code_5(name: str, folder: Path) -> None:
    done = shell('exec "$@" > /dev/full', folder, *COMMANDS[name])
    assert (done.returncode, messages(done.stderr)) == (5, [FULL])


STREAMS = [("verify", "<&- >&- 2>&-"), ("generate", "2>/dev/full"), ("help", ">&-"), ("help", "2>&-")]


@pytest.mark.parametrize(("name", "stream"), STREAMS)
def test_closed_streams_and_full_stderr_do_not_end_a_command(name: str, stream: str, folder: Path) -> None:
    done = shell(f'exec "$@" {stream}', folder, *COMMANDS[name])
    assert done.returncode == 0
    assert "Traceback" not in done.stderr


def test_mistake_keeps_its_exit_code_without_stderr(folder: Path) -> None:
    assert shell('exec "$@" 2>/dev/full', folder, "verfy").returncode == 2
    assert shell('exec "$@" 2>&-', folder, "verify", "no such folder").returncode == 2


@pytest.mark.parametrize("name", ["help", "verify"])
def test_broken_pipe_gives_exit_code_141_without_a_message(name: str, folder: Path) -> None:
    read_end, write_end = os.pipe()
    os.close(read_end)
    command = [sys.executable, "-m", "unprocess_gen", *COMMANDS[name]]
    broken = subprocess.run(command, cwd=folder, stdout=write_end, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write_end)
    assert (broken.returncode, broken.stderr) == (141, "")


@pytest.mark.parametrize("code", [5, pytest.param(141, marks=pytest.mark.slow)])
def test_unwritable_stdout_ends_a_sweep_and_keeps_the_row(code: int, tmp_path: Path) -> None:
    fill(tmp_path / "p", 1)
    read_end, closed_pipe = os.pipe()
    os.close(read_end)
    command = [sys.executable, "-m", "unprocess_gen", "-m", "seed=1,2", "source.root=p", "n_jobs=1", "out=sweep"]
    with Path("/dev/full").open("w") as full, os.fdopen(closed_pipe, "wb") as pipe:
        stdout = full if code == 5 else pipe
        done = subprocess.run(command, cwd=tmp_path, stdout=stdout, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, "Traceback" in done.stderr) == (code, False)
    with (tmp_path / "sweep/sweep.csv").open(newline="") as stream:
        assert [(row["folder"], row["exit"]) for row in csv.DictReader(stream)] == [("seed=1", "0")]


def test_signal_hidden_by_a_library_error_ends_a_sweep(
    run_main: RunMain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started = []

    def interrupted(config: Any, label: str = "") -> Any:
        started.append(label)
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        except BaseException as error:
            raise ValueError("internal error") from error

    monkeypatch.setattr("unprocess_gen.pipeline.generate.generate", interrupted)
    fill(tmp_path / "p", 1)
    done = run_main("-m", "seed=1,2", "source.root=p", "out=sweep")
    assert (done.code, started) == (128 + signal.SIGTERM, ["1/2 seed=1"])
    assert (done.err.startswith("gen-dataset: ended by SIGTERM"), "Traceback" in done.err) == (True, False)


# Messages -------------------------------------------------------------------------------------------------------------


def test_quiet_shows_no_progress_but_results(run_main: RunMain, tmp_path: Path) -> None:
    fill(tmp_path / "p", 2)
    done = run_main("source.root=p", "n_jobs=1", "-q")
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith("ds: 2 pairs")


# Signals --------------------------------------------------------------------------------------------------------------

ENDS = {signal.SIGHUP: "ended by SIGHUP", signal.SIGINT: "interrupted", signal.SIGTERM: "ended by SIGTERM"}


def start(folder: Path, *arguments: str, prefix: tuple[str, ...] = ()) -> subprocess.Popen[str]:
    command = [*prefix, sys.executable, "-m", "unprocess_gen", *arguments]
    return subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


@pytest.mark.parametrize("number", slow_except((signal.SIGINT,), ENDS), ids=lambda number: number.name)
def test_signal_during_a_run_gives_one_line(number: signal.Signals, tmp_path: Path) -> None:
    process = start(tmp_path, "source.limit=2000", "output.pairs_per_shard=1", "n_jobs=1")
    wait_for((tmp_path / "ds/.work").exists)
    process.send_signal(number)
    _, err = process.communicate(timeout=WAIT_S)
    assert process.returncode == 128 + number
    assert messages(err) == [
        f"gen-dataset: {ENDS[number]}; finished shards are kept; run the same command again to resume"
    ]


INTERRUPTING = """
import os, signal, sys

class Interrupt:
    def find_spec(self, name, path, target=None):
        if name == interrupted:
            exec("signal.raise_signal(signal.SIGINT)")

interrupted, *sys.argv[1:] = sys.argv[1:]
sys.meta_path.insert(0, Interrupt())
from unprocess_gen.__main__ import main
sys.exit(main())
"""


@pytest.mark.parametrize("module", ["unprocess_gen.cli", "unprocess_gen.cli.verbs", "hydra"])
def test_interrupted_import_gives_one_line(module: str, tmp_path: Path) -> None:
    (tmp_path / "interrupting.py").write_text(INTERRUPTING)
    command = [sys.executable, "-m", "interrupting", module, "plan"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "gen-dataset: interrupted\n")


def test_ignored_interrupt_stays_ignored_during_imports() -> None:
    command = ["sh", "-c", 'trap "" INT; exec "$@"', "sh", sys.executable, "-c", INTERRUPTING, "argparse", "unknown"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert done.returncode == 2
    assert messages(done.stderr)[0].startswith("gen-dataset: unknown: no such verb; expected ")


@pytest.mark.slow
def test_nohup_is_respected(tmp_path: Path) -> None:
    process = start(tmp_path, "source.limit=1", "n_jobs=1", "out=ds", prefix=("nohup",))
    wait_for((tmp_path / "ds/.work").exists)
    process.send_signal(signal.SIGHUP)
    process.communicate(timeout=WAIT_S)
    assert process.returncode == 0


def test_line_of_another_thread_is_no_message_of_a_codec(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    thread = threading.Thread(target=report, args=("1/3 images",))
    with open(2, "w", closefd=False) as stderr:
        monkeypatch.setattr("sys.stderr", stderr)
        with captured() as taken:
            thread.start()
            thread.join(0.2)
        thread.join()
        monkeypatch.undo()
    assert (bytes(taken), capfd.readouterr().err) == (b"", "gen-dataset: 1/3 images\n")
