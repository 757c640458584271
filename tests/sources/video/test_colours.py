"""Colours of videos: those of the formulas to half a code, and upright."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from helpers.promise_report import Figure
from helpers.videos import film, opened, raw_frame, rgb, scene, settings_of

from unprocess_gen.core.errors import SourceError
from unprocess_gen.sources.loader import list_photographs, load_source

av = pytest.importorskip("av")
from unprocess_gen.sources.video.colours import PIXEL_FORMATS  # noqa: E402

# Colours --------------------------------------------------------------------------------------------------------------

WEIGHTS = {1: (0.2126, 0.0722), 5: (0.299, 0.114), 6: (0.299, 0.114), 9: (0.2627, 0.0593)}


def formula(y: np.ndarray, u: np.ndarray, v: np.ndarray, matrix: int, full: bool, bits: int) -> np.ndarray:
    """YUV to RGB in float64 after the standards' equations, chroma replicated; unrounded codes, clipped."""
    unit = 2.0 ** (bits - 8)
    black, luma, chroma = (0.0, 2.0**bits - 1, 2.0**bits - 1) if full else (16 * unit, 219 * unit, 224 * unit)
    height, width = y.shape
    by = (-(-height // u.shape[0]), -(-width // u.shape[1]))
    pb, pr = (
        (np.repeat(np.repeat(one, by[0], 0), by[1], 1)[:height, :width] - 128 * unit) / chroma
        for one in (u.astype(float), v.astype(float))
    )
    light = (y.astype(float) - black) / luma
    kr, kb = WEIGHTS[matrix]
    red, blue = light + 2 * (1 - kr) * pr, light + 2 * (1 - kb) * pb
    green = (light - kr * red - kb * blue) / (1 - kr - kb)
    return np.clip(np.stack([red, green, blue], -1), 0, 1) * (65535 if bits > 8 else 255)


def noise_planes(pix_fmt: str, width: int = 33, height: int = 17) -> list[np.ndarray]:
    form = PIXEL_FORMATS[pix_fmt]
    rng = np.random.default_rng(5)
    dtype = np.uint16 if form.bits > 8 else np.uint8
    small = -(-height >> form.shift_y), -(-width >> form.shift_x)
    return [rng.integers(0, 1 << form.bits, shape, dtype) for shape in ((height, width), small, small)]


LOSSLESS = {
    "rgb24": ("rawvideo", "mov"),
    "bgr24": ("rawvideo", "avi"),  # stored from the bottom up
    "gbrp": ("utvideo", "avi"),
    "bgr0": ("ffv1", "mkv"),
}
YUVJ = {"yuvj420p": "mjpeg", "yuvj422p": "mjpeg", "yuvj444p": "mjpeg"}
YUV = [name for name in PIXEL_FORMATS if name.startswith("yuv") and name not in YUVJ]


@pytest.mark.parametrize("pix_fmt", YUV)
def test_colours_are_the_formulas_to_half_a_code(pix_fmt: str, tmp_path: Path, figure: Figure) -> None:
    planes, largest = noise_planes(pix_fmt), 0.0
    for matrix, full in itertools.product(WEIGHTS, (False, True)):
        tags = {"colorspace": matrix, "color_range": 2 if full else 1}
        path = film(tmp_path / "a.mkv", "ffv1", pix_fmt, [raw_frame(pix_fmt, planes)], **tags)
        found = rgb(opened(path), 0)
        wanted = formula(*planes, matrix, full, PIXEL_FORMATS[pix_fmt].bits)
        assert found.dtype == (np.uint16 if PIXEL_FORMATS[pix_fmt].bits > 8 else np.uint8)
        assert found.shape == wanted.shape == (17, 33, 3)
        largest = max(largest, np.abs(found - wanted).max())
        assert largest <= 0.5 + 1e-6, tags
    figure("video", f"at most {largest:.2f} codes from the formula")


def test_interleaved_chroma_is_taken_apart(tmp_path: Path) -> None:
    y, u, v = noise_planes("nv12")
    frame = raw_frame("nv12", [y, np.stack([u, v], -1)])
    found = rgb(opened(film(tmp_path / "a.mkv", "rawvideo", "nv12", [frame])), 0)
    assert np.abs(found - formula(y, u, v, 6, False, 8)).max() <= 0.5 + 1e-6


@pytest.mark.parametrize("pix_fmt", YUVJ)
def test_motion_jpeg_has_full_range(pix_fmt: str, tmp_path: Path) -> None:
    path = film(tmp_path / "a.avi", "mjpeg", pix_fmt, scene(1), {"q": "2"})
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
        planes = [np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size) for plane in frame.planes]
        y, u, v = (lines[: plane.height, : plane.width] for lines, plane in zip(planes, frame.planes, strict=True))
        assert np.abs(rgb(opened(path), 0) - formula(y, u, v, 6, True, 8)).max() <= 0.5 + 1e-6


@pytest.mark.parametrize("pix_fmt", LOSSLESS)
def test_lossless_rgb_is_decoded_exactly(pix_fmt: str, tmp_path: Path) -> None:
    wanted = scene(3, 33, 17)
    codec, extension = LOSSLESS[pix_fmt]
    video = opened(film(tmp_path / f"a.{extension}", codec, pix_fmt, wanted))
    assert video._tags.pix_fmt == pix_fmt
    assert [np.array_equal(rgb(video, number), frame) for number, frame in enumerate(wanted)] == [True] * 3


@pytest.mark.parametrize(("bits", "pix_fmt"), [(8, "yuv444p"), (10, "yuv444p10le")])
def test_a_gray_ramp_of_limited_range_maps_exactly(bits: int, pix_fmt: str, tmp_path: Path) -> None:
    unit, white = 1 << bits - 8, 255 if bits == 8 else 65535
    codes = np.arange(256 * unit, dtype=np.uint8 if bits == 8 else np.uint16).reshape(16, -1)
    gray = np.full_like(codes, 128 * unit)
    path = film(tmp_path / "a.mkv", "ffv1", pix_fmt, [raw_frame(pix_fmt, [codes, gray, gray])], color_range=1)
    found = rgb(opened(path), 0).reshape(-1, 3)
    wanted = np.clip((np.arange(256 * unit) - 16 * unit) * white / (219 * unit), 0, white)
    assert np.abs(found - wanted[:, None]).max() <= 0.5 + 1e-6
    assert (found[16 * unit].tolist(), found[235 * unit].tolist()) == ([0] * 3, [white] * 3)


@pytest.mark.parametrize(("tag", "black", "white"), [(0, 0, 255), (1, 16, 235), (2, 0, 255)])
def test_gray_video_has_full_range_unless_tagged(tag: int, black: int, white: int, tmp_path: Path) -> None:
    codes = np.arange(256, dtype=np.uint8).reshape(16, 16)
    path = film(tmp_path / "a.mkv", "ffv1", "gray", [raw_frame("gray", [codes])], color_range=tag)
    found = rgb(opened(path), 0).reshape(-1, 3)
    wanted = np.clip(np.rint((np.arange(256) - black) * 255 / (white - black)), 0, 255)
    assert (found == wanted[:, None]).all()


@pytest.mark.parametrize(("width", "height", "matrix"), [(1278, 16, 6), (1280, 16, 1), (32, 576, 6), (32, 578, 1)])
def test_untagged_video_is_bt601_up_to_standard_definition(
    width: int, height: int, matrix: int, tmp_path: Path
) -> None:
    planes = noise_planes("yuv420p", width, height)
    found = rgb(opened(film(tmp_path / "a.mkv", "ffv1", "yuv420p", [raw_frame("yuv420p", planes)])), 0)
    assert np.abs(found - formula(*planes, matrix, False, 8)).max() <= 0.5 + 1e-6


TURNS = {
    1: (1, 0, 0, 1),
    2: (-1, 0, 0, 1),
    3: (-1, 0, 0, -1),
    4: (1, 0, 0, -1),
    5: (0, 1, 1, 0),
    6: (0, 1, -1, 0),
    7: (0, -1, -1, 0),
    8: (0, -1, 1, 0),
}


def turned(path: Path, matrix: Sequence[int], unit: int = 65536) -> Path:
    """Write another display matrix over the one in an MP4's track header."""

    def spelled(a: int, b: int, c: int, d: int) -> bytes:
        return b"".join(one.to_bytes(4, "big", signed=True) for one in (a, b, 0, c, d, 0, 0, 0, 1 << 30))

    content = path.read_bytes()
    at = content.index(b"tkhd")
    identity = spelled(65536, 0, 0, 65536)
    path.write_bytes(content[:at] + content[at:].replace(identity, spelled(*(unit * one for one in matrix)), 1))
    return path


@pytest.mark.parametrize("orientation", TURNS)
def test_rotation_is_applied_like_exif_orientation(orientation: int, tmp_path: Path) -> None:
    path = film(tmp_path / "a.mp4", *("libx264", "yuv420p"), scene(1, 34, 18), {"x264-params": "log-level=none"})
    stored = rgb(opened(path), 0)
    turned(path, TURNS[orientation])
    (source,) = list_photographs(settings_of(tmp_path)).sources
    _, photograph = load_source(settings_of(tmp_path), source)

    a, b, c, d = TURNS[orientation]
    q, p = np.mgrid[0:18, 0:34]
    x, y = a * p + c * q, b * p + d * q
    wanted = np.zeros((34, 18, 3) if b else (18, 34, 3), np.uint8)
    wanted[y - y.min(), x - x.min()] = stored
    assert photograph.orientation == orientation
    np.testing.assert_array_equal(photograph.srgb, wanted)


def test_a_turn_by_no_multiple_of_90_degrees_is_refused(tmp_path: Path) -> None:
    path = film(tmp_path / "a.mp4", "libx264", "yuv420p", scene(1), {"x264-params": "log-level=none"})
    with pytest.raises(SourceError, match=r"^unsupported: the video is rotated by an angle that is not"):
        rgb(opened(turned(path, (1, 1, -1, 1), 46341)), 0)
