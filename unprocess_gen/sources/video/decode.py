"""Decode single frames of video files, with the same pixels on every machine.

Bytes. Only codecs are accepted whose decoding is exact: by standard (H.264, HEVC, VP8, VP9, AV1), because they are
lossless (FFV1, HuffYUV, Ut Video, raw video), or by FFmpeg's integer transforms. MPEG-1, MPEG-2, MPEG-4 part 2 and
Motion JPEG leave the rounding of the inverse transform open: ``idct=simple`` with ``bitexact`` selects an integer one
that C and SIMD code compute alike; DNxHD and ProRes have their own. Each decoder uses one thread, since workers are
processes already and errors then occur at the same place.

Frames. Listing reads packets and decodes nothing: a packet is a frame, and timestamps give the order. A frame is always
what a new decoder yields that starts at the same packet (`_starts`), whichever frames were requested before: the last
packet before it at which the codec discards all references. In H.264 this is an IDR picture; in HEVC any random access
point, for frames shown after it (the standard has the decoder drop the others); elsewhere a keyframe after which no
earlier frame is shown. Frames in sequence continue the same decoder. If timestamps are missing or not unique, decoding
begins at the first packet, and frames are counted.

Damage. A decoder that meets broken data is stopped. The frame fails, and so do all later ones from the same start,
since they may refer to it.

This is the only module that imports PyAV.
"""

from __future__ import annotations

import itertools
import struct
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, BinaryIO, cast

from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.types import Srgb
from unprocess_gen.sources.video.colours import PixelTags, refuse, rgb
from unprocess_gen.sources.video.containers import missing_part

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.codeccontext import VideoCodecContext
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream

CODECS = (
    *("h264", "hevc", "vp8", "vp9", "av1"),
    *("ffv1", "huffyuv", "ffvhuff", "utvideo", "rawvideo"),
    *("mpeg1video", "mpeg2video", "mpeg4", "mjpeg", "prores", "dnxhd"),
)
"""Codecs whose pixels are the same on every machine: by standard, lossless, or by FFmpeg's integer transforms."""

_OPTIONS = {"err_detect": "crccheck+explode", "idct": "simple"}

# FFmpeg also reads playlists, which refer to other files.
_CONTAINERS = "mov,matroska,avi"


# Signs of (a, b, c, d) of the display matrix -> EXIF orientation; pixel (p, q) is shown at (a·p + c·q, b·p + d·q).
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
    """True if PyAV is installed."""
    return find_spec("av") is not None


# ---------------------------------------------------------------------------------------------------------- a video


@dataclass(frozen=True, slots=True)
class _PacketInfo:
    """Hold a packet's timestamps, whether it is shown, and whether a new decoder can start at it."""

    pts: int | None
    dts: int | None
    shown: bool
    restarts: bool


