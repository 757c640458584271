"""Fit `CameraNoise` to real pairs of a noisy and a clean sRGB picture, by second moments of noisy - clean.

The statistics are standard deviations of luma and chroma in bands of levels, the correlations R-G and G-B, and those of
horizontal neighbours in Y and Cb (ITU-T T.871). The clean pictures get simulated noise, always of the same random
numbers. Least squares change a, b, chroma_nr² and luma_nr², in which variances are nearly linear, until its statistics
are those of the real noise.
"""

from __future__ import annotations

import functools
import itertools
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from unprocess_gen.api import array_pixels
from unprocess_gen.calibration.gain import Estimate
from unprocess_gen.calibration.profile import MARK, rounded
from unprocess_gen.config.composition import load_config
from unprocess_gen.config.schema import Config
from unprocess_gen.core.arrays import Float, Srgb, last_code
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.libraries import require
from unprocess_gen.picture_isp import YCBCR
from unprocess_gen.reports.formatting import short_number
from unprocess_gen.simulation.reference.isp import DEMOSAICS

Combination = tuple[str, str, str]
"""Curve, camera and demosaicking; the first two are overrides."""

NUMBERS = ("a_dn", "b_dn2", "chroma_nr", "luma_nr")
FITTED = {"demosaic", "chroma_nr", "luma_nr", "seed"}
"""Keyword arguments of `CameraNoise` that are fitted, or that `CameraFit.noise` takes."""
TRIED = {
    "isp=": ("isp=smoothstep_gamma22", "isp=gamma22", "isp=srgb"),
    "camera=": ("camera=nexus_6p", "camera=sony_a7r", "camera=olympus_em10", "camera=sony_rx100"),
}
"""Overrides tried unless the config has one of the group; without convex, which draws a matrix for each picture."""
PIXELS, TILE, BAND, BANDS = 2**19, 32, 16, 16
"""Most pixels of all pairs, which are cut to their middle; side of a tile; codes of a band of clean luma; bands."""
DARKEST, BRIGHTEST = 8, 247
"""Least and largest clean code of a channel that is used; beyond them, 0 and 255 cut the noise off."""
LEAST_PIXELS, LEAST_TILES, LEAST_BANDS, LEAST_PAIRS = 400, 3, 2, 4
"""Fewest pixels and tiles of a band; fewest bands, to separate a from b; fewest pairs that show luma reduction.

Fewer pairs are resampled tile by tile.
"""
MODEL_ERRORS = (0.03, 0.02)
"""Chosen errors of the model, in addition to sampling: of logarithms of standard deviations, and of correlations."""
START = (0.0026, 7e-5, 2.0, 0.5)
"""First a and b for light from 0 to 1 (their size follows from the luma), chroma_nr², luma_nr² in luma variances."""
STEPS, RESAMPLES, ALIKE, LEAST_BLUR = 6, 200, 4.0, 0.3
"""Most steps; resamples; excess of a sum of squares, in mean squares, that does not exclude a choice (two standard
errors); least standard deviation of a Gaussian filter that changes a picture, pixels."""
NOISELESS, SEED = math.log(0.01), 2**31 - 1
"""Logarithm of the standard deviation, in codes, at or below which there is no noise; seed of the simulated noise."""
TO_YCC = YCBCR.T.round(4).astype(np.float32)  # the digits with which published fits were made
ALL = np.zeros((8, 5))
"""R, G, B, Y, Cb, Cr, and Y and Cb of the right neighbour, from R, G, B, and Y and Cb of the right neighbour."""
ALL[:3, :3], ALL[3:6, :3], ALL[6:, 3:] = np.eye(3), TO_YCC.T, np.eye(2)
RATIOS = {"correlation R-G": (0, 1), "correlation G-B": (1, 2), "lag 1 of Y": (3, 6), "lag 1 of Cb": (4, 7)}
"""Correlations of two rows of `ALL`."""


