"""Shards: uncompressed tar files in the WebDataset layout, whose bytes depend on nothing but their members.

Members of one sample, an image or a patch of it, stand side by side: ``KEY.clean.npy``, ``KEY.noisy.npy`` (uint16 or
float32, ``[H, W]`` or packed ``[4, H / 2, W / 2]``), the noisy frames of other levels and draws
(``KEY.noisy.l01d02.npy``), ``KEY.json``. Headers are USTAR with time, owner and mode fixed. Writing goes straight from
the arrays to the file while SHA-256 runs along (0.5 ns a byte together), reading maps just the bytes of one array into
memory, found through an index of offsets that is read from the tar headers: nothing is ever unpacked.
"""

from __future__ import annotations

import errno
import hashlib
import io
import math
import mmap
import os
import tarfile
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, NamedTuple

import numpy as np
import xxhash

from unprocess_gen.core.errors import DamageError
from unprocess_gen.core.files import little_endian
from unprocess_gen.core.types import DESCRIPTIONS, PACKED, UINT16, Frame

RECORD = 512
END = b"\0" * (2 * RECORD)
CLEAN, ROW = "clean.npy", "json"

MAX_JSON_BYTES = 2**27
"""Largest JSON member that is read: the rows of 99 levels with 99 draws take half of it."""


def noisy_member(level: int, draw: int) -> str:
    """Return the member that holds a noisy frame: the first is ``noisy.npy``, others say their level and draw."""
    return f"noisy.l{level:02d}d{draw:02d}.npy" if level or draw else "noisy.npy"


def shard_name(number: int) -> str:
    """Return a shard's file name."""
    return f"shard-{number:05d}.tar"


class Form(NamedTuple):
    """How the numbers of a frame lie in a file: their dtype, one of `DESCRIPTIONS`, and the array's shape."""

    dtype: str
    shape: tuple[int, ...]

    @property
    def description(self) -> str:
        """The dtype as NumPy spells it in a file."""
        return DESCRIPTIONS[self.dtype]

    @property
    def size(self) -> int:
        """Bytes of the numbers alone."""
        return np.dtype(self.description).itemsize * math.prod(self.shape)

    @property
    def header(self) -> bytes:
        """What stands before them in the npy format."""
        stream = io.BytesIO()
        facts = {"descr": self.description, "fortran_order": False, "shape": self.shape}
        np.lib.format.write_array_header_1_0(stream, facts)
        return stream.getvalue()

    def __str__(self) -> str:
        sides = " x ".join(map(str, reversed(self.shape)))
        return f"{sides} {'DN' if self.dtype == UINT16 else self.dtype}"


