"""LibRaw (rawpy) reads and develops DNG files correctly; tifffile and exiftool read their tags."""

from __future__ import annotations

import io
import os
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rawpy
import tifffile
from helpers.commands import RunMain, run_process
from helpers.datasets import Make
from helpers.photographs import pixels
from helpers.promise_report import Figure
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from unprocess_gen import RawPairs
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.dataset import dng
from unprocess_gen.dataset.row import plan_from_row
from unprocess_gen.pipeline.verify import verify
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference.isp import apply_gains
from unprocess_gen.simulation.reference.unprocess import camera_light, linear_light
from unprocess_gen.sources import synthetic

Tags = dict[str, Any]
D65_XY = (0.3127, 0.3290)
RGB2XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)  # http://www.brucelindbloom.com/index.html?Eqn_RGB_XYZ_Matrix.html

SIZES = {"a.png": (65, 97), "b&<é>.png": (64, 22), "c.png": (22, 23), "d.png": (40, 21)}
KEYS = "00000000,00000002,00000003"
"""Height and width of the photographs. Key 1 (aa.jpg) is no photograph, key 4 is too narrow; the others are `KEYS`."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dng") / "photos"
    folder.mkdir()
    for seed, (name, size) in enumerate(SIZES.items()):
        Image.fromarray(pixels(seed, *size)).save(folder / name)
    (folder / "aa.jpg").write_bytes(b"\xff\xd8\xff")
    return folder


@pytest.fixture(scope="module")
def ds(folder: Path, make: Make) -> Path:
    out = folder.parent / "ds"
    make(folder, out)
    return out


def read(path: Path | bytes) -> tuple[np.ndarray, Tags]:
    """Read a file by tifffile: its array, and its tags by name."""
    with tifffile.TiffFile(io.BytesIO(path) if isinstance(path, bytes) else path) as file:
        return file.asarray(), {tag.name: tag.value for tag in file.pages[0].tags}  # type: ignore[union-attr]


def numbers(flat: tuple[int, ...]) -> np.ndarray:
    """Return rationals as numbers."""
    return np.array(flat[::2]) / np.array(flat[1::2])


def pair(ds: Path, number: int = 0) -> tuple[np.ndarray, np.ndarray, dict[str, Any], Plan]:
    clean, noisy, row = RawPairs(ds)[number]
    return clean, noisy, row, plan_from_row(row)


def tags_of(row: dict[str, Any], name: str = "noisy") -> Tags:
    return read(dng.encode(np.zeros((22, 22), np.uint16), row, name))[1]


# --------------------------------------------------------------------------------------------------------- the array


@pytest.mark.parametrize("pattern", ["BGGR", "GRBG"])
def test_libraw_reads_array_pattern_and_levels_as_they_are(
    pattern: str, folder: Path, make: Make, tmp_path: Path, figure: Figure
) -> None:
    make(folder, tmp_path / "ds", "sensor=generic_14bit", f"sensor.pattern={pattern}", "source.limit=4")
    dng.export(tmp_path / "ds", KEYS, dng.FRAMES, tmp_path / "to")
    equal = 0
    for clean, noisy, row in RawPairs(tmp_path / "ds"):
        for name, frame in (("clean", clean), ("noisy", noisy)):
            with rawpy.imread(str(tmp_path / "to" / f"{row['key']}.{name}.dng")) as raw:
                np.testing.assert_array_equal(raw.raw_image, frame)
                np.testing.assert_array_equal(raw.raw_image_visible, frame)
                letters = raw.color_desc.decode()
                assert "".join(letters[index] for index in raw.raw_pattern.ravel()) == pattern
                assert raw.black_level_per_channel == [1024] * 4
                assert raw.white_level == 16383
            equal += 1
    figure("dng", f"{equal} frames equal bit for bit in LibRaw")


def test_libraw_opens_the_least_and_the_greatest_side_and_none_beyond(ds: Path) -> None:
    """The limits that the refusal of frames relies on."""
    row = pair(ds)[2]
    for shape in ((22, 22), (22, 64000)):
        with rawpy.imread(io.BytesIO(dng.encode(np.zeros(shape, np.uint16), row, "clean"))) as raw:
            assert raw.raw_image.shape == shape
    for shape in ((21, 22), (22, 21), (22, 64001)):
        with pytest.raises(rawpy.LibRawFileUnsupportedError):
            rawpy.imread(io.BytesIO(dng.encode(np.zeros(shape, np.uint16), row, "clean")))


# ----------------------------------------------------------------------------------------------------------- colours


def test_matrix_and_neutral_give_d65(ds: Path) -> None:
    tags = tags_of(pair(ds)[2])
    assert tags["CalibrationIlluminant1"] == 21  # D65
    xyz = np.linalg.solve(numbers(tags["ColorMatrix1"]).reshape(3, 3), numbers(tags["AsShotNeutral"]))
    assert xyz[:2] / xyz.sum() == pytest.approx(D65_XY, abs=5e-5)  # D65 is given to four digits
    assert xyz == pytest.approx(RGB2XYZ.sum(axis=1), abs=1e-7)  # which is white of the photographs' space


def test_libraw_finds_the_white_balance_and_the_matrix(ds: Path) -> None:
    """LibRaw keeps floats; and its own copy of the sRGB matrix, of six digits, moves the inverse by some 1e-6."""
    _, noisy, row, plan = pair(ds)
    with rawpy.imread(io.BytesIO(dng.encode(noisy, row, "noisy"))) as raw:
        assert raw.camera_whitebalance[:3] == pytest.approx(
            [plan.camera.red_gain, 1, plan.camera.blue_gain], rel=2**-22
        )
        expected = np.linalg.inv(np.array(plan.camera.rgb2cam).reshape(3, 3))
        assert raw.color_matrix[:, :3] == pytest.approx(expected, abs=5e-6)


@pytest.mark.parametrize(
    ("changed", "stops"),
    [
        ({"inverse_rgb_gain": 2.0}, -1),
        ({"inverse_rgb_gain": 0.5, "exposure_ratio": 4.0}, 3),
        ({"inverse_rgb_gain": 1.0, "red_gain": 0.25}, -2),  # red saturates first, and readers scale by that
    ],
)
def test_baseline_exposure_restores_the_brightness(changed: dict[str, float], stops: int, ds: Path) -> None:
    tags = tags_of(pair(ds)[2] | changed)
    assert numbers(tags["BaselineExposure"]) == pytest.approx([stops], abs=1e-9)


@given(st.floats(-(2.0**29.9), 2.0**29.9))
def test_rational_has_the_documented_error(value: float) -> None:
    numerator, denominator = dng.rational(value)
    assert abs(numerator) < 2**31
    assert 0 < denominator < 2**31
    assert abs(numerator / denominator - value) <= max(2**-31, 2**-30 * abs(value))


# ----------------------------------------------------------------------------------------- colours, from end to end


def doubled(srgb: np.ndarray, path: Path) -> None:
    """Write a picture of which every pixel fills a 2x2 tile of the mosaic: then there is nothing to demosaic."""
    cv2.imwrite(str(path), np.repeat(np.repeat(srgb, 2, axis=0), 2, axis=1)[..., ::-1])


def develop(path: Path, **options: Any) -> np.ndarray:
    """Develop a file by LibRaw into linear sRGB, by nothing but its tags, and brighten it by BaselineExposure.

    Left alone, LibRaw takes the brightest DN of a picture for white where it is above three quarters of it.
    """
    (stops,) = numbers(read(path)[1]["BaselineExposure"])
    with rawpy.imread(str(path)) as raw:
        codes = raw.postprocess(
            use_camera_wb=True, no_auto_bright=True, output_bps=16, gamma=(1, 1), user_flip=0, adjust_maximum_thr=0,
            output_color=rawpy.ColorSpace.sRGB, highlight_mode=rawpy.HighlightMode.Clip, **options,
        )  # fmt: skip
    return codes / 65535 * 2**stops


def errors(developed: np.ndarray, srgb: np.ndarray, plan: Plan) -> tuple[np.ndarray, float]:
    """Return what is off from the photograph's linear light, ``[N, 3]``, and the share of pixels that were compared.

    Left out: pixels with a channel above the highlight threshold, which are kept brighter by intent, or clipped in the
    mosaic or in what LibRaw gives.
    """
    light = linear_light(srgb, plan.isp.tone, plan.isp.gamma)
    native = camera_light(srgb, plan)
    used = (apply_gains(native, plan.camera.inverse_gains, "none", 0.9) < plan.isp.highlight_threshold).all(axis=-1)
    used &= (light < plan.isp.highlight_threshold).all(axis=-1) & (native < 1).all(axis=-1) & (native > 0).all(axis=-1)
    used &= (developed > 0).all(axis=-1) & (developed < developed.max()).all(axis=-1)
    return (developed - light)[used], float(used.mean())


def rounding(plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Return what rounding allows in each channel: the PSNR (dB), and the largest error.

    DN err by up to 1/2, in variance by 1/12, which gains and matrix spread. LibRaw cuts to 16 bits after the white
    balance and after the matrix: each time by up to a code, half of it on average (rows of the matrix sum to 1), 1/12
    in variance. The largest error has 1e-5 for LibRaw's single precision.
    """
    cam2rgb = np.linalg.inv(np.array(plan.camera.rgb2cam).reshape(3, 3))
    of_dn = cam2rgb / np.array(plan.camera.inverse_gains) / (plan.sensor.white_level_dn - plan.sensor.black_level_dn)
    code = 1 / (65535 * max(plan.camera.inverse_gains))
    variance = (of_dn**2).sum(axis=1) / 12 + (1 + ((cam2rgb**2).sum(axis=1) + 1) / 12) * code**2
    largest = np.abs(of_dn).sum(axis=1) / 2 + (np.abs(cam2rgb).sum(axis=1) + 1) * code + 1e-5
    return -10 * np.log10(variance), largest


