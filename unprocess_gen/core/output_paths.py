"""Check paths that the user names for output, before any work: no file of a dataset or of the user is overwritten."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from unprocess_gen.core.errors import ConfigError

if TYPE_CHECKING:
    from unprocess_gen.core.paths import AnyPath

DATASET_ENTRIES = ("dataset.json", "config.yaml", "manifest.csv", "shards", ".work")
"""Names that mark a folder as a dataset, finished or not. Other files in such a folder count as damage."""


def enclosing_dataset(path: Path) -> Path | None:
    """Nearest dataset, finished or begun, that is a path itself or a parent of it; None without one."""
    resolved = Path(os.path.realpath(path))
    return next((folder for folder in (resolved, *resolved.parents) if is_dataset(folder)), None)


def is_dataset(folder: AnyPath) -> bool:
    """True if a folder or prefix is a dataset, finished or begun."""
    try:
        return (
            (folder / "dataset.json").is_file()
            or (folder / ".work" / "run.json").is_file()
            or ((folder / "manifest.csv").is_file() and (folder / "shards").is_dir())
        )
    except OSError:  # a folder that may not be searched, above one that may
        return False


def check_output_folder(folder: Path, option: str) -> None:
    """Raise ConfigError if a folder is inside a dataset, is a file, or cannot be written; it need not exist.

    ``option`` is the text of the user for messages, such as ``--to sheets``.
    """
    _refuse_dataset(folder, option, "folder")
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"{option}: is a file; expected a folder")
    nearest = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not nearest.is_dir():
        raise ConfigError(f"{option}: cannot be written (Not a directory); {nearest} is a file; choose another folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise ConfigError(f"{option}: cannot be written (Permission denied); choose another folder")


def check_output_file(file: Path, option: str, expected: str, *marks: bytes) -> None:
    """Raise ConfigError if a file is inside a dataset, cannot be written, or replaces another file than an output.

    ``expected`` describes an earlier output (``an HTML page``), which may be replaced. Its first 1,024 bytes contain
    one of the ``marks``, in lower case. The folder of the file must exist.
    """
    _refuse_dataset(file, option, "file")
    if file.is_dir():
        raise ConfigError(f"{option}: is a folder; expected the name of a file")
    if not file.parent.is_dir():
        raise ConfigError(f"{option}: expected a file in a folder that exists; run mkdir -p {file.parent} first")
    if not os.access(file.parent, os.W_OK | os.X_OK):
        raise ConfigError(f"{option}: cannot be written (Permission denied); choose another folder")
    beginning = _first_bytes(file, option).lower() if file.is_file() else b""
    if beginning and not any(mark in beginning for mark in marks):
        raise ConfigError(f"{option}: exists and is not {expected}; choose another name, or remove the file")


def _first_bytes(file: Path, option: str) -> bytes:
    """First 1,024 bytes of a file; ConfigError if it cannot be read."""
    try:
        with file.open("rb") as stream:
            return stream.read(1024)
    except OSError as error:
        raise ConfigError(f"{option}: cannot be read ({error.strerror}); choose another name") from None


def _refuse_dataset(path: Path, option: str, kind: str) -> None:
    try:
        path.exists()
    except OSError as error:  # the name is too long, or a parent may not be searched
        raise ConfigError(f"{option}: cannot be written ({error.strerror}); choose another name") from None
    if (dataset := enclosing_dataset(path)) is not None:
        raise ConfigError(
            f"{option}: is inside the dataset {dataset}; expected a {kind} outside of datasets; choose another name"
        )
