"""Read the headers of JPEG, PNG, TIFF, WebP and BMP files without decoding pixels.

A header takes 5 to 200 µs, whatever size it declares, plus the search for a JPEG's last marker at about 1 GB/s. The
shape of the decoded array is compared with the header later (`decode`). Why no library reads them:
``docs/design/decoding.md``.

A file is complete if it contains its end-of-image marker, IEND, or its last strip; bytes after the end (motion photos)
are accepted. Data missing from the middle are found when the file is decoded.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import NamedTuple, TypeVar

from unprocess_gen.core.errors import SourceError

ORIENTATIONS = range(1, 9)

_MOST_PIECES = 2**18
"""Largest number of segments or chunks: 2^26 pixels of 16-bit RGBA in pieces of 2 KiB. Walking them takes 0.5 s."""

_MAX_PROFILE_BYTES = 2**22
# Raised when a header field lies past the end of the file; 64-bit offsets overflow first.
_PAST_THE_END = (struct.error, OverflowError)


@dataclass(frozen=True, slots=True)
class Header:
    """Hold what a file declares about itself.

    Attributes
    ----------
    format : str
        ``jpeg``, ``png``, ``tiff``, ``webp`` or ``bmp``.
    width, height : int
        Size as stored, before the orientation is applied, in pixels.
    mode : str
        ``gray``, ``white_is_zero``, ``rgb``, ``palette`` or ``cmyk``.
    bits : int
        Bits of the decoded array, 8 or 16.
    has_alpha : bool
        Whether the file has an alpha channel or a transparent colour.
    orientation : int
        EXIF orientation, 1 to 8.
    frames : int
        Full pages of a TIFF; 2 for an animation.
    icc : bytes or None
        Embedded ICC profile.
    cicp : tuple of int or None
        Primaries, transfer, matrix and full-range flag of a PNG (ITU-T H.273).
    missing : str
        What the file lacks if it was cut; empty for a complete file.
    """

    format: str
    width: int
    height: int
    mode: str = "rgb"
    bits: int = 8
    has_alpha: bool = False
    orientation: int = 1
    frames: int = 1
    icc: bytes | None = None
    cicp: tuple[int, int, int, int] | None = None
    missing: str = ""


def probe(data: bytes) -> Header:
    """Read the header of a complete image file; its first bytes decide the format; no pixel is decoded.

    Raises SourceError: ``empty``, ``unsupported``, ``truncated`` (within the header itself) or ``corrupt``.
    """
    header = _header(data)
    if header.width < 1 or header.height < 1:
        raise SourceError("corrupt", f"the {header.format} header declares {header.width} x {header.height} pixels")
    return header


def max_side(name: str) -> int:
    """Return the longest side, in pixels, that OpenCV's codec of a format accepts."""
    return _FORMATS[name].max_side


_Piece = TypeVar("_Piece")


def _bounded(pieces: Iterable[_Piece]) -> Iterator[_Piece]:
    """Yield the pieces of a file; raise SourceError if there are so many that walking them takes long."""
    for count, piece in enumerate(pieces):
        if count == _MOST_PIECES:
            raise SourceError("corrupt", f"the file has more than {_MOST_PIECES} segments or chunks")
        yield piece


# JPEG -----------------------------------------------------------------------------------------------------------------

