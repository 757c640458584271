"""Video files as clips: from a file to the pixels of its frames, the same on every machine. Only this room names av.

**Which bytes.** OpenCV reads videos through swscale, whose code for AVX2 rounds unlike that for SSE2; so FFmpeg's
decoders are asked for their own planes (PyAV), and chroma and colours are made here, in whole numbers. Decoding itself
is exact by their standards for H.264, HEVC, VP8, VP9 and AV1, and lossless for FFV1, HuffYUV, Ut Video and raw video.
MPEG-1, MPEG-2, MPEG-4 part 2 and Motion JPEG leave the inverse transform's rounding open: FFmpeg's integer one
(``idct=simple``, with ``bitexact``) is asked for, which its C and its SIMD code do alike, and so are DNxHD's and
ProRes' own. Other codecs are refused. One thread each: workers are processes already, and errors fall alike.

**Which frame.** Listing reads packets and decodes nothing: a packet is a frame, and their times put them in order. A
frame is always what a fresh decoder gives that starts at the same packet (`_starts`), whichever frames were asked for
before: the last one before it at which the codec forgets everything. In H.264 that is an IDR picture; in HEVC any
random access point for what is shown after it (the standard has the decoder drop the rest); elsewhere a keyframe after
which nothing is shown that should come before. Frames in turn continue the same walk. Where times are missing, or not
unique, every walk begins at the first packet, and frames are counted.

**Damage.** A decoder that meets broken data is stopped: the frame fails, and so do all after it that were to come of
the same start, since they may refer to it.
"""

from __future__ import annotations

import ctypes
import itertools
import struct
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.jit import kernel
from unprocess_gen.core.types import Srgb

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.codeccontext import VideoCodecContext
    from av.video.frame import VideoFrame
    from av.video.plane import VideoPlane
    from av.video.stream import VideoStream

CODECS = (
    *("h264", "hevc", "vp8", "vp9", "av1"),
    *("ffv1", "huffyuv", "ffvhuff", "utvideo", "rawvideo"),
    *("mpeg1video", "mpeg2video", "mpeg4", "mjpeg", "prores", "dnxhd"),
)
"""Those whose pixels are the same on every machine: by standard, lossless, or by FFmpeg's integer transforms."""

_OPTIONS = {"err_detect": "crccheck+explode", "idct": "simple"}

# FFmpeg also reads playlists, which lead to other files.
_CONTAINERS = "mov,matroska,avi"


@dataclass(frozen=True, slots=True)
class _Format:
    """Where a pixel format keeps its samples: chroma's share of width and height as shifts, and bits.

    ``planes`` and ``offsets`` name the plane and the place in it of Y, U and V, or of R, G and B (``rgb``).
    ``step``: samples from one to the next in the plane, for each of the three.
    """

    shift_x: int = 0
    shift_y: int = 0
    bits: int = 8
    rgb: bool = False
    planes: tuple[int, ...] = (0, 1, 2)
    offsets: tuple[int, ...] = (0, 0, 0)
    steps: tuple[int, ...] = (1, 1, 1)


def _packed(offsets: tuple[int, int, int], step: int) -> _Format:
    return _Format(rgb=True, planes=(0, 0, 0), offsets=offsets, steps=(step,) * 3)


FORMATS = {
    **{f"{kind}420p": _Format(1, 1) for kind in ("yuv", "yuvj")},
    **{f"{kind}422p": _Format(1, 0) for kind in ("yuv", "yuvj")},
    **{f"{kind}444p": _Format() for kind in ("yuv", "yuvj")},
    "yuv420p10le": _Format(1, 1, bits=10),
    "yuv422p10le": _Format(1, 0, bits=10),
    "yuv444p10le": _Format(bits=10),
    "nv12": _Format(1, 1, planes=(0, 1, 1), offsets=(0, 0, 1), steps=(1, 2, 2)),
    "gray": _Format(planes=(0,)),
    "gbrp": _Format(rgb=True, planes=(2, 0, 1)),
    "rgb24": _packed((0, 1, 2), 3),
    "bgr24": _packed((2, 1, 0), 3),
    "rgb0": _packed((0, 1, 2), 4),
    "bgr0": _packed((2, 1, 0), 4),
}
"""The pixel formats taken, by FFmpeg's name."""

