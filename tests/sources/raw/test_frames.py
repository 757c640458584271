"""Raw sources: light by plane, means of cells, levels and colours of the file, and refusals."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from helpers.commands import RunMain
from helpers.corpus import retagged

import unprocess_gen as ug
from unprocess_gen.config.schema import RawConfig, SourceConfig
from unprocess_gen.core.errors import SourceError
from unprocess_gen.simulation.facts import RawParts
from unprocess_gen.simulation.reference.cfa import plane_sites
from unprocess_gen.sources.image.decode import Photograph
from unprocess_gen.sources.raw.frames import read_raw_source

BLACK = {"R": 500, "G": 509, "B": 523}
"""Odd black levels by colour."""
WHITE = 16383


def dng(pixels: np.ndarray, pattern: str = "RGGB", photometric: int = 32803, **tags: tuple[Any, ...]) -> bytes:
    """Return a DNG of a mosaic with masked borders: 3 rows above and 5 columns left of the active area."""
    height, width = pixels.shape[:2]
    extra: list[tuple[Any, ...]] = [
        (50706, 1, 4, bytes((1, 4, 0, 0))), (50708, 2, 0, "Test Camera"), (274, 3, 1, 1),
        (50717, 4, 1, WHITE), (50778, 3, 1, 17), (50779, 3, 1, 21),
        (50721, 10, 9, rationals(9054, -4504, 215, -4751, 12611, 2388, -296, 802, 6816)),
        (50722, 10, 9, rationals(7662, -2686, -660, -5240, 12965, 2530, -796, 1508, 6167)),
        (50728, 5, 3, (354571, 1000000, 1000000, 1000000, 703297, 1000000)),
        (34855, 3, 1, 100), (33434, 5, 1, (1, 25)),
    ]  # fmt: skip
    if photometric == 32803:
        extra += [
            (33421, 3, 2, (2, 2)), (33422, 1, 4, bytes("RGB".index(one) for one in pattern)),
            (50713, 3, 2, (2, 2)), (50714, 4, 4, tuple(BLACK[one] for one in pattern)),
            (50829, 4, 4, (3, 5, height, width)),
        ]  # fmt: skip
    extra += tags.values()
    file = io.BytesIO()
    tifffile.imwrite(
        file, pixels, photometric=photometric, metadata=None, subfiletype=0, byteorder="<",
        extratags=sorted((*tag, True) for tag in extra),
    )  # fmt: skip
    return file.getvalue()


def rationals(*numbers: int) -> tuple[int, ...]:
    """Return fractions with the denominator 10,000."""
    return tuple(part for number in numbers for part in (number, 10000))


def framed(pattern: str = "RGGB") -> tuple[np.ndarray, bytes]:
    """Return random visible DN, and their DNG with masked borders."""
    visible = np.random.default_rng(3).integers(480, WHITE + 1, (40, 48)).astype(np.uint16)
    stored = np.full((43, 53), 77, np.uint16)
    stored[3:, 5:] = visible
    return visible, dng(stored, pattern)


def read(content: bytes, name: str = "a.dng", **settings: Any) -> tuple[Photograph, RawParts]:
    photograph = read_raw_source(SourceConfig(kind="raw", **settings), content, name)
    assert photograph.raw is not None
    return photograph, photograph.raw


@pytest.mark.parametrize("pattern", ["RGGB", "GBRG"])
def test_mosaic_is_the_visible_part_with_its_phase(pattern: str) -> None:
    visible, content = framed(pattern)
    photograph, raw = read(content)
    assert (photograph.srgb == visible[..., None]).all()
    assert raw.sensor.pattern == raw.source.raw_pattern == pattern
    assert raw.source.raw_black_dn == (500.0, 509.0, 509.0, 523.0)
    assert (raw.sensor.bits, raw.sensor.white_level_dn, raw.sensor.black_level_dn) == (14, WHITE, 510)
    assert (raw.source.source_iso, raw.source.source_exposure_s) == (100.0, 0.04)


def test_colours_are_those_of_the_white_point() -> None:
    _, raw = read(framed()[1])
    assert (raw.camera.red_gain, raw.camera.blue_gain) == pytest.approx((1 / 0.354571, 1 / 0.703297))
    assert raw.camera.camera == "Test Camera"
    cold = np.reshape((7662, -2686, -660, -5240, 12965, 2530, -796, 1508, 6167), (3, 3)) / 1e4  # white is above 6500 K
    to_xyz = [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
    native = cold @ np.array(to_xyz)
    assert raw.camera.rgb2cam == pytest.approx((native / native.sum(axis=1, keepdims=True)).ravel(), abs=1e-4)


def test_cells_have_the_mean_light_of_each_colour() -> None:
    visible, content = framed("GBRG")
    photograph, raw = read(content, shrink=2)
    light = np.zeros((20, 24, 3))
    for (y, x), colour in zip(plane_sites("GBRG"), "RGGB", strict=True):
        plane = (visible[y::2, x::2].astype(float) - BLACK[colour]) / (WHITE - BLACK[colour])
        light[..., "RGB".index(colour)] += plane / (2 if colour == "G" else 1)
    (black, *_), (white, *_) = raw.source.code_levels
    found = (photograph.srgb - black) / (white - black)
    assert np.abs(found - light).max() <= 0.5 / (white - black) + 1e-12


def test_means_of_a_mosaic_of_equal_levels_are_exact() -> None:
    pixels = np.random.default_rng(1).integers(240, 4096, (16, 20)).astype(np.uint16)
    settings = RawConfig("RGGB", 240, 4095)
    photograph, raw = read(npy(pixels), "a.npy", raw=settings, shrink=2)
    (black, *_), (white, *_) = raw.source.code_levels
    green = (pixels[0::2, 1::2].astype(float) + pixels[1::2, 0::2]) / 2
    assert ((photograph.srgb[..., 1] - black) * (4095 - 240) / (white - black) + 240 == green).all()


def npy(pixels: np.ndarray) -> bytes:
    """Return the bytes of an NPY file."""
    file = io.BytesIO()
    np.save(file, pixels)
    return file.getvalue()


def test_formats_of_mosaics_are_equal(tmp_path: Path) -> None:
    import cv2

    pixels = np.random.default_rng(2).integers(0, 65536, (24, 30)).astype(np.uint16)
    raw, found = RawConfig("BGGR", 4, 65535), [npy(pixels)]
    for suffix in (".png", ".tiff"):
        assert cv2.imwrite(str(tmp_path / f"a{suffix}"), pixels)
        found.append((tmp_path / f"a{suffix}").read_bytes())
    for content, name in zip(found, ("a.npy", "a.png", "a.tiff"), strict=True):
        photograph, parts = read(content, name, raw=raw)
        assert (photograph.srgb == pixels[..., None]).all()
        assert parts.source.raw_black_dn == (4.0,) * 4


def test_stated_noise_is_averaged_over_the_planes() -> None:
    profile = (51041, 12, 6, (1e-4, 1e-7, 2e-4, 2e-7, 3e-4, 3e-7))
    _, raw = read(dng(np.full((43, 53), 900, np.uint16), noise=profile))
    assert raw.noise == pytest.approx((2e-4, 2e-7))
    _, given = read(framed()[1], raw=RawConfig(a_dn=0.5, b_dn2=9.0))
    span = WHITE - BLACK["G"]
    assert given.noise == pytest.approx((0.5 / span, 9 / span**2))


@pytest.mark.parametrize("third", [False, True])
def test_camera_of_a_file_is_used_unedited(third: bool, run_main: RunMain, tmp_path: Path) -> None:
    tags = {"third": (52531, 10, 9, rationals(*range(1, 10)))} if third else {}
    (tmp_path / "frame.dng").write_bytes(dng(np.full((43, 53), 900, np.uint16), "GBRG", **tags))
    for group in ("camera", "sensor"):
        (tmp_path / "mine" / group).mkdir(parents=True)
    own = "--to", "mine/camera/phone.yaml", "--sensor", "mine/sensor/phone.yaml"
    done = run_main("camera", "frame.dng", *own)
    assert (done.code, "ColorMatrix3, for a third light, is not used" in done.out) == (0, third), done
    assert "use it with --config-dir mine camera=phone sensor=phone" in done.out
    done = run_main("camera", "frame.dng", "--to", "mine/phone.yaml")
    assert "use it with camera=phone, in a folder camera of --config-dir" in done.out
    config = ug.load_config(["camera=phone", "sensor=phone"], config_dir=tmp_path / "mine")
    cold = (0.7662, -0.2686, -0.0660, -0.5240, 1.2965, 0.2530, -0.0796, 0.1508, 0.6167)  # white is above 6500 K
    assert config.camera.xyz2cam == pytest.approx(cold, abs=1e-4)
    sensor = config.sensor
    assert (sensor.bits, sensor.black_level_dn, sensor.white_level_dn, sensor.pattern) == (14, 510, WHITE, "GBRG")
    pair = ug.make_pair(np.full((8, 8, 3), 90, np.uint8), config)
    assert (pair.row["camera"], pair.row["white_level_dn"]) == ("phone", WHITE)


REFUSED = {
    "cut DNG": (lambda: framed()[1][:-100], "a.dng", {}, "truncated"),
    "linear DNG": (lambda: dng(np.zeros((32, 32, 3), np.uint16), photometric=34892), "a.dng", {}, "unsupported"),
    "float DNG": (lambda: dng(np.zeros((43, 53), np.float32)), "a.dng", {}, "unsupported"),
    "monochrome DNG": (lambda: dng(np.zeros((32, 32), np.uint16), photometric=1), "a.dng", {}, "unsupported"),
    "no raw file": (lambda: b"II*\0nothing", "a.dng", {}, "corrupt"),
    "empty": (lambda: b"", "a.nef", {}, "empty"),
    "too large": (lambda: framed()[1], "a.dng", {"max_pixels": 99}, "too_large"),
    "JPEG XL": (lambda: retagged(framed()[1], {259: 52546}), "a.dng", {}, "unsupported"),
    "another pattern": (lambda: framed()[1], "a.dng", {"raw": RawConfig("BGGR")}, "unsupported"),
    "levels in the wrong order": (lambda: framed()[1], "a.dng", {"raw": RawConfig(white_dn=400)}, "corrupt"),
    "no levels": (lambda: npy(np.zeros((4, 4), np.uint16)), "a.npy", {}, "unsupported"),
    "cut NPY": (lambda: npy(np.zeros((4, 4), np.uint16))[:-3], "a.npy", {"raw": RawConfig("RGGB", 0, 9)}, "corrupt"),
    "8 bits": (lambda: npy(np.zeros((4, 4), np.uint8)), "a.npy", {"raw": RawConfig("RGGB", 0, 9)}, "unsupported"),
    "colours": (lambda: npy(np.zeros((4, 4, 3), np.uint16)), "a.npy", {"raw": RawConfig("RGGB", 0, 9)}, "unsupported"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_unusable_files_have_a_reason(case: str) -> None:
    content, name, settings, reason = REFUSED[case]
    with pytest.raises(SourceError) as error:
        read(content(), name, **settings)
    assert error.value.reason == reason, error.value.text
