"""Linear sources pass through the pipeline: closed loop with photographs, laws of light, replay, refused settings."""

from __future__ import annotations

import io
import json
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.photographs import pixels

import unprocess_gen as ug
from unprocess_gen.config.option_files import conf_dir
from unprocess_gen.core.errors import ConfigError, SourceChangedError
from unprocess_gen.core.source import Source
from unprocess_gen.pipeline.pairs import PairSettings, plan_pixels
from unprocess_gen.pipeline.replay import PairRegenerator
from unprocess_gen.simulation.pair import make_pair, reference_pair
from unprocess_gen.simulation.plan import MOST_LIGHT, Plan
from unprocess_gen.simulation.reference import colour
from unprocess_gen.simulation.reference.primaries import PRIMARIES, primaries2srgb
from unprocess_gen.simulation.tone_curves import linear_table
from unprocess_gen.sources.image.decode import decode
from unprocess_gen.sources.linear.files import read_linear_source

EXACT_14 = "sensor=generic_14bit", "output.dtype=float32", "noise=none"
CAMERAS = sorted(path.stem for path in (conf_dir() / "camera").glob("*.yaml") if path.stem != "custom")


def linear(*overrides: str) -> Any:
    return ug.load_config(["source.kind=linear", *overrides])


def exr(light: np.ndarray) -> bytes:
    """Encode light as an OpenEXR picture of its dtype."""
    openexr = pytest.importorskip("OpenEXR")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.exr")
        openexr.File(header, {"RGB": light}).write(str(path))
        return path.read_bytes()


def hdr_scene(seed: int = 1, height: int = 48, width: int = 70) -> np.ndarray:
    """Light from black to 40 times white, with negative components."""
    return (np.random.default_rng(seed).random((height, width, 3)) ** 6 * 40 - 0.02).astype(np.float32)


# ---------------------------------------------------------------------------------------------------------- closed loop


def clean_dn(codes: np.ndarray, plan: Plan) -> np.ndarray:
    """Unrounded clean values."""
    light = make_pair(codes, plan.replace(dtype="float32")).clean.astype(float)
    return light * plan.sensor.span_dn + plan.sensor.black_level_dn


def check_photograph(codes: np.ndarray, cameras: list[str]) -> None:
    """Compare the clean frames of a photograph and of its light, in float and in half."""
    settings = "sensor=generic_14bit", "noise=none"
    config = linear(*settings)
    curve = linear_table("smoothstep", 2.2, 256**codes.itemsize)
    full, half = (read_linear_source(config.source, exr(curve[codes].astype(f"f{n}")), "a.exr").srgb for n in (4, 2))
    for camera in cameras:
        photograph = ug.load_config([*settings, f"camera={camera}", "gains.inverse_rgb=1", "gains.highlight=none"])
        plan = ug.plan_image(codes[:8, :8], photograph, key="same")
        own = ug.plan_image(full[:8, :8], linear(*settings, f"camera={camera}"), key="same")
        assert own.camera == plan.camera
        expected, exact = make_pair(codes, plan).clean.astype(int), clean_dn(codes, plan)
        is_off = make_pair(full, own).clean != expected
        assert np.abs(exact[is_off] - np.floor(exact[is_off]) - 0.5).max(initial=0) <= 0.001
        assert is_off.mean() < 1e-3
        assert np.abs(make_pair(half, own).clean.astype(int) - expected).max() <= 4


@pytest.mark.parametrize("camera", CAMERAS)
def test_light_of_a_photograph_gives_its_clean_frame(camera: str) -> None:
    check_photograph(pixels(3, 96, 128), [camera])


@pytest.mark.slow
@pytest.mark.skipif("PHOTOS" not in os.environ, reason="set PHOTOS to a folder of photographs")
def test_light_of_photographs_gives_their_clean_frames() -> None:
    for path in sorted(Path(os.environ["PHOTOS"]).glob("*.*")):
        check_photograph(decode(path.read_bytes(), max_pixels=2**26, icc="ignore").srgb, CAMERAS)


# ---------------------------------------------------------------------------------------------------------------- light

