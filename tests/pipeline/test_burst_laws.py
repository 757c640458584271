"""Laws of bursts: flow returns frames to the first one, noise is new in each, fixed patterns stay on the sensor."""

from __future__ import annotations

import importlib
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.promise_report import Figure
from scipy.ndimage import map_coordinates

import unprocess_gen as ug

SIDE = 96


def burst_of(light: np.ndarray, folder: Path, *settings: str) -> Any:
    """Make a burst of a gray picture in camera RGB."""
    folder.mkdir(exist_ok=True)
    np.save(folder / "light.npy", np.repeat(light[..., None], 3, axis=2).astype(np.float32))
    fixed = "source.kind=linear", "source.primaries=camera", "output.dtype=float32", "sensor.clip=none", "n_jobs=1"
    files = f"source.root={folder / 'light.npy'}", f"out={folder / 'ds'}", f"source.patch=[random,{SIDE},1]"
    ug.generate(ug.load_config([*fixed, *files, *settings]))
    return ug.RawClips(folder / "ds")[0]


@pytest.mark.parametrize("form", [(4, 1, "centre"), (4, 1, "corner"), (3, 20, "centre"), (1, 5, "centre")])
def test_flow_returns_frames_within_the_interpolation_error(form: Any, tmp_path: Path, figure: Figure) -> None:
    """Bilinear interpolation errs by at most 1/8 of the second differences along rows and columns."""
    (y, x), (downscale, turn, phase) = np.indices((240, 280)), form
    light, curvature = 0.5 + 0.2 * np.sin(y / 20) + 0.2 * np.sin(x / 25), 0.2 / 20**2 + 0.2 / 25**2
    burst = f"source.burst={{frames: 4, shift: 12, rotation_deg: {turn}, downscale: {downscale}, phase: {phase}}}"
    clip = burst_of(light, tmp_path, "noise=none", burst)
    bound = curvature / 8 * (downscale**2 + 2)  # error in a frame, plus the errors of both frames in the picture
    errors = []
    for k, inverse in itertools.product(range(1, 4), (False, True)):
        places = np.indices(clip.clean[0].shape) + ug.flow(clip.rows, k, inverse=inverse)
        warped = map_coordinates(clip.clean[0 if inverse else k].astype(float), places, order=1, cval=np.nan)
        assert np.isfinite(warped).mean() > 0.2
        errors.append(np.nanmax(np.abs(warped - clip.clean[k if inverse else 0])))
    assert max(errors) <= bound + 1e-6 < np.abs(clip.clean[1] - clip.clean[0]).max() / 10
    figure("bursts", f"{max(errors) / bound:.2f} of the largest interpolation error")


def test_fixed_pattern_stays_on_the_sensor_and_noise_is_new_in_each_frame(tmp_path: Path) -> None:
    noise, textured = {}, np.random.default_rng(1).uniform(0.2, 0.6, (160, 160))
    for name, effects in {"prnu": ["prnu"], "read": ["shot", "read"], "both": ["prnu", "shot", "read"]}.items():
        chosen = ["effects.all=off", *(f"effects.{effect}=on" for effect in effects), "noise.prnu_std=0.02"]
        chosen += ["body=sony_a7s2", "source.burst={frames: 3, shift: 12, downscale: 1}"]
        clip = burst_of(np.full((160, 160), 0.5) if name == "both" else textured, tmp_path / name, *chosen)
        noise[name] = (clip.noisy / clip.clean.astype(float) - 1).reshape(3, -1)
    np.testing.assert_allclose(noise["prnu"][1:], noise["prnu"][[0, 0]], atol=1e-6)  # while the scene moves
    row, signal_dn = clip.rows[0], 0.5 * (clip.rows[0]["white_level_dn"] - clip.rows[0]["black_level_dn"])
    temporal = row["dn_per_e"] / signal_dn + row["dark_variance_dn2"] / signal_dn**2
    for name, expected in (("read", 0.0), ("both", 0.02**2 / (0.02**2 + temporal))):
        correlations = np.corrcoef(noise[name])[np.triu_indices(3, 1)]
        assert np.abs(correlations - expected).max() < 5 * (1 - expected**2) / SIDE  # of SIDE² sites


@pytest.mark.slow
def test_frames_are_the_exact_light_and_not_that_of_8_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both generators of docs/experiments/bursts.md have the stated errors on a dark picture."""
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "docs" / "experiments")
    bursts = importlib.import_module("bursts")
    light, span = next(bursts.lights("dark dead_leaves-0")), bursts.SPAN[14]
    clip = next(bursts.package_clips([light], tmp_path))
    error = clip.clean - 1024 - span * np.array([bursts.mosaic(bursts.package_exact(light, row)) for row in clip.rows])
    assert np.abs(error).max() <= 0.5 + span / 2**16
    assert abs(error.mean()) < 5 * np.sqrt(1 / 12 / error.size)
    codes, exact = map(bursts.mosaic, bursts.public_burst(light, (24, 24), np.random.default_rng(0))[0][:2])
    assert len(np.unique(codes)) < 30 < 300 < len(np.unique(clip.clean[0]))
    assert -0.5 <= (codes - exact).mean() * 255 <= -0.3  # truncated codes are half a code too dark
