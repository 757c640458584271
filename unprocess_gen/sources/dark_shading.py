"""Choose and read dark-shading maps (``noise.dark_shading=PATH``), and measure dark frames around a map.

The dark shading of a camera is the mean of very many dark frames at each site. A map contains it either in DN of the
frames, as the mean of raw frames has it, or in DN above black, as published maps have it (PMN, Feng et al. 2022).
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.errors import ConfigError, MachineError, SourceChangedError
from unprocess_gen.sources.mosaics import (
    SUFFIXES,
    even_sides,
    map_mosaic,
    mosaic_sha256,
    read_mosaic,
)

KEY = "noise.dark_shading"

ISO_IN_NAME = re.compile(r"iso[ _-]?(\d+)", re.IGNORECASE)
"""How the name of a map states its ISO: ``iso1600``, ``ISO-1600`` and others."""

LARGEST_RESIDUAL_DN = 2.0
"""Largest median of dark frames minus their map that is accepted whatever their noise. Chosen: the black error of a
Sony A7S II is 1.7 DN at ISO 100 (PMN), and a map above black may lack it."""

KEPT_MAPS = 2
"""Maps that a process keeps: 0.1 GB for 24 megapixels each, except NPY files of float32, which are mapped."""

FARTHEST = 1e-4
"""Fraction of the sites at each end, such as hot pixels, that is left out of the variance. It lowers that of normal
noise by 0.3 %."""

STEPS_PER_DN = 16
"""Steps in which differences from a map are counted."""
FARTHEST_STEPS = 2**18

BLOCK_SITES = 2**20

Counts = NDArray[np.int64]
Map = NDArray[np.float32]


# ------------------------------------------------------------------------------------------------------------ choosing


def choose_map(place: str, iso: float) -> Path:
    """Return the file of the map for an ISO.

    Parameters
    ----------
    place : str
        A map, or a folder of maps with their ISO in their names.
    iso : float
        ISO of the run.

    Returns
    -------
    Path
        A file. A single map may have a name without ISO.

    Raises
    ------
    ConfigError
        If there is none for this ISO, or several.
    """
    start, path = f"{KEY}={place}", Path(place)
    if path.is_file():
        stated = _iso_of(path)
        if stated not in (None, iso):
            raise ConfigError(f"{start}: is of ISO {stated} by its name; expected ISO {iso:g}, that of the run")
        return path
    if not path.is_dir():
        raise ConfigError(f"{start}: no such file or folder; expected keep, remove, or a dark-shading map")
    by_iso = [(stated, one) for one in maps_of(place) if (stated := _iso_of(one)) is not None]
    if not by_iso:
        raise ConfigError(f"{start}: contains no map with its ISO in its name; expected a file such as iso{iso:g}.npy")
    chosen = [one for stated, one in by_iso if stated == iso]
    if not chosen:
        isos = ", ".join(str(stated) for stated in sorted({stated for stated, _ in by_iso}))
        raise ConfigError(f"{start}: contains no map of ISO {iso:g}; expected one; its maps are of ISO {isos}")
    if len(chosen) > 1:
        names = ", ".join(one.name for one in chosen)
        raise ConfigError(f"{start}: contains several maps of ISO {iso:g}: {names}; expected one")
    return chosen[0]


def _iso_of(path: Path) -> int | None:
    found = ISO_IN_NAME.search(path.name)
    return int(found[1]) if found else None


def maps_of(place: str) -> list[Path]:
    """Return the files of a folder that may be maps, sorted; or the file itself.

    Parameters
    ----------
    place : str
        A file or a folder.

    Returns
    -------
    list of Path
        Files with a suffix of `mosaics.SUFFIXES`; empty if the place does not exist.

    Raises
    ------
    MachineError
        If the folder cannot be read.
    """
    path = Path(place)
    if not path.is_dir():
        return [path] if path.is_file() else []
    try:
        return sorted(one for one in path.iterdir() if one.suffix.lower() in SUFFIXES and one.is_file())
    except OSError as error:
        raise MachineError(f"{KEY}={place}: cannot be read ({error.strerror})") from error


def find_map(place: str, sha256: str) -> Path:
    """Return the map with a digest.

    Parameters
    ----------
    place : str
        A map, or a folder of maps with any names.
    sha256 : str
        SHA-256 of its file.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    SourceChangedError
        If there is none.
    """
    files = maps_of(place)
    for path in files:
        try:
            found = mosaic_sha256(path)
        except OSError as error:
            raise SourceChangedError(f"{KEY}={place}: cannot be read ({error.strerror}); restore it") from error
        if found == sha256:
            return path
    problem = f"has the SHA-256 {found}" if files and Path(place).is_file() else "has no such map"
    problem = problem if Path(place).exists() else "no such file or folder"
    raise SourceChangedError(
        f"{KEY}={place}: {problem}; expected the dark-shading map with the SHA-256 {sha256}, as recorded; restore the "
        "file, or give its place"
    )


@functools.lru_cache(maxsize=KEPT_MAPS)
def shading_map(path: Path, sha256: str) -> Map:
    """Return the values of a map.

    Parameters
    ----------
    path : Path
        Its file.
    sha256 : str
        SHA-256 of the file, which `find_map` has compared.

    Returns
    -------
    ndarray of float32, [H, W]
        Even sides; read-only if the file is mapped.

    Raises
    ------
    ConfigError
        If the file is no map.
    MachineError
        If it cannot be read.
    """
    is_mapped = path.suffix.lower() == ".npy"
    pixels: Any = map_mosaic(path, KEY, numbers=True) if is_mapped else read_mosaic(path, KEY, numbers=True).pixels
    values = even_sides(pixels).astype(np.float32, copy=False)
    if not all(np.isfinite(values[rows]).all() for rows in blocks(values.shape)):
        raise ConfigError(f"{KEY}: {path} has values that are not finite; expected numbers at all sites")
    return values


# ---------------------------------------------------------------------------------------------------------- statistics


def blocks(shape: tuple[int, ...]) -> Iterator[slice]:
    """Yield the rows of blocks of about `BLOCK_SITES`, so that wider types take little memory.

    Parameters
    ----------
    shape : tuple of int
        Height and width.

    Yields
    ------
    slice
        Rows of one block.
    """
    step = max(1, BLOCK_SITES // shape[1])
    return (slice(top, top + step) for top in range(0, shape[0], step))


def median_of(counts: Counts) -> int:
    """Return the lower median of counted integers.

    Parameters
    ----------
    counts : ndarray of int64
        Number of each value, from 0.

    Returns
    -------
    int
        The median.
    """
    return int(np.searchsorted(np.cumsum(counts), (int(counts.sum()) + 1) // 2))


def trimmed_variance(counts: Counts, steps: int) -> float:
    """Return the variance of counted integers, without the `FARTHEST` at both ends; exact.

    Parameters
    ----------
    counts : ndarray of int64
        Number of each value, from 0.
    steps : int
        Steps of the values per DN.

    Returns
    -------
    float
        DN².
    """
    cut = int(int(counts.sum()) * FARTHEST)
    ascending = np.cumsum(counts)
    kept = np.diff(np.clip(ascending, cut, int(ascending[-1]) - cut), prepend=cut)
    pairs = [(int(value), int(kept[value])) for value in np.flatnonzero(kept)]
    count = sum(times for _, times in pairs)
    first = sum(value * times for value, times in pairs)
    second = sum(value * value * times for value, times in pairs)
    return float(Fraction(count * second - first * first, count * count * steps * steps))


class Differences:
    """Count the differences of dark frames from a map, in steps of 1/16 DN.

    Parameters
    ----------
    values : ndarray of float32, [H, W]
        The map.
    black_dn : float
        Value that is subtracted too.
    """

    def __init__(self, values: Map, black_dn: float) -> None:
        self._values, self._black = values, np.float32(black_dn)
        self._counts = np.zeros(2 * FARTHEST_STEPS + 1, dtype=np.int64)

    def add(self, pixels: NDArray[Any]) -> None:
        """Count the differences of a frame, which has the shape of the map."""
        for rows in blocks(pixels.shape):
            difference = np.subtract(pixels[rows], self._values[rows], dtype=np.float32) - self._black
            steps = np.rint(difference * np.float32(STEPS_PER_DN)).astype(np.int64)
            places = np.clip(steps, -FARTHEST_STEPS, FARTHEST_STEPS) + FARTHEST_STEPS
            self._counts += np.bincount(places.reshape(-1), minlength=self._counts.size)

    @property
    def median_dn(self) -> float:
        """Median of the differences, DN of the frames."""
        return (median_of(self._counts) - FARTHEST_STEPS) / STEPS_PER_DN

    @property
    def variance_dn2(self) -> float:
        """Variance of the differences, without the `FARTHEST` at both ends, DN² of the frames."""
        return trimmed_variance(self._counts, STEPS_PER_DN)


def map_median(values: Map) -> float:
    """Return the lower median of a map.

    Parameters
    ----------
    values : ndarray of float32, [H, W]
        The map.

    Returns
    -------
    float
        DN.
    """
    flat = values.reshape(-1)
    return float(np.partition(flat, (flat.size - 1) // 2)[(flat.size - 1) // 2])


def is_above_black(values: Map, black_dn: float) -> bool:
    """Return whether a map is in DN above black: its median is nearer to 0 than to the black level.

    Parameters
    ----------
    values : ndarray of float32, [H, W]
        The map.
    black_dn : float
        Black level of the frames.

    Returns
    -------
    bool
        False if the map contains the black level. Dark shading is much smaller than a black level.
    """
    median_dn = map_median(values)
    return abs(median_dn) < abs(median_dn - black_dn)


def check_residual(path: Path, median_dn: float, variance_dn2: float) -> None:
    """Refuse a map that does not fit the frames, such as that of a camera with another black level.

    Parameters
    ----------
    path : Path
        File of the map.
    median_dn, variance_dn2 : float
        Median and variance of the frames minus the map, DN.

    Raises
    ------
    ConfigError
        If the median is farther from 0 than a standard deviation of the noise, and than `LARGEST_RESIDUAL_DN`.
    """
    if abs(median_dn) > max(LARGEST_RESIDUAL_DN, math.sqrt(variance_dn2)):
        raise ConfigError(
            f"{KEY}={path}: the median of the dark frames minus the map is {median_dn:g} DN; expected about 0; give a "
            "map of this camera and ISO, in DN of the frames or above black; noise.dark_frames_black_dn sets their "
            "black level"
        )
