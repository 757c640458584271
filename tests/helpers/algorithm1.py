"""Compute Algorithm 1 of the article from a manifest row and its source, without using the package.

Plain float64 NumPy with the formulas of the article (arcsine, 100·i·(i - 0.9)²). Tests compare datasets with it, and
the benchmark uses it as the yardstick of a straightforward implementation.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

SITES = ((0, 0), (0, 1), (1, 0), (1, 1))


def read_srgb(path: Path) -> np.ndarray:
    """Decode a photograph to R, G, B (gray as three equal channels), orientation ignored."""
    image = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR | 128)
    return image[..., ::-1]


def linearise(image: np.ndarray, tone: str, gamma: str) -> np.ndarray:
    if tone == "smoothstep":
        image = np.maximum(0.5 - np.sin(np.arcsin(1 - 2 * image) / 3), 0)
    if gamma == "srgb":
        return np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)
    return image ** float(gamma)


def invert_gains(image: np.ndarray, k: np.ndarray, highlight: str, threshold: float) -> np.ndarray:
    if highlight == "per_channel":
        kept = k * image + 100 * (0.1 / (1 - threshold)) ** 2 * image * (image - threshold) ** 2 * (1 - k)
        return np.where((k < 1) & (image > threshold), kept, k * image)
    if highlight == "gray_mean":
        mask = (np.maximum(image.mean(axis=-1, keepdims=True) - threshold, 0) / (1 - threshold)) ** 2
        return image * np.maximum(mask + (1 - mask) * k, k)
    return k * image


def unprocess(srgb: np.ndarray, row: Mapping[str, str]) -> np.ndarray:
    """Return the unrounded clean mosaic in DN, from the row's text alone."""
    image = linearise(srgb / np.iinfo(srgb.dtype).max, row["tone"], row["gamma"])
    ccm = np.array([[float(row[f"rgb2cam_{i}{j}"]) for j in range(3)] for i in range(3)])
    image = image @ ccm.T
    red, blue, inverse = (float(row[name]) for name in ("red_gain", "blue_gain", "inverse_rgb_gain"))
    k = np.array([inverse / red, inverse, inverse / blue])
    image = np.clip(invert_gains(image, k, row["highlight"], float(row["highlight_threshold"])), 0, 1)
    raw = np.empty(image.shape[:2])
    for (y, x), letter in zip(SITES, row["pattern"], strict=True):
        raw[y::2, x::2] = image[y::2, x::2, "RGB".index(letter)]
    black, white = int(row["black_level_dn"]), int(row["white_level_dn"])
    return raw * (white - black) + black


def add_noise(raw: np.ndarray, row: Mapping[str, str], rng: np.random.Generator) -> np.ndarray:
    variance = float(row["a_dn"]) * (raw - int(row["black_level_dn"])) + float(row["b_dn2"])
    return raw + np.sqrt(np.maximum(variance, 0)) * rng.standard_normal(raw.shape)


def to_dn(raw: np.ndarray, white: int) -> np.ndarray:
    return np.clip(np.rint(raw), 0, white).astype(np.uint16)
