"""Check paths that the user names for output, before any work: no file of a dataset or of the user is overwritten."""

from __future__ import annotations

import os
from pathlib import Path

from unprocess_gen.core.errors import ConfigError

DATASET_ENTRIES = ("dataset.json", "config.yaml", "manifest.csv", "shards", ".work")
"""Names that mark a folder as a dataset, finished or not. Other files in such a folder count as damage."""


def enclosing_dataset(path: Path) -> Path | None:
    """Return the dataset that a path is in, finished or begun.

    Parameters
    ----------
    path : Path
        A file or folder; it need not exist.

    Returns
    -------
    Path or None
        The path itself or its nearest parent that is the folder of a dataset; None if there is none.
    """
    resolved = Path(os.path.realpath(path))
    return next((folder for folder in (resolved, *resolved.parents) if _is_dataset(folder)), None)


def _is_dataset(folder: Path) -> bool:
    try:
        return (
            (folder / "dataset.json").is_file()
            or any((folder / ".work" / name).exists() for name in ("listing.json", "sources.json"))
            or ((folder / "manifest.csv").is_file() and (folder / "shards").is_dir())
        )
    except OSError:  # a folder that may not be searched, above one that may
        return False


def check_output_folder(folder: Path, option: str) -> None:
    """Check that files can be written to a folder outside of every dataset.

    Parameters
    ----------
    folder : Path
        The folder; it need not exist.
    option : str
        What the user wrote, for messages: ``--to sheets``.

    Raises
    ------
    ConfigError
        If the folder is inside a dataset, is a file, or cannot be written.
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
    """Check that a file can be written outside of every dataset, and replaces at most an earlier output.

    Parameters
    ----------
    file : Path
        The file; its folder must exist.
    option : str
        What the user wrote, for messages: ``--to page.html``.
    expected : str
        Description of an earlier output, which may be replaced: ``an HTML page``.
    *marks : bytes
        Lower-case text; the first 1,024 bytes of an earlier output contain one of them.

    Raises
    ------
    ConfigError
        If the file is inside a dataset, its folder does not exist or cannot be written, or another file of that name
        exists.
    """
    _refuse_dataset(file, option, "file")
    if file.is_dir() or not file.parent.is_dir():
        raise ConfigError(f"{option}: expected the name of a file in a folder that exists")
    if not os.access(file.parent, os.W_OK | os.X_OK):
        raise ConfigError(f"{option}: cannot be written (Permission denied); choose another folder")
    beginning = _first_bytes(file, option).lower() if file.is_file() else b""
    if beginning and not any(mark in beginning for mark in marks):
        raise ConfigError(f"{option}: exists and is not {expected}; choose another name, or remove the file")


def check_log_file(file: Path, option: str) -> None:
    """Check that text can be appended to a file outside of every dataset.

    Parameters
    ----------
    file : Path
        The file; it need not exist.
    option : str
        What the user wrote, for messages.

    Raises
    ------
    ConfigError
        If the file is inside a dataset, or exists and is not text.
    """
    _refuse_dataset(file, option, "file")
    if file.is_file() and b"\0" in _first_bytes(file, option):
        raise ConfigError(f"{option}: exists and is not a text file; expected a log file; choose another name")


def _first_bytes(file: Path, option: str) -> bytes:
    """Return the first 1,024 bytes of a file; ConfigError if it cannot be read."""
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
