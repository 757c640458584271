"""Camera noise of sRGB pictures: the pair of a picture, developed."""

from __future__ import annotations

import itertools
import multiprocessing
import pickle
import warnings
from typing import Any

import cv2
import numpy as np
import pytest

import unprocess_gen as ug
from unprocess_gen.picture_isp import SAMPLINGS
from unprocess_gen.simulation.pair import make_pair

CAMERAS = ("sony_a7r", "olympus_em10", "sony_rx100", "nexus_6p")
CELL = 6


def cells(colours: np.ndarray, dtype: type) -> np.ndarray:
    """Return a picture with a flat square for each colour."""
    return np.repeat(np.repeat(colours, CELL, axis=0), CELL, axis=1).astype(dtype)


def all_codes(top: int, count: int, seed: int = 0) -> np.ndarray:
    """Return colours [n, n, 3] with every code of 8 bits in each channel, greys and primaries among them."""
    colours = np.random.default_rng(seed).integers(0, top + 1, (count, count, 3))
    colours[:16, :16] = np.arange(256).reshape(16, 16, 1) * top // 255
    for channel in range(3):
        colours[16:32, 16 * channel : 16 * channel + 16] = 0
        colours[16:32, 16 * channel : 16 * channel + 16, channel] = colours[:16, :16, 0]
    return colours


def largest_error(overrides: list[str], dtype: type, count: int, demosaic: str = "malvar") -> int:
    """Return the largest difference of codes in the middle of flat squares that no clip touches."""
    picture, overrides = cells(all_codes(np.iinfo(dtype).max, count), dtype), [*overrides, "noise=none"]
    clean, noisy = ug.CameraNoise(overrides, demosaic)(picture, index=3)
    light = make_pair(
        picture, ug.plan_image(picture, ug.load_config(overrides), key=3).replace(clean_dtype="float32")
    ).clean
    clipped = cv2.dilate(((light >= 1) | (light <= 0)).astype(np.uint8), np.ones((5, 5))) > 0
    middle = np.zeros((CELL, CELL), bool)
    middle[2:4, 2:4] = True
    kept = np.tile(middle, (count, count)) & ~clipped
    assert kept.sum() > count * count
    return max(int(np.abs(frame.astype(int) - picture)[kept].max()) for frame in (clean, noisy))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("isp", ["smoothstep_gamma22", "srgb"])
def test_codes_of_flat_colours_return_without_noise(isp: str, dtype: type) -> None:
    assert largest_error([f"isp={isp}"], dtype, 48) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize(
    "gains", ["brooks2019", "paper_max", "paper_min", "gains.highlight=gray_mean", "gains.highlight=none"]
)
@pytest.mark.parametrize("isp", ["smoothstep_gamma22", "srgb", "gamma22", "linear"])
def test_codes_return_for_every_camera(camera: str, gains: str, isp: str) -> None:
    chosen = gains if "=" in gains else f"gains={gains}"
    dtypes = (np.uint8,) if isp == "gamma22" else (np.uint8, np.uint16)  # float32 does not resolve gamma22's 16 bits
    for dtype, pattern in itertools.product(dtypes, ("RGGB", "GBRG")):
        assert largest_error([f"camera={camera}", chosen, f"isp={isp}", f"sensor.pattern={pattern}"], dtype, 256) <= 1


ALL_GAINS = ("brooks2019", "paper_literal", "paper_min", "paper_max", "fig6_top", "fig6_bottom", "unity", "by_light")


@pytest.mark.parametrize("gains", ALL_GAINS)
@pytest.mark.parametrize("camera", CAMERAS)
def test_codes_return_for_all_gains(camera: str, gains: str) -> None:
    assert largest_error([f"camera={camera}", f"gains={gains}"], np.uint8, 48) <= 1


def test_negative_light_of_a_colour_is_black() -> None:
    blue, settings = np.full((8, 8, 3), (20, 40, 184), np.uint8), ["camera=nexus_6p", "gains=paper_max", "noise=none"]
    assert ug.CameraNoise(settings)(blue, 1)[0][4, 4].tolist() != [20, 40, 184]
    pair = ug.make_pair(blue, ug.load_config(settings), seed=0, key=1)
    assert pair.counts.clean_clipped_low == 16
    assert (pair.clean[::2, ::2] == pair.row["black_level_dn"]).all()  # red sites


