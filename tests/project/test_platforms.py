"""Other systems than Linux: types of the branches for them, and paths of Windows."""

from __future__ import annotations

import ntpath
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from unprocess_gen.core import files


@pytest.mark.slow
@pytest.mark.parametrize("system", ["darwin", "win32"])
def test_types_are_correct_on_other_systems(system: str) -> None:
    """Mypy skips branches for other systems, and knows which modules, functions and constants a system lacks."""
    command = [sys.executable, "-m", "mypy", "--platform", system]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False)

    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("path", ["/a", "../a", "a/../../b", "C:/a", "C:a", "..\\a", "\\a", "//server/share/a"])
def test_paths_that_lead_outside_on_windows_are_found(path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "os", SimpleNamespace(path=ntpath, sep="\\"))
    assert files.leads_outside(path)
    assert not files.leads_outside("folder/..a/photo.png")


@pytest.mark.parametrize("path", ["C:/a", "..\\a", "\\a"])
def test_names_with_backslashes_and_colons_are_inside_on_linux(path: str) -> None:
    assert not files.leads_outside(path)
