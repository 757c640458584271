"""Raw sources pass through the pipeline: closed loop, law of noise, live pairs, replay, and refused settings."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.commands import RunMain

import unprocess_gen as ug
from unprocess_gen.core.errors import ConfigError, SourceChangedError
from unprocess_gen.core.source import Source
from unprocess_gen.dataset import dng
from unprocess_gen.pipeline.pairs import PairSettings, plan_pixels, targets_of
from unprocess_gen.pipeline.replay import PairRegenerator
from unprocess_gen.simulation.frames import Pair, Patch
from unprocess_gen.simulation.pair import reference_pair
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference.cfa import mosaic
from unprocess_gen.simulation.reference.electrons import noise_variance
from unprocess_gen.simulation.reference.sensor import in_dn
from unprocess_gen.sources.image.decode import Photograph
from unprocess_gen.sources.raw.frames import read_raw_source

SENSORS = [("BGGR", 12, 241), ("GBRG", 16, 4097)]


def raw_config(tmp_path: Path, *overrides: str) -> Any:
    return ug.load_config(["source.kind=raw", f"source.root={tmp_path}", *overrides])


def simulated(config: Any, photograph: Photograph) -> tuple[Pair, Plan]:
    image = plan_pixels(PairSettings(config), photograph, Source(0, "a", "a", 1), "00" * 32)
    (_, plan, pair), *_ = image.pairs()
    return pair, plan


def mosaics(config: Any, dn: np.ndarray) -> Photograph:
    """Decode a mosaic as the NPY file of a raw source."""
    return Photograph(*_read(config, dn))


def by_site(photograph: Photograph) -> Photograph:
    """Return a mosaic with a black level of its own for each plane, as the tags of a DNG state it."""
    assert photograph.raw is not None
    source = photograph.raw.source.replace(raw_black_dn=(500.0, 509.0, 511.0, 523.0))
    return replace(photograph, raw=photograph.raw._replace(source=source))


def _read(config: Any, dn: np.ndarray) -> tuple[Any, ...]:
    import io

    file = io.BytesIO()
    np.save(file, dn)
    photograph = read_raw_source(config.source, file.getvalue(), "a.npy")
    return photograph.srgb, 1, photograph.raw


# ---------------------------------------------------------------------------------------------------------- closed loop


@pytest.mark.parametrize(("pattern", "bits", "black"), SENSORS)
def test_exported_clean_frames_keep_every_dn(tmp_path: Path, pattern: str, bits: int, black: int) -> None:
    levels = [f"sensor.black_level_dn={black}", f"sensor.white_level_dn={2**bits - 1}", f"sensor.bits={bits}"]
    config = ug.load_config([*levels, f"sensor.pattern={pattern}"])
    pair = ug.make_pair(np.random.default_rng(bits).integers(0, 256, (44, 61, 3)).astype(np.uint8), config)
    content = dng.encode(pair.clean, pair.row, "clean")
    own = raw_config(tmp_path)
    found, plan = simulated(own, read_raw_source(own.source, content, "a.dng"))
    assert (found.clean == pair.clean).all()
    assert (plan.sensor.pattern, plan.sensor.black_level_dn, plan.sensor.white_level_dn) == (
        pattern,
        black,
        2**bits - 1,
    )
    assert plan.camera.red_gain == pytest.approx(pair.row["red_gain"], rel=1e-8)
    recorded = [pair.row[f"rgb2cam_{i}{j}"] for i in range(3) for j in range(3)]
    assert plan.camera.rgb2cam == pytest.approx(recorded, abs=1e-7)


FIXED = ("noise=sony_a7s2", "noise.lens_shading=[-0.3,-0.1,0]", "noise.prnu_std=0.05", "noise.dsnu_std_e=3",
         "effects.lens_shading=on", "effects.prnu=on", "effects.dsnu=on", "clean.includes_fixed_pattern=true",
         "output.dtype=float32", "sensor.clip=none")  # fmt: skip


@pytest.mark.parametrize(
    ("noise", "shrink"),
    [((), 1), (("noise=sony_a7s2",), 2), (("output.dtype=float32", "noise.law=poisson"), 1), (FIXED, 1),
     (("noise=sony_a7s2", "effects.shot=off", "sensor.black_level_dn=1"), 1), (("sensor.clip=black",), 2)],
)  # fmt: skip
def test_kernels_equal_the_reference(tmp_path: Path, noise: tuple[str, ...], shrink: int) -> None:
    levels = "source.raw.black_dn=500", "source.raw.white_dn=16000", "source.raw.pattern=GRBG"
    overrides = *levels, f"source.shrink={shrink}", "scene.exposure_ratio=15", "sensor=generic_14bit", *noise
    config = raw_config(tmp_path, *overrides)
    dn = np.random.default_rng(5).integers(100, 16384, (36, 50)).astype(np.uint16)
    dn[:, ::3] = dn[:, ::3] // 16  # half of these sites are below black
    photograph = by_site(mosaics(config, dn))
    pair, plan = simulated(config, photograph)
    reference = reference_pair(photograph.srgb, plan)
    assert (pair.clean == reference.clean).all() and (pair.noisy == reference.noisy).all()
    assert pair.counts == reference.counts
    inside = (slice(10, 30), slice(14, 38)) if shrink == 1 else (slice(2, 12), slice(4, 20))
    crop = reference_pair(photograph.srgb[inside], plan, (inside[0].start, inside[1].start))
    assert (crop.clean == pair.clean[inside]).all()


def test_fast_frames_have_light_below_black(tmp_path: Path) -> None:
    config = raw_config(tmp_path, *LEVELS, *NOISE, "accuracy=fast", "scene.exposure_ratio=7")
    photograph = mosaics(config, np.random.default_rng(3).integers(0, 1100, (64, 90)).astype(np.uint16))
    pair, plan = simulated(config, photograph)
    reference = reference_pair(photograph.srgb, plan)
    assert np.abs(pair.clean.astype(int) - reference.clean).max() <= 1 and pair.counts.clean_clipped_low == 0
    assert np.abs(pair.noisy.astype(int) - reference.noisy).max() <= 1


def test_light_is_exact_before_the_exposure(tmp_path: Path) -> None:
    levels = "source.raw.black_dn=500", "source.raw.white_dn=16000", "source.raw.pattern=RGGB"
    scene = "scene.exposure_ratio=100", "output.clean_dtype=float32"
    config = raw_config(tmp_path, *levels, *scene)
    dn = np.random.default_rng(6).integers(400, 16384, (20, 20)).astype(np.uint16)
    pair, _ = simulated(config, by_site(mosaics(config, dn)))
    black = np.tile([[500.0, 509.0], [511.0, 523.0]], (10, 10))
    light = np.minimum((dn - black) / (16000 - black), 1) / 100
    assert np.abs(pair.clean - light).max() < 1e-9


# --------------------------------------------------------------------------------------------------------------- noise

LEVELS = ("source.raw.pattern=RGGB", "source.raw.black_dn=1000", "source.raw.white_dn=16000", "sensor=source")
NOISE = ("noise=heteroscedastic", "noise.a=4", "noise.b=90", "noise.units=dn", "noise.black=subtracted",
         "noise.bits=14", "noise.black_level_dn=1000", "noise.white_level_dn=16000")  # fmt: skip


DN = np.array([1200.0, 3000.0, 9000.0])[:, None]
"""Levels of the bands of a frame, [3, 1]."""
BAND = 256 * 256
"""Sites of a band."""


def variances(pair: Pair) -> np.ndarray:
    """Return the variance of the noisy frame in each band."""
    return pair.noisy.astype(float).reshape(len(DN), BAND).var(axis=1)


def test_noise_has_the_variance_of_its_profile(tmp_path: Path) -> None:
    config = raw_config(tmp_path, *LEVELS, *NOISE)
    frame = np.repeat(DN, BAND, axis=1).astype(np.uint16).reshape(-1, 256)
    pair, _ = simulated(config, mosaics(config, frame))
    assert (pair.clean == frame).all()
    wanted = 4 * (DN[:, 0] - 1000) + 90 + 1 / 12
    assert variances(pair) == pytest.approx(wanted, rel=5 * np.sqrt(2 / BAND))


def test_subtracting_own_noise_leaves_the_target_variance(tmp_path: Path) -> None:
    own = 1.5 * (DN - 1000) + 40
    frame = np.rint(DN + np.sqrt(own) * np.random.default_rng(1).standard_normal((3, BAND))).astype(np.uint16)
    settings = "source.raw.a_dn=1.5", "source.raw.b_dn2=40", "scene.exposure_ratio=2"
    for own_noise, share in (("keep", 1), ("subtract", 0)):
        config = raw_config(tmp_path, *LEVELS, *NOISE, *settings, f"source.own_noise={own_noise}")
        pair, plan = simulated(config, mosaics(config, frame.reshape(-1, 256)))
        assert (plan.source.own_a_dn, plan.source.own_b_dn2) == pytest.approx((0.75, 10.0))
        target = 4 * (DN - 1000) / 2 + 90
        assert variances(pair) == pytest.approx((target + share * own / 4)[:, 0], rel=0.02)


MODELS = {
    "two numbers": (NOISE, (4, 90)),
    "subtract": ((*NOISE, "source.own_noise=subtract"), (3, 50)),
    "poisson": ((*NOISE, "noise.law=poisson"), (4, 90)),
    "physical": (("noise=sony_a7s2", "scene.iso=6400", "noise.prnu_std=0.1", "effects.all=off", "effects.prnu=on",
                  "effects.shot=on", "effects.read=on"), None),
}  # fmt: skip
"""Settings of a noise model, and its variance line at exposure ratio 1."""


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("ratio", [1, 10])
@pytest.mark.parametrize("dtype", ["uint16", "float32"])
def test_noise_at_black_is_complete(tmp_path: Path, model: str, ratio: int, dtype: str) -> None:
    """Noise of a source, whose standard deviation at black is 6.3 DN, keeps its mean and its variance."""
    settings, line = MODELS[model]
    own = "source.raw.a_dn=1", "source.raw.b_dn2=40", f"scene.exposure_ratio={ratio}", f"output.dtype={dtype}"
    signal = np.array([0.0, 3.0, 400.0])[:, None]
    dn = np.rint(1000 + signal + np.sqrt(signal + 40) * np.random.default_rng(1).standard_normal((3, BAND)))
    config = raw_config(tmp_path, *LEVELS, *settings, *own)
    pair, plan = simulated(config, mosaics(config, dn.astype(np.uint16).reshape(-1, 256)))
    (a, b), u = plan.noise.variance_line, (dn - 1000) / ratio
    assert line is None or ratio > 1 or (a, b) == pytest.approx(line)
    clean, noisy = (in_dn(frame, (1000, 16000)).reshape(3, BAND) - 1000 for frame in (pair.clean, pair.noisy))
    prnu, rounding = plan.physics.prnu_std if plan.physics else 0, 0 if dtype == "float32" else 1 / 12
    variance = u.var(axis=1) + (a * np.maximum(u, 0) + (prnu * u) ** 2).mean(axis=1) + b + rounding
    assert np.abs(clean - u).max() <= (0.5 if rounding else 1e-3) and pair.counts.clean_clipped_low == 0
    assert (np.abs((noisy - u).mean(axis=1)) < 5 * np.sqrt(variance / BAND)).all()
    assert noisy.var(axis=1) == pytest.approx(variance, rel=5 * np.sqrt(2.2 / BAND))


def test_sites_of_noisier_sources_are_counted(tmp_path: Path) -> None:
    settings = "source.raw.a_dn=9", "source.raw.b_dn2=20", "source.own_noise=subtract"
    config = raw_config(tmp_path, *LEVELS, *NOISE, *settings)
    dn = np.arange(1000, 1064, dtype=np.uint16).repeat(64).reshape(64, 64)
    pair, plan = simulated(config, mosaics(config, dn))
    assert (plan.noise.a_dn, plan.noise.b_dn2) == (-5.0, 70.0)
    assert pair.counts.zero_variance == (dn >= 1014).sum()  # 5 · 14 = 70
    assert reference_pair(mosaics(config, dn).srgb, plan).counts == pair.counts


def test_noise_maps_are_those_of_black_below_it(tmp_path: Path) -> None:
    config = raw_config(tmp_path, *LEVELS, *NOISE)
    frame = np.arange(900, 1100, dtype=np.uint16).reshape(10, 20)
    pair, plan = simulated(config, mosaics(config, frame))
    target = targets_of(["variance"], mosaics(config, frame).srgb, plan, Patch(20, 10), pair)["variance"]
    assert target == pytest.approx(noise_variance(frame.astype(float), plan)) and target.min() == pytest.approx(90)


# ------------------------------------------------------------------------------------------------- clipped below black


@pytest.mark.parametrize("shrink", [1, 2])
@pytest.mark.parametrize(("sensor", "lowest"), [(("sensor.clip=black",), 0), (("sensor.black_level_dn=10",), -10),
                                                (("output.dtype=float32", "sensor.clip=none"), -np.inf)])  # fmt: skip
def test_light_that_is_clipped_low_is_counted(
    tmp_path: Path, run_main: RunMain, sensor: tuple[str, ...], lowest: float, shrink: int
) -> None:
    """The span of the file is just below a power of two, at which codes of cells would have no space below black."""
    raw = "source.raw.pattern=RGGB", "source.raw.black_dn=1024", "source.raw.white_dn=17407"
    dn = np.rint(np.random.default_rng(2).normal(1024, 9, (64, 64))).astype(np.uint16)
    (tmp_path / "in").mkdir()
    np.save(tmp_path / "in" / "a.npy", dn)
    levels = "sensor=generic_14bit", "sensor.white_level_dn=16383", *sensor, f"source.shrink={shrink}"
    root = "source.kind=raw", f"source.root={tmp_path / 'in'}", *raw, *levels, f"out={tmp_path / 'ds'}", "n_jobs=1"
    code, out, _ = run_main(*root, "noise=none")
    ((clean, _, row),) = ug.RawPairs(tmp_path / "ds")
    black, span = row["black_level_dn"], 16383 - row["black_level_dn"]
    green = dn[0::2, 1::2] / 2 + dn[1::2, 0::2] / 2
    cells = np.stack([dn[0::2, 0::2], green, dn[1::2, 1::2]], axis=-1)
    u = ((dn if shrink == 1 else mosaic(cells, "RGGB")) - 1024.0) / (17407 - 1024) * span
    found = in_dn(clean, (black, 16383)) - black
    assert np.abs(found - np.maximum(u, lowest)).max() <= (1e-3 if clean.dtype == np.float32 else 0.5)
    assert row["clean_clipped_low"] == (u < lowest).sum()
    assert ("clipped low" in out) == (row["clean_clipped_low"] > 0.01 * clean.size) and code == 0
    assert ("clipped low" in run_main("plan", *root, "noise=none")[1]) == ("clipped low" in out)


# ------------------------------------------------------------------------------------------------------------ datasets


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dataset")
    (folder / "frames").mkdir()
    for number in range(2):
        dn = np.random.default_rng(number).integers(1000, 16000, (64, 72)).astype(np.uint16)
        np.save(folder / "frames" / f"{number}.npy", dn)
    scene = "scene.exposure_ratio=[uniform,100,300]", "scene.iso=6400"
    overrides = *LEVELS, "source.patch=[random,32,2]", "noise=sony_a7s2", *scene, "n_jobs=1"
    ug.generate(raw_config(folder / "frames", *overrides, f"out={folder / 'ds'}"))
    return folder / "ds"


def test_datasets_of_raw_sources_are_complete(dataset: Path) -> None:
    assert not ug.verify(dataset) and not any(result.complaint for result in ug.replay(dataset))
    assert json.loads((dataset / "dataset.json").read_text())["versions"]["libraw"]
    pairs, live = ug.RawPairs(dataset), ug.LivePairs(dataset, cache="memory")
    assert len(pairs) == 4
    assert (live[0].noisy == pairs[0].noisy).all() and (live[1, 0].clean == pairs[0].clean).all()
    redrawn = ug.LivePairs(dataset, redraw="all")[1, 0]
    recorded = pairs[0].row
    assert redrawn.row["bits"] == recorded["bits"]
    assert redrawn.row["exposure_ratio"] != recorded["exposure_ratio"]
    assert ug.develop(pairs[0].clean, pairs[0].row).shape == (32, 32, 3)
    config = (dataset / "config.yaml").read_text()
    assert "  kind: raw\n" in config and "levels: source" in config


def test_another_decoded_mosaic_is_not_another_file(dataset: Path, tmp_path: Path) -> None:
    pairs = ug.RawPairs(dataset)
    row = {**pairs[0].row, "mosaic_xxh3": "0" * 32}
    with pytest.raises(SourceChangedError, match="file is the same, but is decoded to other pixels"):
        PairRegenerator(str(dataset.parent / "frames")).regenerate(row)
    np.save(tmp_path / "0.npy", np.zeros((64, 72), np.uint16))
    with pytest.raises(SourceChangedError, match="SHA-256"):
        PairRegenerator(str(tmp_path)).regenerate(pairs[0].row)


# ------------------------------------------------------------------------------------------------------------- refused

REFUSED = {
    "camera=sony_a7r": "camera inverts",
    "gains.red=2": "gains inverts",
    "isp.gamma=2.2": "isp inverts",
    "sensor.bits=12": "takes it from each file",
    "source.downscale=2": "use source.shrink",
    "source.dequantize=dither": "is for photographs",
    "source.shrink=4": "1 to 2",
    "output.targets=[linear_rgb]": "set source.shrink=2",
    "source.raw.a_dn=1": "source.raw.b_dn2",
    "source.raw.black_dn=[1,2,3,4]": "expected 0 to 65534",
}


@pytest.mark.parametrize("override", REFUSED)
def test_settings_of_photographs_are_refused(tmp_path: Path, override: str) -> None:
    with pytest.raises(ConfigError, match=REFUSED[override]):
        raw_config(tmp_path, override)


def test_functions_of_photographs_refuse_raw_sources(tmp_path: Path) -> None:
    picture, config = np.zeros((8, 8, 3), np.uint8), raw_config(tmp_path)
    calls = (
        lambda: ug.make_pair(picture, config),
        lambda: ug.plan_image(picture, config),
        lambda: ug.CameraNoise(config),
    )
    for call in calls:
        with pytest.raises(ConfigError, match=r"source\.kind=raw: .* pixels of photographs.*; expected srgb"):
            call()
    _, plan = simulated(
        raw_config(tmp_path, *LEVELS), mosaics(raw_config(tmp_path, *LEVELS), picture[..., 0] + np.uint16(2000))
    )
    with pytest.raises(ConfigError, match="make_pair: the plan is of a raw frame"):
        ug.make_pair(picture, plan)


@pytest.mark.parametrize("override", ["source.shrink=2", "source.own_noise=subtract", "sensor=source",
                                      "source.raw.white_dn=4095"])  # fmt: skip
def test_settings_of_raw_sources_are_refused_for_photographs(override: str) -> None:
    with pytest.raises(ConfigError, match=r"source\.kind=raw"):
        ug.load_config([override])


def test_subtraction_needs_a_line_of_variance(tmp_path: Path) -> None:
    for others in (["sensor=source", "noise=sony_a7s2"], ["source.shrink=2"]):
        with pytest.raises(ConfigError, match=r"source\.own_noise=subtract"):
            raw_config(tmp_path, "source.own_noise=subtract", *others)


def test_recipe_makes_dark_pairs_with_unrounded_clean_frames(tmp_path: Path) -> None:
    config = raw_config(tmp_path, "+experiment=raw_training", *LEVELS[:3])
    photograph = mosaics(config, np.full((512, 512), 16000, np.uint16))
    image = plan_pixels(PairSettings(config), photograph, Source(0, "a", "a", 1), "00" * 32)
    assert len(image.patches) == 16
    plan = image.plans[0]
    assert (plan.noise.noise, plan.output.clean_dtype, plan.sensor.white_level_dn) == ("sony_a7s2", "float32", 16300)
    assert 10 <= plan.scene.exposure_ratio <= 300
