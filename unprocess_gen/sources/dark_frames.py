"""List, check and read the dark frames from which a run samples noise (``noise.dark_frames``).

A dark frame is a mosaic that a camera recorded without light. All files of the folder are read once at the start:
their digests, one black level, and the variance of their noise. Workers read the pixels of a frame when a pair needs
it: NPY files are mapped into memory, other files are decoded, and the last `DECODED` frames are kept. `dark_shading`
has the map that may be subtracted from them.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.config.interpretation import run_iso, shading_place, uses_dark_frames
from unprocess_gen.config.schema import Config, NoiseConfig, SensorConfig
from unprocess_gen.core.errors import ConfigError, MachineError, SourceChangedError
from unprocess_gen.core.raw_files import SUFFIXES
from unprocess_gen.core.types import DarkFrame, DarkFrames, DarkShading, Raw
from unprocess_gen.sources import dark_shading, mosaics
from unprocess_gen.sources.mosaics import Mosaic, mosaic_sha256, read_mosaic

FRAMES_KEY = "noise.dark_frames"

LEAST_SIDE = 64
"""Least height and width of a dark frame, pixels."""

DECODED = 4
"""Decoded frames that a process keeps: 0.2 GB for 24 megapixels each."""
MAPPED = 256
"""NPY files that a process keeps mapped; they occupy no memory of its own."""

BRIGHTEST_MEDIAN = 0.05
"""Largest median of dark frames above black, as a fraction of the range of the sensor. Chosen: brighter is light."""


@dataclass(frozen=True)
class DarkFolder:
    """Read the dark frames of a folder by their digests.

    ``files`` has the name of each file by its SHA-256; of twins the last by name. ``shading_place`` is a dark-shading
    map, or a folder of such maps; None to know only the mean of the frames.
    """

    folder: str
    files: Mapping[str, str] = field(hash=False, default_factory=dict)
    shading_place: str | None = None

    @property
    def sha256(self) -> str:
        """Return the digest that identifies the set of frames; it does not depend on names."""
        return hashlib.sha256("\n".join(["dark frames 1", *sorted(self.files)]).encode()).hexdigest()

    def frame(self, sha256: str) -> Raw:
        """Return the mosaic of a frame, uint16 [H, W] with even sides; read-only if the file is mapped."""
        name = self.files.get(sha256)
        if name is None:
            raise SourceChangedError(
                f"noise.dark_frames={self.folder}: no file has the SHA-256 {sha256}; expected the dark frames of the "
                "dataset; restore the file, or give their folder"
            )
        return mosaics.even_sides(
            (_mapped if name.lower().endswith(".npy") else _decoded)(Path(self.folder) / name, sha256)
        )

    def frames(self) -> Iterator[Raw]:
        """Yield the mosaics of all frames."""
        return map(self.frame, sorted(self.files))

    def shading(self, sha256: str) -> NDArray[np.float32]:
        """Return the map that is subtracted from the frames, float32 [H, W] in DN of the frames.

        ``sha256`` is the digest of the set, for the mean of all frames, or of the file of a map.
        """
        if sha256 == self.sha256:
            return _mean(self)
        if self.shading_place is not None:
            return dark_shading.shading_map(dark_shading.find_map(self.shading_place, sha256), sha256)
        raise SourceChangedError(
            f"noise.dark_frames={self.folder}: the set of frames has the SHA-256 {self.sha256}; expected {sha256}, "
            "whose mean was subtracted; restore the files, or give their folder; if a map was subtracted, give "
            "noise.dark_shading=FILE"
        )


def dark_folder(folder: str, shading_place: str | None = None) -> DarkFolder:
    """Return access to the dark frames of a folder.

    Raises ConfigError or MachineError.
    """
    try:
        names = sorted(path.name for path in Path(folder).iterdir() if path.suffix.lower() in SUFFIXES)
        files = {mosaic_sha256(Path(folder) / name): name for name in names}
    except (FileNotFoundError, NotADirectoryError):
        raise ConfigError(f"noise.dark_frames={folder}: no such folder; expected a folder of dark frames") from None
    except OSError as error:
        raise MachineError(f"noise.dark_frames={folder}: cannot be read ({error.strerror})") from error
    if not files:
        raise ConfigError(
            f"noise.dark_frames={folder}: contains no dark frame; expected files with a suffix of {', '.join(SUFFIXES)}"
        )
    return DarkFolder(folder, files, shading_place)


@dataclass(frozen=True, slots=True)
class DarkPlaces:
    """Name where the dark frames of a dataset are, and their dark-shading map; None for what is unknown or not used."""

    frames: str | None = None
    shading: str | None = None

    def open(self) -> DarkFolder | None:
        """Return access to the dark frames, None without a folder.

        Raises ConfigError or MachineError.
        """
        if self.frames is None:
            return None
        if self.shading is not None and not Path(self.shading).exists():
            raise ConfigError(
                f"noise.dark_shading={self.shading}: no such file or folder; expected the recorded dark-shading map; "
                "restore it, or give its place"
            )
        return dark_folder(self.frames, self.shading)


NO_PLACES = DarkPlaces()
"""For datasets without dark frames."""


def with_dark_places(config: Config, places: DarkPlaces) -> Config:
    """Return a recorded config, which has the digests of dark frames and of their map, with their places.

    The place of the map is ignored if the config records no map.
    """
    noise = replace(config.noise, dark_frames=places.frames)
    if noise.dark_shading_sha256 is not None and places.shading is not None:
        noise = replace(noise, dark_shading=places.shading)
    return replace(config, noise=noise)


def open_dark_frames(config: Config) -> tuple[Config, DarkFrames | None, DarkFolder | None]:
    """Read and check the dark frames of a run; return its config, what plans need, and access to the pixels.

    The config contains the digests of the set and of the map, which ``config.yaml`` records. Without dark frames, the
    others are None. Raises ConfigError, SourceChangedError or MachineError.
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
    shading_map = _shading_map(config)
    if shading_map is not None:
        folder = replace(folder, shading_place=str(shading_map[0]))
    dark_frames = _described(folder, config.noise, config.sensor, shading_map)
    noise = replace(config.noise, dark_frames_sha256=folder.sha256, dark_shading_sha256=shading_map and shading_map[1])
    return replace(config, noise=noise), dark_frames, folder


