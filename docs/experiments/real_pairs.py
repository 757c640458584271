"""Find pairs of a noisy and a clean frame of one scene below a folder, by the file names of published datasets."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from unprocess_gen.core.raw_files import RAW_FILES
from unprocess_gen.sources.raw.decode import read_metadata

CENTRE = 256
PICTURES = (".jpg", ".jpeg", ".png")
FORMS = {
    "PolyU": re.compile(r"(?P<scene>[^/]+)_[^_/]+_real\.\w+$"),
    "SIDD": re.compile(r"\d{4}_(?P<scene>\d{3})_(?P<group>\w+?_\d{5})_[^/]+/[^/]*NOISY_SRGB[^/]*$"),
    "SID": re.compile(r"short/(?P<scene>\d{5})_\d\d_[\d.]+s\.\w+$"),
    "ELD": re.compile(r"(?P<group>[^/]+)/scene-(?P<scene>\d+)/IMG_(?P<number>\d{4})\.\w+$"),
}
"""Ends of the paths of noisy frames: their scene, and for some the phone and ISO, or the camera."""
PATCHES = {"SIDD_patches": re.compile(r"samples_noisy/\d{4}_(?P<scene>\d{3})_(?P<group>\w+?_\d{5})_[^/]*$")}
"""The same for the patches of SIDD in folders LIGHT/ISO/PHONE/KIND."""
REFERENCES = (1, 6, 11, 16)
"""Numbers of the frames of an ELD scene that are clean."""


@dataclass(frozen=True)
class RealPair:
    """Noisy and clean centre of a frame, uint8 [H, W, 3], with name, scene, and phone and ISO if the name has them.

    The name is that of the file, with its folder.
    """

    name: str
    scene: str
    group: str
    noisy: Any
    clean: Any


def real_pairs(folder: Path, forms: Mapping[str, re.Pattern[str]] = FORMS) -> Iterator[RealPair]:
    """Yield the pairs below a folder, in the order of their names."""
    for path in sorted(folder.rglob("*")):
        found = ((form, match) for form, name in forms.items() if (match := name.search(path.as_posix())))
        form, match = next(found, ("", None))
        if match is None or path.suffix.lower() not in (*PICTURES, *RAW_FILES):
            continue
        clean = clean_of(path, form, match["scene"])
        if clean != path and clean.exists():
            facts = match.groupdict()
            yield RealPair(
                f"{path.parent.name}/{path.stem}", match["scene"], facts.get("group", ""), *centres(path, clean)
            )


def clean_of(noisy: Path, form: str, scene: str) -> Path:
    """Return the path of the clean frame of a noisy one."""
    if form == "SID":
        return next(noisy.parents[1].glob(f"long/{scene}_00_*{noisy.suffix}"), noisy)
    if form == "ELD":
        number = min(REFERENCES, key=lambda reference: abs(reference - int(noisy.stem[-4:])))
        return noisy.with_stem(f"IMG_{number:04d}")
    if form in PATCHES:
        return noisy.parents[1] / "samples_gts" / noisy.name
    return noisy.with_name(noisy.name.replace("_real.", "_mean.").replace("NOISY_SRGB", "GT_SRGB"))


def centres(noisy: Path, clean: Path) -> tuple[Any, Any]:
    """Read the centres of a pair; raw frames are developed, the noisy one at the exposure of the clean one."""
    if noisy.suffix.lower() in PICTURES:
        return read(noisy), read(clean)
    light = [float(facts.iso or 1) * float(facts.exposure_s or 1) for facts in metadata(noisy, clean)]
    return developed(noisy, light[1] / light[0], clean), developed(clean, 1.0, clean)


def metadata(*paths: Path) -> list[Any]:
    """Read ISO and exposure of raw files."""
    return [read_metadata(path, "training") for path in paths]


def read(file: Path) -> Any:
    """Read the centre of a picture."""
    return centre(cv2.imread(str(file), cv2.IMREAD_COLOR)[..., ::-1])


def developed(file: Path, ratio: float, balance: Path) -> Any:
    """Develop the centre of a raw file with the white balance of another file, its light multiplied by ``ratio``."""
    import rawpy

    with rawpy.imread(str(balance)) as raw:
        gains = raw.camera_whitebalance
    with rawpy.imread(str(file)) as raw:
        black = np.array(raw.black_level_per_channel)[raw.raw_colors_visible]
        light = (raw.raw_image_visible - black) * ratio + black
        raw.raw_image_visible[:] = np.clip(np.rint(light), 0, raw.white_level)
        return centre(raw.postprocess(user_wb=list(gains), no_auto_bright=True, output_bps=8))


def centre(image: Any) -> Any:
    """Cut the middle of an image."""
    y, x = (max(side - CENTRE, 0) // 2 for side in image.shape[:2])
    return np.ascontiguousarray(image[y : y + CENTRE, x : x + CENTRE])
