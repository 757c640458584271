"""Video files as clips: exact colours, the same frame however it was reached, and a row with a reason for the rest."""

from __future__ import annotations

import csv
import functools
import io
import itertools
import random
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, Settings, TreeHash
from helpers.photographs import pixels
from helpers.processes import SLOW_DISK, committed, imported_first, kill_group, running, wait_for
from helpers.promise_report import Figure
from PIL import Image

from unprocess_gen import RawPairs
from unprocess_gen.core.errors import ConfigError, MachineError, SourceError
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.pipeline.replay import replay
from unprocess_gen.pipeline.verify import verify
from unprocess_gen.sources import loader as photographs
from unprocess_gen.sources.loader import list_photographs, load_source

av = pytest.importorskip("av")
from unprocess_gen.sources.video.colours import PIXEL_FORMATS  # noqa: E402
from unprocess_gen.sources.video.decode import CODECS, Video  # noqa: E402

Planes = Sequence[np.ndarray]


# Making videos --------------------------------------------------------------------------------------------------------


def scene(count: int, width: int = 64, height: int = 48, seed: int = 0) -> list[np.ndarray]:
    """A textured picture that moves, with noise of its own in each frame: nothing that a codec could take for still."""
    rng = np.random.default_rng(seed)
    large = pixels(seed, height + 2 * count, width + 3 * count).astype(int)
    frames = [large[2 * i : 2 * i + height, 3 * i : 3 * i + width] for i in range(count)]
    return [np.clip(frame + rng.integers(-9, 10, frame.shape), 0, 255).astype(np.uint8) for frame in frames]


def film(
    path: Path,
    codec: str,
    pix_fmt: str,
    frames: Sequence[Any],
    options: dict[str, str] | None = None,
    times: Sequence[int] | None = None,
    container: dict[str, str] | None = None,
    **tags: int,
) -> Path:
    """Encode frames: RGB arrays, which FFmpeg converts, or frames of PyAV's in ``pix_fmt``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", options=container or {}) as output:
        stream = output.add_stream(codec, rate=25, options=options or {})
        first = frames[0] if not isinstance(frames[0], np.ndarray) else av.VideoFrame.from_ndarray(frames[0])
        stream.width, stream.height, stream.pix_fmt = first.width, first.height, pix_fmt
        for name, value in tags.items():
            setattr(stream.codec_context, name, value)
        for number, frame in enumerate(frames):
            if isinstance(frame, np.ndarray):
                frame = av.VideoFrame.from_ndarray(frame, format="rgb24").reformat(format=pix_fmt)
            frame.pts = number if times is None else times[number]
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
    return path


def raw_frame(pix_fmt: str, planes: Planes) -> Any:
    """A frame of PyAV's with these samples in its planes."""
    frame = av.VideoFrame(planes[0].shape[1], planes[0].shape[0], pix_fmt)
    for plane, samples in zip(frame.planes, planes, strict=True):
        lines = np.zeros((samples.shape[0], plane.line_size), np.uint8)
        content = samples.reshape(samples.shape[0], -1).view(np.uint8)
        lines[:, : content.shape[1]] = content
        plane.update(lines.tobytes())
    return frame


def opened(path: Path) -> Video:
    return Video(path.open("rb", buffering=0))


def rgb(video: Video, number: int) -> np.ndarray:
    return video.frame(number, 2**40, "ignore")[0]


def rows(out: Path) -> list[dict[str, str]]:
    with (out / "manifest.csv").open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