# Within a scan, FF is followed by 00, a restart marker or FF; anything else begins the next segment.
_JPEG_MARKER = re.compile(rb"\xff[^\x00\x01\xd0-\xd8\xff]")
_JPEG_END, _JPEG_SCAN, _JPEG_EXIF, _JPEG_ICC = 0xD9, 0xDA, 0xE1, 0xE2
_JPEG_HUFFMAN_FRAMES = (0xC0, 0xC1, 0xC2)
_JPEG_OTHER_FRAMES = (0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF)
_JPEG_MODES = {1: "gray", 3: "rgb", 4: "cmyk"}
_JPEG_MOST_SCANS = 100
"""Encoders write 1 to 20 scans. An empty scan has 100 bytes but takes 7 ms or more for declared 2^26 pixels."""
_EXIF_PREFIX = b"Exif\0\0"
_ICC_PREFIX = b"ICC_PROFILE\0"


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield (marker, payload) up to the end-of-image marker, or to the end of a file without one."""
    match = _JPEG_MARKER.search(data, 2)
    while match is not None:
        marker = data[match.start() + 1]
        if marker == _JPEG_END:
            yield marker, b""
            return
        (length,) = struct.unpack_from(">H", data, match.end())
        end = match.end() + length
        if length < 2 or end > len(data):
            return
        yield marker, data[match.end() + 2 : end]
        match = _JPEG_MARKER.search(data, end)


def _jpeg(data: bytes) -> Header:
    header, orientation, profile, marker, scans = None, None, {}, 0, 0
    for marker, payload in _bounded(_jpeg_segments(data)):
        scans += marker == _JPEG_SCAN
        if marker in _JPEG_HUFFMAN_FRAMES + _JPEG_OTHER_FRAMES and header is None:
            header = _jpeg_frame(marker, payload)
        elif marker == _JPEG_EXIF and payload.startswith(_EXIF_PREFIX) and orientation is None:
            orientation = _exif_orientation(payload)
        elif marker == _JPEG_ICC and payload.startswith(_ICC_PREFIX):
            profile[payload[12:13]] = payload[14:]
    if header is None:
        raise SourceError("corrupt" if marker == _JPEG_END else "truncated", "the JPEG file has no frame header")
    if scans > _JPEG_MOST_SCANS:
        raise SourceError("corrupt", f"the JPEG file has {scans} scans, more than {_JPEG_MOST_SCANS}")
    return replace(
        header,
        orientation=orientation or 1,
        icc=b"".join(part for _, part in sorted(profile.items())) if profile else None,
        missing="" if marker == _JPEG_END else "its end-of-image marker",
    )


def _jpeg_frame(marker: int, payload: bytes) -> Header:
    depth, height, width, components = struct.unpack_from(">BHHB", payload)
    if marker not in _JPEG_HUFFMAN_FRAMES or depth != 8 or components not in _JPEG_MODES:
        raise _unsupported(f"a JPEG of type SOF{marker - 0xC0} with {components} components of {depth} bits")
    return Header("jpeg", width, height, _JPEG_MODES[components])


# PNG ------------------------------------------------------------------------------------------------------------------

_PNG_MODES = {0: "gray", 2: "rgb", 3: "palette", 4: "gray", 6: "rgb"}
_PNG_ALPHA = (4, 6)
"""Colour types with an alpha channel."""
_PNG_HEAD = 8


def _png_walk(data: bytes) -> Iterator[tuple[bytes, slice]]:
    """Yield the kind and the place of each complete chunk up to IEND."""
    offset, kind = _PNG_HEAD, b""
    while kind != b"IEND" and offset + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, offset)
        start, offset = offset + 8, offset + 12 + length
        if offset <= len(data):
            yield kind, slice(start, offset - 4)


def _png_chunks(data: bytes) -> dict[bytes, slice]:
    """Return the place of the first chunk of each kind."""
    chunks: dict[bytes, slice] = {}
    for kind, place in _bounded(_png_walk(data)):
        chunks.setdefault(kind, place)
    return chunks


def _png(data: bytes) -> Header:
    chunks = _png_chunks(data)
    exif, profile, cicp = (data[chunks[kind]] if kind in chunks else None for kind in (b"eXIf", b"iCCP", b"cICP"))
    first, width, height, bits, colour = struct.unpack_from(">4sIIBB", data, _PNG_HEAD + 4)
    if first != b"IHDR" or colour not in _PNG_MODES:
        raise SourceError("corrupt", f"the PNG file begins with {first!r} and has colour type {colour}")
    return Header(
        "png",
        width,
        height,
        _PNG_MODES[colour],
        16 if bits == 16 else 8,
        has_alpha=colour in _PNG_ALPHA or b"tRNS" in chunks,
        orientation=_exif_orientation(exif or b""),
        frames=2 if b"acTL" in chunks else 1,
        icc=_png_profile(profile),
        cicp=_png_cicp(cicp),
        missing="" if b"IEND" in chunks else "its IEND chunk",
    )


def _png_profile(chunk: bytes | None) -> bytes | None:
    """Decompress iCCP (name, zero, method, deflated bytes); a broken one gives no bytes, which never count as sRGB."""
    if chunk is None:
        return None
    try:
        return zlib.decompressobj().decompress(chunk.partition(b"\0")[2][1:], _MAX_PROFILE_BYTES)
    except zlib.error:
        return b""


def _png_cicp(chunk: bytes | None) -> tuple[int, int, int, int] | None:
    """Return primaries, transfer, matrix and full-range flag (PNG 3rd edition, cICP); they override iCCP."""
    if chunk is None:
        return None
    if len(chunk) != 4:
        raise SourceError("corrupt", f"the cICP chunk has {len(chunk)} bytes, expected 4")
    return chunk[0], chunk[1], chunk[2], chunk[3]


def png_transparent_gray(data: bytes) -> int:
    """Return the gray value that tRNS declares transparent, as it appears in the decoded array."""
    bits = data[_PNG_HEAD + 16]
    key = int.from_bytes(data[_png_chunks(data).get(b"tRNS", slice(0))][:2], "big")
    return key if bits == 16 else (key & (2**bits - 1)) * (255 // (2**bits - 1))


# TIFF, and the EXIF block, which is one -------------------------------------------------------------------------------

_TIFF_VALUES = {1: "B", 3: "H", 4: "I", 7: "B", 13: "I", 16: "Q", 18: "Q"}
_TIFF_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
_SUBFILE, _WIDTH, _HEIGHT, _BITS, _COMPRESSION, _PHOTOMETRIC = 254, 256, 257, 258, 259, 262
_STRIP_OFFSETS, _ORIENTATION, _SAMPLES, _STRIP_ROWS, _STRIP_BYTES, _PLANES = 273, 274, 277, 278, 279, 284
_TILE_WIDTH, _TILE_HEIGHT, _TILE_OFFSETS, _TILE_BYTES, _SAMPLE_FORMAT, _PROFILE = 322, 323, 324, 325, 339, 34675
_REDUCED_PAGE = 1
_CHUNKY, _SEPARATE = 1, 2
_UNCOMPRESSED = 1
_TIFF_COMPRESSIONS = {_UNCOMPRESSED: "none", 5: "LZW", 7: "JPEG", 8: "deflate", 32773: "PackBits", 32946: "deflate"}
_TIFF_CMYK, _TIFF_SUBSAMPLED = 5, 6
# (photometric, bits, samples) -> mode; OpenCV reads other kinds wrongly or not at all
_TIFF_KINDS = {
    **{(0, bits, 1): "white_is_zero" for bits in (1, 8, 16)},
    **{(1, bits, 1): "gray" for bits in (1, 8, 16)},
    **{(2, bits, samples): "rgb" for bits in (8, 16) for samples in (3, 4)},
    **{(3, bits, 1): "palette" for bits in (1, 4, 8)},
    (6, 8, 3): "rgb",
}
_STRIP_PLACES = (_STRIP_OFFSETS, _STRIP_BYTES)
_TILE_PLACES = (_TILE_OFFSETS, _TILE_BYTES)
_PLACES = _STRIP_PLACES + _TILE_PLACES
_MOST_ENTRIES = 4096
"""Tags of a directory that libtiff accepts, in each of up to `_MAX_PAGES` directories, which may overlap."""
_MOST_PLACES, _MOST_VALUES = 2**22, 2**16
"""Largest number of values of a tag that lists strips (one row and channel each), and of any other tag."""
_MOST_READ = 16
"""Largest ratio of listed strip bytes to file size in a compressed file: strips may share bytes, each is copied."""
_SMALLEST_TILE = 32
_LARGEST_TILE = 2**24
_MAX_PAGES = 64
"""Pages that are counted; a chain of overlapping directories could take hours."""


class _Entry(NamedTuple):
    """Tag of a TIFF directory: offset of the entry, type and number of its values, offset of the first value."""

    offset: int
    kind: int
    values: int
    values_offset: int


class _Directory:
    """Read the tags of one directory, a page, of a TIFF file; struct.error if it lies outside the file."""

    def __init__(self, data: bytes, order: str, is_big: bool, offset: int) -> None:
        counter, entry, link = ("Q", "HHQ", "Q") if is_big else ("H", "HHI", "I")
        step, inline_bytes = (20, 8) if is_big else (12, 4)
        self.data, self.order, self.is_big = data, order, is_big
        (count,) = struct.unpack_from(order + counter, data, offset)
        if count > _MOST_ENTRIES:
            raise SourceError("corrupt", f"the TIFF directory has {count} entries, more than {_MOST_ENTRIES}")
        first = offset + struct.calcsize("<" + counter)
        (self.next_offset,) = struct.unpack_from(order + link, data, first + count * step)
        self.entries: dict[int, _Entry] = {}
        for place in range(first, first + count * step, step):
            tag, kind, values = struct.unpack_from(order + entry, data, place)
            values_offset = place + step - inline_bytes
            if values * _TIFF_SIZES.get(kind, 1) > inline_bytes:
                (values_offset,) = struct.unpack_from(order + link, data, values_offset)
            self.entries.setdefault(tag, _Entry(place, kind, values, values_offset))

    def values(self, tag: int, default: int) -> tuple[int, ...]:
        """Return the values of a tag, at least one."""
        entry = self.entries.get(tag)
        if entry is None or entry.kind not in _TIFF_VALUES:
            return (default,)
        most = _MOST_PLACES if tag in _PLACES else _MOST_VALUES
        if entry.values > most:
            raise SourceError("corrupt", f"a TIFF tag has {entry.values} values, more than {most}")
        form = f"{self.order}{entry.values}{_TIFF_VALUES[entry.kind]}"
        return struct.unpack_from(form, self.data, entry.values_offset) or (default,)

    def value(self, tag: int, default: int) -> int:
        """Return the first value of a tag."""
        return self.values(tag, default)[0]

    @property
    def is_thumbnail(self) -> bool:
        """True for a smaller form of another page."""
        return bool(self.value(_SUBFILE, 0) & _REDUCED_PAGE)

    @property
    def orientation(self) -> int:
        """EXIF orientation, 1 if it is missing or unknown."""
        orientation = self.value(_ORIENTATION, 1)
        return orientation if orientation in ORIENTATIONS else 1


def _directories(data: bytes) -> Iterator[_Directory]:
    """Yield the directories of the chain of a TIFF file."""
    order = ">" if data[:2] == b"MM" else "<"
    is_big = struct.unpack_from(order + "H", data, 2)[0] == 43
    (offset,) = struct.unpack_from(order + ("Q" if is_big else "I"), data, 8 if is_big else 4)
    seen = {0}
    while offset not in seen:
        seen.add(offset)
        directory = _Directory(data, order, is_big, offset)
        yield directory
        offset = directory.next_offset


def _tiff(data: bytes) -> Header:
    pages = list(islice(_directories(data), _MAX_PAGES))
    if not pages:
        raise SourceError("corrupt", "the TIFF file has no page")
    page = pages[0]
    mode = _tiff_mode(page)
    profile = page.entries.get(_PROFILE)
    return Header(
        "tiff",
        page.value(_WIDTH, 0),
        page.value(_HEIGHT, 0),
        mode,
        16 if page.value(_BITS, 1) == 16 else 8,
        has_alpha=mode == "rgb" and page.value(_SAMPLES, 1) == 4,
        orientation=page.orientation,
        frames=sum(not other.is_thumbnail for other in pages),
        icc=data[profile.values_offset : profile.values_offset + profile.values] if profile else None,
        missing=_tiff_missing(page),
    )


def _tiff_mode(page: _Directory) -> str:
    """Return the mode; raise SourceError for pixels and layouts that OpenCV cannot read or reads wrongly."""
    photometric, samples, depths = page.value(_PHOTOMETRIC, 1), page.value(_SAMPLES, 1), page.values(_BITS, 1)
    if page.is_thumbnail:
        raise _unsupported("a TIFF whose first page is a thumbnail, as in camera raw files")
    if photometric == _TIFF_CMYK:
        return "cmyk"
    kind = (photometric, depths[0], samples)
    described = f"a TIFF of photometric {photometric} with {samples} samples of {depths} bits"
    if photometric in (0, 1) and samples == 2:
        raise SourceError("alpha", f"{described}: its alpha cannot be checked; save the picture without alpha")
    sample_formats = page.values(_SAMPLE_FORMAT, 1)
    if kind not in _TIFF_KINDS or len(set(depths)) > 1 or set(sample_formats) != {1}:
        raise _unsupported(f"{described} and sample format {sample_formats[0]}")
    if (compression := page.value(_COMPRESSION, _UNCOMPRESSED)) not in _TIFF_COMPRESSIONS:
        raise _unsupported(f"a TIFF of compression {compression}")
    if depths[0] == 16 and samples > 1 and page.value(_PLANES, _CHUNKY) == _SEPARATE:
        raise _unsupported("a 16-bit TIFF with separate colour planes")
    sides = [*page.values(_TILE_WIDTH, _SMALLEST_TILE), *page.values(_TILE_HEIGHT, _SMALLEST_TILE)]
    if depths[0] != 16 and min(sides) < _SMALLEST_TILE:
        raise _unsupported(f"an 8-bit TIFF with tiles narrower than {_SMALLEST_TILE} pixels")
    if page.value(_TILE_WIDTH, 1) * page.value(_TILE_HEIGHT, 1) > _LARGEST_TILE:
        raise _unsupported(f"a TIFF with tiles of more than {_LARGEST_TILE} pixels")
    return _TIFF_KINDS[kind]


def _tiff_missing(page: _Directory) -> str:
    """Missing part of the strips or tiles that the first page of a file lists; empty if the file is complete."""
    is_tiled = page.values(_TILE_OFFSETS, 0) != (0,)
    offsets, lengths = (page.values(tag, 0) for tag in (_TILE_PLACES if is_tiled else _STRIP_PLACES))
    if 0 in offsets or 0 in lengths or len(offsets) != len(lengths):
        raise SourceError("corrupt", "the TIFF page does not list its strips")
    pieces, smallest_bytes = _tiff_pieces(page, is_tiled), _tiff_smallest(page)
    listed_bytes, file_bytes = sum(lengths), len(page.data)
    if len(offsets) < pieces:
        raise SourceError("corrupt", f"the TIFF page lists {len(offsets)} pieces of {pieces}")
    if listed_bytes < smallest_bytes:
        raise SourceError("corrupt", f"the TIFF page lists {listed_bytes} bytes, expected {smallest_bytes}")
    end = max(offset + length for offset, length in zip(offsets, lengths, strict=True))
    if end > file_bytes:
        return f"{end - file_bytes} bytes of its strips"
    if page.value(_COMPRESSION, _UNCOMPRESSED) != _UNCOMPRESSED and listed_bytes > _MOST_READ * file_bytes:
        raise SourceError("corrupt", f"the TIFF page lists {listed_bytes} bytes of strips, the file has {file_bytes}")
    return ""


def _tiff_pieces(page: _Directory, is_tiled: bool) -> int:
    """Number of strips or tiles that a page needs."""
    width, height = page.value(_WIDTH, 0), page.value(_HEIGHT, 0)
    across = page.value(_TILE_WIDTH, 0) if is_tiled else width
    down = page.value(_TILE_HEIGHT, 0) if is_tiled else page.value(_STRIP_ROWS, height)
    if not across or not down:
        raise SourceError("corrupt", "the TIFF page has strips or tiles of size 0")
    planes = page.value(_SAMPLES, 1) if page.value(_PLANES, _CHUNKY) == _SEPARATE else 1
    return -(-width // across) * -(-height // down) * planes


def _tiff_smallest(page: _Directory) -> int:
    """Least number of bytes of the pixels; 1 for compressed or subsampled ones, which give no bound."""
    if page.value(_COMPRESSION, _UNCOMPRESSED) != _UNCOMPRESSED or page.value(_PHOTOMETRIC, 1) == _TIFF_SUBSAMPLED:
        return 1
    row_bits = page.value(_WIDTH, 0) * page.value(_BITS, 1) * page.value(_SAMPLES, 1)
    return (row_bits + 7) // 8 * page.value(_HEIGHT, 0)


def tiff_without_orientation(data: bytes) -> bytes | bytearray:
    """Return the TIFF file with tag 274 set to 1, so that no decoder rotates it; the same bytes if it is 1 already."""
    page = next(_directories(data))
    entry = page.entries.get(_ORIENTATION)
    if entry is None or page.values(_ORIENTATION, 0) == (1,):
        return data
    edited = bytearray(data)
    form = page.order + ("HHQH6x" if page.is_big else "HHIH2x")
    struct.pack_into(form, edited, entry.offset, _ORIENTATION, 3, 1, 1)
    return edited


def _exif_orientation(block: bytes) -> int:
    """Return the orientation in an EXIF block; 1 if it is missing or broken, since the pixels are still usable."""
    tiff = block.removeprefix(_EXIF_PREFIX)
    if not _FORMATS["tiff"].magic.match(tiff):
        return 1
    try:
        # Only the first directory: the second, of the thumbnail, is often broken by editors.
        return next((page.orientation for page in _directories(tiff)), 1)
    except (*_PAST_THE_END, SourceError):
        return 1


# WebP -----------------------------------------------------------------------------------------------------------------

_WEBP_HEAD = 12
_WEBP_ALPHA, _WEBP_ANIMATION = 0x10, 0x02


def _webp_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Yield (kind, start, end) of each chunk; the last may extend past the end of the file."""
    position = _WEBP_HEAD
    while position + 8 <= len(data):
        kind, length = struct.unpack_from("<4sI", data, position)
        yield kind, position + 8, position + 8 + length
        position += 8 + length + length % 2


