"""Provide what the experiments share: frames of a sensor in two halves, its simulation, intervals and results."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import unprocess_gen as ug
from unprocess_gen.calibration.calibrate import calibrate
from unprocess_gen.calibration.captures import Capture, read_captures
from unprocess_gen.calibration.iso_results import FULL_SHARE
from unprocess_gen.calibration.profile import dark_variance, measured_yaml
from unprocess_gen.picture_isp import YCBCR

HERE = Path(__file__).parent
SAMPLES = 2000


def arguments(description: str, name: str, data: str) -> argparse.Namespace:
    """Parse the arguments that every experiment has: the folder of the data, and the file of the results."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help=data)
    parser.add_argument("--to", type=Path, default=HERE / f"{name}.json", help="file of the results")
    parser.add_argument("--photos", type=Path, help="folder of training photographs")
    parser.add_argument("--raw", type=Path, help="captures of a sensor, for the part on raw frames")
    found = parser.parse_args()
    for folder in (found.data, found.photos, found.raw):
        if folder is not None and not folder.is_dir():
            parser.error(f"{folder}: is no folder; expected {data}")
    return found


def run(main: Callable[[], None]) -> None:
    """Run an experiment; data that the package refuses end it with one line."""
    try:
        main()
    except ug.UnprocessGenError as error:
        print(error, file=sys.stderr)
        sys.exit(error.exit_code)