def form_of(dtype: str, layout: str, height: int, width: int) -> Form:
    """Return the form of a frame of ``height`` x ``width`` sites."""
    shape = (4, height // 2, width // 2) if layout == PACKED else (height, width)
    return Form(dtype, shape)


def _tar_header(name: str, size: int) -> bytes:
    info = tarfile.TarInfo(name)
    info.size = size
    return info.tobuf(format=tarfile.USTAR_FORMAT)


def _padding(size: int) -> int:
    return -size % RECORD


def image_bytes(form: Form, json_bytes: int, pairs: int = 1) -> int:
    """Return the bytes that one sample and its noisy frames take in a shard, tar framing included."""
    array = len(form.header) + form.size
    return sum(RECORD + size + _padding(size) for size in (*[array] * (1 + pairs), json_bytes))


def shard_bytes(pairs: list[int]) -> int:
    """Return the size of a shard from those of its pairs; no pair, no file."""
    return sum(pairs) + len(END) if pairs else 0


_sync_data = getattr(os, "fdatasync", os.fsync)  # not everywhere is there one for the data alone

MOST_UNDERWAY = 2**26
SYNC_BYTES = 2**25
"""Synced so often beside the work, so that little is left to sync when a shard is put into place."""


class ShardWriter:
    """Write one shard to ``path``, which must not exist; its size and SHA-256 are known on leaving.

    ``beside`` has a thread of its own hash, write and sync, while the caller makes the next frames: worth it where a
    core is idle. At most `MOST_UNDERWAY` bytes and one part more wait for it; frames given to it must stay as they are.
    Raises OSError as the file system does, then or with a later call; the caller owns the file and what becomes of it.
    """

    def __init__(self, path: Path, beside: bool = False) -> None:
        self._file: BinaryIO = path.open("xb", buffering=0)
        self._hash = hashlib.sha256()
        self._thread = ThreadPoolExecutor(1, "shard writer") if beside else None
        self._underway: deque[tuple[int, Future[None]]] = deque()
        self._bytes_underway = 0
        self._unsynced = 0
        self.bytes = 0

    def __enter__(self) -> ShardWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        try:
            if kind is None:
                self._write(END)
                self._wait(-1)
        finally:
            if self._thread is not None:
                self._thread.shutdown(cancel_futures=True)
            self._file.close()

    @property
    def sha256(self) -> str:
        """Hex digest of what was written."""
        self._wait(-1)
        return self._hash.hexdigest()

    def add_frame(self, key: str, member: str, frame: Frame) -> None:
        """Append a frame of a sample."""
        header = Form(frame.dtype.name, frame.shape).header
        self._member(f"{key}.{member}", len(header) + frame.nbytes, header, little_endian(frame).data)

    def add_rows(self, key: str, row_json: bytes) -> None:
        """Append the rows of a sample, after its frames."""
        self._member(f"{key}.{ROW}", len(row_json), row_json)

    def _member(self, name: str, size: int, *parts: bytes | memoryview) -> None:
        self._write(_tar_header(name, size), *parts, b"\0" * _padding(size))

    def _write(self, *parts: bytes | memoryview) -> None:
        views = [memoryview(part).cast("B") for part in parts]
        size = sum(map(len, views))
        self.bytes += size
        if self._thread is None:
            self._put(views)
        else:
            self._wait(MOST_UNDERWAY)
            self._underway.append((size, self._thread.submit(self._put_and_sync, views)))
            self._bytes_underway += size

    def _wait(self, most: int) -> None:
        """Wait until no more than so many bytes are underway; what failed there is raised here."""
        while self._underway and (self._bytes_underway > most or self._underway[0][1].done()):
            size, done = self._underway.popleft()
            self._bytes_underway -= size
            done.result()

    def _put_and_sync(self, views: Sequence[memoryview]) -> None:
        self._put(views)
        self._unsynced += sum(map(len, views))
        if self._unsynced >= SYNC_BYTES:
            _sync_data(self._file.fileno())
            self._unsynced = 0

    def _put(self, views: Sequence[memoryview]) -> None:
        for view in views:
            self._hash.update(view)
            while view:
                written = self._file.write(view)
                if not written:
                    raise OSError(errno.EIO, "the file takes no more bytes", self._file.name)
                view = view[written:]


# --------------------------------------------------------------------------------------------------------- reading


class Member(NamedTuple):
    """Where the bytes of one tar member lie."""

    offset: int
    size: int


def read_index(path: Path) -> dict[str, Member]:
    """Return name → place of every member of a shard, from its headers; DamageError where it is not a whole tar."""
    index: dict[str, Member] = {}
    try:
        with path.open("rb") as stream:
            while (header := stream.read(RECORD)) != END[:RECORD]:
                info = tarfile.TarInfo.frombuf(header, "utf-8", "strict")
                if info.size < 0:
                    raise ValueError(f"member {info.name} has {info.size} bytes")
                index[info.name] = Member(stream.tell(), info.size)
                stream.seek(info.size + _padding(info.size), io.SEEK_CUR)
    except (tarfile.HeaderError, OSError, ValueError, OverflowError) as error:
        raise DamageError(f"{path}: not a whole shard ({error})") from error
    return index


def map_array(path: Path, member: Member, form: Form) -> Frame:
    """Return an array that lies in the file: mapped, not copied, and private, so that writing to it is harmless.

    DamageError where the member is not an array of ``form``, or the file is gone or too short.
    """
    start = member.offset - member.offset % mmap.ALLOCATIONGRANULARITY
    skipped, header = member.offset - start, form.header
    try:
        with path.open("rb") as stream:
            mapped = mmap.mmap(stream.fileno(), skipped + member.size, access=mmap.ACCESS_COPY, offset=start)
    except (OSError, ValueError) as error:
        raise DamageError(f"{path}: the member at byte {member.offset} cannot be read ({error})") from error
    size = len(header) + form.size
    if member.size != size or mapped[skipped : skipped + len(header)] != header:
        raise DamageError(f"{path}: the member at byte {member.offset} is not an array of {form}")
    return np.ndarray(form.shape, np.dtype(form.description), mapped, skipped + len(header))


# ------------------------------------------------------------------------------------------------------- verifying


class Expected(NamedTuple):
    """What a shard must hold of one sample: the frames' form, members and XXH3-128, and the JSON to the byte."""

    key: str
    form: Form
    frames: tuple[tuple[str, str], ...]
    json: bytes


PIECE = 2**20


def check_members(path: Path, images: Sequence[Expected]) -> Iterator[tuple[str, str, str]]:
    """Yield (key, member, what is wrong) for every member that is not as expected, and for what follows the last.

    Tar headers, npy headers, JSON and padding are held to the byte, arrays to their digest, so that a shard without a
    complaint has just the bytes it was written with.
    """
    with path.open("rb") as stream:
        for image in images:
            head = image.form.header
            size = len(head) + image.form.size
            for member, digest in image.frames:
                found = [*_check_bytes(stream, _tar_header(f"{image.key}.{member}", size), "tar header")]
                found += _check_bytes(stream, head, "npy header")
                found += _check_digest(stream, size - len(head), digest)
                found += _check_bytes(stream, b"\0" * _padding(size), "padding")
                yield from ((image.key, member, what) for what in found)
            header = _tar_header(f"{image.key}.{ROW}", len(image.json))
            whole = header + image.json + b"\0" * _padding(len(image.json))
            yield from ((image.key, ROW, what) for what in _check_bytes(stream, whole, "member"))
        rest = stream.read(len(END) + 1)
        if rest != END:
            yield "", "", "the end of the archive is missing" if len(rest) < len(END) else "something follows the end"


def salvage(path: Path, images: Sequence[Expected]) -> Iterator[dict[str, Frame]]:
    """Yield for each image those frames, by member, that lie at their place in a damaged shard, whole."""
    content = np.memmap(path, np.uint8, "r") if path.is_file() and path.stat().st_size else np.empty(0, np.uint8)
    at = 0
    for image in images:
        size, head = image.form.size, len(image.form.header)
        frames = {}
        for member, digest in image.frames:
            frame = content[at + RECORD + head :][:size]
            at += RECORD + head + size + _padding(head + size)
            if len(frame) == size and xxhash.xxh3_128_hexdigest(frame.data) == digest:
                frames[member] = frame.view(image.form.description).reshape(image.form.shape)
        at += RECORD + len(image.json) + _padding(len(image.json))
        yield frames


def json_inside(path: Path) -> list[bytes]:
    """Return the JSON members of an intact shard.

    Parameters
    ----------
    path : Path
        The shard.

    Returns
    -------
    list of bytes
        Content of each ``KEY.json``, in the order of the shard; `manifest.rows_of_json` reads it.

    Raises
    ------
    DamageError
        If the file is not a complete tar archive, or a member has more than `MAX_JSON_BYTES`.
    """
    members = [member for name, member in read_index(path).items() if name.endswith(f".{ROW}")]
    if any(member.size > MAX_JSON_BYTES for member in members):
        raise DamageError(f"{path}: a JSON member has more than {MAX_JSON_BYTES} bytes")
    with path.open("rb") as stream:
        return [_read_at(stream, member) for member in members]


def _read_at(stream: BinaryIO, member: Member) -> bytes:
    stream.seek(member.offset)
    return stream.read(member.size)


def _check_bytes(stream: BinaryIO, wanted: bytes, what: str) -> Iterator[str]:
    found = stream.read(len(wanted))
    if len(found) < len(wanted):
        yield f"its {what} is cut short"
    elif found != wanted:
        at = next(i for i, (a, b) in enumerate(zip(found, wanted, strict=True)) if a != b)
        yield f"its {what} differs from what the manifest says, from byte {at} on"


def _check_digest(stream: BinaryIO, size: int, wanted: str) -> Iterator[str]:
    digest, left = xxhash.xxh3_128(), size
    while left and (piece := stream.read(min(PIECE, left))):
        digest.update(piece)
        left -= len(piece)
    if left:
        yield f"its data are cut short by {left} bytes"
    elif digest.hexdigest() != wanted:
        yield f"the XXH3-128 of its data is {digest.hexdigest()}, the manifest says {wanted}"