def _shading_map(config: Config) -> tuple[Path, str] | None:
    """Return file and SHA-256 of the dark-shading map; None if the config has no map."""
    place, recorded = shading_place(config.noise), config.noise.dark_shading_sha256
    if place is None:
        if recorded is not None:
            raise ConfigError("noise.dark_shading is missing; expected the place of the recorded dark-shading map")
        return None
    if recorded is not None:
        return dark_shading.find_map(place, recorded), recorded
    path = dark_shading.choose_map(place, run_iso(config))
    try:
        return path, mosaic_sha256(path)
    except OSError as error:
        raise MachineError(f"noise.dark_shading={place}: cannot be read ({error.strerror})") from error


@functools.lru_cache(maxsize=8)
def _described(
    folder: DarkFolder, noise: NoiseConfig, sensor: SensorConfig, shading_map: tuple[Path, str] | None
) -> DarkFrames:
    """Decode and check every frame, and measure black level and variance."""
    assert noise.white_level_dn is not None and noise.black_level_dn is not None and noise.bits is not None
    span_dn = noise.white_level_dn - noise.black_level_dn
    frames: list[DarkFrame] = []
    counts = np.zeros(2**16, dtype=np.int64)
    blacks: set[float | None] = set()
    for sha256, name in sorted(folder.files.items()):
        mosaic = read_mosaic(Path(folder.folder) / name, FRAMES_KEY)
        _check(f"{FRAMES_KEY}={folder.folder}: {name}", mosaic, noise.bits, sensor.pattern)
        blacks.add(mosaic.black_dn)
        pixels = folder.frame(sha256)
        frames.append(DarkFrame(sha256, *pixels.shape))
        for rows in dark_shading.blocks(pixels.shape):
            counts += np.bincount(pixels[rows].reshape(-1), minlength=2**16)
    median_dn = dark_shading.median_of(counts)
    stated_dn = noise.dark_frames_black_dn
    stated_dn = _black_level(folder, blacks) if stated_dn is None else stated_dn
    level = dark_shading.BLACK_LEVELS[noise.dark_frames_level]
    black_dn = float(level(counts)) if stated_dn is None else stated_dn
    if abs(median_dn - black_dn) > BRIGHTEST_MEDIAN * span_dn:
        raise ConfigError(
            f"noise.dark_frames={folder.folder}: the median of the frames is {median_dn} DN, and black is {black_dn:g} "
            "DN; expected frames without light; noise.dark_frames_black_dn sets the black level"
        )
    variance_dn2, shading = dark_shading.trimmed_variance(counts, 1), None
    if noise.dark_shading == "remove":
        if len(frames) < 2:
            raise ConfigError(
                "noise.dark_shading=remove: the mean of one dark frame is the frame itself; expected several"
            )
        _, variance_dn2 = dark_shading.shading_differences(folder.shading(folder.sha256), 0.0, folder.frames())
        shading = DarkShading(folder.sha256)
    elif shading_map is not None:
        derived = None if stated_dn is not None else level
        variance_dn2, shading = _around_map(folder, frames, shading_map, black_dn, derived)
        black_dn = shading.black_dn or black_dn
    scale, dither_dn2 = (sensor.white_level_dn - sensor.black_level_dn) / span_dn, 1 / 12
    return DarkFrames(tuple(frames), folder.sha256, black_dn, scale, scale**2 * (variance_dn2 + dither_dn2), shading)