def test_every_demosaicking_restores_flat_colours() -> None:
    picture = np.full((12, 15, 3), (40, 130, 90), np.uint8)
    for demosaic, pattern in itertools.product(("malvar", "bilinear"), ("RGGB", "BGGR", "GRBG", "GBRG")):
        clean, _ = ug.CameraNoise([f"sensor.pattern={pattern}", "noise=none"], demosaic)(picture, index=1)
        assert np.abs(clean.astype(int) - picture).max() <= 1, (demosaic, pattern)


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    ramp = np.linspace(20, 220, 97)[None, :, None] + np.linspace(0, 30, 65)[:, None, None]
    return (ramp * [1, 0.8, 0.6]).astype(np.uint8)


def test_pictures_are_pure_in_seed_and_index(picture: np.ndarray) -> None:
    noise = ug.CameraNoise(["noise=imx385_iso12800"], seed=5)
    first = noise(picture, index=7)
    again = pickle.loads(pickle.dumps(noise))(picture, index=7)
    assert all((a == b).all() for a, b in zip(first, again, strict=True))
    others = [ug.CameraNoise(["noise=imx385_iso12800"], seed=6)(picture, index=7), noise(picture, index=8)]
    assert all((first[1] != other[1]).any() for other in others)


def test_calls_without_index_count(picture: np.ndarray) -> None:
    noise = ug.CameraNoise(["noise=imx385_iso12800"])
    calls = [noise(picture)[1] for _ in range(2)]
    assert all((call == noise(picture, index=n)[1]).all() for n, call in enumerate(calls))


def warnings_in_a_fork(noise: ug.CameraNoise, picture: np.ndarray, index: int | None) -> int:
    """Number of warnings of two calls in a fork, like a worker of a DataLoader in one epoch."""
    context = multiprocessing.get_context("fork")
    counts: Any = context.SimpleQueue()

    def work() -> None:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            noise(picture, index)
            noise(picture, index)
        counts.put(sum("pass the index" in str(warning.message) for warning in caught))

    process = context.Process(target=work)
    process.start()
    process.join()
    return int(counts.get())


@pytest.mark.parametrize(("index", "expected"), [(None, [1, 0]), (3, [0, 0])])
def test_forks_without_index_warn_once(index: int | None, expected: list[int], picture: np.ndarray) -> None:
    noise = ug.CameraNoise(["noise=imx385_iso12800"])
    noise(picture)  # in the process that made it, calls are counted
    assert [warnings_in_a_fork(noise, picture, index) for _ in range(2)] == expected


def test_raw_pair_is_that_of_make_pair(picture: np.ndarray) -> None:
    config = ug.load_config(["noise=imx385_iso12800"])
    raw = ug.make_pair(picture, config, seed=2, key=9)
    noisy = ug.CameraNoise(config, seed=2)(picture, index=9)[1]
    difference = noisy.astype(float) - ug.develop(raw.noisy, raw.row)
    assert np.abs(difference).max() <= 1


