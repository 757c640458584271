"""Draw the README's picture of a pair: python .readme/draw_pair.py (makes its dataset in a temporary folder)."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

import cv2
import numpy as np

from unprocess_gen import RawPairs
from unprocess_gen.sources.scenes import synthetic

SCENE = "highlights-0"
CROP = (slice(260, 340), slice(100, 220))  # rows and columns, even: the Bayer phase is kept
SIZE = (360, 240)


def level(raw: np.ndarray, black: int, white: int) -> np.ndarray:
    """Bring DN to [0, 1] on a square-root scale, for the eye."""
    return np.sqrt(np.clip((raw.astype(float) - black) / (white - black), 0, 1))


def developed(raw: np.ndarray, row: dict) -> np.ndarray:
    """One RGB pixel from the four sites of each RGGB tile, white balanced: quick, and honest about the noise."""
    light = np.maximum(raw.astype(float) - row["black_level_dn"], 0) / (row["white_level_dn"] - row["black_level_dn"])
    red, blue = light[0::2, 0::2] * row["red_gain"], light[1::2, 1::2] * row["blue_gain"]
    green = (light[0::2, 1::2] + light[1::2, 0::2]) / 2
    return np.sqrt(np.clip(np.dstack([red, green, blue]) / row["inverse_rgb_gain"], 0, 1))


def sites(raw: np.ndarray, row: dict) -> np.ndarray:
    """Each site of the mosaic in the colour of its filter."""
    bright = level(raw, row["black_level_dn"], row["white_level_dn"])
    picture = np.zeros((*raw.shape, 3))
    for (y, x), channel in {(0, 0): 0, (0, 1): 1, (1, 0): 1, (1, 1): 2}.items():
        picture[y::2, x::2, channel] = bright[y::2, x::2]
    return picture


def panel(picture: np.ndarray, interpolation: int) -> np.ndarray:
    """Scale a picture in [0, 1] to a panel of uint8."""
    return cv2.resize(np.rint(picture * 255).astype(np.uint8), SIZE, interpolation=interpolation)


def main() -> None:
    """Make the dataset, pick the scene, write pair.png."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(["gen-dataset", f"out={folder}/ds", "noise=imx385_iso12800", "camera=sony_a7r"], check=True)
        sample = next(sample for sample in RawPairs(f"{folder}/ds") if sample.row["source"] == SCENE)
        frames = [np.array(frame) for frame in (sample.clean, sample.noisy)]
    source = synthetic.scene(SCENE) / 255
    top = [source, *(developed(frame, sample.row) for frame in frames)]
    bottom = [source[CROP], *(sites(frame, sample.row)[CROP] for frame in frames)]
    picture = np.vstack(
        [
            np.hstack([panel(one, cv2.INTER_AREA) for one in top]),
            np.hstack([panel(one, cv2.INTER_NEAREST) for one in bottom]),
        ]
    )
    cv2.imwrite(str(Path(__file__).with_name("pair.png")), picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
