"""Experiment 3: compare simulated and learned noise with the real noise of phones, on the same patches.

    python docs/experiments/learned_noise.py PATCHES [--to RESULTS.json]

PATCHES has folders LIGHT/ISO/PHONE/KIND, as `sample_imgs_per_ISO_lighting_camera` of synt_noise_GANs has; KIND is
samples_noisy, samples_gts, GAN, samples_noisyNF, samples_gtsNF or samples_noiseflowNF. Or it is a folder of SIDD, which
has no learned noise. Protocol: protocol.md.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from common import arguments, divergence, interval, write
from real_pairs import real_pairs
from scipy.optimize import nnls

import unprocess_gen as ug

CURVES, DEMOSAICS = ("smoothstep_gamma22", "gamma22", "srgb"), ("bilinear", "malvar")
BINS = np.arange(0, 257, 16)
WIDTH = 4
FIRST = (20.0, 100.0)
"""Numbers from which the fit starts: a (DN) and b (DN²) at 12 bits."""
KINDS = {"GAN": ("GAN", "samples_gts"), "noise_flow": ("samples_noiseflowNF", "samples_gtsNF")}


@dataclass(frozen=True)
class Patch:
    """Hold the pictures of a patch by kind; those with the same phone and ISO are fitted together."""

    name: str
    group: str
    kinds: dict[str, Any]

    def noise(self, noisy: str, clean: str) -> Any:
        """Return the difference of two pictures of the patch."""
        return self.kinds[noisy].astype(int) - self.kinds[clean]


def patches_of(folder: Path) -> list[Patch]:
    """Read all patches below a folder that have the real pair; of larger pictures, the centre."""
    found = []
    for noisy in sorted(folder.rglob("samples_noisy/*.png")):
        place = noisy.parents[1]
        files = {kind.name: kind / noisy.name for kind in place.iterdir() if kind.is_dir()}
        files["GAN"] = place / "GAN" / f"{noisy.stem}_fake_B.png"
        kinds = {kind: read(file) for kind, file in files.items() if file.exists()}
        if "samples_gts" in kinds:
            found.append(Patch(noisy.stem, f"{place.name}_{place.parent.name}", kinds))
    for pair in real_pairs(folder):
        found.append(Patch(pair.name, pair.group, {"samples_noisy": pair.noisy, "samples_gts": pair.clean}))
    return found


def read(file: Path) -> Any:
    """Read a picture as R, G, B."""
    return np.ascontiguousarray(cv2.imread(str(file), cv2.IMREAD_COLOR)[..., ::-1])


def by_level(noise: Any, clean: Any) -> tuple[Any, Any]:
    """Return variance and number of the pixels of each channel in each band of levels, [3, 16]."""
    bands = np.digitize(clean, BINS) - 1
    cells = [[noise[..., c][bands[..., c] == band] for band in range(len(BINS) - 1)] for c in range(3)]
    variances = [[cell.var() if cell.size > 50 else 0 for cell in row] for row in cells]
    return np.array(variances), np.array([[cell.size if cell.size > 50 else 0 for cell in row] for row in cells])


def correlation(noise: Any, lag: int) -> float:
    """Return the mean over channels of the correlation with the pixel ``lag`` further in the row."""
    return float(np.mean([np.corrcoef(noise[:, :-lag, c].ravel(), noise[:, lag:, c].ravel())[0, 1] for c in range(3)]))


@functools.cache
def camera_noise(curve: str, demosaic: str, a: float, b: float) -> ug.CameraNoise:
    """Return the camera noise of a curve, a demosaicking and two numbers."""
    numbers = [f"noise.a={a}", f"noise.b={b}", "noise.units=dn", "noise.black=subtracted"]
    levels = ["noise.bits=12", "noise.black_level_dn=240", "noise.white_level_dn=4095"]
    return ug.CameraNoise(
        ["noise=heteroscedastic", *numbers, *levels, f"isp={curve}", "camera=nexus_6p"], demosaic=demosaic
    )


def simulate(model: ug.CameraNoise, patch: Patch, index: int) -> Any:
    """Return the noise that a model adds to the clean picture of a patch."""
    clean, noisy = model(patch.kinds["samples_gts"], index=index)
    return noisy.astype(int) - clean


def fit(patches: Sequence[Patch], curve: str, demosaic: str) -> tuple[float, float]:
    """Fit a and b to the variance by level: least squares relative to it, then one step of scale."""
    rows, targets = [], []
    for index, patch in enumerate(patches):
        clean = patch.kinds["samples_gts"]
        real, counts = by_level(patch.noise("samples_noisy", "samples_gts"), clean)
        parts = [
            by_level(simulate(camera_noise(curve, demosaic, *numbers), patch, index), clean)[0].ravel()
            for numbers in ((FIRST[0], 0.0), (0.0, FIRST[1]))
        ]
        weights = np.sqrt(counts.ravel()) / np.maximum(real.ravel(), 1)
        rows.append(np.stack(parts, axis=1) * weights[:, None])
        targets.append(real.ravel() * weights)
    shares = nnls(np.concatenate(rows), np.concatenate(targets))[0]
    a, b = (max(float(share * start), 1e-3) for share, start in zip(shares, FIRST, strict=True))
    ratios = [
        patch.noise("samples_noisy", "samples_gts").var()
        / simulate(camera_noise(curve, demosaic, a, b), patch, 50 + n).var()
        for n, patch in enumerate(patches)
    ]
    return a * float(np.median(ratios)), b * float(np.median(ratios))


def chosen(patches: Sequence[Patch]) -> tuple[str, str, float, float]:
    """Return curve, demosaicking and numbers with the smallest mean divergence on the patches that are fitted."""
    fits = []
    for curve, demosaic in itertools.product(CURVES, DEMOSAICS):
        a, b = fit(patches, curve, demosaic)
        model = camera_noise(curve, demosaic, a, b)
        error = np.mean(
            [
                divergence(patch.noise("samples_noisy", "samples_gts"), simulate(model, patch, 100 + n), WIDTH)
                for n, patch in enumerate(patches)
            ]
        )
        fits.append((float(error), curve, demosaic, a, b))
    return min(fits)[1:]


def white(noise: Any, clean: Any, seed: int) -> Any:
    """Draw white Gaussian noise with the standard deviation of other noise at each level."""
    deviations = np.sqrt(by_level(noise, clean)[0])
    bands = np.digitize(clean, BINS) - 1
    std = np.stack([deviations[c][bands[..., c]] for c in range(3)], axis=-1)
    drawn = np.random.default_rng(seed).normal(0, 1, clean.shape) * std
    return np.clip(np.rint(clean + drawn), 0, 255).astype(int) - clean


def judge(patch: Patch, others: Sequence[Patch], number: int) -> dict[str, Any]:
    """Compare all models with the real noise of a patch."""
    curve, demosaic, a, b = chosen(others)
    clean = patch.kinds["samples_gts"]
    real = patch.noise("samples_noisy", "samples_gts")
    noises = {"camera_noise": (simulate(camera_noise(curve, demosaic, a, b), patch, 1000 + number), real)}
    noises["white_oracle"] = (white(real, clean, number), real)
    for name, (noisy, truth) in KINDS.items():
        if noisy in patch.kinds and truth in patch.kinds:
            reference = real if name == "GAN" else patch.noise("samples_noisyNF", truth)
            noises[name] = (patch.noise(noisy, truth), reference)
    found: dict[str, Any] = {"group": patch.group, "fit": [curve, demosaic, a, b], "fitted_patches": len(others)}
    for name, (noise, reference) in noises.items():
        lags = {f"lag_{lag}": [correlation(noise, lag), correlation(reference, lag)] for lag in (1, 2)}
        ratio = float(noise.std() / reference.std())
        found[name] = {"divergence": divergence(reference, noise, WIDTH), "std_to_real": ratio, **lags}
    model, counts = by_level(noises["camera_noise"][0], clean)
    truth = by_level(real, clean)[0]
    filled = (counts > 500) & (truth > 0)
    found["camera_noise"]["variance_by_level_error"] = float(np.median(np.abs(model[filled] / truth[filled] - 1)))
    return found


def main() -> None:
    """Run the experiment."""
    options = arguments(__doc__, "learned_noise", "folder of SIDD patches")
    patches, judged = patches_of(options.data), []
    for number, patch in enumerate(patches):
        others = [other for other in patches if other.group == patch.group and other.name != patch.name]
        if others:
            judged.append(judge(patch, others, number))
            print(patch.group, judged[-1]["camera_noise"], flush=True)
    if not judged:
        raise SystemExit(f"{options.data}: no two patches of one phone and ISO; expected LIGHT/ISO/PHONE/samples_noisy")
    summary = {}
    for name in ("camera_noise", "noise_flow", "GAN", "white_oracle"):
        results = [patch[name] for patch in judged if name in patch]
        if results:
            lags = {
                f"{lag}_difference": interval([abs(result[lag][0] - result[lag][1]) for result in results])
                for lag in ("lag_1", "lag_2")
            }
            summary[name] = {
                "patches": len(results),
                "divergence": interval([result["divergence"] for result in results]),
                "std_to_real": interval([result["std_to_real"] for result in results]),
                "lag_1": float(np.median([result["lag_1"][0] for result in results])),
                **lags,
            }
    real = float(np.median([patch["camera_noise"]["lag_1"][1] for patch in judged]))
    write(
        {
            "patches": len(patches),
            "judged": len(judged),
            "groups": len({patch["group"] for patch in judged}),
            "real_lag_1": real,
            "models": summary,
            "by_patch": [{key: value for key, value in patch.items() if key != "name"} for patch in judged],
        },
        options.to,
    )


if __name__ == "__main__":
    main()
