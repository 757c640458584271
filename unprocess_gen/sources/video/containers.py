"""Check that a video container is complete, from its first bytes and its boxes."""

from __future__ import annotations

import struct
from typing import BinaryIO

from unprocess_gen.core.errors import SourceError

_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"uuid", b"moof", b"mfra", b"styp", b"sidx", b"udta")
_EBML, _SEGMENT = b"\x1aE\xdf\xa3", b"\x18S\x80g"


def missing_part(file: BinaryIO) -> str:
    """Part of a container that is declared beyond the end of the file; an empty text if the file is complete.

    Raises SourceError (``unsupported``) for other kinds of files.
    """
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
        raise SourceError("unsupported", "the content is not an MP4, QuickTime, Matroska, WebM or AVI file")
    return f"{end - size} bytes at its end" if end > size else ""


def _missing_boxes(file: BinaryIO, size: int) -> str:
    position, kinds = 0, set()
    while position + 8 <= size:
        file.seek(position)
        head = file.read(16).ljust(16, b"\0")
        length, kind = struct.unpack(">I4s", head[:8])
        length = {0: size - position, 1: int.from_bytes(head[8:16], "big")}.get(length, length)
        if kind not in _BOXES and b"moov" in kinds:
            break
        kinds.add(kind)
        position += max(length, 8)
    if position > size:
        return f"{position - size} bytes at its end"
    return "" if b"moov" in kinds else "its index (moov)"


def _matroska_end(head: bytes) -> int:
    """End of the segment by its header; 0 if the header states none, as in an interrupted recording."""
    length, size_bytes = _vint(head[4:])
    position = 4 + size_bytes + length
    if head[position : position + 4] != _SEGMENT:
        return 0
    length, size_bytes = _vint(head[position + 4 :])
    return 0 if length == (1 << 7 * size_bytes) - 1 else position + 4 + size_bytes + length


def _vint(content: bytes) -> tuple[int, int]:
    """Return a variable-length integer of Matroska and its number of bytes."""
    size_bytes = 9 - content[0].bit_length() if content and content[0] else 8
    return int.from_bytes(content[:size_bytes], "big") & ((1 << 7 * size_bytes) - 1), size_bytes