def test_libraw_develops_a_picture_to_its_light(make: Make, tmp_path: Path) -> None:
    scenes = [synthetic.picture(name)[::3, ::3] for name in ("colour_chart-0", "dead_leaves-0")]
    (tmp_path / "photos").mkdir()
    for number, srgb in enumerate(scenes):
        doubled(srgb, tmp_path / "photos" / f"{number}.png")
    make(tmp_path / "photos", tmp_path / "ds", "seed=5")
    assert_colours_are_right(tmp_path, scenes, 1)


def assert_colours_are_right(place: Path, photographs: list[np.ndarray], allowed_db: float) -> float:
    """Return the least PSNR of a channel, dB."""
    least_db = np.inf
    for number, srgb in enumerate(photographs):
        _, _, row, plan = pair(place / "ds", number)
        dng.export(place / "ds", row["key"], ["clean"], place / "to")
        developed = develop(place / "to" / f"{row['key']}.clean.dng", half_size=True)
        error, share = errors(developed, srgb, plan)
        psnr_db = -10 * np.log10((error**2).mean(axis=0))
        rounding_db, largest = rounding(plan)
        print(f"{row['source']}: {psnr_db.round(1)} dB, by rounding {rounding_db.round(1)}, of {share:.0%}")
        assert share > 0.3
        assert (np.abs(error) < largest).all()
        assert (psnr_db > rounding_db - allowed_db).all()
        least_db = min(least_db, float(psnr_db.min()))
    return least_db


