"""Linear sources in every format: the same light, notes on what is left out, and damaged or other files refused."""

from __future__ import annotations

import importlib.util
import io
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from unprocess_gen.config.schema import SourceConfig
from unprocess_gen.core.errors import SourceError
from unprocess_gen.sources.image.decode import Photograph
from unprocess_gen.sources.linear.files import DECODERS, read_linear_source
from unprocess_gen.sources.linear.pixels import linear_pixels

LIGHT = (np.random.default_rng(1).random((13, 40, 3)) ** 4 * 5 + 0.01).astype(np.float32)
LIGHT[3:5, 4:30] = 2.5
HALVES = LIGHT.astype(np.float16)
ACESCG = 0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767


def read(content: bytes, name: str, **settings: Any) -> Photograph:
    return read_linear_source(SourceConfig(kind="linear", **settings), content, name)


def refused(content: bytes, name: str, **settings: Any) -> str:
    with pytest.raises(SourceError) as error:
        read(content, name, **settings)
    return f"{error.value.reason}: {error.value.text}"


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def tiff(array: np.ndarray, **options: Any) -> bytes:
    tifffile, file = pytest.importorskip("tifffile"), io.BytesIO()
    tifffile.imwrite(file, array, **{"photometric": "rgb", **options})
    return file.getvalue()


def npy_header(text: str) -> bytes:
    return b"\x93NUMPY\1\0" + bytes([len(text) + 1, 0]) + text.encode() + b"\n"


@pytest.fixture
def exr(tmp_path: Path) -> Callable[..., bytes]:
    """Return a function that encodes channels as an OpenEXR picture with attributes."""
    openexr = pytest.importorskip("OpenEXR")

    def encode(channels: dict[str, Any], **attributes: Any) -> bytes:
        header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage, **attributes}
        openexr.File(header, channels).write(str(tmp_path / "a.exr"))
        return (tmp_path / "a.exr").read_bytes()

    return encode


def colours(prefix: str = "", light: np.ndarray = LIGHT) -> dict[str, np.ndarray]:
    return {f"{prefix}{name}": light[..., channel].copy() for channel, name in enumerate("RGB")}


# -------------------------------------------------------------------------------------------------------------- formats


def test_formats_have_the_same_light(exr: Callable[..., bytes]) -> None:
    files = {
        "a.exr": exr({"RGB": LIGHT}), "b.EXR": exr(colours("beauty.")), "c.npy": npy(LIGHT), "d.tif": tiff(LIGHT),
        "e.tiff": tiff(LIGHT, compression="zlib", byteorder=">"), "f.npy": npy(LIGHT.astype(">f4")),
    }  # fmt: skip
    found = [read(content, name) for name, content in files.items()]
    assert all((photograph.srgb == LIGHT).all() and photograph.srgb.dtype == np.float32 for photograph in found)
    assert {(photograph.source, photograph.note) for photograph in found} == {(found[0].source, "")}
    for content, name in ((exr({"RGB": HALVES}), "a.exr"), (npy(HALVES), "a.npy"), (tiff(HALVES), "a.tif")):
        assert (read(content, name).srgb == HALVES).all()


def test_arrays_of_the_other_byte_order_are_light() -> None:
    swapped = linear_pixels(LIGHT.astype(LIGHT.dtype.newbyteorder("S")))
    assert swapped.dtype == np.dtype("=f4") and (swapped == LIGHT).all()


def test_half_floats_keep_their_smallest_numbers(exr: Callable[..., bytes]) -> None:
    least = np.full((2, 2, 3), 2.0**-24, np.float16)
    assert (read(exr({"RGB": least}), "a.exr").srgb == np.float32(2.0**-24)).all()


def test_alpha_is_left_out_with_a_note(exr: Callable[..., bytes]) -> None:
    rgba = np.dstack([LIGHT, LIGHT[..., :1]])
    for content, name in ((exr({"RGBA": rgba}), "a.exr"), (tiff(rgba), "a.tif")):
        photograph = read(content, name)
        assert (photograph.srgb == LIGHT).all() and photograph.note == "has alpha, which is left out"


def test_a_colour_profile_of_tiff_has_a_note() -> None:
    assert "a colour profile, which is not read" in read(tiff(LIGHT, iccprofile=bytes(128)), "a.tif").note


def test_r_g_b_win_over_layers_whose_names_decide_otherwise(exr: Callable[..., bytes]) -> None:
    both = exr(colours() | colours("diffuse.", LIGHT * 0) | {"Z": LIGHT[..., 0].copy()})
    assert (read(both, "a.exr").srgb == LIGHT).all()
    several = refused(exr(colours("diffuse.") | colours("specular.")), "a.exr")
    assert "has the channels diffuse.B" in several and "expected R, G, B, or one set of *.R, *.G, *.B" in several