def write(results: dict[str, Any], path: Path) -> None:
    """Write results with four digits, which all machines of one kind reproduce."""
    path.write_text(json.dumps(_rounded(results), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    print(path.read_text(encoding="utf-8"), end="")


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_rounded(item) for item in value]
    return float(f"{value:.4g}") if isinstance(value, float | np.floating) else value


def interval(values: Sequence[Any], statistic: Callable[..., Any] = np.median) -> list[float]:
    """Return a statistic of rows of values and its 95 % bootstrap interval: [value, low, high]."""
    rows, random = np.asarray(values, float), np.random.default_rng(0)
    samples = [statistic(rows[random.integers(0, len(rows), len(rows))]) for _ in range(SAMPLES)]
    return [float(statistic(rows)), *(float(end) for end in np.quantile(samples, (0.025, 0.975)))]


def ratio_of_medians(rows: Any) -> float:
    """Return the median of the first column divided by that of the second."""
    return float(np.median(rows[:, 0]) / np.median(rows[:, 1]))


def divergence(real: Any, model: Any, width: int = 1) -> float:
    """Return the Kullback-Leibler divergence from the histogram of ``real`` to that of ``model``."""
    low, high = (int(end(np.concatenate((real.ravel(), model.ravel())))) for end in (np.min, np.max))
    edges = np.arange(low - width / 2, high + 1.5 * width, width)
    p, q = (np.histogram(values, edges)[0] + 0.5 for values in (real, model))
    p, q = p / p.sum(), q / q.sum()
    return float(np.sum(p * np.log(p / q)))


def colour(noise: Any) -> dict[str, float]:
    """Return what the noise [H, W, 3] of a picture has in common between channels, and between neighbours in a row."""
    y, cb, cr = np.moveaxis(noise @ YCBCR.T, -1, 0)
    return {
        "luma_std": float(y.std()),
        "chroma_to_luma": float((cb.var() + cr.var()) / y.var()),
        "red_green": correlation(noise[..., 0], noise[..., 1]),
        "green_blue": correlation(noise[..., 1], noise[..., 2]),
        "lag_1": float(np.mean([lag_1(channel) for channel in np.moveaxis(noise, -1, 0)])),
        "lag_1_y": lag_1(y),
        "lag_1_cb": lag_1(cb),
    }


def lag_1(values: Any) -> float:
    """Return the correlation with the next pixel in a row."""
    return correlation(values[:, :-1], values[:, 1:])


def correlation(first: Any, second: Any) -> float:
    """Return the correlation of two arrays of one shape."""
    return float(np.corrcoef(first.ravel(), second.ravel())[0, 1])


@dataclass(frozen=True)
class Level:
    """Hold the frames of one level: its kind, exposure and mean signal above black, in order of recording."""

    kind: str
    mean_dn: float
    frames: tuple[Any, ...]
    captures: tuple[Capture, ...]


SERIES = 4
"""Frames from which a level is divided frame by frame."""


def halves(folder: Path) -> tuple[list[Level], list[Level]]:
    """Return the calibrating and the judged levels of a folder of captures."""
    captures = read_captures(folder).captures
    groups = [
        tuple(group) for _, group in groupby(sorted(captures, key=lambda c: (c.group, c.path.name)), lambda c: c.group)
    ]
    levels = []
    for group in groups:
        frames = tuple(capture.pixels() for capture in group)
        levels.append(Level(group[0].kind, float(np.mean(frames[0])), frames, group))
    first, second = [], []
    short = [level for level in levels if 2 <= len(level.frames) < SERIES]
    for kind in ("dark", "flat"):
        ordered = sorted((level for level in short if level.kind == kind), key=lambda level: level.mean_dn)
        first += ordered[0::2]
        second += ordered[1::2]
    for level in levels:
        if len(level.frames) >= SERIES:
            for half, start in ((first, 0), (second, 1)):
                frames, listed = level.frames[start::2], level.captures[start::2]
                half.append(Level(level.kind, level.mean_dn, frames, listed))
    return first, second


class Sensor:
    """A sensor that was calibrated on some levels, and its simulation by three models."""

    def __init__(self, levels: Sequence[Level]) -> None:
        self.folder = Path(tempfile.mkdtemp())
        (self.folder / "noise").mkdir()
        places = self.folder / "frames"
        places.mkdir()
        lines = ["file,kind,iso,exposure_s,level,black_level_dn,white_level_dn,bits,pattern"]
        for number, level in enumerate(levels):
            for capture in level.captures:
                name = f"{number:03d}_{capture.path.name}"
                shutil.copyfile(capture.path, places / name)
                stated = (capture.black_level_dn, capture.white_level_dn, capture.bits, capture.pattern)
                known = ["" if value is None else f"{value}" for value in (capture.exposure_s, f"{number}", *stated)]
                lines.append(",".join((name, capture.kind, f"{capture.iso:g}", *known)))
        (places / "captures.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
        found = calibrate(read_captures(places))
        sensor, first = found.captures.sensor, found.isos[0]
        (self.folder / "noise" / "physical.yaml").write_text(measured_yaml(found, "physical"), encoding="utf-8")
        (self.folder / "noise" / "two_numbers.yaml").write_text(
            "name: two_numbers\nunits: dn\nblack: subtracted\nnegative_variance: refuse\n"
            f"bits: {sensor.bits}\nblack_level_dn: {sensor.black_dn:g}\nwhite_level_dn: {sensor.white_dn:g}\n"
            f"a: {first['dn_per_e'].value!r}\nb: {dark_variance(first).value!r}\n"
        )
        self.iso, self.black = found.isos[0].iso, round(sensor.black_dn)
        self.white, self.bits = round(sensor.white_dn), sensor.bits
        self.pattern = sensor.pattern if sensor.pattern in ("RGGB", "BGGR", "GRBG", "GBRG") else "RGGB"
        pairs = [np.subtract(*map(np.float64, level.frames[:2])).var() / 2 for level in levels if not self.fills(level)]
        self._configs: dict[tuple[str, tuple[str, ...]], Any] = {}
        self.white_std = float(np.sqrt(np.mean(pairs)))

    def fills(self, level: Level) -> bool:
        """Return True if a level saturates, by the limit of `calibrate`: its noise is cut at white."""
        return bool(np.mean(np.array(level.frames) >= self.white) > FULL_SHARE)

    def simulate(self, model: str, clean_dn: Any, number: int, *extra: str) -> Any:
        """Simulate a frame of a clean one: ``awgn``, ``two_numbers`` or ``physical``; ``number`` selects its noise."""
        if model == "awgn":
            noise = np.random.default_rng(number).normal(0, self.white_std, clean_dn.shape)
            return np.clip(np.rint(clean_dn + noise), 0, 2**self.bits - 1)
        light = (clean_dn - self.black) / (self.white - self.black)
        codes = np.rint(np.clip(light, 0, 1) * 65535).astype(np.uint16)
        return ug.make_pair(np.repeat(codes[..., None], 3, axis=2), self._composed(model, extra), key=number).noisy

    def _composed(self, model: str, extra: tuple[str, ...]) -> Any:
        if (model, extra) not in self._configs:
            self._configs[model, extra] = self.config(model, *extra)
        return self._configs[model, extra]

    def config(self, model: str, *extra: str) -> Any:
        """Return the config whose light is the picture itself, on this sensor."""
        overrides = [f"noise={model}", "camera=identity", "gains=unity", "isp=linear", f"sensor.bits={self.bits}"]
        overrides += [f"sensor.black_level_dn={self.black}", f"sensor.white_level_dn={self.white}"]
        overrides += [f"sensor.pattern={self.pattern}", "scene=low_light", f"scene.iso={self.iso:g}"]
        # frames of one body, as the real ones: the difference of two has no fixed pattern
        overrides += ["scene.exposure_ratio=1", "effects.all=on", "sensor.units=1", *extra]
        return ug.load_config(overrides, config_dir=str(self.folder))


def smooth(level: Level) -> Any:
    """Return the mean of the frames of a level, smoothed in each plane of a 2 x 2 tile."""
    mean = np.mean(level.frames, axis=0)
    for y in (0, 1):
        for x in (0, 1):
            mean[y::2, x::2] = cv2.GaussianBlur(np.ascontiguousarray(mean[y::2, x::2]), (0, 0), 12)
    return mean