class Video:
    """Give access to the frames of a video file in any order; in sequence is fastest.

    ``file``: The open file, which is closed when the object is deleted. Raises SourceError.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        weakref.finalize(self, file.close)
        if missing := missing_part(file):
            raise SourceError("truncated", f"the video lacks {missing}")
        with _as_source_errors("the video cannot be read"):
            container, stream = self._open()
            self._check_stream(stream)
            self._packet_infos = tuple(_packet_infos(self._codec, container, stream))
        if not any(mark.shown for mark in self._packet_infos):
            raise SourceError("empty", "the video has no frame")
        times = [mark.pts for mark in self._packet_infos]
        # AVI stores no timestamps: those of reordered streams are guesses
        guessed = container.format.name == "avi" and stream.codec_context.reorder_depth > 0
        self._timed = None not in times and len(set(times)) == len(times) and not guessed
        self._order = [index for index, mark in enumerate(self._packet_infos) if mark.shown]
        if self._timed:
            self._order.sort(key=lambda index: cast(int, times[index]))
        self._places = {time: index for index, time in enumerate(times)}
        self._numbers = {times[index]: number for number, index in enumerate(self._order)}
        self._starts = _starts(self._packet_infos, self._codec) if self._timed else [0] * len(times)
        self._decoder: _Decoder | None = None

    def __len__(self) -> int:
        return len(self._order)

    def _open(self) -> tuple[InputContainer, VideoStream]:
        import av

        self._file.seek(0)
        container = av.open(self._file, "r", options={"format_whitelist": _CONTAINERS}, metadata_errors="replace")
        covers = av.stream.Disposition.attached_pic
        stream = next((video for video in container.streams.video if not video.disposition & covers), None)
        if stream is None:
            raise SourceError("unsupported", "the file has no video stream")
        return container, stream

    def _check_stream(self, stream: VideoStream) -> None:
        context = cast("VideoCodecContext | None", stream.codec_context)
        self._codec = "" if context is None else context.codec.canonical_name
        if context is None or self._codec not in CODECS:
            raise SourceError(
                "unsupported", f"the codec is {self._codec or 'unknown'}, expected one of {', '.join(CODECS)}"
            )
        if stream.metadata.get("alpha_mode") == "1":
            raise SourceError("alpha", "the video has an alpha channel; flatten it onto a background")
        self._intra_only = context.codec.intra_only
        self._tags = PixelTags.of(context, context.pix_fmt)

    def refuse(self, max_pixels: int, icc: str) -> None:
        """Raise SourceError if the stream's declared pixels cannot be read; see `colours.refuse`."""
        refuse(self._tags, max_pixels, icc)

    def frame(self, number: int, max_pixels: int, icc: str) -> tuple[Srgb, int]:
        """Decode one frame.

        The result is uint8 or uint16, [H, W, 3]. Raises SourceError.
        """
        if number >= len(self):
            raise SourceError("corrupt", f"frame {number} was requested, the video has {len(self)}")
        self.refuse(max_pixels, icc)
        with _as_source_errors(f"frame {number} cannot be decoded"):
            decoded = self._decoded(number)
        if decoded.is_corrupt:
            raise SourceError("corrupt", f"the decoder reports that frame {number} is damaged")
        refuse(PixelTags.of(decoded, decoded.format.name), max_pixels, icc)
        return rgb(decoded), _orientation(decoded)

    def _decoded(self, number: int) -> VideoFrame:
        start = self._starts[self._order[number]]
        if self._decoder is None or not self._decoder.continues_to(number, start):
            self._decoder = _Decoder(start, self._frames(start), self._intra_only)
        return self._decoder.to(number)

    def _frames(self, start: int) -> Iterator[tuple[int, VideoFrame]]:
        """Yield numbered frames from a packet on; FFmpeg's errors are raised after the frames decoded before them."""
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
            for frame in _buffered(context) if self._timed else ():
                if frame.pts in fed and frame.pts in self._numbers:
                    yield self._numbers[frame.pts], frame
            raise

    def _decode(self, context: VideoCodecContext, packet: Packet[VideoStream] | None) -> list[VideoFrame]:
        """Decode a packet; FFV1's decoder conceals damage and reports it in FFmpeg's log only."""
        from av import logging

        if self._codec != "ffv1":
            return context.decode(packet)
        level = logging.get_level()
        logging.set_level(logging.ERROR)
        try:
            with logging.Capture() as messages:
                frames = context.decode(packet)
        finally:
            logging.set_level(level)
        if messages:
            raise SourceError("corrupt", f"the decoder reports: {messages[0][2].strip()}")
        return frames

    def _packets(self, start: int) -> tuple[Iterator[Packet[VideoStream]], VideoCodecContext]:
        """Return the packets from number ``start`` on, and a new decoder for them."""
        from av.codec.context import Flags

        container, stream = self._open()
        packets = self._seek(container, stream, start) if start else _packets_with_data(container, stream)
        if packets is None:
            container, stream = self._open()
            packets = itertools.islice(_packets_with_data(container, stream), start, None)
        context = stream.codec_context
        context.thread_count = 1
        context.flags |= Flags.bitexact
        context.options = _OPTIONS
        return packets, context

    def _seek(self, container: InputContainer, stream: VideoStream, start: int) -> Iterator[Packet[VideoStream]] | None:
        """Return the packets from number ``start`` on through the container's index; None if it does not contain it."""
        import av

        mark = self._packet_infos[start]
        with suppress(av.FFmpegError):
            container.seek(cast(int, mark.pts if mark.dts is None else mark.dts), stream=stream)
            packets = _packets_with_data(container, stream)
            for packet in packets:
                if packet.pts == mark.pts:
                    return itertools.chain([packet], packets)
                if self._places.get(packet.pts, start) >= start:
                    break
        return None


