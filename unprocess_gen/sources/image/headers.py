"""Read the headers of photographs without decoding pixels.

A header takes 5 to 200 µs, whatever size it declares, plus the search for a JPEG's last marker at about 1 GB/s. The
shape of the decoded array is compared with the header later (`decode`). Why no library reads them:
``docs/design/decoding.md``.

A file is complete if it contains its end-of-image marker, IEND, or its last strip; bytes after the end (motion photos)
are accepted. Data missing from the middle are found when the file is decoded.
"""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, TypeVar

from unprocess_gen.core.errors import SourceError
from unprocess_gen.sources.image.heif import SEQUENCES, avif_facts, open_heic

_MOST_PIECES = 2**18
"""Largest number of segments or chunks: 2^26 pixels of 16-bit RGBA in pieces of 2 KiB. Walking them takes 0.5 s."""

_MAX_PROFILE_BYTES = 2**22
_Piece = TypeVar("_Piece")
_EXIF_PREFIX, _TIFF_MAGIC = b"Exif\0\0", (b"II*\0", b"MM\0*")


@dataclass(frozen=True, slots=True)
class Header:
    """Header of a picture: its size as stored, in pixels, before the EXIF ``orientation`` is applied, and its kind.

    ``bits`` are those of the decoded array, 8 or 16; of HEIC and AVIF, those of the codes, which may be 10 or 12.
    ``mode`` is ``cmyk``, ``white_is_zero``, or empty. ``has_alpha`` is also true for a transparent colour. ``frames``
    counts full pages of a TIFF, and is 2 for an animation. ``missing`` says what the file lacks if it was cut.

    ``cicp`` (primaries, transfer, matrix and full-range flag, ITU-T H.273) overrides the profile ``icc``, which
    overrides the chunks ``gamma`` and ``chromaticities`` of a PNG.
    """

    format: str
    width: int
    height: int
    bits: int = 8
    mode: str = ""
    has_alpha: bool = False
    orientation: int = 1
    frames: int = 1
    icc: bytes = b""
    cicp: tuple[int, ...] | None = None
    gamma: bytes = b""
    chromaticities: bytes = b""
    missing: str = ""
    note: str = ""


def probe(data: bytes) -> Header:
    """Read the header of a complete image file; its first bytes decide the format; no pixel is decoded.

    Raises SourceError: ``empty``, ``unsupported``, ``truncated`` (within the header itself) or ``corrupt``.
    """
    if not data:
        raise SourceError("empty", "the file has 0 bytes")
    name = next((name for name, (magic, _) in _FORMATS.items() if re.match(magic, data, re.DOTALL)), None)
    if name is None:
        if other := next((other for other, magic in _OTHER_FORMATS.items() if re.match(magic, data, re.DOTALL)), None):
            raise SourceError("unsupported", f"{other}; convert it to JPEG, PNG or TIFF")
        raise _unsupported(f"a file that begins with {data[:8].hex(' ')}")
    try:
        header = _FORMATS[name][1](data)
    except struct.error:
        raise SourceError("truncated", f"the {name} header points past the end of the file") from None
    if header.width < 1 or header.height < 1:
        raise _corrupt(f"the {name} header declares {header.width} x {header.height} pixels")
    return header


def _corrupt(what: str) -> SourceError:
    return SourceError("corrupt", what)


def _unsupported(what: str) -> SourceError:
    return SourceError("unsupported", f"{what}; expected {', '.join(_FORMATS)} of 8 bits, or PNG or TIFF of 16 bits")


def _bounded(pieces: Iterable[_Piece]) -> Iterator[_Piece]:
    """Yield the pieces of a file; raise SourceError if there are so many that walking them takes long."""
    for count, piece in enumerate(pieces):
        if count == _MOST_PIECES:
            raise _corrupt(f"the file has more than {_MOST_PIECES} segments or chunks")
        yield piece


# JPEG -----------------------------------------------------------------------------------------------------------------

