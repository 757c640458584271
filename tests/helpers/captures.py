"""Captures of a simulated camera: flats and darks of a physical profile, as DNG files or mosaics with captures.csv."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import unprocess_gen as ug
from unprocess_gen.config.schema import Config
from unprocess_gen.dataset.dng import encode

LEVELS = (0.01, 0.02, 0.04, 0.06, 0.09, 0.12, 0.16, 0.2, 0.25, 0.3)
SHORT_S = 0.001


@functools.cache
def load(*overrides: str) -> Config:
    return ug.load_config(list(overrides))


@dataclass(frozen=True)
class Camera:
    """A simulated camera: a profile at an ISO, the side of its frames, and a seed, which is its body."""

    profile: str
    iso: float
    side: int = 512
    seed: int = 0
    overrides: tuple[str, ...] = ()

    def pair(self, light: float, seconds: float, number: int) -> ug.RawPair:
        """Record a frame of even light, a fraction of white above black."""
        config = load(
            *("camera=identity", "gains=unity", "isp=linear", f"noise={self.profile}", f"scene.iso={self.iso}"),
            *(f"scene.exposure_s={seconds}", "effects.all=on", "sensor.units=1", *self._levels(), *self.overrides),
        )
        codes = np.full((self.side, self.side, 3), round(light * 65535), np.uint16)
        return ug.make_pair(codes, config, seed=self.seed, key=f"{self.iso} {light} {seconds} {number}")

    def _levels(self) -> list[str]:
        noise = load(f"noise={self.profile}", f"scene.iso={self.iso}").noise
        names = ("bits", "black_level_dn", "white_level_dn")
        return [f"sensor.{name}={getattr(noise, name)}" for name in names]

    @property
    def truth(self) -> dict[str, Any]:
        """Return the numbers of the row of a dark of one second."""
        return dict(self.pair(0, 1.0, 0).row)


def frames(
    darks: int, flats: int, levels: Sequence[float], long_s: Sequence[float]
) -> Iterator[tuple[str, float, float]]:
    """Yield kind, light and exposure of each frame."""
    yield from (("dark", 0.0, SHORT_S) for _ in range(darks))
    yield from (("dark", 0.0, seconds) for seconds in long_s for _ in range(4))
    yield from (("flat", light, SHORT_S) for light in levels for _ in range(flats))


def record(
    folder: Path,
    *cameras: Camera,
    darks: int = 16,
    flats: int = 2,
    levels: Sequence[float] = LEVELS,
    long_s: Sequence[float] = (),
    as_dng: bool = True,
) -> Path:
    """Write the captures of cameras that differ in ISO into a folder, with captures.csv; return the folder."""
    folder.mkdir(parents=True)
    lines = ["file,kind,iso,exposure_s,level" + ("" if as_dng else ",black_level_dn,white_level_dn,bits,pattern")]
    for camera in cameras:
        for number, (kind, light, seconds) in enumerate(frames(darks, flats, levels, long_s)):
            pair = camera.pair(light, seconds, number)
            name = f"{camera.iso:g}_{kind}_{number:03d}.{'dng' if as_dng else 'npy'}"
            if as_dng:
                (folder / name).write_bytes(encode(pair.noisy, pair.row, "noisy"))
            else:
                np.save(folder / name, pair.noisy)
            sensor = [pair.row[key] for key in ("black_level_dn", "white_level_dn", "bits", "pattern")]
            facts = [
                name,
                kind,
                f"{camera.iso:g}",
                seconds,
                light if kind == "flat" else "",
                *([] if as_dng else sensor),
            ]
            lines.append(",".join(map(str, facts)))
    (folder / "captures.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder
