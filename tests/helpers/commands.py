"""Calls of the command line, in this process and in others."""

from __future__ import annotations

import os
import subprocess
import sysconfig
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

COMMAND = Path(sysconfig.get_path("scripts"), "gen-dataset")


def environment(**changes: str) -> dict[str, str]:
    """Return this process's environment with changes."""
    return os.environ | {"HYDRA_FULL_ERROR": ""} | changes


def run_process(
    *command: object, cwd: Path | None = None, timeout: float = 600, **env: str
) -> subprocess.CompletedProcess[str]:
    """Run a command with changes of the environment, and capture what it prints."""
    words = [*map(str, command)]
    return subprocess.run(
        words, cwd=cwd, env=environment(**env), capture_output=True, text=True, errors="replace", timeout=timeout,
        check=False,
    )  # fmt: skip


class Done(NamedTuple):
    """Exit code, stdout and stderr of a call."""

    code: int
    out: str
    err: str


RunMain = Callable[..., Done]
"""Type of the fixture `run_main`."""

Cli = Callable[..., "subprocess.CompletedProcess[str]"]
"""Type of the fixture `cli`."""


def messages(text: str) -> list[str]:
    """Return the lines of stderr, except those of progress and of compiling, which depend on machine and cache."""
    return [line for line in text.splitlines() if "images/s" not in line and "compiling kernels" not in line]
