"""Add camera noise to sRGB pictures: make the raw pair of a picture, and develop both frames.

The raw frames are made by `make_pair`, exact on every machine. Frames are developed in float32, so codes may differ by
one between machines. No byte of a dataset depends on this module.
"""

from __future__ import annotations

import functools
import operator
import os
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from unprocess_gen.api import array_pixels, array_settings, plan_array
from unprocess_gen.config.composition import load_config
from unprocess_gen.config.schema import Config
from unprocess_gen.config.values import refusal
from unprocess_gen.core.arrays import FLOAT32, MOSAIC, Frame, Srgb
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.forks import SharedCount
from unprocess_gen.simulation import self_test
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference import isp

Float32 = NDArray[np.float32]

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
        ``"malvar"``, the filters of Malvar, He and Cutler, or ``"bilinear"``.
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
        When a picture is made, if the self-test of the kernels fails.
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
        demosaic: str = "malvar",
        jpeg: int | None = None,
        seed: int = 0,
        clean: str = "developed",
    ) -> None:
        for name, value, allowed in (("demosaic", demosaic, tuple(isp.DEMOSAICS)), ("clean", clean, CLEANS)):
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
        self._calls, self._process, self._told = 0, os.getpid(), SharedCount()

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
            such as in the workers of a DataLoader, count their calls separately, so state it there; they warn once.

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
            if os.getpid() != self._process and self._told.next() == 1:
                problem = "without index, copies in several processes make the same noise"
                warnings.warn(f"CameraNoise: {problem}; pass the index of the picture", stacklevel=2)
            index, self._calls = self._calls, self._calls + 1
        _, image = plan_array(pixels, self._settings, operator.index(index))
        if self._settings.config.self_test == "stop":
            self_test.check(image.plans[:1])
        _, plan, pair = next(image.pairs())
        has_noise = set(plan.noise.effects) != {"quantise"}
        codes = int(np.iinfo(pixels.dtype).max) + 1
        noisy = _develop(pair.noisy if has_noise else pair.clean, plan, self._demosaic, codes)
        clean = pixels.copy() if self._clean == "source" else _develop(pair.clean, plan, self._demosaic, codes)
        return clean, noisy if self._jpeg is None else _compressed(noisy, self._jpeg)


def _config_of_pictures(config: Config, seed: int) -> Config:
    """Config whose pairs have the geometry of pictures and unrounded clean frames; ConfigError if none has."""
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


def _develop(frame: Frame, plan: Plan, demosaic: str, codes: int) -> Srgb:
    """Develop a frame in float32: gains, demosaicking, matrix, gamma and tone curve."""
    light: Any = frame.astype(np.float32)
    is_dn = frame.dtype == np.uint16
    light = isp.to_light(light, plan) if is_dn else light * np.float32(plan.scene.exposure_ratio)
    image = isp.white_balanced(light, plan, method=demosaic)
    table = _codes_of_roots(plan.isp.tone, plan.isp.gamma, codes)
    positions: Any = cv2.transform(image, np.reshape(isp.cam2rgb(plan), (3, 3)).astype(np.float32))
    np.sqrt(np.clip(positions, 0, 1, out=positions), out=positions)
    positions *= np.float32(len(table) - 1)
    positions += np.float32(0.5)
    picture: Srgb = table.take(positions.astype(np.int32))
    return picture


ROOTS_PER_CODE = {256: 64, 65536: 4}
"""Entries for each code of the table from roots of light to codes."""


@functools.lru_cache(maxsize=8)
def _codes_of_roots(tone: str, gamma: float | str, codes: int) -> Any:
    """Codes of the squares of equally spaced values from 0 to 1, in place of powers of each pixel."""
    light = np.linspace(0, 1, codes * ROOTS_PER_CODE[codes]) ** 2
    rounded = isp.to_codes(isp.TONES[tone](isp.compress_gamma(light, gamma)), codes)
    return np.asarray(rounded, dtype=np.uint8 if codes == 256 else np.uint16)


def _compressed(picture: Srgb, quality: int) -> Srgb:
    """Compress a picture as JPEG, and decode it."""
    encoded = cv2.imencode(".jpg", picture[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, quality))[1]
    decoded: Any = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    return np.ascontiguousarray(decoded[..., ::-1])