# Within a scan, FF is followed by 00, a restart marker or FF; anything else begins the next segment.
_JPEG_MARKER = re.compile(rb"\xff[^\x00\x01\xd0-\xd8\xff]")
_JPEG_END, _JPEG_SCAN, _JPEG_EXIF, _JPEG_ICC = 0xD9, 0xDA, 0xE1, 0xE2
_JPEG_FRAMES = (*range(0xC0, 0xC4), *range(0xC5, 0xC8), *range(0xC9, 0xCC), *range(0xCD, 0xD0))
_JPEG_LAST_HUFFMAN = 0xC2
_JPEG_MOST_SCANS = 100
"""Encoders write 1 to 20 scans. An empty scan has 100 bytes but takes 7 ms or more for declared 2^26 pixels."""


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
    frame, exif, profile, marker, scans, note = None, b"", dict[bytes, bytes](), 0, 0, ""
    for marker, payload in _bounded(_jpeg_segments(data)):
        scans += marker == _JPEG_SCAN
        if marker in _JPEG_FRAMES and frame is None:
            frame = marker, *struct.unpack_from(">BHHB", payload)
        elif marker == _JPEG_EXIF and payload.startswith(_EXIF_PREFIX):
            exif = exif or payload
        elif marker == _JPEG_ICC and payload.startswith(b"ICC_PROFILE\0"):
            profile[payload[12:13]] = payload[14:]
        elif marker == _JPEG_ICC and payload.startswith(b"MPF\0"):
            note = "contains other pictures or a gain map (MPO, Ultra HDR), which are not used"
    if frame is None:
        raise SourceError("corrupt" if marker == _JPEG_END else "truncated", "the JPEG file has no frame header")
    if scans > _JPEG_MOST_SCANS:
        raise _corrupt(f"the JPEG file has {scans} scans, more than {_JPEG_MOST_SCANS}")
    kind, depth, height, width, components = frame
    if kind > _JPEG_LAST_HUFFMAN or depth != 8 or components not in (1, 3, 4):
        raise _unsupported(f"a JPEG of type SOF{kind - 0xC0} with {components} components of {depth} bits")
    mode, missing = "cmyk" if components == 4 else "", "" if marker == _JPEG_END else "its end-of-image marker"
    icc, size = b"".join(profile[number] for number in sorted(profile)), (width, height)
    return Header("jpeg", *size, 8, mode, orientation=_orientation(exif), icc=icc, missing=missing, note=note)


# PNG ------------------------------------------------------------------------------------------------------------------