# The codes of ISO/IEC 23091-2 (H.273), which all containers and codecs use.
_UNTAGGED = 2
_LUMA = {
    1: ("0.2126", "0.0722"),  # BT.709
    5: ("0.299", "0.114"),  # BT.601
    6: ("0.299", "0.114"),
    9: ("0.2627", "0.0593"),  # BT.2020, non-constant luminance
}
"""Weights of red and blue in luma, by the code of the matrix."""

_DISPLAYED = (1, _UNTAGGED, 4, 5, 6, 7, 11, 12, 13, 14, 15)
"""Transfer characteristics of ordinary displays; PQ, HLG, logarithmic and linear light are others."""

_SRGB_PRIMARIES = (1, _UNTAGGED)
_FULL_RANGE, _UNTAGGED_RANGE = 2, 0

# (a, b, c, d) of the display matrix, by sign -> EXIF orientation: pixel (p, q) is shown at (a·p + c·q, b·p + d·q).
_ORIENTATIONS = {
    (1, 0, 0, 1): 1,
    (-1, 0, 0, 1): 2,
    (-1, 0, 0, -1): 3,
    (1, 0, 0, -1): 4,
    (0, 1, 1, 0): 5,
    (0, 1, -1, 0): 6,
    (0, -1, -1, 0): 7,
    (0, -1, 1, 0): 8,
}


def is_installed() -> bool:
    """Whether PyAV is there."""
    return find_spec("av") is not None


# ---------------------------------------------------------------------------------------------------------- a video


@dataclass(frozen=True, slots=True)
class _Mark:
    """What is kept of a packet: its times, whether it is shown, and whether a fresh decoder can start at it."""

    pts: int | None
    dts: int | None
    shown: bool
    restarts: bool