LOSSLESS = {
    "rgb24": ("rawvideo", "mov"),
    "bgr24": ("rawvideo", "avi"),  # stored from the bottom up
    "gbrp": ("utvideo", "avi"),
    "bgr0": ("ffv1", "mkv"),
}
YUVJ = {"yuvj420p": "mjpeg", "yuvj422p": "mjpeg", "yuvj444p": "mjpeg"}
ENCODED = {
    "h264": ("libx264", "mp4", {"bf": "3", "x264-params": "open-gop=0:keyint=7:log-level=none"}),
    "h264_open": ("libx264", "mkv", {"bf": "3", "x264-params": "open-gop=1:keyint=7:log-level=none"}),
    "h264_avi": ("libx264", "avi", {"bf": "3", "x264-params": "keyint=7:log-level=none"}),
    "hevc": ("libx265", "mp4", {"x265-params": "open-gop=1:keyint=7:min-keyint=7:bframes=3:log-level=none"}),
    "mpeg4": ("mpeg4", "avi", {"bf": "2", "g": "7"}),
    "mpeg4_mp4": ("mpeg4", "mp4", {"bf": "2", "g": "7"}),
    "mpeg2": ("mpeg2video", "mkv", {"bf": "2", "g": "7"}),
    "vp8": ("libvpx", "webm", {"auto-alt-ref": "1", "lag-in-frames": "12", "g": "12"}),
    "vp9": ("libvpx-vp9", "webm", {"auto-alt-ref": "1", "lag-in-frames": "12", "g": "12"}),
    "av1": ("libsvtav1", "mp4", {"preset": "12", "g": "8"}),
    "ffv1": ("ffv1", "mkv", {"g": "5"}),
    "mjpeg": ("mjpeg", "avi", {"q": "5"}),
    "prores": ("prores_ks", "mov", {}),
    "dnxhd": ("dnxhd", "mov", {"profile": "dnxhr_sq"}),
}
PIX_FMT = {"mjpeg": "yuvj420p", "prores": "yuv422p10le", "dnxhd": "yuv422p"}