_PNG_HEAD = 8


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield kind and content of each complete chunk up to IEND, without pixels."""
    offset, kind = _PNG_HEAD, b""
    while kind != b"IEND" and offset + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, offset)
        start, offset = offset + 8, offset + 12 + length
        if offset <= len(data):
            yield kind, b"" if kind == b"IDAT" else data[start : offset - 4]


def _png(data: bytes) -> Header:
    chunks: dict[bytes, bytes] = {}
    for kind, content in _bounded(_png_chunks(data)):
        chunks.setdefault(kind, content)
    width, height, bits, colour = struct.unpack_from(">IIBB", data, _PNG_HEAD + 8)
    cicp = chunks.get(b"cICP")
    if cicp is not None and len(cicp) != 4:
        raise _corrupt(f"the cICP chunk has {len(cicp)} bytes, expected 4")
    gamma, chromaticities = (b"" if b"sRGB" in chunks else chunks.get(kind, b"") for kind in (b"gAMA", b"cHRM"))
    icc = chunks.get(b"iCCP", b"")
    with suppress(zlib.error):  # a broken one stays compressed, and never counts as sRGB
        icc = zlib.decompressobj().decompress(icc.partition(b"\0")[2][1:], _MAX_PROFILE_BYTES)  # name, zero, method
    return Header(
        "png",
        width,
        height,
        16 if bits == 16 else 8,
        has_alpha=colour in (4, 6) or b"tRNS" in chunks,
        orientation=_orientation(chunks.get(b"eXIf", b"")),
        frames=2 if b"acTL" in chunks else 1,
        icc=icc,
        cicp=None if cicp is None else tuple(cicp),
        gamma=gamma,
        chromaticities=chromaticities,
        missing="" if b"IEND" in chunks else "its IEND chunk",
    )


# TIFF, and the EXIF block, which is one -------------------------------------------------------------------------------

_TIFF_VALUES = {1: "B", 3: "H", 4: "I", 7: "B", 13: "I"}
_SUBFILE, _WIDTH, _HEIGHT, _BITS, _COMPRESSION, _PHOTOMETRIC = 254, 256, 257, 258, 259, 262
_STRIP_OFFSETS, _ORIENTATION, _SAMPLES, _STRIP_BYTES, _PLANES = 273, 274, 277, 279, 284
_TILE_WIDTH, _TILE_HEIGHT, _TILE_OFFSETS, _TILE_BYTES, _SAMPLE_FORMAT, _PROFILE = 322, 323, 324, 325, 339, 34675
_REDUCED_PAGE, _SEPARATE, _UNCOMPRESSED = 1, 2, 1
_TIFF_COMPRESSIONS = (_UNCOMPRESSED, 5, 7, 8, 32773, 32946)
"""None, LZW, JPEG, deflate, PackBits, deflate."""
_TIFF_WHITE_IS_ZERO, _TIFF_BLACK_IS_ZERO, _TIFF_CMYK, _TIFF_SUBSAMPLED = 0, 1, 5, 6
_TIFF_KINDS = {
    *((photometric, bits, 1) for photometric in (_TIFF_WHITE_IS_ZERO, _TIFF_BLACK_IS_ZERO) for bits in (1, 8, 16)),
    *((2, bits, samples) for bits in (8, 16) for samples in (3, 4)),
    *((3, bits, 1) for bits in (1, 4, 8)),
    (_TIFF_SUBSAMPLED, 8, 3),
}
"""Photometric, bits and samples of pages that OpenCV reads correctly."""
_MOST_ENTRIES = 4096
"""Tags of a directory that libtiff accepts, in each of up to `_MAX_PAGES` directories, which may overlap."""
_MOST_VALUES = 2**22
"""Largest number of values of a tag: strips of one row and channel each."""
_MOST_READ = 16
"""Largest ratio of listed strip bytes to file size in a compressed file: strips may share bytes, each is copied."""
_SMALLEST_TILE, _LARGEST_TILE = 32, 2**24
_MAX_PAGES = 64
"""Pages that are counted; a chain of overlapping directories could take hours."""


class _Directory:
    """Read the tags of one directory, a page, of a TIFF file; struct.error if it lies outside the file."""

    def __init__(self, data: bytes, offset: int) -> None:
        self.data, self.order = data, ">" if data[:2] == b"MM" else "<"
        (count,) = struct.unpack_from(self.order + "H", data, offset)
        if count > _MOST_ENTRIES:
            raise _corrupt(f"the TIFF directory has {count} entries, more than {_MOST_ENTRIES}")
        last = offset + 2 + 12 * count
        (self.next_offset,) = struct.unpack_from(self.order + "I", data, last)
        self.places: dict[int, int] = {}
        for place in range(offset + 2, last, 12):
            (tag,) = struct.unpack_from(self.order + "H", data, place)
            self.places.setdefault(tag, place)

    def values(self, tag: int, default: int) -> tuple[int, ...]:
        """Values of a tag, at least one."""
        if tag not in self.places:
            return (default,)
        kind, count = struct.unpack_from(self.order + "HI", self.data, self.places[tag] + 2)
        if kind not in _TIFF_VALUES:
            return (default,)
        if count > _MOST_VALUES:
            raise _corrupt(f"a TIFF tag has {count} values, more than {_MOST_VALUES}")
        form, offset = f"{self.order}{count}{_TIFF_VALUES[kind]}", self.places[tag] + 8
        if struct.calcsize(form) > 4:
            (offset,) = struct.unpack_from(self.order + "I", self.data, offset)
        return struct.unpack_from(form, self.data, offset) or (default,)

    def value(self, tag: int, default: int) -> int:
        """First value of a tag."""
        return self.values(tag, default)[0]

    @property
    def is_thumbnail(self) -> bool:
        """True for a smaller form of another page."""
        return bool(self.value(_SUBFILE, 0) & _REDUCED_PAGE)

    @property
    def orientation(self) -> int:
        """EXIF orientation, 1 if it is missing or unknown."""
        orientation = self.value(_ORIENTATION, 1)
        return orientation if 1 <= orientation <= 8 else 1


def _directories(data: bytes) -> Iterator[_Directory]:
    """Yield the directories of the chain of a TIFF file."""
    (offset,), seen = struct.unpack_from(">I" if data[:2] == b"MM" else "<I", data, 4), {0}
    while offset not in seen:
        seen.add(offset)
        directory = _Directory(data, offset)
        yield directory
        offset = directory.next_offset


def _tiff(data: bytes) -> Header:
    pages = list(islice(_directories(data), _MAX_PAGES))
    if not pages:
        raise _corrupt("the TIFF file has no page")
    page = pages[0]
    photometric, bits, samples = page.value(_PHOTOMETRIC, 1), page.value(_BITS, 1), page.value(_SAMPLES, 1)
    modes = {_TIFF_CMYK: "cmyk", _TIFF_WHITE_IS_ZERO: "white_is_zero"}
    if photometric != _TIFF_CMYK:
        _check_tiff(page, (photometric, bits, samples))
    return Header(
        "tiff",
        page.value(_WIDTH, 0),
        page.value(_HEIGHT, 0),
        16 if bits == 16 else 8,
        modes.get(photometric, ""),
        has_alpha=photometric != _TIFF_CMYK and samples == 4,
        orientation=page.orientation,
        frames=sum(not other.is_thumbnail for other in pages),
        icc=bytes(value % 256 for value in page.values(_PROFILE, 0)) if _PROFILE in page.places else b"",
        missing=_tiff_missing(page),
    )


def _check_tiff(page: _Directory, kind: tuple[int, int, int]) -> None:
    """Raise SourceError for pixels and layouts that OpenCV cannot read or reads wrongly."""
    photometric, bits, samples = kind
    described = f"of photometric {photometric} with {samples} samples of {bits} bits"
    if photometric in (_TIFF_WHITE_IS_ZERO, _TIFF_BLACK_IS_ZERO) and samples == 2:
        raise SourceError("alpha", f"a TIFF {described}: its alpha cannot be checked; save the picture without alpha")
    compression = page.value(_COMPRESSION, _UNCOMPRESSED)
    is_uniform = set(page.values(_BITS, 1)) == {bits} and set(page.values(_SAMPLE_FORMAT, 1)) == {1}
    across, down = page.value(_TILE_WIDTH, _SMALLEST_TILE), page.value(_TILE_HEIGHT, _SMALLEST_TILE)
    refusals = {
        "whose first page is a thumbnail, as in camera raw files": page.is_thumbnail,
        f"{described}, or of other sample formats": not (is_uniform and kind in _TIFF_KINDS),
        f"of compression {compression}": compression not in _TIFF_COMPRESSIONS,
        "of 16 bits with separate colour planes": bits == 16 and samples > 1 and page.value(_PLANES, 1) == _SEPARATE,
        f"of 8 bits with tiles narrower than {_SMALLEST_TILE} pixels": bits < 16 and min(across, down) < _SMALLEST_TILE,
        f"with tiles of more than {_LARGEST_TILE} pixels": across * down > _LARGEST_TILE,
    }
    for what, is_refused in refusals.items():
        if is_refused:
            raise _unsupported(f"a TIFF {what}")


def _tiff_missing(page: _Directory) -> str:
    """Missing part of the strips or tiles that the first page of a file lists; empty if the file is complete."""
    is_tiled = page.values(_TILE_OFFSETS, 0) != (0,)
    offsets = page.values(_TILE_OFFSETS if is_tiled else _STRIP_OFFSETS, 0)
    lengths = page.values(_TILE_BYTES if is_tiled else _STRIP_BYTES, 0)
    if 0 in (*offsets, *lengths) or len(offsets) != len(lengths):
        raise _corrupt("the TIFF page does not list its strips")
    end, listed_bytes, file_bytes = max(map(sum, zip(offsets, lengths, strict=True))), sum(lengths), len(page.data)
    row_bytes = (page.value(_WIDTH, 0) * page.value(_BITS, 1) * page.value(_SAMPLES, 1) + 7) // 8
    is_plain = page.value(_COMPRESSION, 1) == _UNCOMPRESSED and page.value(_PHOTOMETRIC, 1) != _TIFF_SUBSAMPLED
    if is_plain and listed_bytes < row_bytes * page.value(_HEIGHT, 0):
        raise _corrupt(f"the TIFF page lists {listed_bytes} bytes, fewer than its pixels have")
    if listed_bytes > _MOST_READ * file_bytes:
        raise _corrupt(f"the TIFF page lists {listed_bytes} bytes of strips, the file has {file_bytes}")
    return f"{end - file_bytes} bytes of its strips" if end > file_bytes else ""


def tiff_without_orientation(data: bytes) -> bytes | bytearray:
    """Set tag 274 of a TIFF file to 1, so that no decoder rotates it, in a copy if it is not 1 already."""
    page = next(_directories(data))
    if page.values(_ORIENTATION, 1) == (1,):
        return data
    edited = bytearray(data)
    struct.pack_into(page.order + "HHIH2x", edited, page.places[_ORIENTATION], _ORIENTATION, 3, 1, 1)
    return edited


def _orientation(block: bytes) -> int:
    """Orientation in an EXIF block; 1 if it is missing or broken, since the pixels are still usable."""
    tiff = block.removeprefix(_EXIF_PREFIX)
    if not tiff.startswith(_TIFF_MAGIC):
        return 1
    try:
        # Only the first directory: the second, of the thumbnail, is often broken by editors.
        return next((page.orientation for page in _directories(tiff)), 1)
    except (struct.error, SourceError):
        return 1


# WebP, AVIF, HEIC -----------------------------------------------------------------------------------------------------


def _webp(data: bytes) -> Header:
    lacking = 8 + struct.unpack_from("<I", data, 4)[0] - len(data)
    if lacking > 0:
        raise SourceError("truncated", f"the file lacks {lacking} bytes of its RIFF block")
    return _by_pillow("webp", data)


def _by_pillow(name: str, data: bytes) -> Header:
    from PIL import AvifImagePlugin, Image, WebPImagePlugin

    readers: dict[str, Any] = {"webp": WebPImagePlugin.WebPImageFile, "avif": AvifImagePlugin.AvifImageFile}
    try:
        picture = readers[name](io.BytesIO(data))
    except (OSError, SyntaxError, ValueError, RuntimeError, Image.DecompressionBombError) as error:
        raise _corrupt(f"the {name} file has no picture ({type(error).__name__})") from error
    facts, (width, height) = picture.info, picture.size
    return Header(
        name,
        width,
        height,
        has_alpha=picture.mode == "RGBA",
        orientation=_orientation(facts.get("exif", b"")),
        frames=picture.n_frames,
        icc=facts.get("icc_profile", b""),
    )


def _avif(data: bytes) -> Header:
    header, (bits, points) = _by_pillow("avif", data), avif_facts(data)
    return replace(header, bits=bits, cicp=None if header.icc or points is None else (*points, 0, 1))


def _heic(data: bytes) -> Header:
    facts, (width, height), mode, frames = open_heic(data)
    icc, points = facts.get("icc_profile") or b"", facts.get("nclx_profile")
    cicp = None if icc or not points else (points["color_primaries"], points["transfer_characteristics"], 0, 1)
    frames, has_alpha = frames + (data[8:12] in SEQUENCES), "A" in mode
    colours: dict[str, Any] = {"icc": icc, "cicp": cicp}
    return Header("heic", width, height, facts["bit_depth"], has_alpha=has_alpha, frames=frames, **colours)


# BMP ------------------------------------------------------------------------------------------------------------------


def _bmp(data: bytes) -> Header:
    offset, size = struct.unpack_from("<II", data, 10)
    if size == 12:  # of OS/2
        (width, height, _, bits), compression = struct.unpack_from("<HHHH", data, 18), 0
    else:
        width, height, _, bits, compression = struct.unpack_from("<iiHHI", data, 18)
    if bits not in (1, 4, 8, 24, 32) or compression:
        raise _unsupported(f"a BMP of {bits} bits and compression {compression}")
    end = offset + (width * bits + 31) // 32 * 4 * abs(height)
    missing = f"{end - len(data)} bytes of its pixels" if end > len(data) else ""
    return Header("bmp", width, abs(height), missing=missing)


# The formats ----------------------------------------------------------------------------------------------------------


_FORMATS: dict[str, tuple[bytes, Callable[[bytes], Header]]] = {
    "jpeg": (rb"\xff\xd8\xff", _jpeg),
    "png": (rb"\x89PNG\r\n\x1a\n", _png),
    "tiff": (rb"II\*\0|MM\0\*", _tiff),
    "webp": (rb"RIFF", _webp),
    "bmp": (rb"BM", _bmp),
    "avif": (rb"....ftyp(?:avi[fs]|mif1....(?:....){0,9}?avif)", _avif),  # mif1 names the codec among the next brands
    "heic": (rb"....ftyp(?:hei[cmsx]|hev[cx]|mif1|msf1)", _heic),
}
"""First bytes and reader of each format."""

_OTHER_FORMATS = {
    "JPEG XL": rb"\xff\x0a|\0\0\0\x0cJXL ",
    "JPEG 2000": rb"\xff\x4f\xff\x51|\0\0\0\x0cjP  ",
    "GIF": rb"GIF8",
}
"""First bytes of pictures that are named when they are refused; those of telephones often have the suffix .jpg."""
