"""Choose and read dark-shading maps (``noise.dark_shading=PATH``), and measure dark frames around a map.

The dark shading of a camera is the mean of very many dark frames at each site. A map contains it either in DN of the
frames, as the mean of raw frames has it, or in DN above black, as published maps have it (PMN, Feng et al. 2022).
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.errors import ConfigError, MachineError, SourceChangedError
from unprocess_gen.core.raw_files import SUFFIXES
from unprocess_gen.sources.mosaics import even_sides, map_mosaic, mosaic_sha256, read_mosaic

KEY = "noise.dark_shading"

ISO_IN_NAME = re.compile(r"iso[ _-]?(\d+)", re.IGNORECASE)
"""How the name of a map states its ISO: ``iso1600``, ``ISO-1600`` and others."""

LARGEST_RESIDUAL_DN = 2.0
"""Largest median of dark frames minus their map that is accepted whatever their noise. Chosen: the black error of a
Sony A7S II is 1.7 DN at ISO 100 (PMN), and a map above black may lack it."""

KEPT_MAPS = 2
"""Maps that a process keeps: 0.1 GB for 24 megapixels each, except NPY files of float32, which are mapped."""

FARTHEST = 1e-4
"""Fraction of the sites at each end, such as hot pixels, that is left out of the variance. It lowers the variance
of normal noise by 0.3 %."""

STEPS_PER_DN = 16
"""Steps in which differences from a map are counted."""
FARTHEST_STEPS = 2**18

BLOCK_SITES = 2**20

StepCounts = NDArray[np.int64]
Map = NDArray[np.float32]


# ------------------------------------------------------------------------------------------------------------ choosing


def choose_map(place: str, iso: float) -> Path:
    """Return the file of the map for an ISO.

    Raises ConfigError.
    """
    start, path = f"{KEY}={place}", Path(place)
    if path.is_file():
        stated = _iso_of(path)
        if stated not in (None, iso):
            raise ConfigError(f"{start}: is of ISO {stated} by its name; expected ISO {iso:g}, that of the run")
        return path
    if not path.is_dir():
        raise ConfigError(f"{start}: no such file or folder; expected keep, remove, or a dark-shading map")
    by_iso = [(iso_in_name, path) for path in maps_of(place) if (iso_in_name := _iso_of(path)) is not None]
    if not by_iso:
        raise ConfigError(f"{start}: contains no map with its ISO in its name; expected a file such as iso{iso:g}.npy")
    chosen = [path for iso_in_name, path in by_iso if iso_in_name == iso]
    if not chosen:
        isos = ", ".join(map(str, sorted({iso_in_name for iso_in_name, _ in by_iso})))
        raise ConfigError(f"{start}: contains no map of ISO {iso:g}; expected one; its maps are of ISO {isos}")
    if len(chosen) > 1:
        names = ", ".join(path.name for path in chosen)
        raise ConfigError(f"{start}: contains several maps of ISO {iso:g}: {names}; expected one")
    return chosen[0]


def _iso_of(path: Path) -> int | None:
    match = ISO_IN_NAME.search(path.name)
    return int(match[1]) if match else None


def maps_of(place: str) -> list[Path]:
    """Return the files of a folder that may be maps, sorted; or the file itself.

    Raises MachineError.
    """
    path = Path(place)
    if not path.is_dir():
        return [path] if path.is_file() else []
    try:
        return sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES and file.is_file())
    except OSError as error:
        raise MachineError(f"{KEY}={place}: cannot be read ({error.strerror})") from error


def find_map(place: str, sha256: str) -> Path:
    """Return the map with a digest.

    Raises SourceChangedError.
    """
    files = maps_of(place)
    for path in files:
        try:
            digest = mosaic_sha256(path)
        except OSError as error:
            raise SourceChangedError(f"{KEY}={place}: cannot be read ({error.strerror}); restore it") from error
        if digest == sha256:
            return path
    problem = f"has the SHA-256 {digest}" if files and Path(place).is_file() else "has no such map"
    problem = problem if Path(place).exists() else "no such file or folder"
    raise SourceChangedError(
        f"{KEY}={place}: {problem}; expected the dark-shading map with the SHA-256 {sha256}, as recorded; restore the "
        "file, or give its place"
    )


@functools.lru_cache(maxsize=KEPT_MAPS)
def shading_map(path: Path, sha256: str) -> Map:
    """Return the values of a map.

    The result is float32, [H, W]. Raises ConfigError or MachineError.
    """
    is_mapped = path.suffix.lower() == ".npy"
    pixels: Any = map_mosaic(path, KEY, numbers=True) if is_mapped else read_mosaic(path, KEY, numbers=True).pixels
    values = even_sides(pixels).astype(np.float32, copy=False)
    if not all(np.isfinite(values[rows]).all() for rows in blocks(values.shape)):
        raise ConfigError(f"{KEY}: {path} has values that are not finite; expected numbers at all sites")
    return values


# ---------------------------------------------------------------------------------------------------------- statistics


def blocks(shape: tuple[int, ...]) -> Iterator[slice]:
    """Yield the rows of blocks of about `BLOCK_SITES`, so that wider types take little memory."""
    step = max(1, BLOCK_SITES // shape[1])
    return (slice(top, top + step) for top in range(0, shape[0], step))


def median_of(counts: StepCounts) -> int:
    """Return the lower median of counted integers."""
    return int(np.searchsorted(np.cumsum(counts), (int(counts.sum()) + 1) // 2))


def trimmed_mean(counts: StepCounts) -> float:
    """Return the mean of counted integers, without the `FARTHEST` at both ends; exact."""
    count, first, _ = _trimmed_sums(counts)
    return float(Fraction(first, count))


def trimmed_variance(counts: StepCounts, steps: int) -> float:
    """Return the variance of counted integers, without the `FARTHEST` at both ends; exact."""
    count, first, second = _trimmed_sums(counts)
    return float(Fraction(count * second - first * first, count * count * steps * steps))


def _trimmed_sums(counts: StepCounts) -> tuple[int, int, int]:
    """Return the number, the sum and the sum of squares of counted integers, without the `FARTHEST` at both ends."""
    cut = int(int(counts.sum()) * FARTHEST)
    ascending = np.cumsum(counts)
    kept = np.diff(np.clip(ascending, cut, int(ascending[-1]) - cut), prepend=cut)
    pairs = [(int(value), int(kept[value])) for value in np.flatnonzero(kept)]
    count = sum(times for _, times in pairs)
    first = sum(value * times for value, times in pairs)
    return count, first, sum(value * value * times for value, times in pairs)


BLACK_LEVELS: dict[str, Callable[[StepCounts], float]] = {"median": median_of, "mean": trimmed_mean}
"""Statistic of counted pixels that is the black level, by the value of ``noise.dark_frames_level``."""


def shading_differences(
    values: Map, black_dn: float, frames: Iterable[NDArray[Any]], level: Callable[[StepCounts], float] = median_of
) -> tuple[float, float]:
    """Level and variance of dark frames minus a map and ``black_dn``, in steps of 1/16 DN; DN and DN² of the frames.

    The variance is without the `FARTHEST` at both ends.
    """
    counts = np.zeros(2 * FARTHEST_STEPS + 1, dtype=np.int64)
    for pixels in frames:
        for rows in blocks(pixels.shape):
            difference = np.subtract(pixels[rows], values[rows], dtype=np.float32) - np.float32(black_dn)
            steps = np.rint(difference * np.float32(STEPS_PER_DN)).astype(np.int64)
            places = np.clip(steps, -FARTHEST_STEPS, FARTHEST_STEPS) + FARTHEST_STEPS
            counts += np.bincount(places.reshape(-1), minlength=counts.size)
    return (level(counts) - FARTHEST_STEPS) / STEPS_PER_DN, trimmed_variance(counts, STEPS_PER_DN)


def is_above_black(values: Map, black_dn: float) -> bool:
    """Decide if a map is in DN above black: its lower median is nearer to 0 than to the black level."""
    middle = (values.size - 1) // 2
    median_dn = float(np.partition(values.reshape(-1), middle)[middle])
    return abs(median_dn) < abs(median_dn - black_dn)


def check_residual(path: Path, median_dn: float, variance_dn2: float) -> None:
    """Refuse a map that does not fit the frames, such as a map of a camera with another black level.

    Raises ConfigError.
    """
    if abs(median_dn) > max(LARGEST_RESIDUAL_DN, math.sqrt(variance_dn2)):
        raise ConfigError(
            f"{KEY}={path}: the median of the dark frames minus the map is {median_dn:g} DN; expected about 0; give a "
            "map of this camera and ISO, in DN of the frames or above black; noise.dark_frames_black_dn sets their "
            "black level"
        )