@dataclass(frozen=True)
class CameraFit:
    """Camera noise that `CameraNoise.fit` fitted to real pairs; its text is a table, real against model.

    Attributes
    ----------
    numbers : dict of Estimate
        ``a_dn`` and ``b_dn2`` in DN of the sensor, ``chroma_nr``, and ``luma_nr`` if it was fitted; each has ``value``,
        ``low`` and ``high`` (95 %). a and b are effective: they hold with the other overrides only.
    choice : tuple of str
        Curve, camera and demosaicking with the smallest residual.
    alike : tuple of str
        Other choices that the pairs do not exclude.
    resampled : str
        Number of the pairs or tiles whose bootstrap gives the intervals.
    table : dict of (Estimate, Estimate)
        Statistics of the real and of the simulated noise. Standard deviations are in 8-bit codes.
    overrides : tuple of str
        Hydra overrides of the fitted noise.
    options : dict
        Keyword arguments of `CameraNoise` in addition to the overrides.
    make : callable
        Class that `noise` makes an instance of.
    """

    numbers: Mapping[str, Estimate]
    choice: Combination
    alike: tuple[str, ...]
    resampled: str
    table: Mapping[str, tuple[Estimate, Estimate]]
    overrides: tuple[str, ...]
    options: Mapping[str, Any]
    make: Callable[..., Any]

    @property
    def settings(self) -> str:
        """Overrides with which a and b hold."""
        return " ".join(word for word in self.overrides if not word.startswith("noise"))

    @property
    def keywords(self) -> str:
        """Keyword arguments as text."""
        return ", ".join(f"{key}={value!r}" for key, value in self.options.items())

    def noise(self, seed: int = 0, **options: Any) -> Any:
        """Make the fitted `CameraNoise`.

        Parameters
        ----------
        seed : int
            Seed of the noise.
        **options : Any
            Other keyword arguments of `CameraNoise`, such as ``strength``.

        Returns
        -------
        CameraNoise
            Noise with the fitted numbers.
        """
        return self.make(self.overrides, seed=seed, **{**self.options, **options})

    def __str__(self) -> str:
        lines = [("", f"{' '.join(self.choice)}; 95 % intervals: bootstrap over {self.resampled}")]
        lines += [("", f"not excluded: {choice}") for choice in self.alike]
        lines += [(name, _text(number)) for name, number in self.numbers.items()]
        lines += [("", f"{'real':<26}model")]
        lines += [(name, f"{_text(real):<26}{_text(model)}") for name, (real, model) in self.table.items()]
        return "\n".join(f"{name:<24}{text}" if name or text[:4] == "real" else text for name, text in lines)


def _text(number: Estimate) -> str:
    value, low, high = (short_number(end, 3) for end in (number.value, number.low, number.high))
    return f"{value} ({low} to {high})"


def fit_yaml(fit: CameraFit, name: str, source: str) -> str:
    """Format a fit as a noise profile; ``source`` describes the pairs."""
    lines = [f"Fitted {MARK} --srgb to {source}.", f"a and b are effective: they hold with {fit.settings}."]
    lines += [f"CameraNoise needs also {fit.keywords}.", *(f"Not excluded: {choice}." for choice in fit.alike)]
    words = [word.removeprefix("noise.").replace("=", ": ") for word in fit.overrides if word.startswith("noise.")]
    head = [f"name: {name}", "units: dn", "black: subtracted", "negative_variance: refuse"]
    return "\n".join([*(f"# {line}" for line in lines), *head, *words]) + "\n"


def fit_json(fit: CameraFit) -> str:
    """Format numbers and table of a fit as a JSON list, one object per line."""
    named = dict(fit.numbers)
    for name, both in fit.table.items():
        named |= zip((f"{name} (real)", f"{name} (model)"), both, strict=True)
    ends = {name: [rounded(end) for end in (each.value, each.low, each.high)] for name, each in named.items()}
    lines = [json.dumps({"name": name, "value": value, "interval": pair}) for name, (value, *pair) in ends.items()]
    return "[\n" + ",\n".join(lines) + "\n]\n"


# -------------------------------------------------------------------------------------------------------------- moments


class Picture(NamedTuple):
    """A clean picture, its real noise, the cell (band of a tile) of each pixel, -1 if left out, and number of tiles."""

    clean: Srgb
    noise: Any
    cells: Any
    tiles: int

    def sums(self, noise: Any) -> Float:
        """Sums of 1, R, G, B, and Y and Cb of the right neighbour, and their products; [tiles, bands, 6, 6]."""
        used = self.cells >= 0
        values = [*noise[:, :-1][used].T, *(noise[:, 1:] @ TO_YCC[:, :2])[used].T]
        values, total = [np.ones_like(values[0]), *values], np.zeros((6, 6, self.tiles * BANDS))
        for i, j in itertools.combinations_with_replacement(range(6), 2):
            total[i, j] = total[j, i] = np.bincount(self.cells[used], values[i] * values[j], total.shape[2])
        return np.moveaxis(total.reshape(6, 6, self.tiles, BANDS), (0, 1), (2, 3))


