"""Check that a report can be written to the requested place, and write its files, which are no part of a dataset."""

from __future__ import annotations

import os
from pathlib import Path

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.files import machine_errors
from unprocess_gen.core.libraries import require
from unprocess_gen.core.output_paths import DATASET_ENTRIES, check_output_file, check_output_folder
from unprocess_gen.core.paths import AnyPath
from unprocess_gen.pipeline.folder import REPORT


def require_libraries(verb: str) -> None:
    """Raise ConfigError if an optional library of a verb that writes a page is missing; it names the extra."""
    for name in ("matplotlib", "jinja2"):
        require(name, f"{verb}: pages need {name}", "figures")


def check_report_folder(out: Path, verb: str) -> None:
    """Check, before any work, that a report can be written to a folder, which need not exist, outside of datasets."""
    require_libraries(verb)
    if name := next((name for name in DATASET_ENTRIES if (out / name).exists()), None):
        raise ConfigError(f"out={out}: contains a dataset ({name}); expected a folder without one; choose another out")
    check_output_folder(out, f"out={out}")


def page_file(folder: AnyPath, to: Path | None = None) -> Path:
    """The file for a page: ``report.html`` in the folder, or ``to``; ConfigError if it cannot be written."""
    require_libraries("report")
    if to is not None:
        if not (isinstance(folder, Path) and to.resolve() == (folder / REPORT).resolve()):
            check_output_file(to, f"--to {to}", "an HTML page", b"<!doctype html", b"<html")
        return to
    if not isinstance(folder, Path):
        raise ConfigError(f"report: {folder} is in an object store; expected a local file; give --to FILE")
    if not os.access(folder, os.W_OK):
        raise ConfigError(f"report: {folder} is read-only; expected a file that can be written; give --to FILE")
    return folder / REPORT


def write_file(file: Path, content: bytes | str) -> None:
    """Write a file and its folder, replacing the file of an earlier report; MachineError if that fails."""
    with machine_errors(file.parent):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content.encode() if isinstance(content, str) else content)
