"""Name the suffixes of files that contain mosaics, and list such files."""

from collections.abc import Collection
from pathlib import Path

from unprocess_gen.core.entries import EntryKind, hidden_sentence
from unprocess_gen.core.paths import LocalPath

PICTURE_SUFFIXES = (".pgm", ".png", ".tif", ".tiff")
RAW_FILES = (
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".fff", ".gpr", ".iiq", ".kdc", ".mef", ".mos"),
    *(".mrw", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw"),
)
"""Suffixes of files that LibRaw decodes (extra ``raw``)."""
SUFFIXES = (".npy", *PICTURE_SUFFIXES, *RAW_FILES)


def list_raw_files(folder: Path, suffixes: Collection[str], recursive: bool = True) -> tuple[list[Path], str]:
    """Files with these suffixes in a folder, in order, and a sentence on hidden ones, which are left out.

    Links to nothing are listed, so that whoever opens them names them. Raises OSError for a folder that cannot be read.
    """
    entries = list(LocalPath(folder).walk_entries(recursive, enters_hidden=False))
    kinds = EntryKind.FILE, EntryKind.BROKEN_LINK, EntryKind.UNREADABLE
    files = [Path(folder, entry.path) for entry in entries if entry.kind in kinds]
    hidden = hidden_sentence(entry.path for entry in entries if entry.kind is EntryKind.HIDDEN)
    return sorted(path for path in files if path.suffix.lower() in suffixes), hidden