class Video:
    """A video file, whose frames can be had in any order, cheapest in turn. It closes ``file`` when it goes.

    Raises SourceError: ``unsupported``, ``truncated``, ``empty`` (no frame), ``alpha`` or ``corrupt``.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        weakref.finalize(self, file.close)
        if missing := _missing(file):
            raise SourceError("truncated", f"the video lacks {missing}")
        with _refusing("the video cannot be read"):
            container, stream = self._open()
            self._look(stream)
            self._marks = tuple(_marks(self._codec, container, stream))
        if not any(mark.shown for mark in self._marks):
            raise SourceError("empty", "the video holds no frame")
        times = [mark.pts for mark in self._marks]
        guessed = container.format.name == "avi" and stream.codec_context.reorder_depth > 0  # AVI keeps no times
        self._timed = None not in times and len(set(times)) == len(times) and not guessed
        self._order = [index for index, mark in enumerate(self._marks) if mark.shown]
        if self._timed:
            self._order.sort(key=lambda index: cast(int, times[index]))
        self._places = {time: index for index, time in enumerate(times)}
        self._numbers = {times[index]: number for number, index in enumerate(self._order)}
        self._starts = _starts(self._marks, self._codec) if self._timed else [0] * len(times)
        self._walk: _Walk | None = None

    def __len__(self) -> int:
        return len(self._order)

    def _open(self) -> tuple[InputContainer, VideoStream]:
        import av

        self._file.seek(0)
        container = av.open(self._file, "r", options={"format_whitelist": _CONTAINERS}, metadata_errors="replace")
        covers = av.stream.Disposition.attached_pic
        stream = next((one for one in container.streams.video if not one.disposition & covers), None)
        if stream is None:
            raise SourceError("unsupported", "the file holds no video")
        return container, stream

    def _look(self, stream: VideoStream) -> None:
        context = cast("VideoCodecContext | None", stream.codec_context)
        self._codec = "" if context is None else context.codec.canonical_name
        if context is None or self._codec not in CODECS:
            raise SourceError(
                "unsupported", f"the codec is {self._codec or 'unknown'}, expected one of {', '.join(CODECS)}"
            )
        if stream.metadata.get("alpha_mode") == "1":
            raise SourceError("alpha", "the video has an alpha channel; flatten it onto a background")
        self._intra_only = context.codec.intra_only
        self._tags = _Tags.of(context, context.pix_fmt)

    def refuse(self, max_pixels: int, icc: str) -> None:
        """Raise SourceError where no frame would be taken: for what the stream says of its frames."""
        _refuse(self._tags, max_pixels, icc)

    def frame(self, number: int, max_pixels: int, icc: str) -> tuple[Srgb, int]:
        """Return a frame's pixels as stored, uint8 or uint16 ``[H, W, 3]``, and the EXIF orientation to turn them by.

        Raises SourceError where it cannot be had.
        """
        if number >= len(self):
            raise SourceError("corrupt", f"frame {number} is asked for, the video holds {len(self)}")
        self.refuse(max_pixels, icc)
        with _refusing(f"frame {number} cannot be decoded"):
            found = self._decoded(number)
        if found.is_corrupt:
            raise SourceError("corrupt", f"the decoder says that frame {number} is damaged")
        _refuse(_Tags.of(found, found.format.name), max_pixels, icc)
        return _rgb(found), _orientation(found)

    def _decoded(self, number: int) -> VideoFrame:
        start = self._starts[self._order[number]]
        if self._walk is None or not self._walk.leads_to(number, start):
            self._walk = _Walk(start, self._frames(start), self._intra_only)
        return self._walk.to(number)

    def _frames(self, start: int) -> Iterator[tuple[int, VideoFrame]]:
        """Decode from a packet on; yield frames with their numbers. Raises as FFmpeg does, after what it still gave."""
        import av

        counted = itertools.count()
        packets, context = self._packets(start)
        fed: set[int | None] = set()
        try:
            for packet in itertools.chain(packets, [None]):
                for frame in self._decode(context, packet):
                    number = self._numbers.get(frame.pts) if self._timed else next(counted)
                    if number is not None:
                        yield number, frame
                fed.add(packet.pts if packet is not None else None)
        except av.FFmpegError:
            for frame in _left(context) if self._timed else ():
                if frame.pts in fed and frame.pts in self._numbers:
                    yield self._numbers[frame.pts], frame
            raise

    def _decode(self, context: VideoCodecContext, packet: Packet[VideoStream] | None) -> list[VideoFrame]:
        """Decode a packet. FFV1's decoder fills in for what is damaged, and tells the log alone."""
        from av import logging

        if self._codec != "ffv1":
            return context.decode(packet)
        level = logging.get_level()
        logging.set_level(logging.ERROR)
        try:
            with logging.Capture() as said:
                frames = context.decode(packet)
        finally:
            logging.set_level(level)
        if said:
            raise SourceError("corrupt", f"the decoder says: {said[0][2].strip()}")
        return frames

    def _packets(self, start: int) -> tuple[Iterator[Packet[VideoStream]], VideoCodecContext]:
        """Return the packets from one on, and a fresh decoder for them."""
        from av.codec.context import Flags

        container, stream = self._open()
        packets = self._sought(container, stream, start) if start else _real(container, stream)
        if packets is None:
            container, stream = self._open()
            packets = itertools.islice(_real(container, stream), start, None)
        context = stream.codec_context
        context.thread_count = 1
        context.flags |= Flags.bitexact
        context.options = _OPTIONS
        return packets, context

    def _sought(
        self, container: InputContainer, stream: VideoStream, start: int
    ) -> Iterator[Packet[VideoStream]] | None:
        """Return the packets from one on by way of the container's index; None where that does not lead to it."""
        import av

        mark = self._marks[start]
        with suppress(av.FFmpegError):
            container.seek(cast(int, mark.pts if mark.dts is None else mark.dts), stream=stream)
            packets = _real(container, stream)
            for packet in packets:
                if packet.pts == mark.pts:
                    return itertools.chain([packet], packets)
                if self._places.get(packet.pts, start) >= start:
                    break
        return None


class _Walk:
    """One decoder on its way from packet ``start`` through the frames that come of it."""

    def __init__(self, start: int, frames: Iterator[tuple[int, VideoFrame]], intra_only: bool) -> None:
        self._start = start
        self._frames = frames
        self._intra_only = intra_only
        self._asked = -1
        self._next: tuple[int, VideoFrame] | None = None
        self._failure: Exception | None = None

    def leads_to(self, number: int, start: int) -> bool:
        """Whether it gives the frame that a fresh decoder from ``start`` would."""
        if self._intra_only:
            return self._failure is None and number == self._asked + 1
        return self._start == start and number > self._asked

    def to(self, number: int) -> VideoFrame:
        """Go on to a frame; SourceError, or what FFmpeg raises, where it does not come."""
        self._asked = number
        while self._next is None or self._next[0] < number:
            self._next = self._step()
        if self._next[0] > number:
            raise SourceError("corrupt", f"frame {number} does not come out of the decoder")
        return self._next[1]

    def _step(self) -> tuple[int, VideoFrame]:
        if self._failure is not None:
            raise self._failure
        try:
            return next(self._frames)
        except StopIteration:
            self._failure = SourceError("corrupt", "the decoder gives fewer frames than there are packets")
        except Exception as error:
            self._failure = error
        raise self._failure