def _around_map(
    folder: DarkFolder,
    frames: Sequence[DarkFrame],
    shading_map: tuple[Path, str],
    black_dn: float,
    level: Callable[[NDArray[np.int64]], float] | None,
) -> tuple[float, DarkShading]:
    """Measure the variance of the frames around a map; ConfigError if the map does not fit the frames.

    ``level`` is the statistic that gives the black level, None if the level is stated. The statistic of the frames
    contains the shading. For a map above black, the black level is therefore the level of the frames minus the map.
    """
    path, sha256 = shading_map
    values = folder.shading(sha256)
    for frame in frames:
        if values.shape != (frame.height, frame.width):
            raise ConfigError(
                f"noise.dark_shading={path}: the map has {values.shape[1]} x {values.shape[0]} pixels; expected those "
                f"of every dark frame; {folder.files[frame.sha256]} has {frame.width} x {frame.height}"
            )
    is_above_black = dark_shading.is_above_black(values, black_dn)
    subtracted_dn = black_dn if is_above_black else 0.0
    if is_above_black and level is not None:
        level_dn, variance_dn2 = dark_shading.shading_differences(values, subtracted_dn, folder.frames(), level)
        if subtracted_dn + level_dn > 0:
            return variance_dn2, DarkShading(sha256, subtracted_dn + level_dn, path.name)
    median_dn, variance_dn2 = dark_shading.shading_differences(values, subtracted_dn, folder.frames())
    dark_shading.check_residual(path, median_dn, variance_dn2)
    return variance_dn2, DarkShading(sha256, subtracted_dn, path.name, median_dn)


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


def _black_level(folder: DarkFolder, stated: set[float | None]) -> float | None:
    """The black level that all files state; None if no file states one."""
    if len(stated) > 1:
        levels = ", ".join("none" if level is None else f"{level:g}" for level in sorted(stated, key=str))
        raise ConfigError(
            f"noise.dark_frames={folder.folder}: the files state several black levels ({levels} DN); expected one; "
            "set noise.dark_frames_black_dn"
        )
    return stated.pop()


# ------------------------------------------------------------------------------------------------------------- pixels


@functools.lru_cache(maxsize=MAPPED)
def _mapped(path: Path, sha256: str) -> Raw:
    """Return the array of an NPY file, mapped into memory."""
    mosaics.check_sha256(path, "dark frame", sha256)
    return mosaics.map_mosaic(path, FRAMES_KEY)


@functools.lru_cache(maxsize=DECODED)
def _decoded(path: Path, sha256: str) -> Raw:
    """Return the pixels of another file."""
    mosaics.check_sha256(path, "dark frame", sha256)
    return read_mosaic(path, FRAMES_KEY).pixels


@functools.lru_cache(maxsize=1)
def _mean(folder: DarkFolder) -> NDArray[np.float32]:
    """The mean of all frames of a folder: an exact sum, divided once."""
    total: NDArray[np.uint32] | None = None
    for pixels in folder.frames():
        total = np.zeros(pixels.shape, dtype=np.uint32) if total is None else total  # 65,537 frames fit
        if pixels.shape != total.shape:
            raise ConfigError(
                f"noise.dark_shading=remove: the dark frames of {folder.folder} have several sizes; expected one; set "
                "noise.dark_shading=keep"
            )
        total += pixels
    assert total is not None
    mean = np.empty(total.shape, dtype=np.float32)
    for rows in dark_shading.blocks(total.shape):
        mean[rows] = total[rows] / np.float64(len(folder.files))
    return mean