def test_chromaticities_are_read_and_settings_win(exr: Callable[..., bytes]) -> None:
    own = exr({"RGB": LIGHT}, chromaticities=(0.7, 0.3, 0.2, 0.7, 0.1, 0.05, 0.31, 0.32))
    lines = "PRIMARIES=0.64 0.33 0.3 0.6 0.15 0.06 0.3127 0.3290\n"
    stated = {"a.exr": exr({"RGB": LIGHT}, chromaticities=ACESCG), "b.exr": own, "c.hdr": flat(lines)}
    found = [read(content, name).source for name, content in stated.items()]
    expected = ["acescg", "0.7;0.3;0.2;0.7;0.1;0.05;0.31;0.32", "srgb"]
    assert [source and source.primaries for source in found] == expected
    source = read(own, "b.exr", primaries="camera").source
    assert source is not None and source.primaries == "camera"


# ------------------------------------------------------------------------------------------------------------- Radiance


def rgbe(light: np.ndarray) -> np.ndarray:
    """Mantissas and exponents of light, [H, W, 4]."""
    exponent = np.frexp(light.max(axis=2))[1]
    mantissas = np.floor(light * np.ldexp(1.0, 8 - exponent)[..., None])
    return np.dstack([mantissas, exponent + 128]).astype(np.uint8)


CODES = rgbe(LIGHT)
DECODED = CODES[..., :3] * np.ldexp(1.0, CODES[..., 3:].astype(int) - 136)


def header(lines: str = "", size: str = "-Y 13 +X 40", magic: str = "#?RADIANCE") -> bytes:
    return f"{magic}\n# a comment\n{lines}FORMAT=32-bit_rle_rgbe\n\n{size}\n".encode()


def flat(lines: str = "", **parts: str) -> bytes:
    return header(lines, **parts) + CODES.tobytes()


def runs_by_channel() -> bytes:
    """Rows in the newer encoding, with runs and literal stretches."""
    rows = bytearray()
    for row in CODES:
        rows += bytes([2, 2, 0, 40])
        for values in row.T:
            x = 0
            while x < 40:
                same = int((np.diff(values[x:].astype(int), append=-1) != 0).argmax()) + 1
                if same > 2:
                    rows += bytes([128 + same, values[x]])
                else:
                    same = min(3, 40 - x)
                    rows += bytes([same]) + values[x : x + same].tobytes()
                x += same
    return bytes(rows)