def _left(context: VideoCodecContext) -> list[VideoFrame]:
    """Return the frames that a decoder still holds when it met broken data."""
    import av

    try:
        return context.decode(None)
    except av.FFmpegError:
        return []


@contextmanager
def _refusing(what: str) -> Iterator[None]:
    """Turn FFmpeg's complaints into a refusal."""
    import av

    try:
        yield
    except MemoryError:
        raise
    except av.FFmpegError as error:
        raise SourceError("corrupt", f"{what}: {error.strerror or error}") from error
    except OSError as error:
        raise SourceError("unreadable", f"{what}: {error.strerror or error}") from error


# ---------------------------------------------------------------------------------------------------------- packets


def _real(container: InputContainer, stream: VideoStream) -> Iterator[Packet[VideoStream]]:
    return (packet for packet in container.demux(stream) if packet.size)


def _marks(codec: str, container: InputContainer, stream: VideoStream) -> Iterator[_Mark]:
    """Read all packets. Those that an edit list hides, and VP8's hidden reference frames, are decoded and not shown."""
    extradata = stream.codec_context.extradata or b""
    for packet in _real(container, stream):
        shown = not packet.is_discard and (codec != "vp8" or bool(bytes(packet)[0] & 0x10))
        restarts = packet.is_keyframe and (codec != "h264" or _has_idr(bytes(packet), extradata))
        yield _Mark(packet.pts, packet.dts, shown, restarts)


def _has_idr(packet: bytes, extradata: bytes) -> bool:
    """Whether an H.264 packet holds a picture at which a decoder forgets all others (type 5)."""
    if extradata[:1] != b"\1":
        return any(part[0] & 31 == 5 for part in packet.split(b"\0\0\1")[1:] if part)
    length = (extradata[4] & 3) + 1
    at = 0
    while at + length < len(packet):
        if packet[at + length] & 31 == 5:
            return True
        at += length + int.from_bytes(packet[at : at + length], "big")
    return False


def _starts(marks: tuple[_Mark, ...], codec: str) -> list[int]:
    """Return for each packet the one that a decoder has to start at for its frame."""
    times = [cast(int, mark.pts) for mark in marks]
    earliest = list(itertools.accumulate(reversed(times), min))[::-1]  # of a packet and all that follow it
    possible = [0]
    starts = []
    for index, mark in enumerate(marks):
        if index and mark.restarts and (codec == "hevc" or times[index] == earliest[index]):
            possible.append(index)
        starts.append(next((start for start in reversed(possible) if times[start] <= times[index]), 0))
    return starts


# -------------------------------------------------------------------------------------------------------- containers

_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"uuid", b"moof", b"mfra", b"styp", b"sidx", b"udta")
_EBML, _SEGMENT = b"\x1aE\xdf\xa3", b"\x18S\x80g"


def _missing(file: BinaryIO) -> str:
    """Return what a container says it holds beyond the end of the file; SourceError where it is no container."""
    size = file.seek(0, 2)
    file.seek(0)
    head = file.read(64)
    if head[4:8] in _BOXES:
        return _missing_boxes(file, size)
    if head[:4] == b"RIFF" and head[8:12] == b"AVI ":
        end = 8 + int.from_bytes(head[4:8], "little")
    elif head[:4] == _EBML:
        end = _matroska_end(head)
    else:
        raise SourceError("unsupported", "the content is no MP4, QuickTime, Matroska, WebM or AVI file")
    return f"{end - size} bytes at its end" if end > size else ""


def _missing_boxes(file: BinaryIO, size: int) -> str:
    at, kinds = 0, set()
    while at + 8 <= size:
        file.seek(at)
        head = file.read(16).ljust(16, b"\0")
        length, kind = struct.unpack(">I4s", head[:8])
        length = {0: size - at, 1: int.from_bytes(head[8:16], "big")}.get(length, length)
        if kind not in _BOXES and b"moov" in kinds:
            break
        kinds.add(kind)
        at += max(length, 8)
    if at > size:
        return f"{at - size} bytes at its end"
    return "" if b"moov" in kinds else "its index (moov)"