def _webp(data: bytes) -> Header:
    chunks: dict[bytes, slice] = {}
    for kind, start, end in _bounded(_webp_chunks(data)):
        chunks.setdefault(kind, slice(start, end))
    sizes = [read(data, chunks[kind].start) for kind, read in _WEBP_SIZES.items() if kind in chunks]
    lacking = 8 + struct.unpack_from("<I", data, 4)[0] - len(data)
    if not sizes:
        raise SourceError("truncated" if lacking > 0 else "corrupt", "the WebP file has no picture")
    exif, icc = (data[chunks[kind]] if kind in chunks else None for kind in (b"EXIF", b"ICCP"))
    flags = [flag for _, _, flag in sizes]
    return Header(
        "webp",
        *sizes[0][:2],
        has_alpha=b"ALPH" in chunks or any(flag & _WEBP_ALPHA for flag in flags),
        orientation=_exif_orientation(exif or b""),
        frames=2 if any(flag & _WEBP_ANIMATION for flag in flags) else 1,
        icc=icc,
        missing=f"{lacking} bytes of its RIFF block" if lacking > 0 else "",
    )


def _webp_canvas(data: bytes, start: int) -> tuple[int, int, int]:
    """Return (width, height, flags) of an extended file: 24-bit sizes minus one."""
    flags, width, height = struct.unpack_from("<B3x3s3s", data, start)
    return 1 + int.from_bytes(width, "little"), 1 + int.from_bytes(height, "little"), flags


