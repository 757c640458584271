"""Captures of a simulated camera: flats and darks of a physical profile, as DNG files or mosaics with captures.csv."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import unprocess_gen as ug
from unprocess_gen.config.schema import Config
from unprocess_gen.config.serialization import read_option
from unprocess_gen.dataset.dng import encode

LEVELS = (0.01, 0.02, 0.04, 0.06, 0.09, 0.12, 0.16, 0.2, 0.25, 0.3)
SHORT_S = 0.001


@dataclass(frozen=True)
class Numbers:
    """Numbers of a sensor that is simulated with NumPy alone: 14 bits, RGGB, by default without fixed patterns."""

    dn_per_e: float = 2.0
    read_std_dn: float = 5.0
    row_std_dn: float = 1.2
    black_error_dn: float = 0.5
    prnu_std: float = 0.0
    dsnu_std_dn: float = 0.0
    column_std_dn: float = 0.0
    dark_e_per_s: float = 0.0
    hot_share: float = 0.0
    hot_e_per_s: float = 0.0
    full_well_e: float = math.inf
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0)
    light: tuple[float, float, float] = (1.0, 1.0, 1.0)


BLACK, WHITE = 512, 16383


class Shot(NamedTuple):
    """A frame to draw: its light as a fraction of white above black, exposure and temperature."""

    light: float
    seconds: float = 0.01
    celsius: float = 20.0


LIGHTS = (0.04, 0.08, 0.12, 0.16, 0.2, 0.24, 0.28, 0.32)
EIGHT_LEVELS = (*[Shot(0.0)] * 6, *(Shot(light) for light in LIGHTS for _ in range(2)))
"""Six darks, and two flats at each of eight levels."""
COLUMNS = "file,kind,iso,exposure_s,level,temperature_c"


def draw(folder: Path, numbers: Numbers, seed: int, side: int = 128, shots: Sequence[Shot] = EIGHT_LEVELS) -> Path:
    """Draw frames at ISO 800 with captures.csv, which states no levels; return the folder.

    The dark current doubles every 6 degrees from 20 on; its mean is removed, as cameras do.
    """
    folder.mkdir(parents=True)
    rng, lines = np.random.default_rng(seed), [COLUMNS]
    pattern = 1 + rng.normal(0, numbers.prnu_std, (side, side))
    defects = np.random.default_rng([seed, 1])
    hot = (defects.random((side, side)) < numbers.hot_share) * defects.exponential(numbers.hot_e_per_s, (side, side))
    offsets = defects.normal(0, numbers.dsnu_std_dn, (side, side)) + defects.normal(0, numbers.column_std_dn, side)
    gains, colours = (np.tile([rgb[:2], rgb[1:]], (side // 2, side // 2)) for rgb in (numbers.gains, numbers.light))
    gains = gains * numbers.dn_per_e
    for place, shot in enumerate(shots):
        seconds = shot.seconds * 2 ** ((shot.celsius - 20) / 6)
        dark = numbers.dark_e_per_s * seconds
        light = shot.light * (WHITE - BLACK) / numbers.dn_per_e * pattern * colours
        electrons = np.minimum(rng.poisson(light + dark + hot * seconds), numbers.full_well_e) - dark
        rows = rng.normal(0, numbers.row_std_dn, (side, 1))
        noise = rng.normal(BLACK + numbers.black_error_dn, numbers.read_std_dn, (side, side)) + rows + offsets
        np.save(folder / f"{place}.npy", np.clip(np.rint(electrons * gains + noise), 0, WHITE).astype(np.uint16))
        kind = f"flat,800,{shot.seconds},{shot.light:.2f}" if shot.light else f"dark,800,{shot.seconds},"
        lines.append(f"{place}.npy,{kind},{shot.celsius}")
    (folder / "captures.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


Estimates = dict[tuple[str, float | None, str | None], dict[str, Any]]


def estimates(profile: Path) -> Estimates:
    """Return the estimates next to a profile by name, ISO and site."""
    rows = json.loads(profile.with_suffix(".json").read_text())
    return {(row["name"], row["iso"], row["site"]): row for row in rows}


def with_levels(folder: Path) -> Path:
    """State black, white and bits in the list of a folder; return the folder."""
    first, *lines = (folder / "captures.csv").read_text(encoding="utf-8").splitlines()
    text = [f"{first},black_level_dn,white_level_dn,bits", *(f"{line},{BLACK},{WHITE},14" for line in lines)]
    (folder / "captures.csv").write_text("\n".join(text) + "\n", encoding="utf-8")
    return folder


@functools.cache
def load(*overrides: str) -> Config:
    return ug.load_config(list(overrides))


@functools.cache
def load_profile(name: str) -> Any:
    return read_option("noise", name)


@dataclass(frozen=True)
class Camera:
    """A simulated camera: a profile at an ISO, the side of its frames, a seed, which is its body, and its effects."""

    profile: str
    iso: float
    side: int = 512
    seed: int = 0
    effects: str = "on"

    def pair(self, light: float, seconds: float, number: int) -> ug.RawPair:
        """Record a frame of even light, a fraction of white above black."""
        config = self.config
        scene = dataclasses.replace(config.scene, exposure_s=seconds)
        codes = np.full((self.side, self.side, 3), round(light * 65535), np.uint16)
        key = f"{self.profile} {self.iso} {light} {seconds} {number}"
        return ug.make_pair(codes, dataclasses.replace(config, scene=scene), seed=self.seed, key=key)

    @property
    def config(self) -> Config:
        """Settings of the camera, on a sensor with the levels of the profile."""
        noise = load_profile(self.profile)
        levels = [f"sensor.{name}={getattr(noise, name)}" for name in ("bits", "black_level_dn", "white_level_dn")]
        return load(
            *("camera=identity", "gains=unity", "isp=linear", f"noise={self.profile}", f"scene.iso={self.iso}"),
            *(f"effects.all={self.effects}", "sensor.units=1", *levels),
        )

    @property
    def truth(self) -> dict[str, Any]:
        """Return the numbers of the row of a dark of one second."""
        return dark_row(self)


@functools.cache
def dark_row(camera: Camera) -> dict[str, Any]:
    return dict(camera.pair(0, 1.0, 0).row)


def record(
    folder: Path,
    *cameras: Camera,
    darks: int = 16,
    flats: int = 2,
    levels: Sequence[float] = LEVELS,
    long_s: Sequence[float] = (),
    bright: int = 0,
) -> Path:
    """Write DNG files of cameras that differ in ISO into a folder, with captures.csv; return the folder.

    ``bright`` more flats at 25 % of white show fixed patterns.
    """
    folder.mkdir(parents=True)
    frames = [("dark", 0.0, SHORT_S)] * darks + [("dark", 0.0, seconds) for seconds in long_s for _ in range(4)]
    frames += [("flat", light, SHORT_S) for light in levels for _ in range(flats)] + [("flat", 0.25, SHORT_S)] * bright
    lines = ["file,kind,iso,exposure_s,level"]
    for camera in cameras:
        for number, (kind, light, seconds) in enumerate(frames):
            pair = camera.pair(light, seconds, number)
            name = f"{camera.iso:g}_{kind}_{number:03d}.dng"
            (folder / name).write_bytes(encode(pair.noisy, pair.row, "noisy"))
            lines.append(f"{name},{kind},{camera.iso:g},{seconds},{light if kind == 'flat' else ''}")
    (folder / "captures.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder
