"""List, check and read the dark frames from which a run samples noise (``noise.dark_frames``).

A dark frame is a mosaic that a camera recorded without light. All files of the folder are read once at the start:
their digests, one black level, and the variance of their noise. Workers read the pixels of a frame when a pair needs
it: NPY files are mapped into memory, other files are decoded, and the last `DECODED` frames are kept.
"""

from __future__ import annotations

import functools
import hashlib
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from unprocess_gen.config.interpretation import uses_dark_frames
from unprocess_gen.config.schema import Config
from unprocess_gen.core.errors import ConfigError, MachineError, SourceChangedError
from unprocess_gen.core.files import file_sha256
from unprocess_gen.core.types import DarkFrame, DarkFrames, Raw

PICTURES = (".png", ".tif", ".tiff")
RAW_FILES = (".3fr", ".arw", ".cr2", ".cr3", ".dng", ".nef", ".orf", ".pef", ".raf", ".rw2")
"""Suffixes that LibRaw decodes (extra ``raw``)."""
SUFFIXES = (".npy", *PICTURES, *RAW_FILES)

LEAST_SIDE = 64
"""Least height and width of a dark frame, pixels."""

DECODED = 4
"""Decoded frames that a process keeps: 0.2 GB for 24 megapixels each."""
MAPPED = 256
"""NPY files that a process keeps mapped; they occupy no memory of its own."""

BRIGHTEST_MEDIAN = 0.05
"""Largest median of dark frames above black, as a fraction of the range of the sensor. Chosen: brighter is light."""

FARTHEST = 1e-4
"""Fraction of the sites at each end, such as hot pixels, that is left out of the variance. It lowers that of normal
noise by 0.3 %."""

STEPS_PER_DN = 16
"""Steps in which differences from the mean of the frames are counted."""
FARTHEST_STEPS = 2**18

BLOCK_SITES = 2**20

Counts = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Mosaic:
    """Decoded dark frame, with the black level and the CFA pattern that a raw file states."""

    pixels: Raw
    black_dn: float | None = None
    pattern: str | None = None


@dataclass(frozen=True)
class DarkFolder:
    """Read the dark frames of a folder by their digests.

    Parameters
    ----------
    folder : str
        The folder.
    files : mapping of str to str
        Name of each file by its SHA-256; of twins the last by name.
    """

    folder: str
    files: Mapping[str, str] = field(default_factory=dict)

    @property
    def sha256(self) -> str:
        """Return the digest that identifies the set of frames; it does not depend on names."""
        return hashlib.sha256("\n".join(["dark frames 1", *sorted(self.files)]).encode()).hexdigest()

    def frame(self, sha256: str) -> Raw:
        """Return the mosaic of a frame, cropped to even sides.

        Parameters
        ----------
        sha256 : str
            SHA-256 of its file.

        Returns
        -------
        ndarray of uint16, [H, W]
            Read-only if the file is mapped.

        Raises
        ------
        SourceChangedError
            If the folder has no such file, or its bytes have changed.
        """
        name = self.files.get(sha256)
        if name is None:
            raise SourceChangedError(
                f"noise.dark_frames={self.folder}: no file has the SHA-256 {sha256}; expected the dark frames of the "
                "dataset; restore the file, or give their folder"
            )
        pixels = (_mapped if name.lower().endswith(".npy") else _decoded)(str(Path(self.folder) / name), sha256)
        return pixels[: pixels.shape[0] // 2 * 2, : pixels.shape[1] // 2 * 2]

    def mean(self, sha256: str) -> NDArray[np.float32]:
        """Return the mean of all frames.

        Parameters
        ----------
        sha256 : str
            SHA-256 of the set (`DarkFolder.sha256`).

        Returns
        -------
        ndarray of float32, [H, W]
            DN of the frames.

        Raises
        ------
        SourceChangedError
            If the folder has another set of frames.
        """
        if sha256 != self.sha256:
            raise SourceChangedError(
                f"noise.dark_frames={self.folder}: the set of frames has the SHA-256 {self.sha256}; expected {sha256}, "
                "whose mean was subtracted; restore the files, or give their folder"
            )
        return _mean(self.folder, tuple(sorted(self.files)), self)

    def __hash__(self) -> int:
        return hash((self.folder, self.sha256))


def dark_folder(folder: str) -> DarkFolder:
    """Return access to the dark frames of a folder.

    Parameters
    ----------
    folder : str
        The folder.

    Returns
    -------
    DarkFolder
        With the digests of all files; no file has been decoded.

    Raises
    ------
    ConfigError
        If the folder does not exist or contains no file with one of `SUFFIXES`.
    MachineError
        If a file cannot be read.
    """
    try:
        names = sorted(path.name for path in Path(folder).iterdir() if path.suffix.lower() in SUFFIXES)
        files = {_digest(Path(folder) / name): name for name in names}
    except (FileNotFoundError, NotADirectoryError):
        raise ConfigError(f"noise.dark_frames={folder}: no such folder; expected a folder of dark frames") from None
    except OSError as error:
        raise MachineError(f"noise.dark_frames={folder}: cannot be read ({error.strerror})") from error
    if not files:
        raise ConfigError(
            f"noise.dark_frames={folder}: contains no dark frame; expected files with a suffix of {', '.join(SUFFIXES)}"
        )
    return DarkFolder(folder, files)


def _digest(path: Path) -> str:
    status = path.stat()
    return _digest_of(path, status.st_size, status.st_mtime_ns)


@functools.lru_cache(maxsize=4096)
def _digest_of(path: Path, size: int, modified_ns: int) -> str:
    """Return the SHA-256 of a file; a program that makes many pairs hashes its dark frames once."""
    return file_sha256(path)


def open_dark_frames(config: Config) -> tuple[Config, DarkFrames | None, DarkFolder | None]:
    """Read and check the dark frames of a run.

    Parameters
    ----------
    config : Config
        Validated configuration.

    Returns
    -------
    config : Config
        The configuration with the digest of the set, which ``config.yaml`` records.
    dark_frames : DarkFrames or None
        What plans need; None without ``noise.dark_frames``.
    folder : DarkFolder or None
        Access to the pixels.

    Raises
    ------
    ConfigError
        If a file is no dark frame of this camera.
    SourceChangedError
        If the configuration records another set of frames.
    MachineError
        If a file cannot be read.
    """
    if not uses_dark_frames(config.noise):
        return config, None, None
    if config.noise.dark_frames is None:
        raise ConfigError("noise.dark_frames is missing; expected the folder of the recorded dark frames")
    folder = dark_folder(config.noise.dark_frames)
    recorded = config.noise.dark_frames_sha256
    if recorded not in (None, folder.sha256):
        raise SourceChangedError(
            f"noise.dark_frames={folder.folder}: the set of frames has the SHA-256 {folder.sha256}; expected "
            f"{recorded}, as recorded; restore the files, or give their folder"
        )
    noise, sensor = config.noise, config.sensor
    assert noise.white_level_dn is not None and noise.black_level_dn is not None and noise.bits is not None
    rules = _Rules(
        noise.bits,
        noise.white_level_dn - noise.black_level_dn,
        (sensor.white_level_dn - sensor.black_level_dn) / (noise.white_level_dn - noise.black_level_dn),
        sensor.pattern,
        noise.dark_frames_black_dn,
        noise.dark_shading == "remove",
    )
    dark_frames = _described(folder, rules)
    return replace(config, noise=replace(noise, dark_frames_sha256=folder.sha256)), dark_frames, folder


@dataclass(frozen=True, slots=True)
class _Rules:
    """Hold what dark frames must fit: bits and range of the profile, DN of the sensor per DN, pattern, black level."""

    bits: int
    span_dn: int
    scale: float
    pattern: str
    black_dn: float | None
    remove: bool


@functools.lru_cache(maxsize=8)
def _described(folder: DarkFolder, rules: _Rules) -> DarkFrames:
    """Decode and check every frame, and measure black level and variance."""
    frames: list[DarkFrame] = []
    counts = np.zeros(2**16, dtype=np.int64)
    blacks: set[float | None] = set()
    for sha256, name in sorted(folder.files.items()):
        mosaic = read_mosaic(Path(folder.folder) / name)
        _check(folder, name, mosaic, rules)
        blacks.add(mosaic.black_dn)
        pixels = folder.frame(sha256)
        frames.append(DarkFrame(sha256, *pixels.shape))
        for rows in _blocks(pixels.shape):
            counts += np.bincount(pixels[rows].reshape(-1), minlength=2**16)
    median_dn = _median(counts)
    black_dn = rules.black_dn if rules.black_dn is not None else _black_level(folder, blacks, median_dn)
    if abs(median_dn - black_dn) > BRIGHTEST_MEDIAN * rules.span_dn:
        raise ConfigError(
            f"noise.dark_frames={folder.folder}: the median of the frames is {median_dn} DN, and black is {black_dn:g} "
            "DN; expected frames without light; noise.dark_frames_black_dn sets the black level"
        )
    variance = _trimmed_variance(counts, 1)
    if rules.remove:
        variance = _variance_around_mean(folder, frames)
    dither = 1 / 12
    return DarkFrames(
        tuple(frames), folder.sha256, black_dn, rules.scale, rules.scale**2 * (variance + dither), rules.remove
    )


def _check(folder: DarkFolder, name: str, mosaic: Mosaic, rules: _Rules) -> None:
    """Raise ConfigError unless a file is a dark frame of the camera of the profile."""
    pixels, start = mosaic.pixels, f"noise.dark_frames={folder.folder}: {name}"
    if min(pixels.shape) < LEAST_SIDE:
        height, width = pixels.shape
        raise ConfigError(f"{start} has {width} x {height} pixels; expected {LEAST_SIDE} x {LEAST_SIDE} or more")
    highest = int(pixels.max())
    if highest >= 2**rules.bits:
        raise ConfigError(
            f"{start} has values up to {highest} DN; expected DN of the profile, which has {rules.bits} bits"
        )
    if mosaic.pattern not in (None, rules.pattern):
        raise ConfigError(
            f"{start} has the CFA pattern {mosaic.pattern}; expected sensor.pattern={rules.pattern}; set "
            f"sensor.pattern={mosaic.pattern}"
        )


def _black_level(folder: DarkFolder, stated: set[float | None], median_dn: int) -> float:
    """Return the black level that all files state; without one, the median."""
    if stated == {None}:
        return float(median_dn)
    if len(stated) > 1:
        levels = ", ".join("none" if one is None else f"{one:g}" for one in sorted(stated, key=str))
        raise ConfigError(
            f"noise.dark_frames={folder.folder}: the files state several black levels ({levels} DN); expected one; "
            "set noise.dark_frames_black_dn"
        )
    (level,) = stated
    assert level is not None
    return level


# ------------------------------------------------------------------------------------------------------------- pixels


def read_mosaic(path: Path) -> Mosaic:
    """Read a dark frame.

    Parameters
    ----------
    path : Path
        NPY, PNG, TIFF or raw file.

    Returns
    -------
    Mosaic
        Pixels [H, W] of uint16; black level and pattern of raw files.

    Raises
    ------
    ConfigError
        If the file cannot be decoded, is no mosaic of 16-bit integers, or needs an extra that is not installed.
    """
    suffix = path.suffix.lower()
    try:
        content = path.read_bytes()
        if suffix in RAW_FILES:
            return _read_raw(path, content)
        if suffix == ".npy":
            pixels: Any = np.load(io.BytesIO(content), allow_pickle=False)
        else:
            pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except OSError as error:
        raise MachineError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, EOFError, cv2.error) as error:
        raise ConfigError(f"noise.dark_frames: {path} cannot be decoded ({str(error).splitlines()[0]})") from error
    if pixels is None:
        raise ConfigError(f"noise.dark_frames: {path} cannot be decoded; expected {suffix[1:].upper()}")
    _check_mosaic(path, pixels)
    return Mosaic(np.ascontiguousarray(pixels, dtype=np.uint16))