def _webp_lossy(data: bytes, start: int) -> tuple[int, int, int]:
    """Return (width, height, flags) of a VP8 key frame: 14-bit sizes; the upper two bits request scaling."""
    width, height = struct.unpack_from("<HH", data, start + 6)
    return width & 0x3FFF, height & 0x3FFF, 0


def _webp_lossless(data: bytes, start: int) -> tuple[int, int, int]:
    """Return (width, height, flags) of a VP8L stream: two 14-bit sizes minus one, then the alpha bit."""
    (packed,) = struct.unpack_from("<I", data, start + 1)
    return 1 + (packed & 0x3FFF), 1 + (packed >> 14 & 0x3FFF), _WEBP_ALPHA * (packed >> 28 & 1)


# The extended header comes first, since it gives the size of the complete canvas.
_WEBP_SIZES = {b"VP8X": _webp_canvas, b"VP8 ": _webp_lossy, b"VP8L": _webp_lossless}


# BMP ------------------------------------------------------------------------------------------------------------------

_BMP_KINDS = {1: "palette", 4: "palette", 8: "palette", 24: "rgb", 32: "rgb"}
_BMP_PLAIN, _BMP_MASKED = 0, 3
_BMP_OLD_HEADER, _BMP_ALPHA_HEADER = 12, 56
_BMP_BYTE_MASKS = {0xFF, 0xFF00, 0xFF0000, 0xFF000000}
_BMP_USUAL_MASKS = (0xFF0000, 0xFF00, 0xFF)


