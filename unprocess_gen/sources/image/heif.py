"""Read the boxes of HEIC and AVIF files, and decode HEIC by libheif (pillow-heif).

Colours are properties of the primary picture; those of other items, such as gain maps, do not count. Of two, ``prof``
(an ICC profile) precedes ``nclx`` (code points). Libheif rotates pixels, and conceals damage of them.
"""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any, NamedTuple, cast

import numpy as np

from unprocess_gen.core.arrays import Srgb
from unprocess_gen.core.errors import SourceError

_MOST_META_BYTES = 2**22
"""Largest box of properties that is read; that of a telephone's picture has 4 kB."""

_SEQUENCES = b"hevc", b"hevx", b"msf1", b"avis"
_FAILURES = ValueError, EOFError, SyntaxError, RuntimeError, OSError
"""Exceptions of pillow-heif for broken files."""
_AV1_10_BITS, _AV1_12_BITS = 0x40, 0x20
"""Flags in the third byte of av1C."""


class HeifFacts(NamedTuple):
    """Facts of the primary picture, as in `headers.Header`; ``bits`` are those of AV1, 0 for HEVC."""

    bits: int
    icc: bytes
    cicp: tuple[int, ...] | None
    missing: str
    note: str


def heif_facts(data: bytes) -> HeifFacts:
    """Read the boxes of a file; struct.error or SourceError if they are broken or declare a sequence."""
    if data[8:12] in _SEQUENCES:
        raise SourceError("animated", "the file is a sequence of pictures")
    top = list(_boxes(data, 0, len(data)))
    lacking = max(end for _, _, end in top) - len(data)
    first, end = next(((start, end) for kind, start, end in top if kind == b"meta"), (0, 0))
    if not 4 < end - first <= _MOST_META_BYTES:
        raise SourceError("truncated" if lacking > 0 else "corrupt", "the file has no readable meta box")
    listed, own = _properties(data, first + 4, min(end, len(data)))
    colours = [content for kind, content in own or listed if kind == b"colr"]
    icc = next((content[4:] for content in colours if content[:4] in (b"prof", b"rICC")), b"")
    points = next((struct.unpack_from(">HH", content, 4) for content in colours if content[:4] == b"nclx"), None)
    flags = next((content[2] for kind, content in listed if kind == b"av1C" and len(content) > 2), None)
    bits = 0 if flags is None else 8 if not flags & _AV1_10_BITS else 12 if flags & _AV1_12_BITS else 10
    note = "contains a gain map, which is not used" if re.search(b"gainmap|tmap", data[first:end]) else ""
    cicp = None if icc or points is None else (*points, 0, 1)
    return HeifFacts(bits, icc, cicp, f"{lacking} bytes of its boxes" if lacking > 0 else "", note)


def _boxes(data: bytes, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Yield kind, start and end of the content of each box."""
    while start + 8 <= end:
        size, kind = struct.unpack_from(">I4s", data, start)
        content = start + 8
        if size == 1:
            (size,), content = struct.unpack_from(">Q", data, content), content + 8
        after = start + size if size else end
        if after < content:
            raise SourceError("corrupt", f"a box of the file has {size} bytes")
        yield kind, content, after
        start = after


Properties = list[tuple[bytes, bytes]]


def _properties(data: bytes, start: int, end: int) -> tuple[Properties, Properties]:
    """Properties of all items, and those of the primary one if it has colours."""
    places = {kind: (first, after) for kind, first, after in _boxes(data, start, end)}
    places |= {kind: (first, after) for kind, first, after in _boxes(data, *places.get(b"iprp", (0, 0)))}
    listed = [(kind, data[first:after]) for kind, first, after in _boxes(data, *places.get(b"ipco", (0, 0)))]
    if not {b"pitm", b"ipma"} <= places.keys():
        return listed, []
    (at, _), (place, _) = places[b"pitm"], places[b"ipma"]
    (primary,) = struct.unpack_from(">I" if data[at] else ">H", data, at + 4)
    flags, items = struct.unpack_from(">II", data, place)
    number, index = ">I" if flags >> 24 else ">H", "H" if flags & 1 else "B"
    place += 8
    for _ in range(min(items, _MOST_META_BYTES)):
        (item,) = struct.unpack_from(number, data, place)
        place += struct.calcsize(number)
        indices = struct.unpack_from(f">{data[place]}{index}", data, place + 1)
        place += 1 + len(indices) * struct.calcsize(index)
        if item == primary:
            kept = [i & (0x7FFF if flags & 1 else 0x7F) for i in indices]
            own = [listed[i - 1] for i in kept if 0 < i <= len(listed)]
            return listed, own if any(kind == b"colr" for kind, _ in own) else []
    return listed, []


def open_heic(data: bytes) -> Any:
    """Open a HEIC file without decoding pixels; SourceError if libheif cannot, or is not installed."""
    if find_spec("pillow_heif") is None:
        problem = "HEIC is read by pillow-heif; in the repository, run: pip install '.[heic]', or convert it to JPEG"
        raise SourceError("unsupported", problem)
    import pillow_heif

    try:
        return pillow_heif.open_heif(io.BytesIO(data), convert_hdr_to_8bit=False, hdr_to_16bit=False)
    except _FAILURES as error:
        raise SourceError("corrupt", f"libheif cannot open the file ({type(error).__name__})") from error


def decode_heic(data: bytes) -> Srgb:
    """Decode a HEIC file to codes as they are stored, [H, W] or [H, W, 3 or 4], upright; raise as `open_heic`."""
    picture = open_heic(data)
    try:
        return cast(Srgb, np.asarray(picture))
    except _FAILURES as error:
        raise SourceError("corrupt", f"libheif cannot decode the file ({type(error).__name__})") from error


def widened(codes: Srgb, bits: int) -> Srgb:
    """Codes of 10 or 12 bits as those of 16, to the nearest."""
    white, wide = 2**bits - 1, codes.astype(np.uint32)
    return np.asarray((wide * 65535 + white // 2) // white, np.uint16)