def _check_mosaic(path: Path, pixels: NDArray[Any]) -> None:
    """Raise ConfigError unless an array is a mosaic of 16-bit integers."""
    if pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise ConfigError(
            f"noise.dark_frames: {path} is {pixels.dtype} {list(pixels.shape)}; expected a mosaic [H, W] of uint16"
        )


def _read_raw(path: Path, content: bytes) -> Mosaic:
    """Decode a raw file with LibRaw: the visible part of the mosaic."""
    if find_spec("rawpy") is None:
        raise ConfigError(
            f"noise.dark_frames: {path} is a raw file, which needs rawpy; in the source folder, run: "
            "pip install '.[raw]', or convert the frames to NPY"
        )
    import rawpy

    try:
        with rawpy.imread(io.BytesIO(content)) as raw:
            pixels, colours = raw.raw_image_visible.copy(), raw.raw_colors_visible[:2, :2].ravel()
            names = raw.color_desc.decode("ascii")
            blacks = {int(raw.black_level_per_channel[colour]) for colour in colours}
    except rawpy.LibRawError as error:
        raise ConfigError(f"noise.dark_frames: {path} cannot be decoded ({error})") from error
    if pixels.ndim != 2 or pixels.dtype != np.uint16:
        raise ConfigError(f"noise.dark_frames: {path} holds no Bayer mosaic; expected one")
    if len(blacks) > 1:
        raise ConfigError(
            f"noise.dark_frames: {path} states the black levels {', '.join(map(str, sorted(blacks)))}; expected one; "
            "convert the frames to NPY, and set noise.dark_frames_black_dn"
        )
    pattern = "".join("G" if names[colour] == "G" else names[colour] for colour in colours)
    return Mosaic(pixels, float(blacks.pop()), pattern)


