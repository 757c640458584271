"""Code blocks of README and documentation run as they are printed.

Every ``python`` and ``bash`` block of a page runs, in order, in a new folder that contains `photos` and `clips`. Python
blocks of a page share their names. A ``yaml`` block that begins with a comment with a path, such as
``# mine/camera/phone.yaml: …``, is written to that path, as is a ``python`` block that begins with ``# train.py: …``.
Indented blocks that begin with a command count as ``bash``.
HTML comments directly before a block change this:

* ``<!-- not run: reason -->``: the block does not run.
* ``<!-- needs: module -->``: the block runs if the module can be imported.
* ``<!-- exit code: 4 -->``: the last command of the block ends with this code instead of 0.
* ``<!-- output -->`` before a ``text`` block: it is exactly what the block before it prints on stdout.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import re
import shlex
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from helpers.commands import COMMAND, RunMain, run_process
from helpers.photographs import pixels
from PIL import Image

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
QUICK = ("README.md",)
"""Pages whose blocks run in the quick tests; the others run with ``-m slow``."""

COMMENT = re.compile(r"<!-- (not run|needs|exit code|output)(?:: ([^\n]+?))? -->\n\n?")
BLOCK = re.compile(
    rf"((?:{COMMENT.pattern})*)(?:^```(\S*)\n(.*?)^```$|(?<=\n\n)((?:^    [^\n]*\n+)+))", re.MULTILINE | re.DOTALL
)
"""Comments, and a fenced block (language and text) or an indented one."""

COMMANDS = ("gen-dataset", "python", ".venv/bin", "pip ", "pytest")
FILE_PATH = re.compile(r"(?:# @package _global_\n)?# ([\w./-]+(?:\.yaml\b|\.py:))")
SYNOPSIS = re.compile(r"\.\.\.|…|\[flags\]")
OPERATORS = ("|", "&", ";", ">", "<", "$(", "=$")


@dataclass(frozen=True)
class Block:
    """One code block of a page: language, text, number of its first line, and the comments before it."""

    language: str
    text: str
    line: int
    comments: dict[str, str] = field(default_factory=dict)

    @property
    def runs(self) -> bool:
        """Return whether the block can run here."""
        needed = self.comments.get("needs")
        return "not run" not in self.comments and (needed is None or importlib.util.find_spec(needed) is not None)


def read_blocks(text: str) -> Iterator[Block]:
    """Yield the fenced and the indented code blocks of a page."""
    for match in BLOCK.finditer(text):
        comments, *_, language, fenced, indented = match.groups()
        code = textwrap.dedent(fenced or indented).rstrip()
        if fenced is None:
            language = "bash" if code.startswith(COMMANDS) and not SYNOPSIS.search(code) else ""
        line = text.count("\n", 0, match.start(6 if fenced is None else 5)) + 1
        yield Block(language, code, line, dict(COMMENT.findall(comments)))


def blocks_of(page: Path) -> list[Block]:
    return list(read_blocks(page.read_text(encoding="utf-8")))


def commands_of(block: Block) -> list[str]:
    """Return the commands of a block, without comments and with continued lines joined."""
    lines = block.text.replace("\\\n", " ").splitlines()
    return [line for line in lines if shlex.split(line, comments=True)]


class Page:
    """Run the blocks of one page in the current folder."""

    def __init__(self, path: Path, run_main: RunMain) -> None:
        self.path = path
        self.run_main = run_main
        self.names: dict[str, object] = {"__name__": "__main__"}

    def run(self, block: Block) -> str:
        """Run one block and return what it prints on stdout."""
        place = f"{self.path.relative_to(ROOT)}:{block.line}"
        if block.language in ("yaml", "python") and (named := FILE_PATH.match(block.text)):
            file = Path(named[1].rstrip(":"))
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(block.text + "\n", encoding="utf-8")
        elif block.language == "python":
            printed = io.StringIO()
            code = compile("\n" * (block.line - 1) + block.text, str(self.path), "exec")
            with contextlib.redirect_stdout(printed):
                exec(code, self.names)
            return printed.getvalue()
        if block.language != "bash":
            return ""
        printed_by, expected = "", [0] * len(commands_of(block))
        expected[-1] = int(block.comments.get("exit code", 0))
        for command, code in zip(commands_of(block), expected, strict=True):
            exit_code, out, err = self.call(command)
            assert exit_code == code, f"{place}: {command}: exit code {exit_code}\n{out}{err}"
            printed_by += out
        return printed_by

    def call(self, command: str) -> tuple[int, str, str]:
        """Run a command: `gen-dataset` in this process if the shell has nothing else to do."""
        words = shlex.split(command, comments=True)
        if words[0] == "gen-dataset" and not any(sign in command.partition("#")[0] for sign in OPERATORS):
            return self.run_main(*words[1:])
        path = f"{COMMAND.parent}:{os.environ['PATH']}"
        done = run_process("bash", "-c", command, timeout=600, PATH=path, PYTHONPATH=str(ROOT))
        return done.returncode, done.stdout, done.stderr


@pytest.fixture
def page_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of a page: ten pictures in `photos`, two folders of frames in `clips`; one core is used."""
    (tmp_path / "photos").mkdir()
    for number in range(10):
        Image.fromarray(pixels(number, 528, 560)).save(tmp_path / "photos" / f"picture_{number}.jpg", quality=95)
    for clip in ("kitchen", "street"):
        (tmp_path / "clips" / clip).mkdir(parents=True)
        for number in range(3):
            Image.fromarray(pixels(number, 96, 128)).save(tmp_path / "clips" / clip / f"{number:04}.png")
    monkeypatch.setattr("unprocess_gen.pipeline.executors.local.usable_cores", lambda: 1)
    return tmp_path


