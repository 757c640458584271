"""Make pairs in plain float32 NumPy, by the formulas of the article and of EMVA 1288: the yardstick of live pairs.

The same distribution as `unprocess_gen.LivePairs`, from the same cached pixels and the parameters of the same rows,
without reproducible random numbers, checks or counts. What does not change between epochs is prepared once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Pair = tuple[NDArray[np.uint16], NDArray[np.uint16]]


class NumpyPairs:
    """Serve random crops of pairs, ``clean, noisy = pairs[epoch, i]``, uint16 [side, side].

    ``rows`` are manifest rows, ``pixels`` the decoded image of each, uint8 [H, W, 3]. ``draw`` replaces the colours and
    gains of a row in each epoch.
    """

    def __init__(
        self,
        rows: Sequence[Mapping[str, Any]],
        pixels: Callable[[int], NDArray[np.uint8]],
        side: int,
        draw: Callable[[np.random.Generator], tuple[Array, Array]] | None = None,
    ) -> None:
        self.images = [Camera(row, pixels(number).shape[:2]) for number, row in enumerate(rows)]
        self.pixels, self.side, self.draw, self.rng = pixels, side, draw, np.random.default_rng(0)

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, item: tuple[int, int]) -> Pair:
        camera, image, side = self.images[item[1]], self.pixels(item[1]), self.side
        y, x = (2 * int(self.rng.integers((length - side) // 2 + 1)) for length in image.shape[:2])
        colours = self.draw(self.rng) if self.draw else (camera.matrix, camera.gains)
        clean = camera.unprocess(image[y : y + side, x : x + side], *colours)
        return camera.round(clean), camera.round(camera.noisy(clean, self.rng, y, x))


class Camera:
    """Camera, exposure and body of one row."""

    def __init__(self, row: Mapping[str, Any], shape: tuple[int, int]) -> None:
        assert (row["tone"], row["gamma"], row["highlight"]) == ("smoothstep", 2.2, "per_channel")
        self.row, self.effects = row, set(row["effects"].split(";"))
        self.matrix = np.array([row[f"rgb2cam_{i}{j}"] for i in range(3) for j in range(3)], np.float32).reshape(3, 3)
        inverse = row["inverse_rgb_gain"]
        self.gains = np.array([inverse / row["red_gain"], inverse, inverse / row["blue_gain"]], np.float32)
        self.black, self.white = np.float32(row["black_level_dn"]), np.float32(row["white_level_dn"])
        self.span, self.exposure = self.white - self.black, np.float32(1 / row["exposure_ratio"])
        body = np.random.default_rng(int(row["body_key"] or "0", 16))
        if "prnu" in self.effects:
            self.response = np.maximum(1 + np.float32(row["prnu_std"]) * body.standard_normal(shape, np.float32), 0)
        if "hot_pixels" in self.effects:
            self.hot = np.argwhere(body.random(shape, np.float32) < row["hot_pixel_share"])
            self.hot_e = row["hot_pixel_e"] * body.standard_exponential(len(self.hot))
        if "column" in self.effects:
            self.columns = np.float32(row["column_std_dn"]) * body.standard_normal(shape[1], np.float32)
        if "black_error" in self.effects:
            self.planes = np.array([row[f"black_error_dn_{i}"] for i in ("00", "01", "10", "11")], np.float32)

    def unprocess(self, srgb: NDArray[np.uint8], matrix: Array, gains: Array) -> Array:
        """Return the unrounded clean mosaic in DN: Algorithm 1 of the article."""
        image = srgb.astype(np.float32) / np.float32(255)
        image = np.maximum(np.float32(0.5) - np.sin(np.arcsin(1 - 2 * image) / 3), 0) ** np.float32(2.2)
        image = image @ matrix.T
        kept = gains * image + 100 * image * (image - np.float32(0.9)) ** 2 * (1 - gains)
        image = np.where((gains < 1) & (image > np.float32(0.9)), kept, gains * image)
        light = np.empty(image.shape[:2], np.float32)
        for n, letter in enumerate(self.row["pattern"]):
            y, x = divmod(n, 2)
            light[y::2, x::2] = image[y::2, x::2, "RGB".index(letter)]
        return np.clip(light, 0, 1) * self.exposure * self.span + self.black

    def noisy(self, clean: Array, rng: np.random.Generator, y: int, x: int) -> Array:
        """Add the effects of the row, in the order in which light meets them."""
        row, effects, signal = self.row, self.effects, clean - self.black
        if "heteroscedastic" in effects:
            std = np.sqrt(np.maximum(np.float32(row["a_dn"]) * signal + np.float32(row["b_dn2"]), 0))
            return clean + std * rng.standard_normal(clean.shape, np.float32)
        gain, (height, width) = np.float32(row["dn_per_e"]), clean.shape
        electrons = signal / gain
        if "prnu" in effects:
            electrons = electrons * self.response[y : y + height, x : x + width]
        electrons = rng.poisson(electrons).astype(np.float32)
        if "dark_current" in effects:
            electrons += rng.poisson(row["dark_e"], clean.shape).astype(np.float32) - np.float32(row["dark_e"])
        if "hot_pixels" in effects:
            inside = ((self.hot >= (y, x)) & (self.hot < (y + height, x + width))).all(axis=1)
            np.add.at(electrons, tuple((self.hot[inside] - (y, x)).T), rng.poisson(self.hot_e[inside]))
        noisy = electrons * gain + self.black
        if "read" in effects:
            noisy += np.float32(row["read_std_dn"]) * self.read(rng, clean.shape)
        if "row" in effects:
            noisy += np.float32(row["row_std_dn"]) * rng.standard_normal((height, 1), np.float32)
        if "column" in effects:
            noisy += self.columns[x : x + width]
        if "black_error" in effects:
            noisy.reshape(height // 2, 2, width // 2, 2)[:] += self.planes.reshape(2, 1, 2)
        return np.where(clean >= self.white, self.white, noisy) if row["saturated_as"] == "white" else noisy

    def read(self, rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Draw read noise of standard deviation 1: normal, or Tukey's lambda distribution."""
        if self.row["read_law"] == "gaussian":
            return rng.standard_normal(shape, np.float32)
        shape_number = self.row["read_shape"]
        variance = 1 / (1 + 2 * shape_number) - math.gamma(shape_number + 1) ** 2 / math.gamma(2 * shape_number + 2)
        uniform, power = rng.random(shape, np.float32), np.float32(shape_number)
        uniform = np.maximum(uniform, np.float32(2**-25))  # 0 would be minus infinity
        return (uniform**power - (1 - uniform) ** power) / np.float32(math.sqrt(2 * variance) * np.sign(shape_number))

    def round(self, dn: Array) -> NDArray[np.uint16]:
        """Round and clip to the sensor's integers."""
        return np.clip(np.rint(dn), 0, 2 ** self.row["bits"] - 1).astype(np.uint16)


def brooks_colours(rng: np.random.Generator, matrices: NDArray[np.float64]) -> tuple[Array, Array]:
    """Draw colours and gains as Brooks et al. (2019); ``matrices`` [4, 3, 3] go from linear sRGB to each camera."""
    weights = rng.random(4)
    matrix = np.tensordot(weights / weights.sum(), matrices, 1)
    inverse = 1.0
    while not 0.5 <= inverse <= 1.1 or inverse == 1.0:
        inverse = rng.normal(0.8, 0.1)
    gains = np.array([inverse / rng.uniform(1.9, 2.4), inverse, inverse / rng.uniform(1.5, 1.9)], np.float32)
    return (matrix / matrix.sum(axis=1, keepdims=True)).astype(np.float32), gains