REAL = pytest.mark.skipif("PHOTOS" not in os.environ, reason="set PHOTOS to a folder of photographs")


def centre(path: Path, side: int) -> np.ndarray:
    """Return the middle of a photograph, R, G, B, at most ``side`` pixels high and wide."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    y, x = (max(0, (length - side) // 2) for length in image.shape[:2])
    return np.ascontiguousarray(image[y : y + side, x : x + side, ::-1])


@REAL
@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["imx385_12bit", "generic_14bit", "generic_16bit"])
def test_libraw_develops_photographs_to_their_light(sensor: str, make: Make, tmp_path: Path, figure: Figure) -> None:
    (tmp_path / "photos").mkdir()
    paths = sorted(Path(os.environ["PHOTOS"]).glob("*.jpg"))
    photographs = [centre(path, 512) for path in paths]
    for path, srgb in zip(paths, photographs, strict=True):
        doubled(srgb, tmp_path / "photos" / f"{path.stem}.png")
    make(tmp_path / "photos", tmp_path / "ds", f"sensor={sensor}")
    # smooth photographs have few codes, whose errors are not spread evenly
    least_db = assert_colours_are_right(tmp_path, photographs, 3)
    figure("dng", f"{sensor}, {len(photographs)} photographs: PSNR at least {least_db:.1f} dB")


# ------------------------------------------------------------------------------------------------------------- noise


@pytest.mark.parametrize(
    "overrides",
    [
        ("noise=imx385_iso12800",),
        ("noise=nikon_d850", "noise.iso=6400", "effects.all=off", "effects.shot=on", "effects.read=on"),
    ],
)
def test_noise_profile_is_the_noise_of_the_frames(overrides: tuple[str, ...], make: Make, tmp_path: Path) -> None:
    """Mean of (noisy - clean)² is that of S·x + O, and 1/6 DN² of rounding, to five standard errors of a normal's."""
    make(None, tmp_path / "ds", "source.limit=1", *overrides)
    _, _, row, plan = pair(tmp_path / "ds")
    dng.export(tmp_path / "ds", row["key"], dng.FRAMES, tmp_path / "to")
    (clean, _), (noisy, tags) = (read(tmp_path / "to" / f"{row['key']}.{name}.dng") for name in dng.FRAMES)
    profile = tags["NoiseProfile"]
    assert profile[:2] * 3 == profile  # for each of the planes
    black, span = plan.sensor.black_level_dn, plan.sensor.white_level_dn - plan.sensor.black_level_dn
    x, y = (clean - float(black)) / span, (noisy - float(black)) / span
    used = (x > 0.02) & (x < 0.6)  # nothing is clipped there
    law = profile[0] * x[used] + profile[1] + 1 / 6 / span**2
    excess = ((y - x)[used] ** 2 - law).mean()
    assert abs(excess) < 5 * np.sqrt(2 * (law**2).mean() / used.sum())