@pytest.mark.filterwarnings("ignore:Exception ignored in. <_io.FileIO:pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(page, id=name, marks=() if name in QUICK else pytest.mark.slow)
        for page in PAGES
        if any(block.runs and block.language in ("python", "bash") for block in blocks_of(page))
        for name in [str(page.relative_to(ROOT))]
    ],
)
def test_blocks_run(path: Path, page_folder: Path, run_main: RunMain) -> None:
    page, printed = Page(path, run_main), ""
    for block in blocks_of(path):
        if "output" in block.comments:
            assert block.text.strip() == printed.strip(), (
                f"{path.relative_to(ROOT)}:{block.line}: another output\n{printed}"
            )
        elif block.runs:
            printed = page.run(block)


@pytest.mark.slow
def test_denoiser_example_trains_and_draws(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    command = [sys.executable, ROOT / "docs" / "examples" / "train_denoiser.py", "--scenes", "5", "--steps", "2"]
    done = run_process(*command, cwd=tmp_path, PYTHONPATH=str(ROOT))
    assert done.returncode == 0, done.stderr
    assert "4 pairs to train on, 1 held out" in done.stdout
    noisy, gaussian, bilateral, network = (float(line.split()[-2]) for line in done.stdout.splitlines()[-4:])
    assert 20 < noisy < min(gaussian, bilateral)
    assert 10 < network < 60
    assert (tmp_path / "denoiser.jpg").stat().st_size > 1000


def test_blocks_that_do_not_run_have_a_reason() -> None:
    blocks = {f"{page.relative_to(ROOT)}:{block.line}": block for page in PAGES for block in blocks_of(page)}
    assert len([block for block in blocks.values() if block.runs and block.language]) > 80
    assert [place for place, block in blocks.items() if block.comments.get("not run") == ""] == []
    assert [place for place, block in blocks.items() if block.language in ("sh", "shell", "console", "py")] == []


def test_a_training_has_at_most_30_lines() -> None:
    page = ROOT / "docs/guides/hydra_apps.md"
    (training,) = [block.text for block in blocks_of(page) if block.text.startswith("# train.py: ")]
    assert all(word in training for word in ("hydra.main", "packed", "noise_map", "develop", "num_workers=2"))
    assert len([line for line in training.splitlines() if line.strip()]) <= 30
