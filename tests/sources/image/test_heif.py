"""HEIC through libheif and AVIF through OpenCV: exact codes, upright, in their colours, and what is refused."""

from __future__ import annotations

import io
import sys
from typing import Any

import cv2
import numpy as np
import pillow_heif
import pytest
from helpers.icc import PROFILES
from helpers.photographs import pixels
from PIL import Image

from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.sources.image.decode import Photograph, decode

PICTURE = pixels(5, 40, 64)
DEEP = PICTURE.astype(np.uint16) * 257 // 64
"""Codes of 10 bits."""
EXIF_6 = Image.Exif()
EXIF_6[274] = 6


def heic(picture: np.ndarray, mode: str = "RGB", more: int = 0, **options: Any) -> bytes:
    """A lossless HEIC; codes of 16 bits are written as those of 10."""
    files = pillow_heif.HeifFile()
    for _ in range(1 + more):
        files.add_frombytes(mode, (picture.shape[1], picture.shape[0]), picture.tobytes())
    files[0].info |= options
    file = io.BytesIO()
    files.save(file, quality=-1, chroma=444, matrix_coefficients=0, **options)
    return file.getvalue()


def avif(picture: Any, **options: Any) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "AVIF", quality=100, subsampling="4:4:4", **options)
    return file.getvalue()


def read(data: bytes, icc: str = "convert") -> Photograph:
    return decode(data, max_pixels=2**26, icc=icc)


def reason(data: bytes, icc: str = "convert") -> str:
    with pytest.raises(SourceError) as caught:
        read(data, icc)
    return caught.value.reason


def test_codes_of_eight_bits_are_exact() -> None:
    np.testing.assert_array_equal(read(heic(PICTURE)).srgb, PICTURE, strict=True)
    assert np.abs(read(avif(PICTURE)).srgb.astype(int) - PICTURE).max() <= 3  # Pillow writes no lossless ones


def test_codes_of_ten_bits_become_the_nearest_of_sixteen() -> None:
    expected = np.rint(DEEP / 1023 * 65535).astype(np.uint16)
    np.testing.assert_array_equal(read(heic(DEEP * 64, "RGB;16")).srgb, expected, strict=True)
    options = cv2.IMWRITE_AVIF_DEPTH, 10, cv2.IMWRITE_AVIF_QUALITY, 100
    data = cv2.imencode(".avif", DEEP[..., ::-1], options)[1].tobytes()
    found = read(data).srgb
    assert found.dtype == np.uint16 and np.abs(found.astype(int) - expected).max() <= 3 * 65


def test_gray_has_three_equal_channels() -> None:
    np.testing.assert_array_equal(read(heic(PICTURE[..., 0].copy(), "L")).srgb, PICTURE[..., :1].repeat(3, axis=2))


def test_pictures_are_upright() -> None:
    expected = np.rot90(PICTURE, -1)
    file = io.BytesIO()
    pillow_heif.from_pillow(Image.fromarray(PICTURE)).save(file, quality=-1, chroma=444, exif=EXIF_6.tobytes())
    for data, tolerance in ((file.getvalue(), 4), (avif(PICTURE, exif=EXIF_6.tobytes()), 3)):
        assert np.abs(read(data).srgb.astype(int) - expected).max() <= tolerance


def test_digest_is_that_of_the_pixels() -> None:
    for data in (heic(PICTURE), avif(PICTURE)):
        photograph = read(data)
        assert photograph.pixels_xxh3 == array_xxh3(photograph.srgb)


def test_icc_precedes_code_points() -> None:
    p3 = PROFILES["Display P3"]
    for data in (heic(PICTURE, icc_profile=p3), avif(PICTURE, icc_profile=p3)):
        assert read(data).profile.name == "Display P3"
    assert read(heic(PICTURE)).profile.name == read(avif(PICTURE)).profile.name == "sRGB"
    assert read(heic(PICTURE, color_primaries=12, transfer_characteristics=13)).profile.name == "cICP 12/13"


def with_avif_points(primaries: int, transfer: int) -> bytes:
    data = cv2.imencode(".avif", PICTURE)[1].tobytes()
    place = data.index(b"colrnclx") + 8
    return data[:place] + primaries.to_bytes(2) + transfer.to_bytes(2) + data[place + 4 :]


def test_code_points_of_avif_are_read() -> None:
    assert read(with_avif_points(12, 13)).profile.name == "cICP 12/13"


@pytest.mark.parametrize("transfer", [16, 18])
def test_hdr_transfers_are_refused(transfer: int) -> None:
    assert reason(heic(PICTURE, color_primaries=9, transfer_characteristics=transfer)) == "icc"
    assert reason(with_avif_points(9, transfer), icc="ignore") == "icc"


def test_several_pictures_and_sequences_are_refused() -> None:
    assert reason(heic(PICTURE, more=1)) == "animated"
    assert reason(avif(PICTURE, save_all=True, append_images=[Image.fromarray(PICTURE[::-1].copy())])) == "animated"
    assert reason(heic(PICTURE).replace(b"ftypheix", b"ftypmsf1", 1)) == "animated"


def test_transparency_is_refused() -> None:
    faded = np.dstack([PICTURE, np.full((40, 64), 128, np.uint8)])
    assert reason(heic(faded, "RGBA")) == reason(avif(faded)) == "alpha"
    opaque = np.dstack([PICTURE, np.full((40, 64), 255, np.uint8)])
    np.testing.assert_array_equal(read(heic(opaque, "RGBA")).srgb, PICTURE)


def test_cut_files_are_refused() -> None:
    for data in (heic(PICTURE), avif(PICTURE)):
        for length in (*range(8, 600, 37), len(data) - 1):
            assert reason(data[:length]) in ("corrupt", "unsupported")


def test_damaged_headers_are_read_or_refused() -> None:
    generator = np.random.default_rng(0)
    for number in range(300):
        data = bytearray((heic(PICTURE), avif(PICTURE))[number % 2])
        for place in generator.integers(4, 400, 1 + number % 3):
            data[place] = int(generator.integers(256))
        try:
            assert read(bytes(data)).srgb.ndim == 3
        except SourceError:
            continue


def test_missing_library_is_named_with_its_installation(monkeypatch: pytest.MonkeyPatch) -> None:
    data = heic(PICTURE)
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(SourceError, match=r"unsupported: HEIC is read by pillow-heif; .*'unprocess_gen\[heic\]'"):
        read(data)