def _matroska_end(head: bytes) -> int:
    """Return where the segment ends by its header; 0 where that does not say, as in a recording that was broken off."""
    length, taken = _vint(head[4:])
    at = 4 + taken + length
    if head[at : at + 4] != _SEGMENT:
        return 0
    length, taken = _vint(head[at + 4 :])
    return 0 if length == (1 << 7 * taken) - 1 else at + 4 + taken + length


def _vint(content: bytes) -> tuple[int, int]:
    """Return a number of Matroska's and the bytes it takes."""
    taken = 9 - content[0].bit_length() if content and content[0] else 8
    return int.from_bytes(content[:taken], "big") & ((1 << 7 * taken) - 1), taken


# ----------------------------------------------------------------------------------------------------------- policy


@dataclass(frozen=True, slots=True)
class _Tags:
    """What a stream or a frame says of its pixels."""

    pix_fmt: str | None
    width: int
    height: int
    matrix: int
    transfer: int
    primaries: int
    range: int

    @classmethod
    def of(cls, told: VideoCodecContext | VideoFrame, pix_fmt: str | None) -> _Tags:
        codes = (int(told.colorspace), int(told.color_trc), int(told.color_primaries), int(told.color_range))
        return cls(pix_fmt, told.width, told.height, *codes)


def _refuse(tags: _Tags, max_pixels: int, icc: str) -> None:
    pixels = tags.width * tags.height
    if pixels > max_pixels:
        size = f"{tags.width} x {tags.height} pixels"
        raise SourceError("too_large", f"{size} are {pixels}, more than source.max_pixels={max_pixels}")
    if _has_alpha(tags.pix_fmt):
        raise SourceError("alpha", f"the pixel format {tags.pix_fmt} has an alpha channel; flatten the video")
    if tags.pix_fmt not in FORMATS:
        raise SourceError("unsupported", f"the pixel format is {tags.pix_fmt}, expected one of {', '.join(FORMATS)}")
    if tags.transfer not in _DISPLAYED:
        raise SourceError("unsupported", f"the transfer is no display's (code {tags.transfer}: HDR, log or linear)")
    form = FORMATS[tags.pix_fmt]
    if not form.rgb and len(form.planes) == 3 and tags.matrix not in (*_LUMA, _UNTAGGED):
        raise SourceError("unsupported", f"the colour matrix has code {tags.matrix}, expected BT.601, 709 or 2020")
    if form.rgb and tags.range not in (_FULL_RANGE, _UNTAGGED_RANGE):
        raise SourceError("unsupported", "the RGB is of limited range")
    if icc == "refuse" and tags.primaries not in _SRGB_PRIMARIES:
        raise SourceError("icc", f"the primaries have code {tags.primaries}, not sRGB's; or set source.icc=ignore")


def _has_alpha(pix_fmt: str | None) -> bool:
    return pix_fmt is not None and pix_fmt.startswith(("yuva", "rgba", "bgra", "argb", "abgr", "gbrap", "ya8", "ya16"))


def _orientation(frame: VideoFrame) -> int:
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return 1
    a, b, _, c, d = struct.unpack("=5i", bytes(cast(Any, matrix))[:20])
    signs = cast("tuple[int, int, int, int]", tuple((one > 0) - (one < 0) for one in (a, b, c, d)))
    if signs not in _ORIENTATIONS:
        raise SourceError("unsupported", "the video is to be shown turned by no multiple of 90 degrees")
    return _ORIENTATIONS[signs]


# ----------------------------------------------------------------------------------------------------------- colours

SHIFT = 32
"""Binary places of the matrices: their rounding moves no result by more than 4e-7 codes."""