def test_clean_frames_and_noise_that_readers_refuse_get_no_noise_profile(
    ds: Path, folder: Path, make: Make, run_main: RunMain, tmp_path: Path
) -> None:
    row = pair(ds)[2]
    assert "NoiseProfile" not in tags_of(row, "clean")
    for changed in ({"a_dn": 0.0}, {"a_dn": -1.0}, {"b_dn2": -0.5}, {"effects": "quantise"}):
        assert "NoiseProfile" not in tags_of(row | changed), changed
    make(folder, tmp_path / "ds", "noise=imx385_iso3200_rvdd", "source.limit=3")
    done = run_main("dng", "ds", "--keys", "00000000,00000002", "--to", "to")
    assert "2 noisy frames without NoiseProfile, which cannot describe the noise" in done.out


# -------------------------------------------------------------------------------------------------------------- tags


def test_file_identifies_its_frame(ds: Path) -> None:
    _, noisy, row, plan = pair(ds)
    array, tags = read(dng.encode(noisy, row, "noisy"))
    np.testing.assert_array_equal(array, noisy)
    assert (tags["ImageWidth"], tags["ImageLength"], tags["BitsPerSample"], tags["Compression"]) == (97, 65, 16, 1)
    assert tags["PhotometricInterpretation"] == 32803  # CFA
    assert (tags["DNGVersion"], tags["DNGBackwardVersion"]) == (bytes((1, 4, 0, 0)), bytes((1, 1, 0, 0)))
    assert (tags["CFARepeatPatternDim"], tags["CFAPattern"]) == ((2, 2), bytes((0, 1, 1, 2)))
    assert tags["BlackLevel"] == (plan.sensor.black_level_dn,) * 4
    assert tags["WhiteLevel"] == plan.sensor.white_level_dn
    assert tags["UniqueCameraModel"] == "unprocess_gen convex"
    assert (tags["ActiveArea"], tags["DefaultCropSize"]) == ((0, 0, 65, 97), (97, 65))
    assert not {"DateTime", "DateTimeOriginal", "DateTimeDigitized"} & tags.keys()


def exiftool(*arguments: object) -> str:
    if shutil.which("exiftool") is None:
        pytest.skip("exiftool is not installed")
    return run_process("exiftool", *arguments).stdout


def test_exiftool_finds_nothing_wrong(ds: Path, tmp_path: Path) -> None:
    dng.export(ds, KEYS, dng.FRAMES, tmp_path)
    found = exiftool("-validate", "-warning", "-error", "-a", tmp_path)
    assert re.findall(r"^(\w+)\s+: (.*)$", found, re.M) == [("Validate", "OK")] * 6


# ------------------------------------------------------------------------------------------------------- the command


