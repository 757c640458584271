"""Add camera noise to sRGB pictures: make the raw pair of a picture, and develop both frames.

Raw frames are the same on every machine. They are developed in float32, so codes may differ by one between machines. No
byte of a dataset depends on this module.
"""

from __future__ import annotations

import operator
import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from unprocess_gen.api import array_pixels, array_settings, plan_array
from unprocess_gen.camera_fit import CameraFit, fit_pairs
from unprocess_gen.config.composition import load_config
from unprocess_gen.config.schema import Config
from unprocess_gen.config.source_validation import require_kind
from unprocess_gen.config.values import refusal
from unprocess_gen.core.arrays import FLOAT32, MOSAIC, Srgb, last_code
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.forks import SharedCount
from unprocess_gen.picture_isp import IspOptions, compressed, light_of, render, with_strength
from unprocess_gen.picture_mean import mean_picture
from unprocess_gen.simulation import self_test

CLEANS = ("developed", "source", "mean")


class CameraNoise:
    """Add the noise of a camera to sRGB pictures, as an augmentation.

    A picture is unprocessed to a raw pair, as by `make_pair`, and both frames are developed with the gains, the matrix
    and the curves of the pair. The geometry does not change. An instance can be pickled and forked.

    Parameters
    ----------
    config : Config, sequence of str, or mapping
        From `load_config`, or what it takes. Everything random is drawn for each index: camera, gains, noise.
    demosaic : str
        ``"malvar"``, the filters of Malvar, He and Cutler, or ``"bilinear"``.
    jpeg : int or list, optional
        JPEG quality of noisy pictures, 1 to 100, or its distribution, such as ``["uniform", 70, 95]``, rounded to
        integers. By default, pictures are not compressed.
    seed : int
        Seed of all that is drawn. The config has none of its own.
    clean : str
        ``"developed"``: the frame without noise, developed like the noisy one. ``"source"``: the picture itself.
        ``"mean"``: the mean of the noisy pictures before JPEG; not with ``gains.highlight=gray_mean``.
    strength : float or list
        Factor of the noise, 0 to 100, or its distribution, such as ``["log_uniform", 0.58, 1.7]``. The noisy light is
        clean + strength · (noisy - clean), clipped where the sensor clips.
    chroma_nr : float
        Noise reduction of noisy pictures: standard deviation of the Gaussian blur of Cb and Cr, pixels; 0: none.
    luma_nr : float
        Noise reduction of noisy pictures: standard deviation of the range of the bilateral filter of luma, in 8-bit
        codes; 0: none.
    jpeg_sampling : str
        Chroma sampling of JPEG: ``"4:2:0"``, ``"4:2:2"`` or ``"4:4:4"``.

    Raises
    ------
    ConfigError
        If an argument or the config is not allowed, or the config changes the geometry or has another seed.
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
    rounded to DN, and only if noise is simulated. So each code of a flat picture without noise returns within 1, unless
    the sensor is saturated or the light of a colour is negative, which sensors record as black.

    The mean takes the light of a channel as normally distributed, and offsets of rows and columns as independent. Its
    error is up to 1 code if white has 60 electrons, 4 at 10, and 18 at 3. Fixed patterns are averaged unless
    ``clean.includes_fixed_pattern`` is set. Of clean pictures, only the mean gets noise reduction.

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
        config: Config | Sequence[str] | Mapping[str, Any] = (),
        demosaic: str = "malvar",
        jpeg: int | Sequence[Any] | None = None,
        seed: int = 0,
        clean: str = "developed",
        *,
        strength: float | Sequence[Any] = 1,
        chroma_nr: float = 0,
        luma_nr: float = 0,
        jpeg_sampling: str = "4:2:0",
    ) -> None:
        self._options = IspOptions(*map(_as_python, (demosaic, strength, chroma_nr, luma_nr, jpeg, jpeg_sampling)))
        if clean not in CLEANS:
            raise ConfigError(f"CameraNoise: clean={clean!r}: unknown; expected one of {', '.join(CLEANS)}")
        if isinstance(config, str):
            raise ConfigError(f"CameraNoise: config={config!r}: is text; expected a list: [{config!r}]")
        if not isinstance(config, Config):
            config = load_config(config)
        if clean == "mean" and config.gains.highlight == "gray_mean":
            problem = "mixes the channels' noise; expected per_channel or none with clean=mean of CameraNoise"
            raise refusal("gains.highlight", "gray_mean", problem)
        require_kind(config.source, "CameraNoise", "srgb")
        self._settings = array_settings(_config_of_pictures(config, seed))
        self._clean, self._seed = clean, seed
        self._calls, self._process, self._told = 0, os.getpid(), SharedCount()

    @classmethod
    def fit(
        cls, pairs: Iterable[tuple[ArrayLike, ArrayLike]], config: Sequence[str] = ("gains=fixed",), **options: Any
    ) -> CameraFit:
        """Fit the noise to real pairs of a noisy and a clean picture.

        Parameters
        ----------
        pairs : iterable of (array_like, array_like)
            Noisy and clean picture of one scene, in this order, uint8 or uint16 [H, W, 3], of one camera and ISO. All
            pairs together are cut to 2**19 pixels, each to its middle.
        config : sequence of str
            Hydra overrides of everything but noise. ``isp=`` and ``camera=`` fix what is fitted otherwise.
        **options : Any
            Keyword arguments of `CameraNoise` that are known, such as ``jpeg=75``.

        Returns
        -------
        CameraFit
            Fitted numbers, a table of real against simulated noise, and ``noise()``, which makes the `CameraNoise`.

        Raises
        ------
        ConfigError
            If there is no pair, shapes or dtypes of a pair differ, its pictures are equal, the pictures have too few
            levels or no noise in chroma, or an argument names what is fitted.
        ValueError
            If a picture has another dtype or shape.

        Notes
        -----
        Fitted are a and b of ``noise=heteroscedastic``, curve (`isp`), colour matrix (`camera`), demosaicking,
        ``chroma_nr``, and ``luma_nr`` from four pairs on; gains are those of the config. a and b are effective: they
        hold with the fitted curve only. The fit matches standard deviations of luma and chroma by level, correlations
        R-G and G-B, and those of horizontal neighbours in Y and Cb. Pixels with a clean code below 8 or above 247 are
        left out.

        Examples
        --------
        >>> import numpy as np
        >>> import unprocess_gen as ug
        >>> ramp = np.linspace(20, 220, 128).astype(np.uint8)[:, None, None] * np.ones((1, 128, 3), np.uint8)
        >>> known = ug.CameraNoise(["noise=imx385_iso6400", "camera=sony_a7r", "gains=fixed"])
        >>> clean, noisy = known(ramp, index=0)
        >>> fit = ug.CameraNoise.fit([(noisy, clean)], ["gains=fixed", "camera=sony_a7r", "isp=smoothstep_gamma22"])
        >>> fit.options["demosaic"], fit.numbers["a_dn"].low < 13.5 < fit.numbers["a_dn"].high
        ('malvar', True)
        >>> noise = fit.noise(seed=1)
        """
        return fit_pairs(cls, pairs, config, **options)

    def __repr__(self) -> str:
        noise = f"noise={self._settings.config.noise.name}"
        return f"CameraNoise({noise}, {self._options}, clean={self._clean}, seed={self._seed})"

    def drawn(self, index: int) -> dict[str, Any]:
        """Draw the strength of the noise and the quality of the JPEG compression of a picture.

        Parameters
        ----------
        index : int
            Number of the picture, as in a call.

        Returns
        -------
        dict
            ``strength``, a factor, and ``jpeg``, an integer, or None.
        """
        return self._options.drawn(self._seed, operator.index(index))

    def __call__(self, picture: ArrayLike, index: int | None = None) -> tuple[Srgb, Srgb]:
        """Make a clean and a noisy picture.

        Parameters
        ----------
        picture : array_like of uint8 or uint16, [H, W, 3]
            Display-referred codes, R, G, B; at least 2 x 2.
        index : int, optional
            Number that selects the random values; by default the number of the call: 0, 1, … Pass it in the workers of
            a DataLoader, whose copies of an instance count their calls separately and warn once.

        Returns
        -------
        clean, noisy : ndarray
            Pictures of the dtype and shape of ``picture``.
        """
        pixels = array_pixels(picture)
        if min(pixels.shape[:2]) < 2:
            raise ValueError(f"picture is {list(pixels.shape)}; expected at least 2 x 2 pixels, for each filter one")
        if self._options.jpeg is not None and pixels.dtype != np.uint8:
            raise ValueError(f"picture is {pixels.dtype}; expected uint8 with jpeg={self._options.jpeg}, or jpeg=None")
        if index is None:
            if os.getpid() != self._process and self._told.next() == 1:
                problem = "without index, copies in several processes make the same noise"
                warnings.warn(f"CameraNoise: {problem}; pass the index of the picture", stacklevel=2)
            index, self._calls = self._calls, self._calls + 1
        index = operator.index(index)
        _, image = plan_array(pixels, self._settings, index)
        if self._settings.config.self_test == "stop":
            self_test.check(image.plans[:1])
        _, plan, pair = next(image.pairs())
        drawn, codes = self._options.drawn(self._seed, index), last_code(pixels) + 1
        strength = 0.0 if set(plan.noise.effects) == {"quantise"} else drawn["strength"]
        clean = light_of(pair.clean, plan)
        noisy = render(with_strength(clean, light_of(pair.noisy, plan), strength, plan), plan, self._options, codes)
        if drawn["jpeg"] is not None:
            noisy = compressed(noisy, drawn["jpeg"], self._options.jpeg_sampling)
        if self._clean == "source":
            return pixels.copy(), noisy
        if self._clean == "mean":
            return mean_picture(pair.clean, plan, self._options, strength, codes), noisy
        return render(clean, plan, replace(self._options, chroma_nr=0, luma_nr=0), codes), noisy


def _as_python(value: Any) -> Any:
    """Convert scalars and arrays of NumPy to Python's numbers and lists."""
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value


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
            raise refusal(key, value, f"CameraNoise keeps the geometry of pictures; expected {expected}")
    return replace(config, seed=seed, output=replace(config.output, clean_dtype=FLOAT32))