@pytest.mark.parametrize(
    ("overrides", "shape", "dtype"),
    [(["noise=imx385_iso12800"], (65, 97), np.uint8), (["noise=sony_a7s2", "scene=low_light"], (2, 3), np.uint16)],
)
def test_pictures_keep_shape_and_dtype(overrides: list[str], shape: tuple[int, int], dtype: type) -> None:
    flat = np.full((*shape, 3), np.iinfo(dtype).max // 3, dtype)
    clean, noisy = ug.CameraNoise(overrides)(flat)
    assert clean.shape == noisy.shape == flat.shape
    assert clean.dtype == noisy.dtype == flat.dtype
    assert (noisy != clean).any()


def test_neighbours_correlate_after_demosaicking() -> None:
    flat = np.full((256, 256, 3), 128, np.uint8)
    clean, noisy = ug.CameraNoise(["noise=imx385_iso12800"])(flat, index=0)
    noise = noisy[..., 1].astype(float) - clean[..., 1]
    lag = [np.corrcoef(noise[:, :-n].ravel(), noise[:, n:].ravel())[0, 1] for n in (1, 8)]
    assert lag[0] > 0.2
    assert abs(lag[1]) < 0.02  # three standard errors are 0.012


def test_clean_can_be_the_picture_and_noisy_a_jpeg(picture: np.ndarray) -> None:
    clean, noisy = ug.CameraNoise(["noise=imx385_iso12800"], clean="source")(picture, index=1)
    assert (clean == picture).all()
    assert not np.shares_memory(clean, picture)
    sizes = [ug.CameraNoise(["noise=imx385_iso12800"], jpeg=quality)(picture, index=1)[1] for quality in (5, 100)]
    errors = [np.abs(size.astype(int) - noisy).mean() for size in sizes]
    assert errors[0] > 1.5 * errors[1] > 0


ISO_12800 = ["noise=imx385_iso12800", "camera=sony_a7r"]


def test_strength_multiplies_the_noise() -> None:
    grey, linear = np.full((32, 33, 3), 30000, np.uint16), ["noise=imx385_iso1600", "camera=sony_a7r", "isp=linear"]
    once, half, never = (ug.CameraNoise(linear, strength=factor)(grey, 1) for factor in (1, 0.5, 0))
    assert (once[0] == half[0]).all()
    assert (never[0] == never[1]).all()
    difference = 2 * (half[1] - once[0].astype(float)) - (once[1] - once[0].astype(float))
    assert np.abs(difference).max() <= 2  # codes are rounded


def test_drawn_options_are_pure_in_seed_and_index(picture: np.ndarray) -> None:
    drawn = {"strength": ["log_uniform", 0.5, 2], "jpeg": ["uniform", 70, 95]}
    noise = ug.CameraNoise(ISO_12800, seed=3, **drawn)
    copy = pickle.loads(pickle.dumps(noise))
    assert (copy(picture, 7)[1] == ug.CameraNoise(ISO_12800, seed=3, **noise.drawn(7))(picture, 7)[1]).all()
    values = [noise.drawn(index) for index in range(400)]
    exponents = np.log2([value["strength"] for value in values])
    assert -1 <= exponents.min() < exponents.max() <= 1
    assert abs(exponents.mean()) < 3 * 2 / np.sqrt(12 * 400)
    assert {value["jpeg"] for value in values} == set(range(70, 96))
    assert noise.drawn(7) != ug.CameraNoise(ISO_12800, seed=4, **drawn).drawn(7)
    assert ug.CameraNoise(jpeg=80).drawn(0) == {"strength": 1, "jpeg": 80}


GREYS = [2, 10, 40, 90, 150, 200, 235, 250]
COLOURS = np.array([*((grey,) * 3 for grey in GREYS), (208, 171, 60), (65, 157, 195)], np.uint16) * 257


def draws_of(overrides: list[str], picture: np.ndarray, count: int, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    """Noisy pictures and their mean picture, in 8-bit codes."""
    noise = ug.CameraNoise(overrides, clean="mean", **options)
    pairs = [noise(picture, index) for index in range(count)]
    return np.stack([noisy for _, noisy in pairs]) / 257, pairs[0][0] / 257


@pytest.mark.parametrize(
    ("overrides", "options"),
    [
        (["noise=imx385_iso12800"], {}),
        (["noise=imx385_iso12800", "isp=srgb"], {"demosaic": "bilinear"}),
        (["noise=imx385_iso6400", "isp=gamma22", "gains.highlight=none"], {"strength": 2}),
        (["noise=imx385_iso12800", "sensor.pattern=MONO", "sensor.saturated=white"], {"strength": 0.5}),
        (["noise=sony_a7s2", "scene=low_light", "scene.iso=25600", "scene.exposure_ratio=4"], {}),
    ],
)
def test_mean_picture_is_the_mean_of_noisy_pictures(overrides: list[str], options: dict) -> None:
    picture = np.repeat(np.repeat(COLOURS[None], 40, axis=0), 32, axis=1)
    noisy, mean = draws_of(["camera=nexus_6p", "gains=fixed", *overrides], picture, 40, **options)
    inner = [cells.reshape(*cells.shape[:-2], len(COLOURS), 32, 3)[..., 4:-4, :, 4:-4, :] for cells in (noisy, mean)]
    averages = inner[0].mean(axis=(1, 3))
    error = averages.mean(axis=0) - inner[1].mean(axis=(0, 2))
    allowed = 4 * averages.std(axis=0) / np.sqrt(len(noisy)) + 0.2  # skewness of counts, interpolation
    assert (np.abs(error) < allowed).all()
    developed = ug.CameraNoise(["camera=nexus_6p", "gains=fixed", *overrides], **options)(picture, 0)[0] / 257
    assert np.abs(averages.mean(axis=0)[0] - developed[20, 16]).max() > 1  # so that the test can fail


def test_mean_picture_holds_at_edges() -> None:
    picture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 65536, (96, 96, 3)).astype(np.uint16), (0, 0), 1.0)
    noisy, mean = draws_of([*ISO_12800, "gains=fixed"], picture, 60)
    squared = (noisy.mean(axis=0) - mean)[2:-2, 2:-2] ** 2 / (noisy.var(axis=0)[2:-2, 2:-2] / 59)
    # 59 degrees of freedom: the mean of t² is 59 / 57; of 25,392 values at least a tenth are independent
    assert abs(np.minimum(squared, 25).mean() - 59 / 57) < 4 * np.sqrt(2 / 2539)


