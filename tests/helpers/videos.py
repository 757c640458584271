"""Small videos: moving pictures, encoded by PyAV in every codec that is accepted. Without PyAV tests are skipped."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from helpers.photographs import pixels
from unprocess_gen.config.schema import SourceConfig

av = pytest.importorskip("av")
from unprocess_gen.sources.video.decode import Video  # noqa: E402

Planes = Sequence[np.ndarray]

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


def scene(count: int, width: int = 64, height: int = 48, seed: int = 0) -> list[np.ndarray]:
    """Return frames of a moving textured picture, each with noise of its own, so that no codec takes it for still."""
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
    """Encode frames: RGB arrays, which FFmpeg converts, or frames of PyAV in ``pix_fmt``."""
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
    """Return a frame of PyAV with these samples in its planes."""
    frame = av.VideoFrame(planes[0].shape[1], planes[0].shape[0], pix_fmt)
    for plane, samples in zip(frame.planes, planes, strict=True):
        lines = np.zeros((samples.shape[0], plane.line_size), np.uint8)
        content = samples.reshape(samples.shape[0], -1).view(np.uint8)
        lines[:, : content.shape[1]] = content
        plane.update(lines.tobytes())
    return frame


def opened(path: Path) -> Video:
    """Open a video file."""
    return Video(path.open("rb", buffering=0))


def rgb(video: Video, number: int) -> np.ndarray:
    """Decode a frame by its number."""
    return video.frame(number, 2**40, "ignore")[0]


def encode(folder: Path, kind: str, count: int = 30) -> Path:
    """Encode a film of a `ENCODED` kind; skip the test if this FFmpeg has no encoder for it."""
    codec, extension, options = ENCODED[kind]
    try:
        av.Codec(codec, "w")
    except av.error.FFmpegError:
        pytest.skip(f"this FFmpeg has no {codec}")
    size = (256, 128) if kind == "dnxhd" else (64, 48)
    return film(folder / f"{kind}.{extension}", codec, PIX_FMT.get(kind, "yuv420p"), scene(count, *size), options)


def settings_of(root: Path, **changes: Any) -> SourceConfig:
    """Return settings that list videos and PNG files below ``root`` as clips."""
    video = ["*.mp4", "*.mov", "*.mkv", "*.avi", "*.webm"]
    return SourceConfig(**{"root": str(root), "include": ["*.png"], "clips": True, "video": video} | changes)


def write_jpeg(path: Path) -> None:
    """Write a small JPEG file under any name."""
    content = io.BytesIO()
    Image.fromarray(pixels(1, 16, 16)).save(content, "JPEG")
    path.write_bytes(content.getvalue())
