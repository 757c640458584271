"""List and read the pairs of a noisy and a clean picture below a folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from unprocess_gen.calibration.captures import joined_sha256
from unprocess_gen.core.arrays import Srgb
from unprocess_gen.core.errors import ConfigError, refused_files
from unprocess_gen.core.files import file_sha256, machine_errors
from unprocess_gen.core.tables import read_table
from unprocess_gen.sources.image.decode import decode

TABLE, COLUMNS = "pairs.csv", ("noisy", "clean")
NAMES = {"_noisy.": "_clean.", "_real.": "_mean.", "NOISY_SRGB": "GT_SRGB"}
"""Parts of the names of noisy pictures, and what clean ones have in their place; the last two as PolyU and SIDD."""
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
MAX_PIXELS = 2**26


def read_picture_pairs(folder: Path) -> tuple[Iterator[tuple[Srgb, Srgb]], int, str]:
    """Find the noisy and clean pictures below a folder: pairs, read one by one, their number, and their files' digest.

    ConfigError or MachineError.
    """
    if not folder.is_dir():
        raise ConfigError(f"calibrate: {folder}: no such folder; expected a folder of noisy and clean pictures")
    with machine_errors(folder):
        paths = list(_listed(folder) if (folder / TABLE).is_file() else _named(folder))
        if not paths:
            expected = f"expected {TABLE}, or names with {', '.join(f'{a} and {b}' for a, b in NAMES.items())}"
            raise ConfigError(f"calibrate: {folder}: contains no picture as {', '.join(SUFFIXES)}; {expected}")
        sha256 = joined_sha256([file_sha256(path) for pair in paths for path in pair])
    return ((read_picture(noisy), read_picture(clean)) for noisy, clean in paths), len(paths), sha256


def _listed(folder: Path) -> Iterator[tuple[Path, Path]]:
    """Yield the pairs of ``pairs.csv``."""
    for place, cells in read_table(folder / TABLE, COLUMNS, ("group", "scene")):
        noisy, clean = (folder / cells[name] for name in COLUMNS)
        if not (noisy.is_file() and clean.is_file()):
            raise ConfigError(f"{place}: {cells['noisy']},{cells['clean']}: expected files that exist")
        yield noisy, clean


def _named(folder: Path) -> Iterator[tuple[Path, Path]]:
    """Yield the pairs that names state; ConfigError for a picture without a partner."""
    for path in sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES):
        both = (*NAMES.items(), *((clean, noisy) for noisy, clean in NAMES.items()))
        partners = [path.with_name(path.name.replace(own, other)) for own, other in both if own in path.name]
        if len(partners) != 1 or not partners[0].is_file():
            expected = " or ".join(map(str, partners)) or "a name with _noisy or _clean"
            raise ConfigError(f"calibrate: {path}: has no partner; expected {expected}, or list the pairs in {TABLE}")
        if any(noisy in path.name for noisy in NAMES):
            yield path, partners[0]


def read_picture(path: Path, key: str = "calibrate") -> Srgb:
    """Decode a picture; ConfigError, which begins with ``key``, if it cannot be used."""
    with machine_errors(path), refused_files(f"{key}: {path}:", "; expected a picture of 8 or 16 bits"):
        return decode(path.read_bytes(), max_pixels=MAX_PIXELS, icc="ignore", name=str(path)).srgb