@pytest.mark.parametrize("options", [{"chroma_nr": 2}, {"luma_nr": 20}])
def test_mean_picture_has_the_noise_reduction(options: dict) -> None:
    picture = np.repeat(np.repeat(COLOURS[None, 3:6], 40, axis=0), 32, axis=1)
    noisy, mean = draws_of(["camera=nexus_6p", "gains=fixed", "noise=imx385_iso3200"], picture, 40, **options)
    averages = noisy.reshape(40, 40, 3, 32, 3)[:, 8:-8, :, 8:-8].mean(axis=(1, 3))
    allowed = 4 * averages.std(axis=0) / np.sqrt(40) + 0.3
    assert (np.abs(averages.mean(axis=0) - mean[20, 16::32]) < allowed).all()


def test_mean_picture_without_noise_is_the_noisy_one(picture: np.ndarray) -> None:
    clean, noisy = ug.CameraNoise(["noise=none"], clean="mean")(picture, 1)
    assert np.abs(clean.astype(int) - noisy).max() <= 1


def test_mean_picture_has_fixed_patterns_where_clean_frames_have() -> None:
    grey = np.full((64, 64, 3), 128, np.uint8)
    prnu = ["noise=sony_a7s2", "noise.prnu_std=0.05", "effects.prnu=on"]
    deviations = [
        ug.CameraNoise([*prnu, f"clean.includes_fixed_pattern={included}"], clean="mean")(grey, 1)[0].std(axis=(0, 1))
        for included in ("false", "true")
    ]
    assert (deviations[0] == 0).all()
    assert (deviations[1] > 1).all()


def luma_and_chroma(picture: np.ndarray) -> list[np.ndarray]:
    """Y and Cb of codes, unrounded."""
    return [picture @ np.array(weights) for weights in ([0.299, 0.587, 0.114], [-0.168736, -0.331264, 0.5])]


def test_noise_reduction_acts_on_its_channels_of_noisy_pictures() -> None:
    edge = np.full((64, 64, 3), 60, np.uint8)
    edge[:, 32:] = 180
    clean, noisy = ug.CameraNoise(ISO_12800)(edge, 1)
    y, cb = luma_and_chroma(noisy)
    for options in ({"chroma_nr": 2.0}, {"luma_nr": 30}):
        same, reduced = ug.CameraNoise(ISO_12800, **options)(edge, 1)
        assert (same == clean).all()
        new_y, new_cb = luma_and_chroma(reduced)
        inside = np.abs(reduced.astype(int) - 127).max(axis=2) < 127  # codes that no limit touches
        if "chroma_nr" in options:
            blurred = cv2.GaussianBlur(cb, (0, 0), 2.0)
            assert np.abs(new_y - y)[inside].max() < 1  # rounding, twice
            assert np.abs(new_cb - blurred)[inside].max() < 1
        else:
            assert np.abs(new_cb - cb)[inside].max() < 1
            assert new_y[:, :24].std() < 0.6 * y[:, :24].std()
            assert new_y[:, 33].mean() - new_y[:, 30].mean() > 0.9 * (y[:, 33].mean() - y[:, 30].mean())