FORMS = {
    "two": (), "physical": ("body=sony_a7s2", "scene=night"), "poisson": ("noise=imx385_iso3200_rvdd",),
    "well": ("body=nikon_d850", "noise.full_well_e=3000", "effects.all=on"), "ratio": ("scene.exposure_ratio=100",),
    "float": ("output.dtype=float32", "sensor.clip=none"), "mono": ("sensor.pattern=MONO",),
    "float_well": ("body=sony_a7s2", "output.dtype=float32", "sensor.clip=none", "noise.full_well_e=2000"),
    "clean": ("body=sony_a7s2", "output.clean_dtype=float32", "noise.full_well_e=2000"),
    "fixed": ("body=sony_a7s2", "clean.includes_fixed_pattern=true", "noise.lens_shading=[-0.3,-0.1,0]"),
    "steep": ("noise=heteroscedastic", "noise.a=1e9", "noise.b=1e9"), "xyz": ("source.primaries=xyz",),
    "p3": ("source.primaries=p3", "gains=by_light", "gains.light=d65"), "sensor": ("source.primaries=camera",),
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_kernels_equal_the_reference_at_hard_values(form: str) -> None:
    light = hdr_scene(width=600)
    hard = [1e9, -1e9, 1e-9, 3e38, 200.0, 6e-8, 2.0**-24, 7e4, 65536.0, 1e-45, 0.0, 1.0]
    light[: len(hard), :90] = np.array(hard, np.float32)[:, None, None]
    light[20, :50] = np.float32([3e38, -3e38, 3e38])
    plan = ug.plan_image(light, linear("scene.ev=0.7", "sensor=generic_16bit", *FORMS[form]))
    pair, reference = make_pair(light, plan), reference_pair(light, plan)
    assert (pair.clean == reference.clean).all() and (pair.noisy == reference.noisy).all()
    assert pair.counts == reference.counts
    crop = make_pair(light[6:30, 10:300], plan, (6, 10))
    assert (crop.clean == pair.clean[6:30, 10:300]).all() and (crop.noisy == pair.noisy[6:30, 10:300]).all()


def test_fast_frames_are_within_their_error() -> None:
    light = hdr_scene()
    plan = ug.plan_image(light, linear("accuracy=fast", "scene.exposure_ratio=20", "sensor=generic_14bit"))
    pair, reference = make_pair(light, plan), reference_pair(light, plan)
    assert np.abs(pair.clean.astype(int) - reference.clean).max() <= 1
    assert np.abs(pair.noisy.astype(int) - reference.noisy).max() <= 1


def expected_light(light: np.ndarray, plan: Plan, matrix: colour.Matrix) -> np.ndarray:
    """Light at the sensor by an own formula, [H, W] of an RGGB mosaic."""
    camera = light.astype(float) @ np.reshape(colour.multiply(plan.camera.rgb2cam, matrix), (3, 3)).T
    camera /= [plan.camera.red_gain, 1.0, plan.camera.blue_gain]
    camera *= 2.0**plan.scene.ev / plan.scene.exposure_ratio
    sites = np.tile([[0, 1], [1, 2]], (light.shape[0] // 2, light.shape[1] // 2))
    return np.take_along_axis(camera, sites[..., None], axis=2)[..., 0]


XYZ = colour.invert(colour.RGB2XYZ)


@pytest.mark.parametrize("primaries", [*PRIMARIES, "xyz"])
def test_light_is_matrix_gain_and_exposure(primaries: str) -> None:
    light = hdr_scene() / 4
    settings = f"source.primaries={primaries}", "scene.ev=-0.5", "scene.exposure_ratio=3", *EXACT_14
    plan = ug.plan_image(light, linear(*settings))
    matrix = XYZ if primaries == "xyz" else primaries2srgb(PRIMARIES[primaries])
    expected = expected_light(light, plan, matrix)
    pair = make_pair(light, plan)
    assert np.abs(pair.clean - np.clip(expected, 0, 1)).max() < 1e-6
    assert pair.counts.light_clipped_low == (expected < 0).sum() > 0
    assert pair.counts.clean_clipped_high == (expected > 1).sum() > 0


def test_sensor_rgb_has_neither_matrix_nor_gains() -> None:
    light = hdr_scene()
    pair = ug.make_pair(light, linear("source.primaries=camera", *EXACT_14))
    sites = np.tile([[0, 1], [1, 2]], (24, 35))
    assert (pair.clean == np.clip(np.take_along_axis(light, sites[..., None], axis=2)[..., 0], 0, 1)).all()


@pytest.mark.parametrize("primaries", [*PRIMARIES, "0.64;0.33;0.3;0.6;0.15;0.06;0.3333;0.3333"])
def test_neutral_light_reaches_white_in_green(primaries: str) -> None:
    plan = ug.plan_image(np.ones((2, 2, 3), np.float32), linear(*EXACT_14)).replace(primaries=primaries)
    red, green, _, blue = make_pair(np.ones((2, 2, 3), np.float32), plan).clean.ravel()
    assert (red, green, blue) == (np.float32(1 / plan.camera.red_gain), 1, np.float32(1 / plan.camera.blue_gain))


def test_exposures_are_a_ladder_up_to_white() -> None:
    light = np.full((4, 4, 3), 0.011, np.float32)
    for ev in range(-4, 12):
        pair = ug.make_pair(light, linear(f"scene.ev={ev}", "noise=none", "sensor=generic_14bit"), key="same")
        sensor, camera = pair.plan.sensor, pair.plan.camera
        gains = np.array([[1 / camera.red_gain, 1], [1, 1 / camera.blue_gain]])
        expected = np.minimum(0.011 * gains * 2.0**ev, 1) * sensor.span_dn + sensor.black_level_dn
        assert np.abs(pair.clean[:2, :2] - expected).max() <= 1
        assert pair.counts.saturated == (np.rint(expected) == sensor.white_level_dn).sum() * 4


def test_drawn_exposures_are_the_uniform_of_their_name_and_recorded() -> None:
    rows = [
        ug.make_pair(np.ones((2, 2, 3), np.float32), linear("scene.ev=[uniform,-3,1]"), key=key).row
        for key in range(40)
    ]
    drawn = [row["ev"] for row in rows]
    assert -3 <= min(drawn) < -2 and 0 < max(drawn) <= 1 and len(set(drawn)) == 40
    darker = [ug.make_pair(np.ones((2, 2, 3), np.float32), linear("noise=none"), key=key).row for key in range(2)]
    assert [row["red_gain"] for row in rows[:2]] == [row["red_gain"] for row in darker]


def test_an_exposure_ratio_divides_light_above_white() -> None:
    light = np.full((2, 2, 3), 50, np.float32)
    pair = ug.make_pair(light, linear("scene.exposure_ratio=100", *EXACT_14))
    assert pair.clean[0, 1] == pytest.approx(0.5, rel=1e-6)


def test_light_beyond_the_limit_is_counted() -> None:
    light = np.full((2, 2, 3), 2 * MOST_LIGHT, np.float32)
    light[0] /= 4
    counts = ug.make_pair(light, linear("gains=unity", "noise=none", "camera=identity")).counts
    assert (counts.light_clipped_high, counts.light_clipped_low, counts.clean_clipped_high) == (2, 0, 4)


# ---------------------------------------------------------------------------------------------------------------- noise

WELL = ("body=sony_a7s2", "noise.full_well_e=20000", "effects.all=off", "effects.shot=on", "effects.read=on",
        "effects.full_well=on", "camera=identity", "gains=unity", "scene.iso=800")  # fmt: skip


def test_a_lamp_saturates_as_computed_by_hand() -> None:
    """At 200 times white every count is beyond the well, so that only read noise is left; shot noise is below white."""
    light = np.full((256, 512, 3), 0.25, np.float32)
    light[:, 256:] = 200
    pair = ug.make_pair(light, linear(*WELL))
    plan, (dim, lamp) = pair.plan, np.split(pair.noisy.astype(float), 2, axis=1)
    physics, black, sites = plan.numbers, plan.sensor.black_level_dn, dim.size
    full_dn = physics.full_well_e * physics.dn_per_e + black
    assert full_dn < plan.sensor.white_level_dn
    read_dn2 = physics.read_std_dn**2 + 1 / 12
    assert lamp.mean() == pytest.approx(full_dn, abs=4 * np.sqrt(read_dn2 / sites))
    assert lamp.var() == pytest.approx(read_dn2, rel=4 * np.sqrt(2 / sites) + 0.01)
    signal_dn = 0.25 * plan.sensor.span_dn
    variance = signal_dn * physics.dn_per_e + read_dn2
    assert dim.mean() == pytest.approx(signal_dn + black, abs=4 * np.sqrt(variance / sites))
    assert dim.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / sites) + 0.005)
    assert (pair.clean[:, 256:] == round(full_dn)).all() and (pair.clean[:, :256] == round(signal_dn + black)).all()


def test_light_above_white_is_not_clipped_before_its_noise() -> None:
    """Photographs end at white, where half of the noise is below; three standard deviations above, none is."""
    noise = "noise=heteroscedastic", "noise.a=4", "noise.b=0", "gains=unity", "camera=identity"
    bright = ug.make_pair(np.full((64, 64, 3), 1.3, np.float32), linear(*noise))
    white = ug.make_pair(np.full((64, 64, 3), 255, np.uint8), ug.load_config(noise))
    top = bright.plan.sensor.white_level_dn
    assert (bright.clean == top).all() and (bright.noisy == top).all()
    assert 0.4 < (white.noisy < top).mean() < 0.6


# ------------------------------------------------------------------------------------------------- datasets and callers


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    """A folder of three linear pictures."""
    folder = tmp_path / "scenes"
    folder.mkdir()
    for number in range(3):
        np.save(folder / f"{number}.npy", hdr_scene(number, 60 + 2 * number, 64))
    return folder


DATASET = "body=sony_a7s2", "scene=night", "scene.ev=[uniform,-4,0]", "source.patch=[random,32,2]", "noise.draws=2"


def test_parts_replay_and_live_pairs_agree(scenes: Path, tmp_path: Path, run_main: RunMain) -> None:
    kind = "source.kind=linear", f"source.root={scenes}", "source.downscale=1", *DATASET, "output.pairs_per_shard=2"
    assert run_main(*kind, f"out={tmp_path / 'ds'}", "n_jobs=1").code == 0
    for part in range(2):
        assert run_main("part", f"{part}/2", *kind, f"out={tmp_path / 'parts'}", "n_jobs=1").code == 0
    assert run_main("merge", str(tmp_path / "parts")).code == 0
    for name in ("manifest.csv", "config.yaml", "shards/shard-00000.tar", "shards/shard-00001.tar"):
        assert (tmp_path / "ds" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes()
    assert run_main("verify", str(tmp_path / "ds"), "--regenerate", "99").code == 0
    assert run_main("again", str(tmp_path / "ds"), f"out={tmp_path / 'again'}", "n_jobs=1").code == 0
    assert run_main("preview", str(tmp_path / "ds"), "--to", str(tmp_path / "sheets"), "--stages").code == 0
    stored, live = ug.RawPairs(tmp_path / "ds"), ug.LivePairs(tmp_path / "ds", redraw="all", targets=["linear_rgb"])
    for number, pair in enumerate(stored):
        assert (live[0, number].noisy == pair.noisy).all() and dict(live[0, number].row) == dict(pair.row)
    redrawn = live[5, 3]
    assert redrawn.row["ev"] != stored[3].row["ev"] and redrawn.row["primaries"] == "srgb"
    assert redrawn.targets["linear_rgb"].max() <= 1


def test_live_crops_are_crops_of_the_pair(scenes: Path) -> None:
    overrides = ["source.kind=linear", f"source.root={scenes}", "noise=sony_a7s2", "scene=night"]
    whole, crops = ug.LivePairs(overrides), ug.LivePairs(overrides, patch=16)
    crop = crops[2, 1]
    y, x = crop.row["patch_y"], crop.row["patch_x"]
    assert (crop.noisy == whole[2, 1].noisy[y : y + 16, x : x + 16]).all()


def test_rows_refuse_other_decoded_pixels(scenes: Path, tmp_path: Path, run_main: RunMain) -> None:
    assert run_main("source.kind=linear", f"source.root={scenes}", f"out={tmp_path / 'ds'}", "n_jobs=1").code == 0
    row = dict(ug.RawPairs(tmp_path / "ds")[0].row)
    regenerate = PairRegenerator(str(scenes)).regenerate
    assert (regenerate(row)["clean"] == ug.RawPairs(tmp_path / "ds")[0].clean).all()
    with pytest.raises(SourceChangedError, match="decoded to other pixels"):
        regenerate(row | {"pixels_xxh3": "0" * 32})
    assert "tifffile" in json.loads((tmp_path / "ds" / "dataset.json").read_text())["versions"]


def test_downscaled_light_is_the_mean(scenes: Path) -> None:
    settings = f"source.root={scenes}", "source.downscale=3", *EXACT_14, "source.primaries=camera"
    pair = ug.LivePairs(["source.kind=linear", *settings])[0]
    light = hdr_scene(0, 60, 64)[:60, :63].astype(float).reshape(20, 3, 21, 3, 3).mean(axis=(1, 3))
    assert np.abs(pair.clean[::2, ::2] - np.clip(light[::2, ::2, 0], 0, 1)).max() < 1e-6


def test_synthetic_scenes_have_light_above_white(tmp_path: Path, run_main: RunMain) -> None:
    out = f"out={tmp_path / 'ds'}"
    assert run_main("source.kind=linear", "source.limit=3", out, "n_jobs=1").code == 0
    assert run_main("verify", str(tmp_path / "ds"), "--regenerate", "3").code == 0
    rows = [pair.row for pair in ug.RawPairs(tmp_path / "ds")]
    assert rows[2]["source"] == "highlights-0" and rows[2]["clean_clipped_high"] > 0


REFUSED = {
    "isp=srgb": "scene-linear pictures have none",
    "isp.gamma=2": "scene-linear pictures have none",
    "gains.inverse_rgb=1": "not brightened; use scene.ev",
    "gains.highlight=none": "contain their highlights",
    "source.dequantize=dither": "source.dequantize=dither: is for photographs",
    "source.shrink=2": "source.shrink=2: is for raw sources",
    "scene.ev=[uniform,1,99]": "scene.ev",
    "source.primaries=adobe": "expected one of srgb, p3, rec2020, acescg, xyz, camera",
}


@pytest.mark.parametrize("override", REFUSED)
def test_settings_of_other_sources_are_refused(override: str) -> None:
    with pytest.raises(ConfigError, match=REFUSED[override]):
        linear(override)


@pytest.mark.parametrize("override", ["scene.ev=1", "source.primaries=p3"])
def test_other_sources_refuse_settings_of_linear_ones(override: str) -> None:
    with pytest.raises(ConfigError, match=override):
        ug.load_config([override])


LIGHT = np.ones((4, 4, 3), np.float32)
NO_LIGHT = [
    (LIGHT.astype(float), "is float64"), (LIGHT.astype(np.uint8), "is uint8"), (LIGHT[..., 0], "expected light"),
    (np.full_like(LIGHT, np.nan), "16 pixels that are NaN or infinite"), (np.full_like(LIGHT, np.inf), "infinite"),
]  # fmt: skip


@pytest.mark.parametrize(("array", "problem"), NO_LIGHT)
def test_arrays_that_are_no_light_are_refused(array: np.ndarray, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        ug.make_pair(array, linear())


def test_light_needs_the_kind_and_camera_noise_refuses_it() -> None:
    with pytest.raises(ValueError, match=r"or source\.kind=linear"):
        ug.make_pair(np.ones((4, 4, 3), np.float32), ug.load_config())
    with pytest.raises(ConfigError, match=r"source\.kind=linear: CameraNoise works on pixels of photographs"):
        ug.CameraNoise(linear())


def test_a_plan_takes_other_light() -> None:
    light = hdr_scene()
    plan = ug.plan_image(light, linear("body=sony_a7s2"))
    pair = ug.make_pair(light / 2, plan)
    assert pair.row["pixels_xxh3"] != plan.source.pixels_xxh3 and pair.plan.camera == plan.camera
    image = plan_pixels(PairSettings(linear()), read_npy(light), Source(0, "a", "a", 1), "00" * 32)
    assert image.plans[0].source.pixels_xxh3 == plan.source.pixels_xxh3


def read_npy(light: np.ndarray) -> Any:
    file = io.BytesIO()
    np.save(file, light)
    return read_linear_source(linear().source, file.getvalue(), "a.npy")


def test_development_keeps_the_exposure() -> None:
    light = np.full((16, 16, 3), 0.5, np.float32)
    bright, dark = (ug.make_pair(light, linear(f"scene.ev={ev}", "noise=none")) for ev in (0, -2))
    codes = [int(ug.develop(pair.clean, pair.row)[8, 8, 1]) for pair in (bright, dark)]
    assert codes == [188, 99]  # sRGB of 0.5 and of 0.125