def _rgb(frame: VideoFrame) -> Srgb:
    """Return a frame's pixels as R, G and B; each chroma sample stands for all pixels that share it."""
    tags = _Tags.of(frame, frame.format.name)
    form = FORMATS[frame.format.name]
    planes = [_samples(frame, form, which) for which in range(len(form.planes))]
    if form.rgb:
        return cast(Srgb, np.stack(planes, axis=-1))
    full = tags.range == _FULL_RANGE or (tags.range == _UNTAGGED_RANGE and tags.pix_fmt in _FULL_UNTAGGED)
    luma, *chroma = planes
    if not chroma:
        chroma = [np.full((1, 1), 1 << form.bits - 1, luma.dtype)] * 2
        form = _Format(32, 32, form.bits)
    out = np.empty((*luma.shape, 3), np.uint16 if form.bits > 8 else np.uint8)
    _yuv_to_rgb(luma, chroma[0], chroma[1], form.shift_x, form.shift_y, _matrix(_kind(tags), full, form.bits), out)
    return cast(Srgb, out)


_FULL_UNTAGGED = ("gray", "yuvj420p", "yuvj422p", "yuvj444p")


def _kind(tags: _Tags) -> int:
    """Return the code of the matrix; of untagged video BT.709's for more than standard definition, as players do."""
    if tags.matrix in _LUMA:
        return tags.matrix
    return 1 if tags.width >= 1280 or tags.height > 576 else 6


def _samples(frame: VideoFrame, form: _Format, which: int) -> NDArray[Any]:
    """Return the samples of Y, U or V (R, G or B), as they lie in the decoder's memory."""
    plane = frame.planes[form.planes[which]]
    dtype, step, offset = np.dtype("<u2" if form.bits > 8 else "u1"), form.steps[which], form.offsets[which]
    chroma = which > 0 and not form.rgb
    width = -(-frame.width >> form.shift_x) if chroma else frame.width
    height = -(-frame.height >> form.shift_y) if chroma else frame.height
    lines = _lines(plane, height)
    samples = lines[:, : lines.shape[1] // dtype.itemsize * dtype.itemsize].view(dtype)
    return cast("NDArray[Any]", samples[:, offset : offset + step * (width - 1) + 1 : step])


def _lines(plane: VideoPlane, height: int) -> NDArray[np.uint8]:
    """Return a plane's bytes line by line from the top; raw video may lie from the bottom up, as a negative length."""
    length = abs(plane.line_size)
    lowest = plane.buffer_ptr + min(0, plane.line_size) * (height - 1)
    content = np.ctypeslib.as_array((ctypes.c_uint8 * (length * height)).from_address(lowest)).reshape(height, length)
    return content[::-1] if plane.line_size < 0 else content


@lru_cache(maxsize=16)
def _matrix(kind: int, full: bool, bits: int) -> NDArray[np.int64]:
    """Return the whole numbers of a conversion: codes of black and gray chroma, and five factors times 2^`SHIFT`.

    Exact rationals, rounded once: from codes of ``bits`` to 255, or to 65535 above 8 bits.
    """
    red, blue = (Fraction(weight) for weight in _LUMA[kind])
    green = 1 - red - blue
    unit = 1 << bits - 8
    luma, chroma = ((1 << bits) - 1,) * 2 if full else (219 * unit, 224 * unit)
    white = 65535 if bits > 8 else 255
    factors = (
        Fraction(white, luma),
        2 * (1 - red) * Fraction(white, chroma),
        -2 * (1 - blue) * blue / green * Fraction(white, chroma),
        -2 * (1 - red) * red / green * Fraction(white, chroma),
        2 * (1 - blue) * Fraction(white, chroma),
    )
    whole = [round(factor * (1 << SHIFT)) for factor in factors]
    return np.array([0 if full else 16 * unit, 128 * unit, white, *whole], dtype=np.int64)


@kernel
def _yuv_to_rgb(luma, u_plane, v_plane, shift_x, shift_y, matrix, out):  # type: ignore[no-untyped-def]
    black, gray, white = matrix[0], matrix[1], matrix[2]
    half = np.int64(1) << np.int64(31)
    for y in range(luma.shape[0]):
        for x in range(luma.shape[1]):
            light = (np.int64(luma[y, x]) - black) * matrix[3] + half
            u = np.int64(u_plane[y >> shift_y, x >> shift_x]) - gray
            v = np.int64(v_plane[y >> shift_y, x >> shift_x]) - gray
            out[y, x, 0] = min(max((light + matrix[4] * v) >> 32, 0), white)
            out[y, x, 1] = min(max((light + matrix[5] * u + matrix[6] * v) >> 32, 0), white)
            out[y, x, 2] = min(max((light + matrix[7] * u) >> 32, 0), white)
