"""List, check and read the dark frames from which a run samples noise (``noise.dark_frames``).

A dark frame is a mosaic that a camera recorded without light. All files of the folder are read once at the start:
their digests, one black level, and the variance of their noise. Workers read the pixels of a frame when a pair needs
it: NPY files are mapped into memory, other files are decoded, and the last frames are kept.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.config.interpretation import uses_dark_frames
from unprocess_gen.config.schema import Config, NoiseConfig, SensorConfig
from unprocess_gen.core.arrays import Raw
from unprocess_gen.core.errors import ConfigError, MachineError, SourceChangedError
from unprocess_gen.core.files import file_sha256, machine_errors
from unprocess_gen.core.raw_files import SUFFIXES, list_raw_files
from unprocess_gen.simulation.facts import DarkFrame, DarkFrames
from unprocess_gen.sources.raw.mosaics import Mosaic, checked_mosaic, even_sides, read_mosaic

KEY = "noise.dark_frames"

LEAST_SIDE = 64
"""Least height and width of a dark frame, pixels."""

DECODED = 4
"""Decoded frames that a process keeps: 0.2 GB for 24 megapixels each."""
MAPPED = 256
"""NPY files that a process keeps mapped; they occupy no memory of its own."""

BRIGHTEST_MEAN = 0.05
"""Largest mean of dark frames above black, as a fraction of the range of the sensor. Chosen: brighter is light."""

FARTHEST = 1e-4
"""Fraction of the sites at each end, such as hot pixels, that is left out of mean and variance. It lowers the variance
of normal noise by 0.3 %."""


@dataclass(frozen=True)
class DarkFolder:
    """Read the dark frames of a folder by their digests.

    ``files`` has the name of each file by its SHA-256; of twins the last by name. ``warning`` is for the user.
    """

    folder: str
    files: Mapping[str, str] = field(hash=False, default_factory=dict)
    warning: str = field(compare=False, default="")

    @property
    def sha256(self) -> str:
        """Digest that identifies the set of frames; it does not depend on names."""
        return hashlib.sha256("\n".join(["dark frames 1", *sorted(self.files)]).encode()).hexdigest()

    def frame(self, sha256: str) -> Raw:
        """Mosaic of a frame, uint16 [H, W] with even sides; read-only if the file is mapped."""
        name = self.files.get(sha256)
        if name is None:
            raise SourceChangedError(
                f"{KEY}={self.folder}: no file has the SHA-256 {sha256}; expected the dark frames of the dataset; "
                "restore the file, or give their folder"
            )
        path = Path(self.folder) / name
        try:
            digest = _file_sha256(path)
        except OSError as error:
            raise SourceChangedError(f"dark frame {path}: cannot be read ({error.strerror}); restore it") from error
        if digest != sha256:
            raise SourceChangedError(f"dark frame {path}: has the SHA-256 {digest}; expected {sha256}; restore it")
        return even_sides((_mapped if name.lower().endswith(".npy") else _decoded)(path, sha256))


def dark_folder(folder: str) -> DarkFolder:
    """Hash the dark frames of a folder; raise ConfigError or MachineError."""
    try:
        paths, hidden = list_raw_files(Path(folder), SUFFIXES, recursive=False)
        files = {_file_sha256(path): path.name for path in paths}
    except (FileNotFoundError, NotADirectoryError):
        raise ConfigError(f"{KEY}={folder}: no such folder; expected a folder of dark frames") from None
    except OSError as error:
        raise MachineError(f"{KEY}={folder}: cannot be read ({error.strerror})") from error
    if not files:
        raise ConfigError(
            f"{KEY}={folder}: contains no dark frame; expected files with a suffix of {', '.join(SUFFIXES)}"
        )
    return DarkFolder(folder, files, f"{KEY}: {hidden}" if hidden else "")


def open_dark_frames(config: Config) -> tuple[Config, DarkFrames | None, DarkFolder | None]:
    """Check the dark frames of a run: its config with the digest of the set, what plans need, access to the pixels.

    Without dark frames, the last two are None. Raises ConfigError, SourceChangedError or MachineError.
    """
    if not uses_dark_frames(config.noise):
        return config, None, None
    if config.noise.dark_frames is None:
        raise ConfigError(f"{KEY} is missing; expected the folder of the recorded dark frames")
    folder = dark_folder(config.noise.dark_frames)
    recorded = config.noise.dark_frames_sha256
    if recorded not in (None, folder.sha256):
        raise SourceChangedError(
            f"{KEY}={folder.folder}: the set of frames has the SHA-256 {folder.sha256}; expected {recorded}, as "
            "recorded; restore the files, or give their folder"
        )
    dark_frames = _described(folder, config.noise, config.sensor)
    return replace(config, noise=replace(config.noise, dark_frames_sha256=folder.sha256)), dark_frames, folder


@functools.lru_cache(maxsize=8)
def _described(folder: DarkFolder, noise: NoiseConfig, sensor: SensorConfig) -> DarkFrames:
    """Decode and check every frame, and measure black level and variance."""
    assert noise.white_level_dn is not None and noise.black_level_dn is not None and noise.bits is not None
    span_dn = noise.white_level_dn - noise.black_level_dn
    frames: list[DarkFrame] = []
    counts = np.zeros(2**16, dtype=np.int64)
    blacks: set[float | None] = set()
    for sha256, name in sorted(folder.files.items()):
        mosaic = read_mosaic(Path(folder.folder) / name, KEY)
        _check(f"{KEY}={folder.folder}: {name}", mosaic, noise.bits, sensor.pattern)
        blacks.add(mosaic.black_dn)
        pixels = even_sides(mosaic.pixels)
        frames.append(DarkFrame(sha256, *pixels.shape))
        counts += np.bincount(pixels.reshape(-1), minlength=2**16)
    mean_dn, variance_dn2 = trimmed_moments(counts)
    if noise.dark_frames_black_dn is None and len(blacks) > 1:
        problem = "the files state several black levels; expected one; set noise.dark_frames_black_dn"
        raise ConfigError(f"{KEY}={folder.folder}: {problem}")
    levels = noise.dark_frames_black_dn, blacks.pop(), mean_dn
    black_dn = next(level for level in levels if level is not None)
    if abs(mean_dn - black_dn) > BRIGHTEST_MEAN * span_dn:
        raise ConfigError(
            f"{KEY}={folder.folder}: the mean of the frames is {mean_dn:.5g} DN, and black is {black_dn:g} DN; "
            "expected frames without light; noise.dark_frames_black_dn sets the black level"
        )
    scale, dither_dn2 = (sensor.white_level_dn - sensor.black_level_dn) / span_dn, 1 / 12
    return DarkFrames(tuple(frames), folder.sha256, black_dn, scale, scale**2 * (variance_dn2 + dither_dn2))


def trimmed_moments(counts: NDArray[np.int64]) -> tuple[float, float]:
    """Mean and variance of counted integers, without the `FARTHEST` at both ends; exact."""
    cut = int(int(counts.sum()) * FARTHEST)
    ascending = np.cumsum(counts)
    kept = np.diff(np.clip(ascending, cut, int(ascending[-1]) - cut), prepend=cut)
    pairs = [(int(value), int(kept[value])) for value in np.flatnonzero(kept)]
    count = sum(times for _, times in pairs)
    first = sum(value * times for value, times in pairs)
    second = sum(value * value * times for value, times in pairs)
    return float(Fraction(first, count)), float(Fraction(count * second - first * first, count * count))


def _check(start: str, mosaic: Mosaic, bits: int, pattern: str) -> None:
    """Raise ConfigError unless a file is a dark frame of the camera of the profile; ``start`` names it."""
    (height, width), highest = mosaic.pixels.shape, int(mosaic.pixels.max(initial=0))
    if min(height, width) < LEAST_SIDE:
        raise ConfigError(f"{start} has {width} x {height} pixels; expected {LEAST_SIDE} x {LEAST_SIDE} or more")
    if highest >= 2**bits:
        raise ConfigError(f"{start} has values up to {highest} DN; expected DN of the profile, which has {bits} bits")
    if mosaic.pattern not in (None, pattern):
        raise ConfigError(
            f"{start} has the CFA pattern {mosaic.pattern}; expected sensor.pattern={pattern}; set "
            f"sensor.pattern={mosaic.pattern}"
        )


def _file_sha256(path: Path) -> str:
    """SHA-256 of a file; a program that makes many pairs hashes each file once. Raises OSError."""
    status = path.stat()
    return _sha256_of(path, status.st_size, status.st_mtime_ns)


@functools.lru_cache(maxsize=4096)
def _sha256_of(path: Path, size: int, modified_ns: int) -> str:
    return file_sha256(path)


@functools.lru_cache(maxsize=MAPPED)
def _mapped(path: Path, sha256: str) -> Raw:
    """Map the array of an NPY file into memory; the digest makes a replaced file another one."""
    try:
        with machine_errors(path):
            pixels: NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError) as error:  # an edited row can name any file of the folder
        raise ConfigError(f"{KEY}: {path} cannot be decoded ({str(error).splitlines()[0]})") from error
    return checked_mosaic(pixels, path, KEY)


@functools.lru_cache(maxsize=DECODED)
def _decoded(path: Path, sha256: str) -> Raw:
    """Decode another file; the digest as in `_mapped`."""
    return read_mosaic(path, KEY).pixels