@pytest.fixture(scope="module")
def encoded(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return a function that returns a film of 30 frames, encoded once for all tests, which leave it as it is."""
    folder = tmp_path_factory.mktemp("encoded")

    @functools.cache
    def path_of(kind: str) -> Path:
        return encode(folder, kind)

    return path_of


def encode(folder: Path, kind: str, count: int = 30) -> Path:
    codec, extension, options = ENCODED[kind]
    try:
        av.Codec(codec, "w")
    except av.error.FFmpegError:
        pytest.skip(f"this FFmpeg has no {codec}")
    size = (256, 128) if kind == "dnxhd" else (64, 48)
    return film(folder / f"{kind}.{extension}", codec, PIX_FMT.get(kind, "yuv420p"), scene(count, *size), options)


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


def test_a_picture_survives_yuv444_to_the_rounding_of_its_codes(tmp_path: Path) -> None:
    """From RGB by the formula's inverse, codes rounded: half a code of Y, U and V each, in 8 bits of limited range."""
    picture = scene(1, 40, 30)[0].astype(float) / 255
    kr, kb = WEIGHTS[1]
    y = picture @ [kr, 1 - kr - kb, kb]
    u, v = (picture[..., 2] - y) / (2 * (1 - kb)), (picture[..., 0] - y) / (2 * (1 - kr))
    planes = [np.rint(one).astype(np.uint8) for one in (16 + 219 * y, 128 + 224 * u, 128 + 224 * v)]
    path = film(tmp_path / "a.mkv", "ffv1", "yuv444p", [raw_frame("yuv444p", planes)], colorspace=1, color_range=1)
    assert np.abs(rgb(opened(path), 0) - picture * 255).max() < 0.5 + 0.5 * 255 / 219 + 0.5 * 1.86 * 255 / 224


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


# Frames ---------------------------------------------------------------------------------------------------------------


def plain(path: Path) -> list[np.ndarray]:
    """All frames in turn, as PyAV decodes them by itself from the first to the last; the luma plane."""
    frames = []
    with av.open(str(path)) as container:
        container.streams.video[0].codec_context.options = {"idct": "simple"}
        for frame in container.decode(video=0):
            lines = np.frombuffer(frame.planes[0], np.uint8).reshape(-1, frame.planes[0].line_size)
            frames.append(lines[: frame.height, : frame.width].copy())
    return frames


@pytest.mark.parametrize("kind", ENCODED)
def test_frame_is_the_same_in_any_order_of_reading(kind: str, tmp_path: Path, figure: Figure) -> None:
    path = encode(tmp_path, kind)
    video = opened(path)
    in_turn = [rgb(video, number) for number in range(len(video))]
    numbers = list(range(30)) * 2
    random.Random(1).shuffle(numbers)
    assert len(video) == 30
    assert all(np.array_equal(rgb(video, number), in_turn[number]) for number in numbers)
    assert all(np.array_equal(rgb(opened(path), number), in_turn[number]) for number in (29, 13, 0))
    assert len({frame.tobytes() for frame in in_turn}) == 30
    figure("video", f"{len(numbers)} reads of {len(in_turn)} frames in any order are equal")


@pytest.mark.parametrize("kind", [kind for kind in ENCODED if kind not in ("prores", "dnxhd")])
def test_frames_and_their_order_are_those_of_a_player(kind: str, encoded: Callable[[str], Path]) -> None:
    path = encoded(kind)
    video, shown = opened(path), plain(path)
    assert len(shown) == len(video)
    for number, luma in enumerate(shown):
        wanted = np.clip((luma.astype(float) - 16) / 219 if kind != "mjpeg" else luma / 255, 0, 1) * 255
        found = rgb(video, number) @ [0.299, 0.587, 0.114]
        inside = ((rgb(video, number) > 0) & (rgb(video, number) < 255)).all(-1)
        assert np.abs(found - wanted)[inside].max() < 1


def test_decoder_starts_at_each_closed_group(encoded: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch) -> None:
    starts: list[int] = []
    packets = Video._packets
    monkeypatch.setattr(Video, "_packets", lambda self, start: starts.append(start) or packets(self, start))
    for kind, groups in (("h264", 5), ("h264_open", 1), ("hevc", 5), ("mjpeg", 1), ("ffv1", 6), ("vp9", 3)):
        starts.clear()
        video = opened(encoded(kind))
        for number in range(30):
            rgb(video, number)
        assert (kind, len(starts)) == (kind, groups)


def test_times_of_any_spacing_make_frames_in_their_order(tmp_path: Path) -> None:
    wanted = scene(6)
    path = film(tmp_path / "a.mkv", "ffv1", "bgr0", wanted, times=[0, 1, 2, 30, 31, 90])
    video = opened(path)
    assert len(video) == 6
    assert all(np.array_equal(rgb(video, number), wanted[number]) for number in (5, 0, 3, 1, 2, 4))


def test_a_video_of_one_frame_has_one(tmp_path: Path) -> None:
    video = opened(film(tmp_path / "a.mp4", "libx264", "yuv420p", scene(1), {"x264-params": "log-level=none"}))
    assert len(video) == 1
    assert rgb(video, 0).shape == (48, 64, 3)


def test_pixels_that_the_codec_crops_are_absent(tmp_path: Path) -> None:
    """H.264 codes squares of 16 pixels; 34 x 18 are cut out of 48 x 32."""
    path = film(tmp_path / "a.mp4", "libx264", "yuv420p", scene(3, 34, 18), {"x264-params": "qp=0:log-level=none"})
    found = rgb(opened(path), 2)
    assert found.shape == (18, 34, 3)
    assert np.abs(found.astype(int) - scene(3, 34, 18)[2]).mean() < 20
    assert np.abs(found[:, ::-1].astype(int) - scene(3, 34, 18)[2]).mean() > 40


EVERY_FRAME = """
import ctypes, glob, hashlib, sys
import av
from pathlib import Path
if sys.argv[2] != "all":
    ctypes.CDLL(glob.glob(str(Path(av.__path__[0]).parent / "av.libs" / "libavutil*"))[0]).av_force_cpu_flags(0)
from unprocess_gen.sources.video.decode import Video
for path in sorted(Path(sys.argv[1]).iterdir()):
    video = Video(path.open("rb", buffering=0))
    found = hashlib.sha256(b"".join(video.frame(n, 2**40, "ignore")[0].tobytes() for n in range(len(video))))
    with av.open(str(path)) as container:
        converted = [frame.to_ndarray(format="rgb24").tobytes() for frame in container.decode(video=0)]
    print(path.name, found.hexdigest(), hashlib.sha256(b"".join(converted)).hexdigest())
"""


def test_processors_with_and_without_simd_give_the_same_frames(tmp_path: Path) -> None:
    """And FFmpeg's own conversion does not: so the switch was thrown, and that is why it is not used."""
    libraries = Path(av.__path__[0]).parent / "av.libs"
    if not list(libraries.glob("libavutil*")):
        pytest.skip("this PyAV was built on the system's FFmpeg")
    for kind in ENCODED:
        encode(tmp_path / "videos", kind, 9)
    called = [sys.executable, "-c", EVERY_FRAME, str(tmp_path / "videos")]
    with_simd, without = (
        [line.split() for line in subprocess.check_output([*called, flags], text=True).splitlines()]
        for flags in ("all", "none")
    )
    assert [line[:2] for line in with_simd] == [line[:2] for line in without]
    assert len(with_simd) == len(ENCODED)
    assert [line[2] for line in with_simd] != [line[2] for line in without]


# What cannot be used --------------------------------------------------------------------------------------------------


def settings_of(root: Path, **changes: Any) -> Any:
    from unprocess_gen.config.schema import SourceConfig

    video = ["*.mp4", "*.mov", "*.mkv", "*.avi", "*.webm"]
    return SourceConfig(**{"root": str(root), "include": ["*.png"], "clips": True, "video": video} | changes)


X264 = {"x264-params": "log-level=none:keyint=5"}


def cut(path: Path, share: float) -> None:
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


def audio(path: Path) -> None:
    with av.open(str(path), "w") as output:
        stream = output.add_stream("aac", rate=8000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.rate = 8000
        output.mux(stream.encode(frame))
        output.mux(stream.encode(None))


def jpeg(path: Path) -> None:
    content = io.BytesIO()
    Image.fromarray(pixels(1, 16, 16)).save(content, "JPEG")
    path.write_bytes(content.getvalue())


def no_frames(path: Path) -> None:
    """Return a film with one packet that declares another track."""
    film(path, "ffv1", "bgr0", scene(1))
    content = bytearray(path.read_bytes())
    at = content.index(b"\xa3", content.index(b"\x1fC\xb6u"))
    content[at] = 0xEC  # a Void in place of the SimpleBlock
    path.write_bytes(content)


UNUSABLE: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "no bytes": ("a.mp4", lambda path: path.touch(), "empty"),
    "index at the end cut off": (
        "a.mp4",
        lambda path: cut(film(path, "libx264", "yuv420p", scene(9), X264), 0.8),
        "truncated",
    ),
    "index at the front": (
        "a.mp4",
        lambda path: cut(film(path, "libx264", "yuv420p", scene(9), X264, container={"movflags": "faststart"}), 0.8),
        "truncated",
    ),
    "Matroska cut off": ("a.mkv", lambda path: cut(film(path, "ffv1", "bgr0", scene(9)), 0.8), "truncated"),
    "AVI cut off": ("a.avi", lambda path: cut(film(path, "mjpeg", "yuvj420p", scene(9)), 0.8), "truncated"),
    "sound alone": ("a.mp4", audio, "unsupported"),
    "JPEG by another name": ("a.mp4", jpeg, "unsupported"),
    "text": ("a.mov", lambda path: path.write_text("#EXTM3U\nhttp://example.org/a.ts\n"), "unsupported"),
    "no frames": ("a.mkv", no_frames, "empty"),
    "nonsense in a box": (
        "a.mp4",
        lambda path: path.write_bytes(b"\0\0\0\x10ftypisom\0\0\0\0" + b"\0" * 99),
        "truncated",
    ),
    "nonsense in the index": (
        "a.mp4",
        lambda path: path.write_bytes(b"\0\0\0\x10ftypisom\0\0\0\0\0\0\0\x28moov" + b"\xff" * 32),
        "unsupported",
    ),
    "alpha": ("a.mkv", lambda path: film(path, "ffv1", "bgra", scene(2)), "alpha"),
    "separate alpha": ("a.webm", lambda path: film(path, "libvpx-vp9", "yuva420p", scene(2)), "alpha"),
    "12 bits": ("a.mkv", lambda path: film(path, "ffv1", "yuv420p12le", scene(2)), "unsupported"),
    "PQ": ("a.mkv", lambda path: film(path, "ffv1", "yuv420p10le", scene(2), color_trc=16), "unsupported"),
    "HLG": ("a.mkv", lambda path: film(path, "ffv1", "yuv420p10le", scene(2), color_trc=18), "unsupported"),
    "YCgCo": ("a.mkv", lambda path: film(path, "ffv1", "yuv420p", scene(2), colorspace=8), "unsupported"),
    "another codec": ("a.mov", lambda path: film(path, "qtrle", "rgb24", scene(2)), "unsupported"),
}


@pytest.mark.parametrize("kind", UNUSABLE)
def test_an_unusable_video_is_one_failed_row_with_its_reason(kind: str, make: Make, tmp_path: Path) -> None:
    name, write, reason = UNUSABLE[kind]
    (tmp_path / "in").mkdir()
    write(tmp_path / "in" / name)
    make(tmp_path / "in", tmp_path / "ds", "source.clips=true")
    (row,) = rows(tmp_path / "ds")
    assert (row["source"], row["status"], row["reason"], row["frame"]) == (name, "failed", reason, "0")
    assert (row["source_sha256"] == "") == (kind == "no bytes")
    assert verify(tmp_path / "ds") == []


def test_a_video_with_too_many_pixels_is_one_failed_row(tmp_path: Path) -> None:
    film(tmp_path / "a.mkv", "ffv1", "bgr0", scene(3))
    config = settings_of(tmp_path, max_pixels=64 * 48 - 1)
    (source,) = list_photographs(config).sources
    with pytest.raises(SourceError, match=r"^too_large: 64 x 48 pixels are 3072"):
        load_source(config, source)


def test_other_primaries_are_refused_under_icc_refuse(tmp_path: Path) -> None:
    film(tmp_path / "a.mkv", "ffv1", "yuv420p", scene(3), color_primaries=9)
    assert len(list_photographs(settings_of(tmp_path)).sources) == 3
    config = settings_of(tmp_path, icc="refuse")
    (source,) = list_photographs(config).sources
    with pytest.raises(SourceError, match=r"^icc: the primaries have code 9"):
        load_source(config, source)


def damaged(folder: Path) -> tuple[Path, Path]:
    """A film of closed groups of five frames, and a copy with bytes of frame 7's packet overwritten."""
    whole = film(folder / "whole.mkv", "ffv1", "yuv420p", scene(20), {"g": "5", "slicecrc": "1", "level": "3"})
    with av.open(str(whole)) as container:
        packet = next(itertools.islice(container.demux(video=0), 7, 8))
        content = bytes(packet)
    data = bytearray(whole.read_bytes())
    at = data.index(content)
    data[at + 40 : at + 60] = bytes(20)
    broken = folder / "broken.mkv"
    broken.write_bytes(data)
    return whole, broken


def reason_of(video: Video, number: int) -> str:
    try:
        rgb(video, number)
    except SourceError as error:
        return error.reason
    return ""


def test_damage_affects_its_frame_and_dependent_ones(tmp_path: Path) -> None:
    whole, broken = map(opened, damaged(tmp_path))
    wanted = [""] * 7 + ["corrupt"] * 3 + [""] * 10
    assert [reason_of(broken, number) for number in range(20)] == wanted
    numbers = list(range(20)) * 2
    random.Random(2).shuffle(numbers)
    for number in numbers:
        assert reason_of(broken, number) == wanted[number]
        if not wanted[number]:
            np.testing.assert_array_equal(rgb(broken, number), rgb(whole, number))


@pytest.mark.parametrize("kind", [kind for kind in ENCODED if kind != "av1"])
def test_damage_is_the_same_in_any_order_of_reading(kind: str, encoded: Callable[[str], Path], tmp_path: Path) -> None:
    """Frames before the damage are intact; later ones are the same each time, whether the decoder finds it or not."""
    path = Path(shutil.copy(encoded(kind), tmp_path))
    video = opened(path)
    whole = [outcome(video, number) for number in range(30)]
    with av.open(str(path)) as container:
        content = bytes(next(itertools.islice(container.demux(video=0), 10, 11)))
    data = bytearray(path.read_bytes())
    at = data.index(content) + len(content) * 3 // 4
    data[at : at + 8] = bytes(one ^ 0x55 for one in data[at : at + 8])
    path.write_bytes(data)
    broken = opened(path)
    in_turn = [outcome(broken, number) for number in range(30)]
    numbers = list(range(30))
    random.Random(3).shuffle(numbers)
    assert [outcome(broken, number) for number in numbers] == [in_turn[number] for number in numbers]
    assert in_turn[:7] == whole[:7]
    assert in_turn != whole


def outcome(video: Video, number: int) -> bytes | str:
    return reason_of(video, number) or rgb(video, number).tobytes()


def test_frames_that_fail_are_rows_and_the_others_pairs(make: Make, tmp_path: Path) -> None:
    _, broken = damaged(tmp_path / "in")
    (tmp_path / "in" / "whole.mkv").unlink()
    made = {per: tmp_path / f"ds{per}" for per in (3, 8)}
    for per, out in made.items():
        make(tmp_path / "in", out, "source.clips=true", f"output.pairs_per_shard={per}")
    found = rows(made[3])
    assert [row["frame"] for row in found if row["status"] == "failed"] == ["7", "8", "9"]
    assert {row["clip"] for row in found} == {broken.name}
    assert [row["noisy_xxh3"] for row in found] == [row["noisy_xxh3"] for row in rows(made[8])]


# The run --------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three videos, two of them the same, a folder of frames and a photograph."""
    folder = tmp_path_factory.mktemp("films")
    encode(folder, "h264", 20)
    film(folder / "sub" / "one.mkv", "ffv1", "yuv420p10le", scene(7, 33, 17, seed=3), {"g": "3"})
    shutil.copy(folder / "sub" / "one.mkv", folder / "sub" / "two.mkv")
    for frame in range(3):
        (folder / "stills").mkdir(exist_ok=True)
        Image.fromarray(pixels(frame, 20, 24)).save(folder / "stills" / f"{frame}.png")
    Image.fromarray(pixels(7, 12, 16)).save(folder / "alone.png")
    return folder


CLIPS = ("source.clips=true", "noise=nikon_d850", "noise.iso=3200", "effects.prnu=on")


@pytest.fixture(scope="module")
def filmed(films: Path, make: Make) -> Path:
    make(films, films.parent / "films_made", *CLIPS)
    return films.parent / "films_made"


def test_every_frame_is_a_row_with_its_clip_and_number(filmed: Path, films: Path) -> None:
    assert [(row["source"], row["clip"], row["frame"]) for row in rows(filmed)] == [
        ("alone.png", ".", "0"),
        *(("h264.mp4", "h264.mp4", str(frame)) for frame in range(20)),
        *((f"stills/{frame}.png", "stills", str(frame)) for frame in range(3)),
        *(("sub/one.mkv", "sub/one.mkv", str(frame)) for frame in range(7)),
        *(("sub/two.mkv", "sub/two.mkv", str(frame)) for frame in range(7)),
    ]
    assert [row["key"] for row in rows(filmed)] == [f"{index:08d}" for index in range(38)]


def test_frames_of_a_video_have_its_digest_and_size(filmed: Path, films: Path) -> None:
    import hashlib

    content = (films / "h264.mp4").read_bytes()
    told = {(row["source_sha256"], row["source_bytes"]) for row in rows(filmed) if row["source"] == "h264.mp4"}
    assert told == {(hashlib.sha256(content).hexdigest(), str(len(content)))}


def test_frames_share_their_draws_and_identical_videos_do_not(filmed: Path) -> None:
    drawn = {
        clip: {(row["stream_key"], row["red_gain"], row["body_key"], row["rgb2cam_00"]) for row in rows(filmed)}
        for clip in ("h264.mp4",)
    }
    by_clip: dict[str, set[tuple[str, ...]]] = {}
    for row in rows(filmed):
        by_clip.setdefault(row["clip"], set()).add((row["stream_key"], row["red_gain"], row["body_key"]))
    assert {clip: len(some) for clip, some in by_clip.items()} == dict.fromkeys(by_clip, 1)
    assert len(set.union(*by_clip.values())) == len(by_clip) == len(drawn["h264.mp4"]) == 5


def test_noise_of_frames_is_independent(filmed: Path) -> None:
    """3,072 sites; six standard errors of a correlation."""
    frames = [noisy.astype(float) - clean for clean, noisy, row in RawPairs(filmed) if row["clip"] == "h264.mp4"]
    found = np.corrcoef([(frame - frame.mean(axis=1, keepdims=True)).ravel() for frame in frames])
    assert np.abs(found - np.eye(20)).max() < 6 / np.sqrt(3072)


def test_number_of_workers_changes_no_byte_of_videos(
    films: Path, filmed: Path, make: Make, tree_hash: TreeHash, tmp_path: Path
) -> None:
    make(films, tmp_path / "ds", *CLIPS, n_jobs=2)
    assert tree_hash(tmp_path / "ds") == tree_hash(filmed)


@pytest.mark.parametrize("per_shard", [1, 5])
def test_shard_size_leaves_frames_unchanged(
    per_shard: int, films: Path, filmed: Path, make: Make, tmp_path: Path
) -> None:
    make(films, tmp_path / "ds", *CLIPS, f"output.pairs_per_shard={per_shard}")
    assert {key(row) for row in rows(tmp_path / "ds")} == {key(row) for row in rows(filmed)}


def key(row: dict[str, str]) -> tuple[str, ...]:
    return row["source"], row["frame"], row["clean_xxh3"], row["noisy_xxh3"]


@pytest.mark.parametrize("n_jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_killed_run_of_videos_resumes_to_the_same_bytes(
    n_jobs: int, films: Path, filmed: Path, make: Make, tree_hash: TreeHash, tmp_path: Path
) -> None:
    out, env = tmp_path / "ds", imported_first(tmp_path, SLOW_DISK)
    with running(*CLIPS, f"source.root={films}", f"out={out}", f"n_jobs={n_jobs}", cwd=tmp_path, **env) as run:
        wait_for(lambda: committed(out) or run.poll() is not None)
        kill_group(run)
    assert not (out / "dataset.json").exists()
    assert make(films, out, *CLIPS).made > 0
    assert tree_hash(out) == tree_hash(filmed)


def test_removing_a_video_leaves_others_unchanged(films: Path, filmed: Path, make: Make, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(films, tmp_path / "films"))
    (copy / "h264.mp4").unlink()
    make(copy, tmp_path / "ds", *CLIPS)
    kept = {key(row) for row in rows(filmed) if row["source"] != "h264.mp4"}
    assert {key(row) for row in rows(tmp_path / "ds")} == kept


def test_frame_is_regenerated_from_its_row(filmed: Path, films: Path) -> None:
    assert verify(filmed) == []
    replayed = list(replay(read_rows(filmed / "manifest.csv"), str(films)))
    assert len(replayed) == 38
    assert [one for one in replayed if one.complaint] == []


def test_damaged_frame_is_repaired(films: Path, filmed: Path, run_main: RunMain, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(filmed, tmp_path / "ds"))
    path = copy / "shards" / "shard-00001.tar"
    content = bytearray(path.read_bytes())
    content[content.index(b"00000010.noisy.npy") + 512 + 200] ^= 1
    path.write_bytes(content)
    done = run_main("verify", copy, "--repair", f"source.root={films}")
    assert (done.code, "1 of 8 pairs regenerated" in done.out) == (0, True)
    assert path.read_bytes() == (filmed / "shards" / "shard-00001.tar").read_bytes()


def test_lost_shard_and_manifest_are_regenerated_from_videos(
    films: Path, filmed: Path, run_main: RunMain, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(filmed, tmp_path / "ds"))
    (copy / "shards" / "shard-00001.tar").unlink()
    (copy / "manifest.csv").unlink()
    assert run_main("verify", copy, "--repair", f"source.root={films}").code == 0
    assert (copy / "manifest.csv").read_bytes() == (filmed / "manifest.csv").read_bytes()


def test_finished_dataset_of_videos_is_complete(films: Path, filmed: Path, make: Make) -> None:
    assert make(films, filmed, *CLIPS).made == 0


def test_another_video_of_the_same_name_and_size_is_noticed(
    films: Path, filmed: Path, make: Make, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(films, tmp_path / "films"))
    out = Path(shutil.copytree(filmed, tmp_path / "ds"))
    content = bytearray((copy / "h264.mp4").read_bytes())
    content[content.index(b"mdat") + 900] ^= 1
    (copy / "h264.mp4").write_bytes(content)
    with pytest.raises(ConfigError, match=r"h264\.mp4 has other bytes than it had"):
        make(copy, out, *CLIPS)


def test_video_that_changes_during_a_run_stops_it(films: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copy(films / "h264.mp4", tmp_path / "a.mp4"))
    config = settings_of(tmp_path)
    first, second, *_ = list_photographs(config).sources
    load_source(config, first)
    content = bytearray(copy.read_bytes())
    content[-1] ^= 1
    copy.write_bytes(content)
    with pytest.raises((MachineError, SourceError), match="changed"):
        load_source(config, second)


def test_the_file_is_opened_and_hashed_once(films: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photographs._open_video.cache_clear()
    config = settings_of(films, include=["none"], video=["*.mp4"])
    for source in list_photographs(config).sources:
        load_source(config, source)
    assert photographs._open_video.cache_info().misses == 1


def test_a_limit_counts_frames(films: Path) -> None:
    listed = list_photographs(settings_of(films, limit=5)).sources
    assert [(source.name, source.frame) for source in listed] == [
        ("alone.png", 0),
        *(("h264.mp4", frame) for frame in range(4)),
    ]


@pytest.mark.parametrize("override", ["source.downscale=2", "source.dequantize=dither"])
def test_downscale_and_dither_apply_to_frames(override: str, films: Path, make: Make, tmp_path: Path) -> None:
    make(films, tmp_path / "ds", "source.clips=true", override)
    assert {row["status"] for row in rows(tmp_path / "ds")} == {"ok"}
    assert [one for one in replay(read_rows(tmp_path / "ds" / "manifest.csv"), str(films)) if one.complaint] == []


def test_without_clips_videos_are_left_out_and_counted(films: Path) -> None:
    listing = list_photographs(settings_of(films, clips=False))
    assert {source.name for source in listing.sources} == {"alone.png", *(f"stills/{frame}.png" for frame in range(3))}
    assert listing.not_matched == 3


def test_photograph_named_like_a_video_is_read_without_clips(make: Make, tmp_path: Path) -> None:
    """Its row records this: a replay does not look at the name."""
    (tmp_path / "in").mkdir()
    jpeg(tmp_path / "in" / "a.mp4")
    make(tmp_path / "in", tmp_path / "ds", "source.include=['*.mp4']")
    assert [one.complaint for one in replay(read_rows(tmp_path / "ds" / "manifest.csv"), str(tmp_path / "in"))] == [""]


def test_without_pyav_a_video_is_refused_with_advice(
    films: Path, run_main: RunMain, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(photographs, "is_installed", lambda: False)
    done = run_main(f"source.root={films}", "source.clips=true")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "h264.mp4 is a video, which needs PyAV; in the source folder, run: pip install '.[video]'" in done.err
    assert not (tmp_path / "ds").exists()
    assert run_main(f"source.root={films}", "source.clips=true", "source.video=[]", "n_jobs=1").code == 0


def test_a_folder_of_videos_alone_needs_no_other_globs(films: Path, settings: Settings) -> None:
    from unprocess_gen.config.validation import validate_config

    config = settings("source.clips=true", "source.include=[]")
    config.source.root = str(films)
    validate_config(config)
    assert len(list_photographs(config.source).sources) == 34


def test_a_plan_counts_frames(films: Path, run_main: RunMain) -> None:
    assert "sources   38 " in run_main("plan", f"source.root={films}", "source.clips=true").out


def test_ffmpeg_knows_every_accepted_codec() -> None:
    assert [name for name in CODECS if av.Codec(name, "r").canonical_name != name] == []