@pytest.mark.parametrize("rows", [CODES.tobytes(), runs_by_channel()], ids=["flat", "runs"])
def test_radiance_pictures_are_decoded_and_cut_ones_refused(rows: bytes) -> None:
    assert (read(header() + rows, "a.hdr").srgb == DECODED.astype(np.float32)).all()
    for cut in (1, len(rows) // 2, len(rows)):
        assert refused((header() + rows)[:-cut], "a.hdr").startswith(("corrupt: ends", "truncated: ends"))


def test_exposures_divide_light() -> None:
    light = read(flat("EXPOSURE=2\nVIEW= -vtv\nEXPOSURE= 0.5e1\n", magic="#?RGBE"), "a.hdr").srgb
    assert (light == (DECODED / 10).astype(np.float32)).all()


def test_opencv_decodes_the_same_light() -> None:
    import cv2

    decoded = cv2.imdecode(np.frombuffer(header() + runs_by_channel(), np.uint8), cv2.IMREAD_UNCHANGED)
    assert (decoded[..., ::-1] == DECODED).all()


# -------------------------------------------------------------------------------------------------------- refused files

REFUSED = {
    "flipped.hdr": (flat(size="+Y 13 +X 40"), "unsupported: is stored as .Y 13"),
    "xyz.hdr": (flat().replace(b"rgbe", b"xyze"), "unsupported: states FORMAT=32-bit_rle_xyze"),
    "other.hdr": (b"P6\n1 1\n255\nabc", "unsupported: has no header of Radiance"),
    "dark.hdr": (flat("EXPOSURE=0\n"), "corrupt: states the exposure 0"),
    "word.hdr": (flat("EXPOSURE=high\n"), "corrupt: states EXPOSURE=high; expected numbers"),
    "line.hdr": (flat("PRIMARIES=0 0 0 0 0 0 0 0\n"), "corrupt: states the chromaticities 0;0"),
    "large.hdr": (header(size="-Y 99999 +X 99999"), "too_large: has 99999 x 99999 pixels"),
    "bomb.hdr": (header(size="-Y 8000 +X 8000") + bytes(9), "truncated: ends before its 8000 x 8000 pixels"),
    "repeats.hdr": (header() + bytes([9, 9, 9, 9, 1, 1, 1, 39]) + flat(), "corrupt: .* or repeats pixels, in row 0"),
    "wide.npy": (npy(LIGHT.astype(float)), r"unsupported: is float64 \[13, 40, 3\]"),
    "gray.npy": (npy(LIGHT[..., 0]), r"unsupported: is float32 \[13, 40\]"),
    "nan.npy": (npy(np.where(LIGHT > 4, np.nan, LIGHT).astype(np.float32)), "corrupt: has .* pixels that are NaN"),
    "half.npy": (npy(np.full((2, 2, 3), np.inf, np.float16)), "corrupt: has 4 pixels that are NaN or infinite"),
    "cut.npy": (npy(LIGHT)[:-9], "corrupt: cannot be decoded"),
    "header.npy": (npy_header("{'shape': (2, 2"), "corrupt: cannot be decoded"),
    "bomb.npy": (npy_header("{'descr': '<f4', 'fortran_order': False, 'shape': (999999999999,)}"), "corrupt: declares"),
    "lab.tif": (tiff(LIGHT, photometric="cielab"), "unsupported: is float32 .* photometric 8"),
    "codes.tif": (tiff((LIGHT * 50).astype(np.uint8)), "unsupported: is uint8"),
    "pages.tif": (tiff(np.stack([LIGHT, LIGHT])), "unsupported: is .* 2 pages"),
    "cut.tif": (tiff(LIGHT)[:-9], "corrupt: tifffile cannot decode it"),
    "rotated.tif": (tiff(LIGHT, extratags=[(274, "H", 1, 6, True)]), "unsupported: is .* orientation 6"),
    "a.jpg": (b"", "unsupported: has the suffix '.jpg'"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_other_and_damaged_files_are_refused(name: str) -> None:
    content, problem = REFUSED[name]
    assert re.match(problem, refused(content, name))


def test_other_exr_files_are_refused(exr: Callable[..., bytes], tmp_path: Path) -> None:
    import OpenEXR

    whole = exr({"RGB": LIGHT})
    for content in (whole[:-700], whole[:40], b"", whole[:500] + bytes(900)):
        assert refused(content, "a.exr") == "corrupt: OpenEXR cannot decode all of the file"
    assert refused(exr({"Z": LIGHT[..., 0].copy()}), "a.exr").startswith("unsupported: has the channels Z")
    whole_numbers = exr({"RGB": (LIGHT * 9).astype(np.uint32)})
    assert refused(whole_numbers, "a.exr").startswith("unsupported: is uint32")
    assert refused(whole, "a.exr", max_pixels=100).startswith("too_large: has 40 x 13 pixels")
    part = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    parts = [OpenEXR.Part({**part, "name": name}, {"RGB": LIGHT}) for name in ("left", "right")]
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    assert refused((tmp_path / "parts.exr").read_bytes(), "a.exr").startswith("unsupported: has 2 parts")
    red = whole.index(b"R\0\2\0\0\0") + 10  # its steps across and down
    subsampled = whole[:red] + bytes([2]) + whole[red + 1 :]
    assert refused(subsampled, "a.exr").startswith("unsupported: has subsampled channels")
    samples = np.empty((2, 2), object)
    for place in np.ndindex(2, 2):
        samples[place] = np.ones(3, np.float32)
    deep = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.deepscanline}
    OpenEXR.File(deep, dict.fromkeys("RGB", samples)).write(str(tmp_path / "deep.exr"))
    assert refused((tmp_path / "deep.exr").read_bytes(), "a.exr").startswith("unsupported: is deep")


@pytest.mark.skipif(importlib.util.find_spec("imagecodecs") is not None, reason="imagecodecs decodes LZW")
def test_compression_without_its_codec_is_named() -> None:
    content, tag = tiff(LIGHT, compression="zlib"), struct.pack("<HHI", 259, 3, 1)
    lzw = content.replace(tag + struct.pack("<H", 8), tag + struct.pack("<H", 5))
    assert refused(lzw, "a.tif") == "unsupported: its compression needs imagecodecs; pip install imagecodecs"


def test_every_suffix_of_the_option_has_a_decoder() -> None:
    from unprocess_gen.config.composition import load_config

    assert {pattern[1:] for pattern in load_config(["source.kind=linear"]).source.include} == DECODERS.keys()
