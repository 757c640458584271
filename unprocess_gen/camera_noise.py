"""Add camera noise to sRGB pictures: make the raw pair of a picture, and develop both frames.

The raw frames are made by `make_pair`, exact on every machine. Developing uses OpenCV and float32, so codes may differ
by one between machines. No byte of a dataset depends on this module.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from unprocess_gen.api import array_pixels, array_settings, array_source, key_identity
from unprocess_gen.config.composition import load_config
from unprocess_gen.config.schema import Config
from unprocess_gen.config.values import refusal
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.jit import inner, kernel
from unprocess_gen.core.libraries import require
from unprocess_gen.core.tone_curves import linear_table
from unprocess_gen.core.types import FLOAT32, MOSAIC, Float, Frame, Pair, Photograph, Plan, Srgb
from unprocess_gen.pipeline.pairs import plan_pixels
from unprocess_gen.simulation import self_test
from unprocess_gen.simulation.reference import isp
from unprocess_gen.simulation.reference.cfa import tile

Float32 = NDArray[np.float32]

OPENCV = {"bilinear": "", "edge_aware": "_EA"}
"""Methods of OpenCV, and the ends of their constants."""

COLOUR_DEMOSAICING = {"malvar": "Malvar2004", "menon": "Menon2007"}
"""Methods of colour-demosaicing, and the ends of their functions."""

DEMOSAICS = (*OPENCV, *COLOUR_DEMOSAICING)
CLEANS = ("developed", "source")


class CameraNoise:
    """Add the noise of a camera to sRGB pictures, as an augmentation.

    A picture is unprocessed to a raw pair, as by `make_pair`, and both frames are developed with the gains, the matrix
    and the curves of the pair. The geometry does not change. An instance can be pickled and forked.

    Parameters
    ----------
    config : Config, or sequence of str
        From `load_config`, or Hydra overrides. Everything random is drawn for each index: camera, gains, noise.
    demosaic : str
        ``"bilinear"`` or ``"edge_aware"``, of OpenCV; ``"malvar"`` or ``"menon"``, of the library colour-demosaicing
        (extra ``demosaic``), which take about 20 times as long.
    jpeg : int, optional
        Quality, 1 to 100, of the JPEG compression of noisy pictures; by default none.
    seed : int
        Seed of all that is drawn. The config has none of its own.
    clean : str
        ``"developed"``: the frame without noise, developed like the noisy one. ``"source"``: the picture itself.

    Raises
    ------
    ConfigError
        If an argument is not allowed, the config is not allowed, changes the geometry or has another seed.
    MachineError
        If a library is missing; when a picture is made, if the self-test of the kernels fails.
    TypeError
        If ``config`` is neither a config nor overrides; when a picture is made, if ``index`` is no integer.
    ValueError
        When a picture is made: if it has another dtype or shape, or fewer than 2 x 2 pixels.

    Notes
    -----
    ``noise(picture, index=7)`` depends only on the picture, the config, the seed and the index. It develops the frames
    of ``make_pair(picture, config, seed=seed, key=7)``, whose ``row`` states all parameters. Only the noisy frame is
    rounded to DN, and only if noise is simulated. So a flat picture without noise returns with each code within 1,
    except where the sensor is saturated.

    Examples
    --------
    >>> import numpy as np
    >>> import unprocess_gen as ug
    >>> picture = np.full((64, 97, 3), 128, np.uint8)
    >>> noise = ug.CameraNoise(["noise=imx385_iso3200"], seed=1)
    >>> clean, noisy = noise(picture, index=7)
    >>> noisy.shape, noisy.dtype
    ((64, 97, 3), dtype('uint8'))
    >>> bool((noise(picture, index=7)[1] == noisy).all())
    True
    """

    def __init__(
        self,
        config: Config | Sequence[str] = (),
        demosaic: str = "bilinear",
        jpeg: int | None = None,
        seed: int = 0,
        clean: str = "developed",
    ) -> None:
        for name, value, allowed in (("demosaic", demosaic, DEMOSAICS), ("clean", clean, CLEANS)):
            if value not in allowed:
                raise ConfigError(f"CameraNoise: {name}={value!r}: unknown; expected one of {', '.join(allowed)}")
        if jpeg is not None and (not isinstance(jpeg, int) or isinstance(jpeg, bool) or not 1 <= jpeg <= 100):
            raise ConfigError(f"CameraNoise: jpeg={jpeg!r}: no quality; expected an integer from 1 to 100, or None")
        if isinstance(config, str):
            raise ConfigError(f"CameraNoise: config={config!r}: is text; expected a list: [{config!r}]")
        if not isinstance(config, Config):
            config = load_config(config)
        self._settings = array_settings(_config_of_pictures(config, seed))
        self._demosaic, self._jpeg, self._clean, self._seed = demosaic, jpeg, clean, seed
        if demosaic in COLOUR_DEMOSAICING:
            _colour_demosaicing(demosaic)
        self._calls = 0

    def __repr__(self) -> str:
        name = self._settings.config.noise.name
        return f"CameraNoise(noise={name}, demosaic={self._demosaic}, jpeg={self._jpeg}, seed={self._seed})"

    def __call__(self, picture: ArrayLike, index: int | None = None) -> tuple[Srgb, Srgb]:
        """Make a clean and a noisy picture.

        Parameters
        ----------
        picture : array_like of uint8 or uint16, [H, W, 3]
            Display-referred codes, R, G, B; at least 2 x 2.
        index : int, optional
            Number that selects the random values; by default the number of the call: 0, 1, … Copies of an instance,
            such as in the workers of a DataLoader, count their calls separately, so state it there.

        Returns
        -------
        clean, noisy : ndarray
            Pictures of the dtype and shape of ``picture``.
        """
        pixels = array_pixels(picture)
        if min(pixels.shape[:2]) < 2:
            raise ValueError(f"picture is {list(pixels.shape)}; expected at least 2 x 2 pixels, for each filter one")
        if self._jpeg is not None and pixels.dtype != np.uint8:
            raise ValueError(f"picture is {pixels.dtype}; expected uint8 with jpeg={self._jpeg}, or jpeg=None")
        if index is None:
            index, self._calls = self._calls, self._calls + 1
        plan, pair = self._raw_pair(pixels, operator.index(index))
        development = Development(plan, self._demosaic, pixels.dtype)
        has_noise = set(plan.noise.effects) != {"quantise"}
        noisy = development.codes(pair.noisy if has_noise else pair.clean)
        clean = (
            pixels.copy() if self._clean == "source" else development.codes(pair.clean) if has_noise else noisy.copy()
        )
        return clean, noisy if self._jpeg is None else _compressed(noisy, self._jpeg)

    def _raw_pair(self, pixels: Srgb, index: int) -> tuple[Plan, Pair]:
        identity = key_identity(index)
        image = plan_pixels(self._settings, Photograph(pixels, 1), array_source(pixels, identity), identity)
        if self._settings.config.self_test == "stop":
            self_test.check(self_test.kernels(image.plans[0]))
        _, plan, pair = next(image.pairs())
        return plan, pair


def _config_of_pictures(config: Config, seed: int) -> Config:
    """Return a config whose pairs have the geometry of pictures and unrounded clean frames."""
    if config.seed not in (0, seed):
        problem = f"differs from seed={seed} of CameraNoise; expected one seed; pass seed={config.seed} to CameraNoise"
        raise refusal("seed", config.seed, problem)
    for key, value, expected in (
        ("source.downscale", config.source.downscale, 1),
        ("output.layout", config.output.layout, MOSAIC),
    ):
        if value != expected:
            problem = f"CameraNoise keeps the geometry of pictures; expected {expected}"
            raise refusal(key, value, problem)
    return replace(config, seed=seed, output=replace(config.output, clean_dtype=FLOAT32))


@dataclass(frozen=True, slots=True)
class Development:
    """Hold what developing the frames of a pair needs.

    Attributes
    ----------
    plan : Plan
        Parameters of the pair.
    demosaic : str
        One of `DEMOSAICS`.
    dtype : dtype
        Dtype of the pictures.
    """

    plan: Plan
    demosaic: str
    dtype: np.dtype[Any]

    def codes(self, frame: Frame) -> Srgb:
        """Develop a frame: gains, demosaicking, matrix, gamma and tone curve."""
        camera, curve = self.plan.camera, self.plan.isp
        codes = int(np.iinfo(self.dtype).max) + 1
        image, zero, unit = self._demosaicked(
            self._balanced(frame), float(linear_table(curve.tone, curve.gamma, codes)[1])
        )
        if camera.highlight == "gray_mean":  # whose gains depend on all three channels
            light = (image - zero) / unit * np.array(camera.inverse_gains)
            balanced = isp.apply_gains(light, camera.inverse_gains, "gray_mean", camera.highlight_threshold)
            image, zero, unit = balanced.astype(np.float32), 0.0, 1.0
        matrix = cv2.invert(np.reshape(camera.rgb2cam, (3, 3)))[1] / unit
        picture, table = np.empty((*frame.shape, 3), self.dtype), _codes_of_roots(curve.tone, curve.gamma, codes)
        _render(image, np.float32(zero), matrix.astype(np.float32), table, picture)
        return picture

    def _balanced(self, frame: Frame) -> Any:
        """Divide the light of each site by its inverse gain, restore highlights and add margins."""
        plan, camera = self.plan, self.plan.camera
        black_dn, span_dn = (plan.sensor.black_level_dn, plan.sensor.span_dn) if frame.dtype == np.uint16 else (0, 1)
        gains = np.array(camera.inverse_gains, np.float32)[np.array(tile(plan.sensor.pattern))]
        factors = (plan.scene.exposure_ratio / span_dn / gains).astype(np.float32)
        threshold = np.float32(camera.highlight_threshold if camera.highlight == "per_channel" else np.inf)
        balanced = np.empty(frame.shape, np.float32)
        _balance(frame, np.float32(black_dn), factors, gains, threshold, balanced)
        return cv2.copyMakeBorder(balanced, MARGIN, MARGIN, MARGIN, MARGIN, cv2.BORDER_REFLECT_101)

    def _demosaicked(self, padded: Any, darkest: float) -> tuple[Any, float, float]:
        """Interpolate the missing channels: an image [H, W, 3], its value at black, and the difference to light 1."""
        pattern = self.plan.sensor.pattern
        if self.demosaic not in OPENCV:
            return _colour_demosaicing(self.demosaic)(padded, pattern)[INNER].astype(np.float32), 0.0, 1.0
        lowest, highest, _, _ = cv2.minMaxLoc(padded)
        unit = (65535 - 7) / (max(highest, 1.0) - min(lowest, 0.0))
        zero = 4.0 * math.ceil(-min(lowest, 0.0) * unit / 4)
        parts = np.empty((1 if darkest * unit >= STEPS else 2, *padded.shape), np.uint16)
        _encode(padded, np.float32(unit), np.float32(zero), parts)
        conversion = getattr(cv2, f"COLOR_Bayer{pattern}2RGB{OPENCV[self.demosaic]}")
        images = [cv2.cvtColor(part, conversion)[INNER] for part in parts]
        if len(images) == 1:
            return images[0], zero, unit
        return cv2.addWeighted(images[0], 1, images[1], 1 / FINE, -32768 / FINE - zero, dtype=cv2.CV_32F), 0.0, unit


def _colour_demosaicing(method: str) -> Callable[[Float32, str], Float]:
    """Return the function of colour-demosaicing; ConfigError if the library is missing."""
    require("colour_demosaicing", f"CameraNoise: demosaic={method} needs colour-demosaicing", "demosaic")
    import colour_demosaicing

    function: Callable[[Float32, str], Float] = getattr(
        colour_demosaicing, f"demosaicing_CFA_Bayer_{COLOUR_DEMOSAICING[method]}"
    )
    return function


MARGIN = 4
"""Sites mirrored about each edge site; libraries copy channels there, or mirror them to sites of other filters."""

INNER = np.s_[MARGIN:-MARGIN, MARGIN:-MARGIN]

STEPS = 8
"""Least number of steps of 16 bits from black to the darkest code.

