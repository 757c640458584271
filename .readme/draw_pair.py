"""Draw pair.png, a pair of the README: python .readme/draw_pair.py. The dataset is generated in a temporary folder."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

import cv2
import numpy as np

from unprocess_gen import RawPairs
from unprocess_gen.sources import synthetic

SCENE = "highlights-0"
CROP = (slice(260, 308), slice(130, 202))  # rows and columns; even starts keep the CFA pattern
SIZE = (360, 240)


def balanced(raw: np.ndarray, row: dict) -> np.ndarray:
    """Return the light of each RGGB site after white balance and brightening; 1 is white."""
    light = np.maximum(raw.astype(float) - row["black_level_dn"], 0) / (row["white_level_dn"] - row["black_level_dn"])
    light[0::2, 0::2] *= row["red_gain"]
    light[1::2, 1::2] *= row["blue_gain"]
    return light / row["inverse_rgb_gain"]


def developed(raw: np.ndarray, row: dict) -> np.ndarray:
    """Return one RGB pixel for each RGGB tile; without interpolation the noise is not smoothed."""
    light = balanced(raw, row)
    green = (light[0::2, 1::2] + light[1::2, 0::2]) / 2
    return np.sqrt(np.clip(np.dstack([light[0::2, 0::2], green, light[1::2, 1::2]]), 0, 1))


def sites(raw: np.ndarray, row: dict) -> np.ndarray:
    """Return each site of a mosaic in the colour of its filter, twice as bright because each shows one channel."""
    bright = np.sqrt(np.clip(2 * balanced(raw, row), 0, 1))
    picture = np.zeros((*raw.shape, 3))
    for (y, x), channel in {(0, 0): 0, (0, 1): 1, (1, 0): 1, (1, 1): 2}.items():
        picture[y::2, x::2, channel] = bright[y::2, x::2]
    return picture


def panel(picture: np.ndarray, interpolation: int) -> np.ndarray:
    """Return a picture in [0, 1] as a panel of uint8."""
    return cv2.resize(np.rint(picture * 255).astype(np.uint8), SIZE, interpolation=interpolation)


def main() -> None:
    """Generate the dataset, find the scene and write pair.png."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(["gen-dataset", f"out={folder}/ds", "noise=imx385_iso12800", "camera=sony_a7r"], check=True)
        sample = next(sample for sample in RawPairs(f"{folder}/ds") if sample.row["source"] == SCENE)
        frames = [np.array(frame) for frame in (sample.clean, sample.noisy)]
    source = synthetic.picture(SCENE) / 255
    top = [source, *(developed(frame, sample.row) for frame in frames)]
    bottom = [source[CROP], *(sites(frame, sample.row)[CROP] for frame in frames)]
    picture = np.vstack(
        [
            np.hstack([panel(image, cv2.INTER_AREA) for image in top]),
            np.hstack([panel(image, cv2.INTER_NEAREST) for image in bottom]),
        ]
    )
    cv2.imwrite(str(Path(__file__).with_name("pair.png")), picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