def test_chroma_sampling_of_jpeg() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (32, 32, 3)).astype(np.uint8)
    noise = {sampling: ug.CameraNoise(jpeg=90, jpeg_sampling=sampling)(picture, 1)[1] for sampling in SAMPLINGS}
    assert (noise["4:2:0"] == ug.CameraNoise(jpeg=90)(picture, 1)[1]).all()
    uncompressed = ug.CameraNoise()(picture, 1)[1].astype(int)
    errors = [np.abs(noise[sampling] - uncompressed).mean() for sampling in ("4:2:0", "4:2:2", "4:4:4")]
    assert errors[0] > 1.1 * errors[1] > 1.1**2 * errors[2]


@pytest.mark.parametrize("shape", [(2, 2), (2, 9), (3, 300)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_flat_colours_return_from_noise_reduction(shape: tuple[int, int], dtype: type) -> None:
    flat = np.full((*shape, 3), np.array([0.2, 0.5, 0.4]) * np.iinfo(dtype).max, dtype)
    noisy = ug.CameraNoise(["noise=none"], chroma_nr=100, luma_nr=255)(flat, 1)[1]
    assert np.abs(noisy.astype(int) - flat).max() <= 1


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ({"demosaic": "ahd"}, "CameraNoise: demosaic=ahd: not allowed; expected one of malvar, bilinear"),
        ({"clean": "none"}, "clean='none': unknown; expected one of developed, source, mean"),
        ({"jpeg": 0}, "CameraNoise: jpeg=0: expected 1 to 100"),
        ({"jpeg": 75.5}, "CameraNoise: jpeg=75.5: no integer; expected 1 to 100 or a distribution"),
        ({"jpeg": True}, "jpeg=true: expected a finite number or a distribution: [uniform, lowest, highest]"),
        ({"jpeg": ["uniform", 95, 70]}, "jpeg=[uniform, 95, 70]: expected the lowest value below the highest"),
        ({"jpeg_sampling": "4:1:1"}, "jpeg_sampling=4:1:1: not allowed; expected one of 4:2:0, 4:2:2, 4:4:4"),
        ({"strength": -1}, "strength=-1: expected 0 to 100"),
        (
            {"strength": ["normal", 1, 2]},
            "expected a finite number or a distribution: [uniform, lowest, highest]; [log",
        ),
        ({"chroma_nr": -0.5}, "chroma_nr=-0.5: not allowed; expected 0 to 100"),
        ({"luma_nr": "weak"}, "luma_nr=weak: not allowed; expected 0 to 255"),
        ({"config": "noise=none"}, "expected a list: ['noise=none']"),
        ({"config": ["noise=loud"]}, "noise=loud"),
        ({"config": ["seed=3"]}, "pass seed=3 to CameraNoise"),
        ({"config": ["source.downscale=2"]}, "source.downscale=2: CameraNoise keeps the geometry"),
        ({"config": ["output.layout=packed"]}, "output.layout=packed: CameraNoise"),
        ({"config": ["noise.draws=2"]}, "noise.draws=2: 2 pairs of an image"),
        ({"seed": -1}, "seed=-1"),
        ({"config": ["gains.highlight=gray_mean"], "clean": "mean"}, "gains.highlight=gray_mean: mixes the channels'"),
    ],
)
def test_wrong_arguments_are_refused(arguments: dict, problem: str) -> None:
    with pytest.raises(ug.ConfigError) as error:
        ug.CameraNoise(**arguments)
    assert problem in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("wrong", "kind", "problem"),
    [
        (np.zeros((8, 8), np.uint8), ValueError, "expected uint8 or uint16 [H, W, 3]"),
        (np.zeros((1, 8, 3), np.uint8), ValueError, "at least 2 x 2"),
        (np.zeros((8, 8, 3), np.uint16), ValueError, "expected uint8 with jpeg=90"),
    ],
)
def test_wrong_pictures_are_refused(wrong: np.ndarray, kind: type[Exception], problem: str) -> None:
    with pytest.raises(kind) as error:
        ug.CameraNoise(jpeg=90)(wrong)
    assert problem in str(error.value)