def read_pictures(pairs: Iterable[tuple[ArrayLike, ArrayLike]]) -> list[Picture]:
    """Check the pairs and cut them to the middle, each when it is read: many pairs of full size exceed the memory."""
    lengths, cut = list[int](), list[tuple[Srgb, Srgb]]()
    for number, pair in enumerate(pairs):
        lengths.append(len(pair))
        if len(pair) == 2:
            cut.append(_checked(number, *pair))
    if not lengths or set(lengths) != {2}:
        problem = f"lengths of the pairs are {', '.join(map(str, lengths))}" if lengths else "no pair"
        raise ConfigError(f"CameraNoise.fit: pairs: {problem}; expected a list of pairs [(noisy, clean), ...]")
    side = math.isqrt(PIXELS // len(cut))
    return [_picture(*pair, side) for pair in cut]


def _checked(number: int, noisy: ArrayLike, clean: ArrayLike) -> tuple[Srgb, Srgb]:
    """Check a pair, and cut it evenly to the size of a single pair, so that its middle stays; ConfigError."""
    both = array_pixels(noisy), array_pixels(clean)
    kinds = [f"{picture.dtype} {list(picture.shape)}" for picture in both]
    if kinds[0] != kinds[1] or np.array_equal(*both):
        problem = f"noisy is {kinds[0]}, clean {kinds[1]}" if kinds[0] != kinds[1] else "noisy equals clean"
        expected = "expected a noisy and a clean picture of one scene, shape and dtype"
        raise ConfigError(f"CameraNoise.fit: pairs[{number}]: {problem}; {expected}")
    y, x = (max(length - math.isqrt(PIXELS), 0) // 2 for length in both[0].shape[:2])
    cut_noisy, cut_clean = (picture[y : len(picture) - y, x : picture.shape[1] - x].copy() for picture in both)
    return cut_noisy, cut_clean


def _picture(noisy: Srgb, clean: Srgb, side: int) -> Picture:
    """Cut a pair to the middle, and find the cell of each pixel."""
    y, x = (max(length - side, 0) // 2 for length in clean.shape[:2])
    noisy, clean = (array_pixels(picture[y : y + side, x : x + side]) for picture in (noisy, clean))
    codes: Any = clean * np.float32(255 / last_code(clean))
    used = ((codes >= DARKEST) & (codes <= BRIGHTEST)).all(axis=2)
    rows, columns = (np.arange(length) // TILE for length in clean.shape[:2])
    tiles = rows[:, None] * (columns[-1] + 1) + columns
    cells = np.where(used, tiles * BANDS + (codes @ TO_YCC[:, 0] / BAND).astype(int), -1)[:, :-1]
    cells[~used[:, 1:]] = -1  # the neighbour is left out
    return Picture(clean, _noise(noisy, clean), cells, int(tiles.max()) + 1)


def _noise(noisy: Srgb, clean: Srgb) -> Any:
    """Noise in 8-bit codes, float32."""
    return (noisy.astype(np.float32) - clean) * np.float32(255 / last_code(clean))


def statistics(sums: Float) -> Float:
    """Logarithms of the standard deviations of luma and of chroma by band, and `RATIOS`; NaN without noise."""
    count = sums[..., :1, :1]
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = sums / count
        about = ALL @ (mean[..., 1:, 1:] - mean[..., 1:, :1] * mean[..., :1, 1:]) @ ALL.T
        stds = [np.log(about[..., 3, 3]) / 2, np.log(about[..., 4, 4] + about[..., 5, 5]) / 2]
        total = np.nansum(about * count, axis=-3)
        ratios = [total[..., i, j] / np.sqrt(total[..., i, i] * total[..., j, j]) for i, j in RATIOS.values()]
    values = np.concatenate([*stds, np.stack(ratios, axis=-1)], axis=-1)
    return np.where(np.isfinite(values), values, np.nan)


def _resampled(sums: Float, tiles: Sequence[int]) -> Float:
    """Statistics of resamples of units that have some tiles each."""
    units = len(tiles)
    draws = np.random.default_rng(0).multinomial(units, np.full(units, 1 / units), RESAMPLES)
    return statistics(np.tensordot(np.repeat(draws, tiles, axis=1), sums, 1))


# ------------------------------------------------------------------------------------------------------------------ fit


class Candidate(NamedTuple):
    """Sum of squares of a choice, fitted parameters, and the matrix from residuals to changes of the parameters."""

    square: float
    choice: Combination
    numbers: Float
    inverse: Float


@dataclass(frozen=True)
class Problem:
    """Moments of the real noise, the statistics that are fitted, their errors, first parameters, and the simulation."""

    sums: Float
    kept: Any
    errors: Float
    start: Float
    simulated: Callable[[Combination, Float], Float]

    def fit(self, choice: Combination, start: Float) -> Candidate:
        """Fit the parameters of a choice by Gauss-Newton steps."""
        from scipy.optimize import nnls  # takes long to import

        target = statistics(self.sums.sum(axis=0))[self.kept]

        def residual(numbers: Float) -> Float:
            model = statistics(self.simulated(choice, numbers).sum(axis=0))[self.kept]
            model = np.nan_to_num(model, nan=NOISELESS)
            return np.asarray((model - target) / self.errors)

        start = np.maximum(start, 1e-3 * self.start)  # what another choice set to 0 has no slope
        levels = (len(target) - len(RATIOS)) // 2
        numbers = np.r_[start[:2] * np.exp(-2 * np.median((residual(start) * self.errors)[:levels])), start[2:]]
        scale, value = np.r_[numbers[:2], self.start[2:]], residual(numbers)
        for _ in range(STEPS):
            square, widths = float(value @ value), 0.1 * (numbers + scale)
            slopes = np.transpose([residual(numbers + width) - value for width in np.diag(widths)])
            aim = nnls(slopes, slopes @ (numbers / widths) - value)[0] * widths
            trials = (numbers + share * (aim - numbers) for share in (1.0, 0.3))
            better = ((trial, new) for trial in trials if (new := residual(trial)) @ new < square)
            numbers, value = next(better, (numbers, value))
            if value @ value > 0.98 * square:
                break
        return Candidate(float(value @ value), choice, numbers, widths[:, None] * np.linalg.pinv(slopes))


def fit_pairs(
    make: Callable[..., Any], pairs: Iterable[tuple[ArrayLike, ArrayLike]], config: Sequence[str], **options: Any
) -> CameraFit:
    """Fit the noise that ``make`` makes of a config and keyword arguments; see `CameraNoise.fit`."""
    require("scipy", "CameraNoise.fit needs scipy", "calibrate")
    if isinstance(config, str | Config | Mapping):
        raise ConfigError(f"CameraNoise.fit: config is a {type(config).__name__}; expected a list of overrides")
    given = [word for word in config if word.lstrip("+~").startswith("noise")] + [*(FITTED & set(options))]
    if given:
        raise ConfigError(f"CameraNoise.fit: {', '.join(given)}: is fitted; expected other settings; leave it out")
    curves, cameras = ([w for w in config if w.startswith(key)] or tried for key, tried in TRIED.items())
    sensor, pictures = load_config(config).sensor, read_pictures(pairs)
    levels = [f"noise.{name}={getattr(sensor, name)}" for name in ("bits", "black_level_dn", "white_level_dn")]
    shared = [*(w for w in config if w not in (*curves, *cameras)), "noise=heteroscedastic", *levels]

    @functools.cache
    def config_of(isp: str, camera: str) -> Config:
        return load_config([*shared, "noise.a=1", "noise.b=1", isp, camera])

    def simulated(choice: Combination, numbers: Float) -> Float:
        config, (a, b, *squares) = config_of(*choice[:2]), numbers.tolist()
        reduction = dict(zip(NUMBERS[2:], map(math.sqrt, squares), strict=False))
        config = replace(config, noise=replace(config.noise, a=a, b=b))
        model = make(config, demosaic=choice[2].removeprefix("demosaic="), seed=SEED, **options, **reduction)
        made = (model(picture.clean, index=index) for index, picture in enumerate(pictures))
        noises = (_noise(noisy, clean) for clean, noisy in made)
        return np.concatenate([picture.sums(noise) for picture, noise in zip(pictures, noises, strict=True)])

    span_dn = sensor.white_level_dn - sensor.black_level_dn
    problem = _problem(simulated, pictures, np.array([span_dn, span_dn**2]))
    demosaics = [f"demosaic={name}" for name in DEMOSAICS]
    fits = [problem.fit(choice, problem.start) for choice in itertools.product(curves, cameras[:1], demosaics)]
    _, (isp, _, demosaic), start, _ = min(fits)
    fits += [problem.fit((isp, camera, demosaic), start) for camera in cameras[1:]]
    best, *others = sorted(fits)
    margin = ALIKE * max(1.0, best.square / len(problem.errors))
    alike = tuple(" ".join(other.choice) for other in others if other.square < best.square + margin)
    numbers, table = _intervals(problem, pictures, best)
    overrides = (*shared, *(f"noise.{key[0]}={rounded(numbers[key].value)}" for key in NUMBERS[:2]), *best.choice[:2])
    options |= {"demosaic": best.choice[2].removeprefix("demosaic=")} | {
        key: rounded(numbers[key].value, 4) for key in list(numbers)[2:]
    }
    units = f"{len(pictures)} pairs" if len(pictures) >= LEAST_PAIRS else f"{len(problem.sums)} tiles"
    return CameraFit(numbers, best.choice, alike, units, table, overrides, options, make)


def _problem(simulated: Callable[[Combination, Float], Float], pictures: Sequence[Picture], units_dn: Float) -> Problem:
    """Statistics of the real noise and their errors; ConfigError if they do not show a and b."""
    sums = np.concatenate([picture.sums(picture.noise) for picture in pictures])
    count, target = sums[..., 0, 0], statistics(sums.sum(axis=0))
    used = ((count > 0).sum(axis=0) >= LEAST_TILES) & (count.sum(axis=0) >= LEAST_PIXELS)
    kept = np.r_[used, used, np.ones(len(RATIOS), bool)]
    has_noise = (target[kept][: -len(RATIOS)] > NOISELESS).all()  # also chroma, which gray pictures lack
    if used.sum() < LEAST_BANDS or not has_noise:
        levels = ", ".join(f"{BAND * band} to {BAND * (band + 1) - 1}" for band in np.flatnonzero(used)) or "none"
        raise ConfigError(
            f"CameraNoise.fit: pairs: levels of luma with enough pixels and noise: {levels}; expected {LEAST_BANDS} "
            f"bands or more, with noise in luma and chroma, all channels from {DARKEST} to {BRIGHTEST}; add larger, "
            "darker or brighter pictures"
        )
    sampling = np.nanstd(_resampled(sums, [1] * len(sums))[:, kept], axis=0)
    errors = np.hypot(sampling, np.repeat(MODEL_ERRORS, (2 * used.sum(), len(RATIOS))))
    start = START * np.r_[units_dn, 1, np.exp(2 * np.nanmedian(target[:BANDS]))]
    return Problem(sums, kept, errors, start[: 4 if len(pictures) >= LEAST_PAIRS else 3], simulated)


def _intervals(
    problem: Problem, pictures: Sequence[Picture], best: Candidate
) -> tuple[dict[str, Estimate], dict[str, tuple[Estimate, Estimate]]]:
    """Fitted numbers and the table, with 95 % intervals by bootstrap."""
    single = [1] * len(problem.sums)
    tiles = [picture.tiles for picture in pictures] if len(pictures) >= LEAST_PAIRS else single
    count = len(tiles) - 1
    # Student's t by its expansion, and the spread of resamples, which is too small by (n - 1)/n
    wide = (1.96 + 2.37 / count + 2.82 / count**2) * math.sqrt(1 + 1 / count) * np.c_[[0, -1, 1]]
    bands = BAND * np.flatnonzero(problem.kept[:BANDS])
    names = [f"{kind} std, level {band}" for kind in ("luma", "chroma") for band in bands]
    columns, resamples = [], []
    for sums in (problem.sums, problem.simulated(best.choice, best.numbers)):
        by_unit, by_tile = (_resampled(sums, units)[:, problem.kept] for units in (tiles, single))
        resamples.append(by_unit)
        spread = np.fmax(np.nanstd(by_unit, axis=0), np.nanstd(by_tile, axis=0))  # a band may be in one pair only
        ends = statistics(sums.sum(axis=0))[problem.kept] + wide * spread
        ends[:, : len(names)] = np.exp(ends[:, : len(names)])
        columns.append(map(Estimate, *ends.tolist()))
    changes = np.nan_to_num((resamples[1] - resamples[0]) / problem.errors) @ best.inverse.T
    ends = (best.numbers + wide * changes.std(axis=0)).clip(0)
    ends[:, 2:] **= 0.5
    ends[:, 2] *= ends[:, 2] >= LEAST_BLUR
    numbers = dict(zip(NUMBERS, map(Estimate, *ends.tolist()), strict=False))
    return numbers, dict(zip([*names, *RATIOS], zip(*columns, strict=True), strict=True))