def test_keys_name_all_pairs_of_an_image(folder: Path, make: Make, run_main: RunMain, tmp_path: Path) -> None:
    make(folder, tmp_path / "ds", "noise.draws=2", "source.patch=22", "source.limit=1")
    done = run_main("dng", "ds", "--keys=00000000-p0001,00000000-p0003-l00d01", "--noisy", "--to=to")
    assert done.code == 0
    names = ["00000000-p0001-l00d00", "00000000-p0001-l00d01", "00000000-p0003-l00d01"]
    assert sorted(path.name for path in (tmp_path / "to").iterdir()) == [f"{name}.noisy.dng" for name in names]
    frames = {row["key"]: noisy for _, noisy, row in RawPairs(tmp_path / "ds")}
    for name in names:
        np.testing.assert_array_equal(read(tmp_path / "to" / f"{name}.noisy.dng")[0], frames[name])


def test_frames_asked_for_are_written_and_existing_files_kept(ds: Path, run_main: RunMain, tmp_path: Path) -> None:
    done = run_main("dng", ds, "--keys", "00000000", "--noisy", "--to", "deep/to")
    assert (done.code, done.out, done.err) == (0, "deep/to: 1 DNG file written\n", "")
    path = tmp_path / "deep/to/00000000.noisy.dng"
    before = path.stat()
    done = run_main("dng", ds, "--keys", "00000000", "--to", "deep/to")
    assert done.out == "deep/to: 1 DNG file written; 1 existed with the same bytes\n"
    assert sorted(file.name for file in path.parent.iterdir()) == ["00000000.clean.dng", path.name]
    assert (path.stat().st_ino, path.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    path.write_bytes(b"mine")
    done = run_main("dng", ds, "--keys", "00000000,00000002", "--to", "deep/to")
    assert (done.code, done.out) == (2, "")
    assert done.err.startswith("gen-dataset: --to deep/to: 00000000.noisy.dng exists with other bytes")
    assert path.read_bytes() == b"mine" and len(list(path.parent.iterdir())) == 2


REFUSED = [
    (["DS", "--keys", "00000000,00000001", "--to", "to"], r"--keys 00000001: failed \(\w+\), so it has no frames"),
    (["DS", "--keys", "00000000,00000004", "--to", "to"], "--keys 00000004: is 21 x 40; LibRaw.* under 22 pixels"),
    (["DS", "--keys", "00000000", "--to", "DS"], "--to .*: is inside the dataset"),
]


@pytest.mark.parametrize(("arguments", "sentence"), REFUSED)
def test_wrong_usage_gives_one_line_and_writes_nothing(
    arguments: list[str], sentence: str, ds: Path, run_main: RunMain, tmp_path: Path
) -> None:
    done = run_main("dng", *(argument.replace("DS", str(ds)) for argument in arguments))
    assert (done.code, done.out) == (2, "")
    assert re.fullmatch(f"gen-dataset: {sentence}.*\n", done.err)
    assert list(tmp_path.iterdir()) == []
    assert verify(ds) == []


def test_packed_planes_are_written_as_the_mosaic_that_they_are(make: Make, tmp_path: Path) -> None:
    arrays = []
    Image.fromarray(pixels(1, 64, 96)).save(tmp_path / "a.png")
    for layout in ("mosaic", "packed"):
        make(tmp_path / "a.png", tmp_path / layout, "sensor.pattern=GBRG", f"output.layout={layout}")
        dng.export(tmp_path / layout, "00000000", dng.FRAMES, tmp_path / f"{layout}.dng")
        arrays.append([read(tmp_path / f"{layout}.dng" / f"00000000.{frame}.dng")[0] for frame in dng.FRAMES])

    assert all(np.array_equal(*frames) for frames in zip(*arrays, strict=True))


def test_frames_that_no_file_can_hold_are_refused(ds: Path, folder: Path, make: Make, tmp_path: Path) -> None:
    for width, height in ((22, 64001), (64000, 64000)):
        with pytest.raises(ConfigError, match=f"is {width} x {height}; a DNG holds 4 GB, and LibRaw opens none"):
            dng._check_writable(pair(ds)[2] | {"width": width, "height": height})
    make(folder, tmp_path / "ds", "source.limit=1", "output.dtype=float32")
    with pytest.raises(ConfigError, match=r"--keys 00000000: has float32 values, .* needs output\.dtype=uint16"):
        dng.export(tmp_path / "ds", "00000000", dng.FRAMES, tmp_path / "files")
    assert not (tmp_path / "files").exists()
