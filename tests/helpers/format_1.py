"""Small datasets of every kind, which every later 1.x reads, verifies and replays: ``tests/project/format_1.zip``.

A change of bytes before 1.0.0 makes the archive once again: ``PYTHONPATH=tests python -m helpers.format_1``.
"""

from __future__ import annotations

import contextlib
import tempfile
import zipfile
from pathlib import Path

import numpy as np
from PIL import Image

import unprocess_gen as ug
from helpers.dark_frames import save_frames
from helpers.dng_files import DN, dng, image
from helpers.icc import PROFILES
from helpers.photographs import fill, pixels

ARCHIVE = Path(__file__).parents[1] / "project" / "format_1.zip"

KINDS = {
    "photographs": ["camera=sony_a7r", "noise=imx385_iso3200", "sensor.pattern=GBRG", "output.pairs_per_shard=1"],
    "patches": ["body=sony_a7s2", "scene=night", "sensor.units=2", "source.patch=[random,12,2]",
                "output.layout=packed"],
    "levels": ["camera=choice", "noise=sony_a7s2", "noise.levels=[1600,3200]", "noise.draws=2", "output.dtype=float32",
               "source.downscale=2", "source.dequantize=dither"],
    "clips": ["source.clips=true", "body=nikon_d850", "effects.all=on", "clean.includes_fixed_pattern=true"],
    "burst": ["source.burst={frames: 3, shift: 4, rotation_deg: 1, downscale: 2}", "body=sony_a7s2", "scene=night",
              "output.targets=[linear_rgb]"],
    "raw": ["source.kind=raw", "noise=heteroscedastic", "noise.a=3", "noise.b=20", "source.patch=[grid,32,48]",
            "source.raw.pattern=RGGB", "source.raw.black_dn=256", "source.raw.white_dn=4095"],
    "linear": ["source.kind=linear", "body=canon_70d", "scene.ev=[uniform,-2,1]", "noise.full_well_e=9000",
               "output.targets=[linear_rgb]"],
    "split": ["split={train: 0.5, val: 0.5}", "noise=brooks2019", "gains=by_light", "output.clean_dtype=float32"],
    "dark_frames": ["body=sony_a7s2", "noise.iso=1600", "noise.dark_frames=dark_frames/darks"],
}  # fmt: skip
"""Settings of each kind. Its sources are in KIND/sources, its dataset in KIND/ds."""


def save_sources(root: Path) -> None:
    """Write the sources of all kinds; photographs have 8 and 16 bits, a colour profile, a turn, and a missing end."""
    photographs, raw, linear = (fill(root / kind / "sources", 0) for kind in ("photographs", "raw", "linear"))
    Image.fromarray(pixels(20, 48, 64)).save(fill(root / "burst" / "sources", 0) / "a.png")
    for name, count in (("photographs", 1), ("patches", 2), ("levels", 1), ("split", 6), ("dark_frames", 1)):
        fill(root / name / "sources", count)
    for clip in (1, 2):
        fill(root / "clips" / "sources" / f"{clip}", 1, first=35 * clip)
        fill(root / "clips" / "sources" / f"{clip}", 1, first=35 * clip + 35)
    Image.fromarray(pixels(1, 20, 30)).save(photographs / "P3, 50%.png", icc_profile=PROFILES["Display P3"])
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(pixels(2, 16, 24)).save(photographs / "été.jpg", exif=exif)
    Image.fromarray(pixels(3, 18, 18, np.uint16)[..., 0]).save(photographs / "deep.png")
    (photographs / "half.png").write_bytes((photographs / "000.png").read_bytes()[:200])
    (raw / "a.dng").write_bytes(dng(image(DN[:40, :48])))
    np.save(raw / "b.npy", DN[:40, :48])
    light = pixels(9, 24, 32, np.uint16).astype(np.float32) ** 2 / 2**28
    np.save(linear / "a.npy", light - np.float32(0.01))
    codes = np.dstack([np.clip(light * 128, 0, 255), np.full(light.shape[:2], 129)]).astype(np.uint8)
    (linear / "b.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 24 +X 32\n" + codes.tobytes())
    save_frames(root / "dark_frames" / "darks", 2, shape=(64, 64))


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name, contextlib.chdir(name):
        save_sources(Path())
        for kind, settings in KINDS.items():
            places = f"source.root={kind}/sources", f"out={kind}/ds", "n_jobs=1"
            ug.generate(ug.load_config([*settings, *places]))
        with zipfile.ZipFile(ARCHIVE, "w", zipfile.ZIP_LZMA) as archive:
            for path in sorted(path for path in Path().rglob("*") if path.is_file()):
                archive.write(path)