@functools.lru_cache(maxsize=MAPPED)
def _mapped(path: str, sha256: str) -> Raw:
    """Return the array of an NPY file, mapped into memory."""
    _check_digest(path, sha256)
    try:
        pixels: Raw = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError) as error:  # an edited row can name any file of the folder
        raise ConfigError(f"noise.dark_frames: {path} cannot be decoded ({str(error).splitlines()[0]})") from error
    _check_mosaic(Path(path), pixels)
    return pixels


@functools.lru_cache(maxsize=DECODED)
def _decoded(path: str, sha256: str) -> Raw:
    """Return the pixels of another file."""
    _check_digest(path, sha256)
    return read_mosaic(Path(path)).pixels


def _check_digest(path: str, sha256: str) -> None:
    try:
        found = file_sha256(Path(path))
    except OSError as error:
        raise SourceChangedError(f"dark frame {path}: cannot be read ({error.strerror}); restore it") from error
    if found != sha256:
        raise SourceChangedError(f"dark frame {path}: has the SHA-256 {found}; expected {sha256}; restore it")


@functools.lru_cache(maxsize=1)
def _mean(folder: str, digests: tuple[str, ...], frames: DarkFolder) -> NDArray[np.float32]:
    """Return the mean of the frames with these digests: an exact sum, divided once."""
    total: NDArray[np.uint32] | None = None
    for sha256 in digests:
        pixels = frames.frame(sha256)
        if total is None:
            total = np.zeros(pixels.shape, dtype=np.uint32)  # 65,537 frames fit
        if pixels.shape != total.shape:
            raise ConfigError(
                f"noise.dark_shading=remove: the dark frames of {folder} have several sizes; expected one; set "
                "noise.dark_shading=keep"
            )
        total += pixels
    assert total is not None
    mean = np.empty(total.shape, dtype=np.float32)
    for rows in _blocks(total.shape):
        mean[rows] = total[rows] / np.float64(len(digests))
    return mean


# --------------------------------------------------------------------------------------------------------- statistics


def _blocks(shape: tuple[int, ...]) -> Iterator[slice]:
    """Yield the rows of blocks of about `BLOCK_SITES`, so that wider types take little memory."""
    step = max(1, BLOCK_SITES // shape[1])
    return (slice(top, top + step) for top in range(0, shape[0], step))


def _median(counts: Counts) -> int:
    """Return the lower median of counted integers."""
    return int(np.searchsorted(np.cumsum(counts), (int(counts.sum()) + 1) // 2))


def _trimmed_variance(counts: Counts, steps: int) -> float:
    """Return the variance of counted integers in units of ``steps``, without the `FARTHEST` at both ends; exact."""
    cut = int(int(counts.sum()) * FARTHEST)
    ascending = np.cumsum(counts)
    kept = np.diff(np.clip(ascending, cut, int(ascending[-1]) - cut), prepend=cut)
    pairs = [(int(value), int(kept[value])) for value in np.flatnonzero(kept)]
    count = sum(times for _, times in pairs)
    first = sum(value * times for value, times in pairs)
    second = sum(value * value * times for value, times in pairs)
    return float(Fraction(count * second - first * first, count * count * steps * steps))


def _variance_around_mean(folder: DarkFolder, frames: Sequence[DarkFrame]) -> float:
    """Return the variance of the differences from the mean of all frames, DN²."""
    if len(frames) < 2:
        raise ConfigError("noise.dark_shading=remove: the mean of one dark frame is the frame itself; expected several")
    mean = folder.mean(folder.sha256)
    counts = np.zeros(2 * FARTHEST_STEPS + 1, dtype=np.int64)
    for frame in frames:
        pixels = folder.frame(frame.sha256)
        for rows in _blocks(mean.shape):
            steps = np.rint((pixels[rows] - mean[rows]) * np.float32(STEPS_PER_DN)).astype(np.int64)
            places = np.clip(steps, -FARTHEST_STEPS, FARTHEST_STEPS) + FARTHEST_STEPS
            counts += np.bincount(places.reshape(-1), minlength=counts.size)
    return _trimmed_variance(counts, STEPS_PER_DN)
