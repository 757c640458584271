"""Fetch a corpus of hostile pictures: ``python tests/helpers/corpus.py FOLDER``.

For `test_hostile_files`, and for tests by hand.

The test pictures of image libraries come from source packages: broken, cut, oversized and odd on purpose. To them are
added derived ones: good pictures cut, flipped, zeroed, and with headers that lie. A picture whose name no default glob
matches is renamed to ``.jpg`` or ``.png``, so that only the bytes give the format. Nothing of it may be distributed,
so nothing of it is kept in the repository.

    FOLDER/<package>/00012-name.png       as fetched
    FOLDER/derived/<what was done>/…      made here, seeded by the content of the file they were made from

A package that cannot be fetched costs a line on stderr; the count at the end says what there is.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import random
import re
import struct
import sys
import tarfile
import tempfile
import warnings
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))  # run as a script
from helpers.commands import run_process

DEBIAN_SOURCES = (
    *("libpng1.6", "libjpeg-turbo", "tiff", "libwebp", "libgd2", "graphicsmagick", "imagemagick", "gdk-pixbuf"),
    *("exiv2", "leptonlib", "vips", "golang-golang-x-image", "pygame"),
)

MATCHED = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp")
"""What the default of ``source.include`` matches."""

OTHER_PICTURES = re.compile(
    rb"\xff\xd8\xff|\x89PNG|II[*+]\x00|MM\x00[*+]|RIFF....WEBP|BM....\x00{4}|GIF8|8BPS|P[1-7]\s|\x00{3}\x0cjP  |qoif"
    rb"|\xff\x4f\xff\x51|\x00\x00\x01\x00|....ftyp|\x59\xa6\x6a\x95|FORM....ILBM|/\* XPM|\x76\x2f\x31\x01|SIMPLE  =",
    re.DOTALL,
)
LARGEST = 2**26
"""Bytes of the largest file that is taken."""

BASES_PER_FORMAT = 60
"""How many good pictures of each format are damaged."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where to put the pictures; made if it is missing")
    folder: Path = parser.parse_args().folder
    with tempfile.TemporaryDirectory() as scratch:
        for package, archives in fetched(Path(scratch)):
            count = unpack(archives, folder / package)
            print(f"{package}: {count} pictures", file=sys.stderr)
    print(f"derived: {derive(folder)} pictures", file=sys.stderr)
    print(sum(path.is_file() for path in folder.rglob("*")))


# Fetching -------------------------------------------------------------------------------------------------------------


def fetched(scratch: Path) -> Iterator[tuple[str, list[Path]]]:
    """Yields each package with the archives of its source."""
    apt = apt_options(scratch)
    run_process("apt-get", *apt, "update")
    for package in DEBIAN_SOURCES:
        (scratch / package).mkdir()
        done = run_process("apt-get", *apt, "source", "--download-only", package, cwd=scratch / package)
        found = sorted(p for p in (scratch / package).iterdir() if re.search(r"\.(tar\.\w+|tgz)$", p.name))
        if not found:
            last = (done.stderr.strip().splitlines() or ["no output"])[-1]
            print(f"{package}: not fetched ({last[:120]})", file=sys.stderr)
        yield package, found


def apt_options(scratch: Path) -> list[str]:
    """Options that make apt read the machine's own package sources as source packages, with lists of its own."""
    parts, lists = scratch / "sources", scratch / "lists"
    (lists / "partial").mkdir(parents=True)
    parts.mkdir()
    etc = Path("/etc/apt")
    for path in (etc / "sources.list", *(etc / "sources.list.d").glob("*")):
        if path.is_file():
            text = re.sub(r"(?m)^Types:.*$", "Types: deb-src", re.sub(r"(?m)^deb\b", "deb-src", path.read_text()))
            (parts / path.name).write_text(text)
    settings = {"Dir::Etc::SourceList": "-", "Dir::Etc::SourceParts": parts, "Dir::State::Lists": lists}
    return ["-q", *(part for key, value in settings.items() for part in ("-o", f"{key}={value}"))]


# Unpacking ------------------------------------------------------------------------------------------------------------


def unpack(archives: list[Path], to: Path) -> int:
    """Writes the pictures of some archives, numbered, without their folders."""
    count = 0
    for archive in archives:
        for name, content in members(archive):
            to.mkdir(parents=True, exist_ok=True)
            (to / f"{count:05d}-{name}").write_bytes(content)
            count += 1
    return count


def members(archive: Path) -> Iterator[tuple[str, bytes]]:
    """Yields the pictures of an archive under names that a default glob matches."""
    with tarfile.open(archive) as opened:
        for entry in opened:
            file = opened.extractfile(entry) if entry.isreg() and entry.size <= LARGEST else None
            content = b"" if file is None else file.read()
            name = re.sub(r"[^A-Za-z0-9._-]", "_", entry.name.rpartition("/")[2])[-80:]
            if content and name.lower().endswith(MATCHED):
                yield name, content
            elif OTHER_PICTURES.match(content):
                yield name + (".jpg" if zlib.crc32(content) % 2 else ".png"), content


# Deriving -------------------------------------------------------------------------------------------------------------