class _Decoder:
    """Hold one decoder that started at packet ``start``, and the frame it reached."""

    def __init__(self, start: int, frames: Iterator[tuple[int, VideoFrame]], intra_only: bool) -> None:
        self._start = start
        self._frames = frames
        self._intra_only = intra_only
        self._reached = -1
        self._next: tuple[int, VideoFrame] | None = None
        self._failure: Exception | None = None

    def continues_to(self, number: int, start: int) -> bool:
        """True if continuing gives the frame that a new decoder from ``start`` would give."""
        if self._intra_only:
            return self._failure is None and number == self._reached + 1
        return self._start == start and number > self._reached

    def to(self, number: int) -> VideoFrame:
        """Continue to a frame; raise SourceError, or FFmpeg's error, if the decoder does not yield it."""
        self._reached = number
        while self._next is None or self._next[0] < number:
            self._next = self._step()
        if self._next[0] > number:
            raise SourceError("corrupt", f"the decoder does not yield frame {number}")
        return self._next[1]

    def _step(self) -> tuple[int, VideoFrame]:
        if self._failure is not None:
            raise self._failure
        try:
            return next(self._frames)
        except StopIteration:
            self._failure = SourceError("corrupt", "the decoder yields fewer frames than there are packets")
        except Exception as error:
            self._failure = error
        raise self._failure


def _buffered(context: VideoCodecContext) -> list[VideoFrame]:
    """Return the frames that a decoder had buffered when it met broken data."""
    import av

    try:
        return context.decode(None)
    except av.FFmpegError:
        return []


@contextmanager
def _as_source_errors(what: str) -> Iterator[None]:
    """Convert FFmpeg's errors to SourceError."""
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


def _packets_with_data(container: InputContainer, stream: VideoStream) -> Iterator[Packet[VideoStream]]:
    return (packet for packet in container.demux(stream) if packet.size)


def _packet_infos(codec: str, container: InputContainer, stream: VideoStream) -> Iterator[_PacketInfo]:
    """Read all packets; those that an edit list hides, and hidden frames of VP8, are decoded but not shown."""
    extradata = stream.codec_context.extradata or b""
    for packet in _packets_with_data(container, stream):
        shown = not packet.is_discard and (codec != "vp8" or bool(bytes(packet)[0] & 0x10))
        restarts = packet.is_keyframe and (codec != "h264" or _has_idr(bytes(packet), extradata))
        yield _PacketInfo(packet.pts, packet.dts, shown, restarts)


def _has_idr(packet: bytes, extradata: bytes) -> bool:
    """True if an H.264 packet contains an IDR picture (type 5), which discards all references."""
    if extradata[:1] != b"\1":
        return any(part[0] & 31 == 5 for part in packet.split(b"\0\0\1")[1:] if part)
    length = (extradata[4] & 3) + 1
    position = 0
    while position + length < len(packet):
        if packet[position + length] & 31 == 5:
            return True
        position += length + int.from_bytes(packet[position : position + length], "big")
    return False


def _starts(infos: tuple[_PacketInfo, ...], codec: str) -> list[int]:
    """Return for each packet the number of the packet that a decoder has to start at for its frame."""
    times = [cast(int, info.pts) for info in infos]
    earliest = list(itertools.accumulate(reversed(times), min))[::-1]  # earliest time of a packet and all later ones
    possible = [0]
    starts = []
    for index, info in enumerate(infos):
        if index and info.restarts and (codec == "hevc" or times[index] == earliest[index]):
            possible.append(index)
        starts.append(next((start for start in reversed(possible) if times[start] <= times[index]), 0))
    return starts


def _orientation(frame: VideoFrame) -> int:
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return 1
    a, b, _, c, d = struct.unpack("=5i", bytes(cast(Any, matrix))[:20])
    signs = cast("tuple[int, int, int, int]", tuple((value > 0) - (value < 0) for value in (a, b, c, d)))
    if signs not in _ORIENTATIONS:
        raise SourceError("unsupported", "the video is rotated by an angle that is not a multiple of 90 degrees")
    return _ORIENTATIONS[signs]