With fewer, OpenCV demosaicks two frames: steps of 4, and remainders. Means of two or four steps of 4 need no rounding,
so the sum is right to 30 bits.
"""

FINE = 16383
"""Steps of the remainders in a step of 16 bits; remainders are between -2 and 2."""

ROOTS_PER_CODE = {256: 64, 65536: 4}
"""Entries for each code of the table from roots of light to codes: 16 kB fit the L1 cache, 512 kB do not."""


@functools.lru_cache(maxsize=8)
def _codes_of_roots(tone: str, gamma: float | str, codes: int) -> Any:
    """Return the codes of the squares of equally spaced values from 0 to 1."""
    light = np.linspace(0, 1, codes * ROOTS_PER_CODE[codes]) ** 2
    rounded = isp.to_codes(isp.TONES[tone](isp.compress_gamma(light, gamma)), codes)
    return np.asarray(rounded, dtype=np.uint8 if codes == 256 else np.uint16)


@kernel
def _balance(
    frame: Frame, black: np.float32, factors: Float32, gains: Float32, threshold: np.float32, balanced: Float32
) -> None:
    """Fill ``balanced`` with (frame - black) * factor of the site, and restore highlights above ``threshold``."""
    for y in range(frame.shape[0]):
        row, (even, odd), (even_gain, odd_gain), bright = balanced[y], factors[y % 2], gains[y % 2], np.int32(0)
        for x in range(frame.shape[1]):
            row[x] = (np.float32(frame[y, x]) - black) * (odd if x % 2 else even)
            bright |= np.int32(row[x] > threshold)  # a maximum would not be vectorised
        if bright:
            for x in range(frame.shape[1]):
                gain = odd_gain if x % 2 else even_gain
                restored = _restored(row[x] * gain, gain, threshold)
                row[x] = restored if row[x] > threshold and gain < np.float32(1) else row[x]


@inner
def _restored(light: np.float32, gain: np.float32, threshold: np.float32) -> Any:
    """Solve for i above the threshold what `isp.apply_gains_per_channel` does, in a constant number of operations.

    With i = threshold + width·m, it is a cubic equation in m. The root without the cubic term is too large by at most
    a few percent; three steps of Newton's method reach float32. The general method would take 4 times as long as all
    else in pictures with bright skies.
    """
    width, rest = np.float32(1) - threshold, np.float32(1) - gain
    cubic, square, linear, excess = rest * width, rest * threshold, gain * width, light - gain * threshold
    m = (np.sqrt(linear * linear + np.float32(4) * square * excess) - linear) / (np.float32(2) * square)
    for _ in range(3):
        value = ((cubic * m + square) * m + linear) * m - excess
        m -= value / ((np.float32(3) * cubic * m + np.float32(2) * square) * m + linear)
    return threshold + width * m


@kernel
def _encode(balanced: Float32, unit: np.float32, zero: np.float32, parts: NDArray[np.uint16]) -> None:
    """Fill the first of ``parts`` with rounded steps, or both with steps of 4 and remainders."""
    if len(parts) == 1:
        for y in range(balanced.shape[0]):
            for x in range(balanced.shape[1]):
                parts[0, y, x] = np.uint16(np.int32(np.rint(balanced[y, x] * unit + zero)))
        return
    for y in range(balanced.shape[0]):
        for x in range(balanced.shape[1]):
            step = balanced[y, x] * unit + zero
            coarse = np.rint(step / 4) * 4
            parts[0, y, x] = np.uint16(coarse)
            parts[1, y, x] = np.uint16(np.rint((step - coarse) * FINE + 32768))


@kernel
def _render(image: Any, zero: np.float32, matrix: Float32, table: Srgb, picture: Srgb) -> None:
    """Fill ``picture`` with the codes of ``matrix`` times ``image`` - ``zero``, clipped to [0, 1].

    A loop for each step of a row is vectorised; in one loop for all steps, the look-up would take four times as long.
    """
    height, width, _ = image.shape
    last, half, low, high = np.float32(len(table) - 1), np.float32(0.5), np.float32(0), np.float32(1)
    camera, indices = np.empty((3, width), np.float32), np.empty(width, np.int32)
    for y in range(height):
        for channel in range(3):
            values, sites = camera[channel], image[y, :, channel]
            for x in range(width):
                values[x] = np.float32(sites[x]) - zero
        for channel in range(3):
            red, green, blue = matrix[channel]
            reds, greens, blues, filled = camera[0], camera[1], camera[2], picture[y, :, channel]
            for x in range(width):
                light = red * reds[x] + green * greens[x] + blue * blues[x]
                indices[x] = np.int32(np.sqrt(min(max(light, low), high)) * last + half)
            for x in range(width):
                filled[x] = table[np.uint32(indices[x])]


def _compressed(picture: Srgb, quality: int) -> Srgb:
    """Compress a picture as JPEG, and decode it."""
    encoded = cv2.imencode(".jpg", picture[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, quality))[1]
    decoded: Any = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    return np.ascontiguousarray(decoded[..., ::-1])