def derive(folder: Path) -> int:
    """Damages the good pictures of a folder in every way there is; returns how many files that made."""
    count = 0
    for path, kind in bases(folder):
        data = path.read_bytes()
        generator = random.Random(hashlib.sha256(data).hexdigest())
        for damage, make in DAMAGES.items():
            to = folder / "derived" / damage
            to.mkdir(parents=True, exist_ok=True)
            for number, damaged in enumerate(make(data, kind, generator)):
                (to / f"{path.parent.name}-{path.stem}-{number}{path.suffix}").write_bytes(damaged)
                count += 1
    return count


def bases(folder: Path) -> Iterator[tuple[Path, str]]:
    """Yields good pictures of each format, RGB or gray, that end where their format says they end."""
    wanted = {"JPEG": "jpeg", "PNG": "png", "TIFF": "tiff", "WEBP": "webp", "BMP": "bmp"}
    left = dict.fromkeys(wanted, BASES_PER_FORMAT)
    paths = (path for path in folder.glob("*/*") if path.is_file() and path.stat().st_size < 2**20)
    for path in sorted(paths, key=lambda path: hashlib.sha256(path.name.encode()).digest()):
        name = good_format(path)
        if left.get(name, 0):
            left[name] -= 1
            yield path, wanted[name]


def good_format(path: Path) -> str:
    """Return the format of a picture that Pillow loads completely, or an empty text."""
    ends = {"JPEG": b"\xff\xd9", "PNG": b"IEND\xaeB`\x82"}
    data = path.read_bytes()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with Image.open(io.BytesIO(data)) as image:
                image.load()
                plain = image.mode in ("RGB", "L") and image.size[0] * image.size[1] < 2**22
                name = image.format or ""
    except Exception:  # a fuzzed file may raise anything
        return ""
    return name if plain and data.endswith(ends.get(name, b"")) else ""


def cuts(data: bytes, kind: str, generator: random.Random) -> Iterator[bytes]:
    for length in {len(data) - 1, len(data) - 2, *(generator.randrange(12, len(data)) for _ in range(6))}:
        yield data[:length]


def flips(data: bytes, kind: str, generator: random.Random) -> Iterator[bytes]:
    for count, reach in ((1, len(data)), (1, 64), (8, len(data)), (8, 400)):
        damaged = bytearray(data)
        for _ in range(count):
            damaged[generator.randrange(min(reach, len(data)))] ^= 1 << generator.randrange(8)
        yield bytes(damaged)


def zeros(data: bytes, kind: str, generator: random.Random) -> Iterator[bytes]:
    at, length = len(data) // 3, max(1, len(data) // 4)
    yield data[:at] + bytes(length) + data[at + length :]
    at = generator.randrange(len(data))
    yield data[:at] + bytes(min(512, len(data) - at)) + data[at + 512 :]


def holes(data: bytes, kind: str, generator: random.Random) -> Iterator[bytes]:
    first, last = sorted(generator.sample(range(len(data)), 2))
    yield data[:first] + data[last:]


def lies(data: bytes, kind: str, generator: random.Random) -> Iterator[bytes]:
    """Headers that claim another size, also one just below the default limit of pixels."""
    for width, height in ((65535, 65535), (8191, 8191), (2**31 - 1, 2**31 - 1), (1, 2**20), (0, 7)):
        yield resized(data, kind, width, height)


DAMAGES: dict[str, Callable[[bytes, str, random.Random], Iterator[bytes]]] = {
    "cut": cuts,
    "flip": flips,
    "zero": zeros,
    "hole": holes,
    "lie": lies,
}


def resized(data: bytes, kind: str, width: int, height: int) -> bytes:
    """A picture with another size in its header, cut to what the field holds; checksums are made right."""
    edited = bytearray(data)
    if kind == "jpeg":
        for frame in re.finditer(rb"\xff[\xc0-\xc2]\0.\x08", data, re.DOTALL):
            struct.pack_into(">HH", edited, frame.start() + 5, min(height, 65535), min(width, 65535))
    elif kind == "png":
        struct.pack_into(">II", edited, 16, width, height)
        struct.pack_into(">I", edited, 29, zlib.crc32(edited[12:29]))
    elif kind == "bmp":
        struct.pack_into("<ii", edited, 18, width, height)
    elif kind == "webp" and data[12:16] == b"VP8X":
        sizes = ((size - 1 & 0xFFFFFF).to_bytes(3, "little") for size in (width, height))
        edited[24:30] = b"".join(sizes)
    elif kind == "webp":
        struct.pack_into("<HH", edited, 26, width & 0x3FFF, height & 0x3FFF)
    elif kind == "tiff":
        return retagged(data, {256: width, 257: height, 278: height})
    return bytes(edited)


def retagged(data: bytes, values: dict[int, int]) -> bytes:
    """Return a TIFF with other numbers in tags of its first page that hold one number."""
    edited, order = bytearray(data), ">" if data[:2] == b"MM" else "<"
    (first,) = struct.unpack_from(order + "I", data, 4)
    if data[2:4] not in (b"*\0", b"\0*") or first + 2 > len(data):
        return data
    (entries,) = struct.unpack_from(order + "H", data, first)
    for at in range(first + 2, min(first + 2 + 12 * entries, len(data) - 12), 12):
        (tag,) = struct.unpack_from(order + "H", data, at)
        if tag in values:
            struct.pack_into(order + "HII", edited, at + 2, 4, 1, values[tag])
    return bytes(edited)


if __name__ == "__main__":
    main()