def _bmp(data: bytes) -> Header:
    offset, size = struct.unpack_from("<II", data, 10)
    old = size == _BMP_OLD_HEADER
    width, height, _, bits = struct.unpack_from("<HHHH" if old else "<iiHH", data, 18)
    (compression,) = (_BMP_PLAIN,) if old else struct.unpack_from("<I", data, 30)
    masked = compression == _BMP_MASKED and bits == 32
    if bits not in _BMP_KINDS or not (compression == _BMP_PLAIN or masked):
        raise _unsupported(f"a BMP of {bits} bits and compression {compression}")
    end = offset + (width * bits + 31) // 32 * 4 * abs(height)
    return Header(
        "bmp",
        width,
        abs(height),
        _BMP_KINDS[bits],
        has_alpha=masked and _bmp_has_alpha(data, size),
        missing=f"{end - len(data)} bytes of its pixels" if end > len(data) else "",
    )


def _bmp_has_alpha(data: bytes, header_size: int) -> bool:
    red, green, blue = struct.unpack_from("<III", data, 54)
    # For headers below 56 bytes OpenCV assumes the usual masks.
    unusual = header_size < _BMP_ALPHA_HEADER and (red, green, blue) != _BMP_USUAL_MASKS
    if unusual or not {red, green, blue} < _BMP_BYTE_MASKS or len({red, green, blue}) < 3:
        raise _unsupported(f"a BMP whose colours have the masks {red:#x}, {green:#x}, {blue:#x}")
    return header_size >= _BMP_ALPHA_HEADER and struct.unpack_from("<I", data, 66)[0] != 0


