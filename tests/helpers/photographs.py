"""Small photographs: random smooth colours, and folders of them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from PIL import Image


def pixels(seed: int, height: int, width: int, dtype: type = np.uint8, channels: int = 3) -> np.ndarray:
    """Smooth random colours with some of them saturated, so that highlights and shadows both occur."""
    noise = np.random.default_rng(seed).random((height // 4 + 2, width // 4 + 2, channels)) * 1.3 - 0.1
    smooth = cv2.resize(noise, (width, height), interpolation=cv2.INTER_LINEAR).reshape(height, width, channels)
    return (np.clip(smooth, 0, 1) * np.iinfo(dtype).max).astype(dtype)


def fill(folder: Path, count: int, first: int = 0) -> Path:
    """Write ``count`` small PNGs, all of another content and size, and return their folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(first, first + count):
        Image.fromarray(pixels(i, 12 + i % 5, 16 + i % 7)).save(folder / f"{i:03d}.png")
    return folder


PHOTOS = (
    "50%25.png",
    "%3Dformula.png",
    "comma, and space.jpg",
    "deep.png",
    "gray.png",
    "one.png",
    "scan.tif",
    "strip.bmp",
    "sub/inner one.jpg",
    "sub/été.png",
    "turned.jpg",
    "web.webp",
    "wide.png",
)
"""The photographs of the fixture `photos`, as a manifest spells and orders them."""
