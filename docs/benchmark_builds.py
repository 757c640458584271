"""Make the files of ``manifests/``: ``python docs/benchmark_builds.py [NAME …]``.

A build that has files is regenerated from its ``NAME.yaml``; manifest, digests and card are written if its shards are
the recorded ones, for example after a column was added. Other builds are made from `RECIPES`. Needs the extra
``photos``.

Scores compare the noisy frames, and the frames after a classical denoiser, with the clean ones. The denoiser stabilises
the variance that the row states (generalised Anscombe transformation), filters the four planes together by non-local
means of scikit-image, and inverts by the closed form of the exact unbiased inverse (Mäkitalo and Foi, IEEE TIP 2013).
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from skimage.restoration import denoise_nl_means

import unprocess_gen as ug
from unprocess_gen.config.option_files import build_names, manifests_dir
from unprocess_gen.core.files import file_sha256
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.pipeline.builds import make_build, photographs
from unprocess_gen.simulation.reference.cfa import unpack

OF_PHOTOS = ("source.include=[astronaut.png,chelsea.png,coffee.png,rocket.jpg]", "source.recursive=false")
MIXTURE = (
    "mixture=[{weight: 2, camera: sony_a7r, noise: imx385_iso3200}, "
    "{weight: 1, camera: nexus_6p, noise: imx385_iso12800}, "
    "{weight: 1, camera: canon_5d4, noise: canon_5d4, scene: indoor}]"
)

RECIPES: dict[str, tuple[str, tuple[str, ...]]] = {
    "scenes_imx385_iso3200": ("Two-number noise at a medium ISO, with the default settings.", ()),
    "scenes_brooks2019_14bit": ("Random noise levels and gains, as Brooks et al. train.", ()),
    "scenes_cameras_by_iso": (
        "Three ISOs of one sensor, in the colours of four cameras: how a method depends on the noise level.",
        ("camera=choice", "noise=imx385", "noise.levels=[1600,6400,25600]", "source.limit=4"),
    ),
    "scenes_a7s2_daylight": (
        "Physical noise of a full-frame camera in daylight: shot noise and response of pixels.",
        ("body=sony_a7s2", "scene=daylight", "source.limit=4"),
    ),
    "scenes_a7s2_night": (
        "The same camera at night: heavy-tailed read noise, rows, columns and hot pixels.",
        ("body=sony_a7s2", "scene=night", "source.limit=4"),
    ),
    "scenes_5d4_low_light": (
        "Physical noise of a camera with strong rows, in low light.",
        ("body=canon_5d4", "scene=low_light", "source.limit=4"),
    ),
    "scenes_clip": (
        "A clip of eight frames at night: fixed patterns stay, noise does not.",
        ("source.clips=true", "source.limit=8", "noise=imx385", "scene=video_night"),
    ),
    "scenes_patches": (
        "Patches of 64 x 64 pixels at random noise levels, with two draws each, as training sets have.",
        ("source.patch=[random,64,2]", "noise=brooks2019", "noise.draws=2", "source.limit=4"),
    ),
    "scenes_mixture": ("Cameras, ISOs and a physical profile in one dataset, by weight.", (MIXTURE, "source.limit=8")),
    "photos_imx385_iso3200": (
        "Real photographs with two-number noise at a medium ISO.",
        ("noise=imx385_iso3200", *OF_PHOTOS),
    ),
    "photos_a7s2_night": (
        "Real photographs at night, with the physical noise of a full-frame camera.",
        ("body=sony_a7s2", "scene=night", *OF_PHOTOS),
    ),
}
"""Purpose and settings of each build. The first two were made by version 0.1 and have their files since."""

SCORED = 8


def stabilised(dn: np.ndarray, slope: float, intercept: float) -> np.ndarray:
    """Transform DN above black, whose variance is slope · x + intercept, to noise of standard deviation 1."""
    if slope == 0:
        return dn / np.sqrt(intercept)
    return 2 / slope * np.sqrt(np.maximum(slope * dn + 0.375 * slope**2 + intercept, 0))


def inverted(values: np.ndarray, slope: float, intercept: float) -> np.ndarray:
    """Invert `stabilised` without bias."""
    if slope == 0:
        return values * np.sqrt(intercept)
    d = np.maximum(values, 2 * np.sqrt(0.375 + intercept / slope**2) / 2)
    root = np.sqrt(1.5)
    exact = d**2 / 4 + root / 4 / d - 11 / 8 / d**2 + 5 / 8 * root / d**3 - 1 / 8 - intercept / slope**2
    return slope * exact


def denoised(noisy: np.ndarray, row: dict) -> np.ndarray:
    """Denoise a mosaic of even sides, DN."""
    black, slope = row["black_level_dn"], row["a_dn"] or 0.0
    intercept = max(row["dark_variance_dn2"] or 0.0, 0.0) + 1 / 12
    planes = stabilised(ug.pack(noisy, row["pattern"]) - float(black), slope, intercept)
    filtered = denoise_nl_means(planes, 5, 6, 0.8, sigma=1.0, fast_mode=True, channel_axis=0)
    dn = inverted(filtered, slope, intercept) + black
    return unpack(np.rint(np.clip(dn, 0, row["white_level_dn"])).astype(np.uint16), row["pattern"])


def scores(clean: np.ndarray, other: np.ndarray, row: dict) -> list[float]:
    """PSNR and SSIM in raw (white above black is 1), and developed (8 bits)."""
    light = [ug.pack(ug.to_light(frame, row), row["pattern"]) for frame in (clean, other)]
    codes = [ug.develop(frame, row) for frame in (clean, other)]
    return [
        peak_signal_noise_ratio(*light, data_range=1),
        structural_similarity(*light, data_range=1, channel_axis=0),
        peak_signal_noise_ratio(*codes),
        structural_similarity(*codes, channel_axis=2),
    ]


def table(folder: Path) -> str:
    """Return the table of scores, means over at most `SCORED` evenly spaced pairs."""
    pairs = ug.RawPairs(folder)
    numbers = evenly_spaced(range(len(pairs)), SCORED)
    of_all = []
    for number in numbers:
        clean, noisy, row = pairs[number]
        even = tuple(slice(side // 2 * 2) for side in clean.shape)
        clean, noisy = clean[even], noisy[even]
        of_all.append([scores(clean, noisy, row), scores(clean, denoised(noisy, row), row)])
    lines = ["| frames | PSNR raw | SSIM raw | PSNR developed | SSIM developed |", "|---|--:|--:|--:|--:|"]
    for name, mean in zip(("noisy", "denoised"), np.mean(of_all, axis=0), strict=True):
        lines.append(f"| {name} | {mean[0]:.2f} dB | {mean[1]:.4f} | {mean[2]:.2f} dB | {mean[3]:.4f} |")
    return "\n".join([*lines, "", f"Means over {len(numbers)} of {len(pairs)} pairs, by `docs/benchmark_builds.py`."])


def card(name: str, folder: Path) -> str:
    """Return the card of a build."""
    purpose, settings = RECIPES[name]
    made = " ".join(f"'{one}'" if " " in one or "[" in one else one for one in settings)
    lines = [f"# {name}", "", purpose, "", f"Make and compare it: `gen-dataset build {name} --to FOLDER`.", ""]
    lines += [f"Settings: `{made or 'those of ' + name + '.yaml'}`.", "", table(folder), ""]
    return "\n".join(lines)


def write(name: str, folder: Path) -> None:
    """Write the files of a build from a dataset."""
    place = manifests_dir()
    shutil.copy(folder / "config.yaml", place / f"{name}.yaml")
    shutil.copy(folder / "manifest.csv", place / f"{name}.csv")
    files = ["config.yaml", "manifest.csv", *sorted(f"shards/{path.name}" for path in (folder / "shards").iterdir())]
    lines = [f"{file_sha256(folder / file)}  {file}\n" for file in files]
    (place / f"{name}.sha256").write_text("".join(lines), encoding="ascii")


def main(arguments: list[str]) -> None:
    """Make the named builds, or all."""
    for name in arguments or list(RECIPES):
        folder = Path(tempfile.mkdtemp()) / name
        if name in build_names():
            if changed := [str(one) for one in make_build(name, str(folder), 1) if one.file.startswith("shards/")]:
                sys.exit("\n".join(changed))
        else:
            root = f"source.root={photographs()}" if name.startswith("photos") else "source.root=null"
            ug.generate(ug.load_config([*RECIPES[name][1], root, f"out={folder}", "n_jobs=1"]))
        write(name, folder)
        (manifests_dir() / f"{name}.md").write_text(card(name, folder), encoding="utf-8")
        shutil.rmtree(folder.parent)
        print(f"{name}: written")


if __name__ == "__main__":
    main(sys.argv[1:])
