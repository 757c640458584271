"""Compare the gains that `gains=by_light` draws with the presets of cameras, for each built-in camera."""

from __future__ import annotations

import itertools

import numpy as np

from unprocess_gen.config.option_files import group_options
from unprocess_gen.config.serialization import read_option
from unprocess_gen.simulation.reference.colour import CAMERAS, Matrix, matrix
from unprocess_gen.simulation.reference.light import LIGHTS, camera_gains, chromaticity

PRESETS = {
    "daylight": ((1.51, 1.97, 2.64), (1.22, 1.58, 1.91)),
    "shade": ((1.80, 2.38, 3.16), (1.00, 1.29, 1.61)),
    "tungsten": ((0.97, 1.31, 1.69), (1.98, 2.57, 3.40)),
}
"""Gains of red and blue at 5, 50 and 95 % of the cameras: statistics of the presets in wb_presets.json of darktable
(442 cameras with a preset of daylight, 355 of shade, 449 of tungsten)."""

SHARES = (0.05, 0.5, 0.95)
STEPS = 21
"""Colour temperatures and distances from the locus in each range, evenly spaced in what is drawn uniformly."""


def builtin_cameras() -> dict[str, Matrix]:
    """Return the matrices from XYZ to the built-in cameras: those of `camera=choice`, and those of bodies."""
    cameras = dict(CAMERAS)
    for name in group_options("camera"):
        option = read_option("camera", name)
        if option.law == "custom" and option.xyz2cam is not None:
            cameras[name] = matrix(option.xyz2cam)
    return cameras


def drawn_gains(camera: Matrix, name: str) -> np.ndarray:
    """Return gains of red and blue, [N, 2], for colour temperatures and distances of a light."""
    light = LIGHTS[name]
    mired = np.linspace(1e6 / light.high_k, 1e6 / light.low_k, STEPS)
    distances = light.offset + light.scatter * np.linspace(-1, 1, STEPS)
    points = itertools.product((1e6 / mired).tolist(), distances.tolist())
    return np.array([camera_gains(camera, chromaticity(light, *point)) for point in points])


def _quantiles(gains: np.ndarray) -> str:
    return ", ".join(f"{value:.2f}" for value in np.quantile(gains, SHARES))


def light_tables() -> str:
    """Return the tables of presets and built-in cameras, of all together and of each."""
    cameras = builtin_cameras()
    drawn = {name: {camera: drawn_gains(cameras[camera], name) for camera in cameras} for name in PRESETS}
    lines = [
        "| | red, presets of some 440 cameras (5, 50, 95 %) | red, built-in cameras | blue, presets "
        "| blue, built-in cameras |",
        "|---|---|---|---|---|",
    ]
    for name, presets in PRESETS.items():
        together = np.concatenate(list(drawn[name].values()))
        columns = []
        for channel, preset in enumerate(presets):
            columns += [", ".join(f"{value:.2f}" for value in preset), _quantiles(together[:, channel])]
        lines.append(f"| {name} | {' | '.join(columns)} |")
    return "\n".join(lines)
