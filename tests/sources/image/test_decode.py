"""Decoding and its policy: exact pixels where a photograph is taken, a reason where it is not, and nothing in between.

Every file is made here, by Pillow, tifffile, OpenCV or by hand; Pillow's reading of a header is a second opinion.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from helpers.corpus import retagged
from helpers.promise_report import Figure
from PIL import Image, ImageCms

from unprocess_gen.core.errors import SourceError
from unprocess_gen.sources.image.decode import ICC_CHOICES, decode
from unprocess_gen.sources.image.headers import probe

SIZES = [(1, 1), (1, 9), (7, 13), (40, 61)]


def smooth(height: int = 40, width: int = 61, seed: int = 0) -> np.ndarray:
    """A soft, asymmetric picture, uint8 [H, W, 3]: what JPEG can hold."""
    rows, columns = np.mgrid[:height, :width]
    wave = np.stack([3 * rows + columns, 2 * columns + rows + 40, rows * columns // 16 + seed], -1)
    return (np.abs(wave % 400 - 200) + 30).astype(np.uint8)


def noise(height: int, width: int, dtype: Any = np.uint8, channels: int = 3) -> np.ndarray:
    generator = np.random.default_rng(height * 1000 + width)
    return generator.integers(0, np.iinfo(dtype).max, (height, width, channels), dtype, endpoint=True)


def pillow(pixels: np.ndarray | Image.Image, kind: str, **options: Any) -> bytes:
    file = io.BytesIO()
    image = pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels)
    image.save(file, kind, **options)
    return file.getvalue()


def tiff(pixels: np.ndarray, photometric: str = "rgb", **options: Any) -> bytes:
    file = io.BytesIO()
    tifffile.imwrite(file, pixels, photometric=photometric, **options)
    return file.getvalue()


def chunk(kind: bytes, payload: bytes = b"") -> bytes:
    return struct.pack(">I", len(payload)) + kind + payload + struct.pack(">I", zlib.crc32(kind + payload))


def png(
    width: int, bits: int, colour: int, row: bytes, before: bytes = b"", after: bytes = b"", height: int = 1
) -> bytes:
    """A PNG of equal rows, with chunks before and after the pixels."""
    head = chunk(b"IHDR", struct.pack(">IIBB3x", width, height, bits, colour))
    pixels = chunk(b"IDAT", zlib.compress((b"\0" + row) * height))
    return b"\x89PNG\r\n\x1a\n" + head + before + pixels + after + chunk(b"IEND")


def bmp(width: int, height: int, bits: int, pixels: bytes, masks: tuple[int, ...] = (), palette: bytes = b"") -> bytes:
    """A BMP with the 108-byte header where there are masks, and the 40-byte one where there are none."""
    size = 108 if masks else 40
    extra = struct.pack(f"<{len(masks)}I", *masks).ljust(size - 40, b"\0") + palette
    offset = 54 + len(extra)
    compression = 3 if masks else 0
    info = struct.pack(
        "<IiiHHIIiiII", size, width, height, 1, bits, compression, len(pixels), 0, 0, len(palette) // 4, 0
    )
    return struct.pack("<2sIHHI", b"BM", offset + len(pixels), 0, 0, offset) + info + extra + pixels


def exif(orientation: int, order: str = "<", kind: int = 3) -> bytes:
    """An EXIF block with the orientation only."""
    mark = b"II*\0" if order == "<" else b"MM\0*"
    value = struct.pack(order + ("H2x" if kind == 3 else "I"), orientation)
    return b"Exif\0\0" + mark + struct.pack(order + "IHHHI", 8, 1, 274, kind, 1) + value + bytes(4)


def pixels_of(data: bytes, *, max_pixels: int = 2**26, icc: str = "ignore") -> np.ndarray:
    return decode(data, max_pixels=max_pixels, icc=icc).srgb


def reason_of(data: bytes, *, max_pixels: int = 2**26, icc: str = "ignore") -> str:
    with pytest.raises(SourceError) as caught:
        decode(data, max_pixels=max_pixels, icc=icc)
    return caught.value.reason


# Pixels are exact -----------------------------------------------------------------------------------------------------

Write = Callable[[np.ndarray], bytes]
LOSSLESS: dict[str, tuple[Any, Write]] = {
    "png": (np.uint8, lambda pixels: pillow(pixels, "PNG")),
    "png, 16 bits": (np.uint16, lambda pixels: cv2.imencode(".png", pixels[..., ::-1])[1].tobytes()),
    "webp": (np.uint8, lambda pixels: pillow(pixels, "WEBP", lossless=True)),
    "bmp": (np.uint8, lambda pixels: pillow(pixels, "BMP")),
    "tiff": (np.uint8, tiff),
    "tiff, big-endian": (np.uint8, lambda pixels: tiff(pixels, byteorder=">")),
    "tiff, deflated": (np.uint8, lambda pixels: tiff(pixels, compression="zlib", predictor=True)),
    "tiff, PackBits": (np.uint8, lambda pixels: pillow(pixels, "TIFF", compression="packbits")),
    "tiff, tiles": (np.uint8, lambda pixels: tiff(pixels, tile=(32, 32))),
    "tiff, strips": (np.uint8, lambda pixels: tiff(pixels, rowsperstrip=2)),
    "tiff, planes": (np.uint8, lambda pixels: tiff(np.moveaxis(pixels, -1, 0).copy(), planarconfig="separate")),
    "tiff, 16 bits": (np.uint16, tiff),
    "tiff, 16 bits, big-endian": (np.uint16, lambda pixels: tiff(pixels, byteorder=">")),
    "tiff, 16 bits, tiles": (np.uint16, lambda pixels: tiff(pixels, tile=(16, 16))),
}


@pytest.mark.parametrize("kind", LOSSLESS)
def test_lossless_pixels_are_exact(kind: str) -> None:
    dtype, write = LOSSLESS[kind]
    for size in SIZES:
        stored = noise(*size, dtype)
        np.testing.assert_array_equal(pixels_of(write(stored)), stored, f"{size}", strict=True)


GRAY: dict[str, Write] = {
    "png": lambda gray: cv2.imencode(".png", gray)[1].tobytes(),
    "tiff": lambda gray: tiff(gray, "minisblack"),
    "tiff, white is zero": lambda gray: tiff(np.iinfo(gray.dtype).max - gray, "miniswhite"),
    "bmp": lambda gray: pillow(gray, "BMP"),
}


@pytest.mark.parametrize(
    ("kind", "dtype"), [*((kind, np.uint8) for kind in GRAY), *((kind, np.uint16) for kind in GRAY if kind != "bmp")]
)
def test_gray_becomes_three_equal_channels(kind: str, dtype: Any) -> None:
    stored = noise(7, 13, dtype, 1)
    np.testing.assert_array_equal(pixels_of(GRAY[kind](stored[..., 0])), np.repeat(stored, 3, 2), strict=True)


def test_few_bits_of_gray_are_spread_over_all_codes() -> None:
    assert pixels_of(png(4, 2, 0, b"\x1b"))[0, :, 0].tolist() == [0, 85, 170, 255]
    stored = noise(5, 19, channels=1)[..., 0] > 100
    np.testing.assert_array_equal(pixels_of(tiff(stored, "minisblack"))[..., 1], stored * np.uint8(255))


@pytest.mark.parametrize("kind", ["PNG", "BMP", "TIFF"])
def test_palettes_become_rgb(kind: str) -> None:
    image = Image.fromarray(smooth()).quantize(4)
    np.testing.assert_array_equal(pixels_of(pillow(image, kind)), np.asarray(image.convert("RGB")), strict=True)


@pytest.mark.parametrize(("subsampling", "progressive"), [(0, True), (2, False)], ids=["444", "420"])
def test_jpeg_pixels_are_those_opencv_decodes_by_default(subsampling: int, progressive: bool) -> None:
    for size in SIZES:
        data = pillow(smooth(*size), "JPEG", subsampling=subsampling, progressive=progressive)
        by_default = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(pixels_of(data), by_default[..., ::-1], f"{size}", strict=True)


@pytest.mark.parametrize(("kind", "options"), [("WEBP", {}), ("TIFF", {"compression": "jpeg"})], ids=str)
def test_lossy_pixels_are_read_in_rgb_order(kind: str, options: dict[str, str]) -> None:
    difference = pixels_of(pillow(smooth(), kind, quality=95, **options)).astype(int) - smooth()
    assert np.abs(difference).mean() < 8


def test_a_bmp_may_be_stored_top_down_or_with_an_unused_byte() -> None:
    assert pixels_of(bmp(1, -2, 24, b"\3\2\1\0\6\5\4\0")).tolist() == [[[1, 2, 3]], [[4, 5, 6]]]
    assert pixels_of(bmp(1, 1, 32, b"\3\2\1\0")).tolist() == [[[1, 2, 3]]]


# Orientation ----------------------------------------------------------------------------------------------------------

# What the EXIF standard says of tag 274: where the stored first row and first column lie in the upright picture.
UPRIGHT: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    1: lambda stored: stored,
    2: np.fliplr,
    3: lambda stored: np.rot90(stored, 2),
    4: np.flipud,
    5: lambda stored: stored.swapaxes(0, 1),
    6: lambda stored: np.rot90(stored, -1),
    7: lambda stored: np.rot90(stored, 2).swapaxes(0, 1),
    8: lambda stored: np.rot90(stored, 1),
}

ORIENTED: dict[str, tuple[Any, Callable[[np.ndarray, int], bytes]]] = {
    "jpeg": (np.uint8, lambda pixels, turn: pillow(pixels, "JPEG", exif=exif(turn))),
    "jpeg, big-endian": (np.uint8, lambda pixels, turn: pillow(pixels, "JPEG", exif=exif(turn, ">"))),
    "png": (np.uint8, lambda pixels, turn: pillow(pixels, "PNG", exif=exif(turn))),
    "webp": (np.uint8, lambda pixels, turn: pillow(pixels, "WEBP", lossless=True, exif=exif(turn))),
    "tiff": (np.uint8, lambda pixels, turn: tiff(pixels, extratags=[(274, "H", 1, turn, True)])),
    "tiff, tiles": (np.uint8, lambda pixels, turn: tiff(pixels, tile=(32, 32), extratags=[(274, "H", 1, turn, True)])),
    "tiff, 32-bit tag": (np.uint8, lambda pixels, turn: tiff(pixels, extratags=[(274, "I", 1, turn, True)])),
    "tiff, 16 bits, big-endian": (
        np.uint16,
        lambda pixels, turn: tiff(pixels, byteorder=">", extratags=[(274, "H", 1, turn, True)]),
    ),
}


@pytest.mark.parametrize("kind", ORIENTED)
def test_orientation_is_applied_once(kind: str) -> None:
    dtype, write = ORIENTED[kind]
    stored = smooth(6, 11).astype(dtype) * dtype(257 if dtype is np.uint16 else 1)
    as_stored = decode(write(stored, 1), max_pixels=66, icc="ignore").srgb
    if kind.partition(",")[0] != "jpeg":
        np.testing.assert_array_equal(as_stored, stored)
    for turn, upright in UPRIGHT.items():
        photograph = decode(write(stored, turn), max_pixels=66, icc="ignore")
        np.testing.assert_array_equal(photograph.srgb, upright(as_stored), f"orientation {turn}", strict=True)
        assert photograph.orientation == turn


@pytest.mark.parametrize("kind", ["jpeg", "tiff"])
def test_an_orientation_that_does_not_exist_is_1(kind: str) -> None:
    dtype, write = ORIENTED[kind]
    for value in (0, 9):
        photograph = decode(write(noise(4, 6, dtype), value), max_pixels=24, icc="ignore")
        assert (photograph.orientation, photograph.srgb.shape) == (1, (4, 6, 3)), value


@pytest.mark.parametrize(
    ("data", "orientation"),
    [
        (pillow(smooth(), "JPEG", exif=b"\0"), 1),
        (pillow(smooth(), "JPEG", exif=b"Exif\0\0garbage"), 1),
        (pillow(smooth(), "JPEG", exif=exif(6)[:20]), 1),
        (pillow(smooth(), "JPEG", exif=exif(6)[:-4] + struct.pack("<I", 2**31)), 6),
        (pillow(smooth(), "JPEG", exif=b"Exif\0\0" + struct.pack("<2sHIH", b"II", 42, 8, 5000) + bytes(60004)), 1),
        (png(1, 8, 2, b"abc", after=chunk(b"eXIf", exif(5)[6:])), 5),
    ],
    ids=["no block", "no directory", "a cut directory", "a broken thumbnail", "too many entries", "behind the pixels"],
)
def test_a_broken_exif_block_is_no_reason_to_refuse_pixels(data: bytes, orientation: int) -> None:
    assert decode(data, max_pixels=2**26, icc="ignore").orientation == orientation


# Alpha ----------------------------------------------------------------------------------------------------------------


def with_alpha(alpha: int, dtype: Any = np.uint8) -> np.ndarray:
    """Return ``[5, 7, 4]``, opaque except for one pixel."""
    stored = np.dstack([noise(5, 7, dtype), np.full((5, 7), np.iinfo(dtype).max, dtype)])
    stored[3, 2, 3] = alpha
    return stored


def bgra(stored: np.ndarray) -> np.ndarray:
    return stored[..., [2, 1, 0, 3]]


ALPHA: dict[str, tuple[Any, Callable[[np.ndarray], bytes]]] = {
    "png": (np.uint8, lambda pixels: pillow(pixels, "PNG")),
    "png, 16 bits": (np.uint16, lambda pixels: cv2.imencode(".png", bgra(pixels))[1].tobytes()),
    "webp": (np.uint8, lambda pixels: pillow(pixels, "WEBP", lossless=True, exact=True)),
    "tiff": (np.uint8, lambda pixels: tiff(pixels, extrasamples=["unassalpha"])),
    "tiff, 16 bits": (np.uint16, lambda pixels: tiff(pixels, extrasamples=["unassalpha"])),
}


@pytest.mark.parametrize("kind", ALPHA)
def test_alpha_is_dropped_if_all_pixels_are_opaque_and_refused_otherwise(kind: str) -> None:
    dtype, write = ALPHA[kind]
    stored = with_alpha(np.iinfo(dtype).max, dtype)
    np.testing.assert_array_equal(pixels_of(write(stored)), stored[..., :3], strict=True)
    assert reason_of(write(with_alpha(np.iinfo(dtype).max - 1, dtype))) == "alpha"


PALETTE = chunk(b"PLTE", bytes(range(12)))
# colour type, bits, row, a tRNS that no pixel meets, one that a pixel meets
TRANSPARENT_KEYS = {
    "rgb 8": (2, 8, bytes(range(12)), b"\0\0\0\1\0\3", b"\0\3\0\4\0\5"),
    "rgb 16": (2, 16, bytes(range(24)), b"\0\1\2\3\4\4", b"\0\1\2\3\4\5"),
    "palette": (3, 8, b"\0\1\1\0", b"\xff\xff\0", b"\xff\xfe"),
}


@pytest.mark.parametrize("kind", TRANSPARENT_KEYS)
def test_transparent_png_colour_is_refused_if_a_pixel_has_it_and_dropped_otherwise(kind: str) -> None:
    colour, bits, row, unmet, met = TRANSPARENT_KEYS[kind]
    before = PALETTE if colour == 3 else b""
    assert reason_of(png(4, bits, colour, row, before + chunk(b"tRNS", met))) == "alpha"
    dropped = pixels_of(png(4, bits, colour, row, before + chunk(b"tRNS", unmet)))
    np.testing.assert_array_equal(dropped, pixels_of(png(4, bits, colour, row, before)))


def test_gray_with_alpha_is_accepted_where_opencv_keeps_it() -> None:
    assert pixels_of(png(2, 8, 4, bytes([5, 255, 170, 255])))[0, :, 0].tolist() == [5, 170]


# Refusals -------------------------------------------------------------------------------------------------------------


OTHER_FORMATS = {
    "JPEG XL": [b"\xff\x0a", b"\0\0\0\x0cJXL \r\n\x87\n"],
    "JPEG 2000": [b"\xff\x4f\xff\x51", b"\0\0\0\x0cjP  \r\n\x87\n"],
    "GIF": [b"GIF89a"],
}


@pytest.mark.parametrize(
    ("name", "start"), [(name, start) for name, starts in OTHER_FORMATS.items() for start in starts]
)
def test_other_formats_are_named_with_advice(name: str, start: bytes) -> None:
    with pytest.raises(SourceError) as caught:
        decode(start + bytes(16), max_pixels=2**26, icc="ignore")
    assert (caught.value.reason, caught.value.text) == ("unsupported", f"{name}; convert it to JPEG, PNG or TIFF")


GRADES = noise(4, 6, channels=1)[..., 0]
CMYK = Image.new("CMYK", (5, 4), (10, 20, 30, 40))
MORE = {"save_all": True, "append_images": [Image.fromarray(smooth(seed=seed)) for seed in (50, 90)]}
REFUSED = {
    "nothing": (b"", "empty"),
    "text": (b"hello", "unsupported"),
    "zero": (b"\0", "unsupported"),
    "big tiff": (b"II+\0\x08\0\0\0", "unsupported"),
    "12-bit jpeg": (pillow(smooth(), "JPEG").replace(b"\xff\xc0\0\x11\x08", b"\xff\xc0\0\x11\x0c"), "unsupported"),
    "float tiff": (tiff(GRADES.astype(np.float32), "minisblack"), "unsupported"),
    "signed tiff": (tiff(GRADES.astype(np.int16), "minisblack"), "unsupported"),
    "lab tiff": (tiff(noise(4, 6), "cielab"), "unsupported"),
    "planes of 16 bits": (tiff(noise(3, 40, np.uint16, 61), planarconfig="separate"), "unsupported"),
    "small tiles": (tiff(noise(40, 61), tile=(16, 16)), "unsupported"),
    "lzma tiff": (tiff(noise(4, 6), compression="lzma"), "unsupported"),
    "huge tiles": (
        retagged(tiff(noise(40, 61), tile=(32, 64), compression="zlib"), {322: 2**15, 323: 2**15}),
        "unsupported",
    ),
    "thumbnail first": (tiff(noise(4, 6), subfiletype=1), "unsupported"),
    "16-bit bmp": (bmp(1, 1, 16, b"\x1f\x7c\0\0"), "unsupported"),
    "bmp with masks": (bmp(1, 1, 32, bytes(4), (0xFF0000, 0xFF00, 0xFF, 0)), "unsupported"),
    "inks, jpeg": (pillow(CMYK, "JPEG"), "cmyk"),
    "inks, tiff": (pillow(CMYK, "TIFF"), "cmyk"),
    "animated png": (pillow(smooth(), "PNG", **MORE), "animated"),
    "animated webp": (pillow(smooth(), "WEBP", **MORE), "animated"),
    "pages of a tiff": (pillow(smooth(), "TIFF", **MORE), "animated"),
    "gray png of alpha": (png(2, 8, 4, bytes([5, 255, 170, 254])), "alpha"),
    "gray png of a transparent value": (png(4, 8, 0, b"\5\6\7\x08", chunk(b"tRNS", b"\0\4")), "alpha"),
    "gray tiff of alpha": (tiff(noise(3, 4, channels=2), "minisblack", extrasamples=["unassalpha"]), "alpha"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_pictures_that_cannot_be_read_correctly_are_refused(kind: str) -> None:
    data, reason = REFUSED[kind]
    assert reason_of(data) == reason


def test_thumbnail_page_next_to_a_full_one_is_accepted() -> None:
    file = io.BytesIO()
    with tifffile.TiffWriter(file) as writer:
        writer.write(noise(8, 9), photometric="rgb")
        writer.write(noise(2, 3), photometric="rgb", subfiletype=1)
    np.testing.assert_array_equal(pixels_of(file.getvalue()), noise(8, 9))


def test_the_limit_of_pixels_is_inclusive() -> None:
    data = pillow(noise(7, 13), "PNG")
    assert pixels_of(data, max_pixels=91).shape == (7, 13, 3)
    assert reason_of(data, max_pixels=90) == "too_large"


# Colour profiles ------------------------------------------------------------------------------------------------------


def swapped_primaries() -> bytes:
    """Return a profile that is sRGB with red and green swapped."""
    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    tags = {
        bytes(profile[at : at + 4]): at for at in range(132, 132 + 12 * int.from_bytes(profile[128:132], "big"), 12)
    }
    profile[tags[b"rXYZ"] : tags[b"rXYZ"] + 4], profile[tags[b"gXYZ"] : tags[b"gXYZ"] + 4] = b"gXYZ", b"rXYZ"
    return bytes(profile)


SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
LAB = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF"])
def test_only_srgb_profiles_are_accepted_when_asked(kind: str) -> None:
    assert pixels_of(pillow(smooth(), kind, icc_profile=SRGB), icc="refuse").shape == (40, 61, 3)
    for profile in (swapped_primaries(), LAB, b"garbage"):
        assert reason_of(pillow(smooth(), kind, icc_profile=profile), icc="refuse") == "icc"


def test_profile_in_many_segments_is_joined() -> None:
    profile = SRGB + bytes(150_000)
    assert probe(pillow(smooth(), "JPEG", icc_profile=profile)).icc == profile


def with_cicp(primaries: int, transfer: int, matrix: int = 0, full_range: int = 1, **options: object) -> bytes:
    """Return a PNG that declares its colours by code points (cICP, before the pixels)."""
    data = pillow(smooth(), "PNG", **options)
    return data[:33] + chunk(b"cICP", bytes((primaries, transfer, matrix, full_range))) + data[33:]


@pytest.mark.parametrize("codes", [(9, 16), (9, 18), (1, 8), (1, 13, 9, 1), (1, 13, 0, 0)])
@pytest.mark.parametrize("choice", ICC_CHOICES)
def test_png_whose_codes_are_not_display_referred_rgb_is_refused(codes: tuple[int, ...], choice: str) -> None:
    assert reason_of(with_cicp(*codes), icc=choice) == ("icc" if len(codes) == 2 else "unsupported")


def test_broken_profiles_and_other_primaries_are_refused_when_asked() -> None:
    assert reason_of(png(1, 8, 2, b"abc", chunk(b"iCCP", b"name\0\0not deflated")), icc="refuse") == "icc"
    assert reason_of(with_cicp(12, 13), icc="refuse") == "icc"
    for data in (with_cicp(12, 13), pillow(smooth(), "PNG", icc_profile=swapped_primaries())):
        np.testing.assert_array_equal(pixels_of(data, icc="ignore"), smooth())


def test_srgb_code_points_override_the_profile_of_a_png() -> None:
    data = with_cicp(1, 13, icc_profile=swapped_primaries())
    np.testing.assert_array_equal(pixels_of(data, icc="refuse"), smooth())


# Truncation and damage ------------------------------------------------------------------------------------------------


def thumbnail_exif() -> bytes:
    """Return EXIF with a complete JPEG in it, which has an end-of-image marker."""
    block = exif(6)
    small = pillow(smooth(8, 8), "JPEG")
    link = struct.pack("<I", len(block) - 6)
    second = struct.pack("<HHHIIHHIII", 2, 513, 4, 1, len(block) - 6 + 30, 514, 4, 1, len(small), 0)
    return block[:-4] + link + second + small


CUTTABLE = {
    "jpeg": pillow(smooth(), "JPEG"),
    "jpeg, progressive": pillow(smooth(), "JPEG", progressive=True),
    "jpeg, thumbnail": pillow(smooth(), "JPEG", exif=thumbnail_exif()),
    "png": pillow(smooth(), "PNG"),
    "webp": pillow(smooth(), "WEBP"),
    "webp, lossless, EXIF": pillow(smooth(), "WEBP", lossless=True, exif=exif(6)),
    "bmp": pillow(smooth(20, 21), "BMP"),
    "tiff": tiff(smooth(20, 21)),
    "tiff, directory first": pillow(smooth(20, 21), "TIFF"),
    "tiff, deflated, 16 bits": tiff(noise(9, 9, np.uint16), compression="zlib"),
}


@pytest.mark.parametrize("kind", CUTTABLE)
def test_every_cut_is_refused(kind: str, figure: Figure) -> None:
    data = CUTTABLE[kind]
    assert pixels_of(data).shape[2] == 3
    reasons = Counter(reason_of(data[:length]) for length in range(12, len(data)))
    assert set(reasons) == {"truncated"}
    figure("damaged-pictures", f"{len(data) - 12 - reasons['truncated']} of {len(data) - 12} truncations decoded")


@pytest.mark.parametrize("kind", ["jpeg", "jpeg, progressive", "png", "webp", "bmp", "tiff"])
def test_bytes_after_the_end_are_accepted(kind: str) -> None:
    for tail in (b"\xff", pillow(smooth(), "JPEG"), b"\0\0\0\x18ftypmp42" + bytes(99)):
        np.testing.assert_array_equal(pixels_of(CUTTABLE[kind] + tail), pixels_of(CUTTABLE[kind]))
    if kind == "jpeg":  # some cameras write bytes before the end marker, which libjpeg ignores
        np.testing.assert_array_equal(pixels_of(CUTTABLE[kind][:-2] + b"\0\0\xff\xd9"), pixels_of(CUTTABLE[kind]))


NOISY = pillow(noise(64, 64), "JPEG", quality=85)
DEFLATED = pillow(noise(64, 64), "TIFF", compression="tiff_deflate")
CORRUPT = {
    **{f"jpeg without bytes from {cut}": NOISY[: cut + 400] + NOISY[-2:] for cut in (300, 1410, 2890)},
    "tiff of broken data": DEFLATED[:400] + bytes(byte ^ 0x55 for byte in DEFLATED[400:460]) + DEFLATED[460:],
    "jpeg without a frame": b"\xff\xd8\xff\xe0\0\4ab\xff\xd9",
    "jpeg of height 0": pillow(smooth(), "JPEG").replace(struct.pack(">HH", 40, 61), struct.pack(">HH", 0, 61), 1),
    "png with a flipped bit": CUTTABLE["png"][:-40] + bytes([CUTTABLE["png"][-40] ^ 1]) + CUTTABLE["png"][-39:],
    "png of width 0": png(0, 8, 2, b""),
    "png that begins otherwise": b"\x89PNG\r\n\x1a\n" + chunk(b"CgBI", bytes(20)) + chunk(b"IEND"),
    "webp without a picture": b"RIFF" + struct.pack("<I4s4sI", 12, b"WEBP", b"EXIF", 0),
    "tiff of few strips": retagged(tiff(smooth(), rowsperstrip=8), {278: 2}),
    "tiff of short strips": retagged(tiff(smooth()), {279: 100}),
    "bmp of width -1": bmp(-1, 1, 24, bytes(8)),
}


@pytest.mark.parametrize("kind", CORRUPT)
def test_damage_is_corrupt(kind: str) -> None:
    assert reason_of(CORRUPT[kind]) == "corrupt"


def test_circular_chain_of_tiff_pages_ends() -> None:
    data = bytearray(tiff(smooth()))
    (first,) = struct.unpack_from("<I", data, 4)
    (entries,) = struct.unpack_from("<H", data, first)
    struct.pack_into("<I", data, first + 2 + 12 * entries, first)
    np.testing.assert_array_equal(pixels_of(bytes(data)), smooth())


# Messages of codecs ---------------------------------------------------------------------------------------------------


def test_a_refusal_leaves_stderr_clean(capfd: pytest.CaptureFixture[str]) -> None:
    test_damage_is_corrupt("jpeg without bytes from 1410")
    assert capfd.readouterr().err == ""


def test_codec_warning_is_logged_with_the_name_of_its_file(
    capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    true_imdecode = cv2.imdecode

    def chatty(buffer: np.ndarray, flags: int) -> np.ndarray:
        os.write(2, b"something\nharmless\n")
        return true_imdecode(buffer, flags)

    monkeypatch.setattr(cv2, "imdecode", chatty)
    decode(pillow(smooth(), "PNG"), max_pixels=2**26, icc="ignore", name="sub/a.png")
    assert caplog.messages == ["sub/a.png: something harmless"]
    assert capfd.readouterr().err == ""


def test_reason_of_damage_does_not_depend_on_the_codec_version(monkeypatch: pytest.MonkeyPatch) -> None:
    for words in (b"Corrupt JPEG data: 9 bytes before 0xd9 of libjpeg 9\n", b"Corrupt JPEG data: premature end 62\n"):
        monkeypatch.setattr(cv2, "imdecode", lambda buffer, flags, words=words: os.write(2, words) and None)
        with pytest.raises(SourceError) as caught:
            decode(pillow(smooth(), "JPEG"), max_pixels=2**26, icc="ignore")
        assert caught.value.text == "OpenCV cannot decode all of the jpeg data: Corrupt JPEG data"