# The formats ----------------------------------------------------------------------------------------------------------


class _Format(NamedTuple):
    """Hold a format's first bytes, its header reader, and the longest side in pixels that OpenCV's codec accepts."""

    magic: re.Pattern[bytes]
    read: Callable[[bytes], Header]
    max_side: int


_FORMATS = {
    "jpeg": _Format(re.compile(rb"\xff\xd8\xff"), _jpeg, 65_500),
    "png": _Format(re.compile(rb"\x89PNG\r\n\x1a\n"), _png, 1_000_000),
    "tiff": _Format(re.compile(rb"II[*+]\0|MM\0[*+]"), _tiff, 2**20),
    "webp": _Format(re.compile(rb"RIFF....WEBP", re.DOTALL), _webp, 16_383),
    "bmp": _Format(re.compile(rb"BM"), _bmp, 2**20),
}


_HEIF = re.compile(rb"....ftyp(?:hei[cmsx]|hev[cx]|mif1|msf1|(?P<avif>avi[fs]))", re.DOTALL)
"""First bytes of photographs of telephones, which often have the suffix of a JPEG."""


def _header(data: bytes) -> Header:
    if not data:
        raise SourceError("empty", "the file has 0 bytes")
    name = next((name for name, form in _FORMATS.items() if form.magic.match(data)), None)
    if name is None and (heif := _HEIF.match(data)):
        raise SourceError("unsupported", f"{'AVIF' if heif['avif'] else 'HEIC'}; convert it to JPEG, PNG or TIFF")
    if name is None:
        raise _unsupported(f"a file that begins with {data[:8].hex(' ')}")
    try:
        return _FORMATS[name].read(data)
    except _PAST_THE_END:
        raise SourceError("truncated", f"the {name} header points past the end of the file") from None


def _unsupported(what: str) -> SourceError:
    return SourceError("unsupported", f"{what}; expected {', '.join(_FORMATS)} of 8 bits, or PNG or TIFF of 16 bits")
