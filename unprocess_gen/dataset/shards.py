"""Write, read and check shards: uncompressed tar archives in the WebDataset layout.

The members of one sample (an image, or a patch of it) are consecutive: ``KEY.clean.npy``, ``KEY.linear_rgb.npy`` if it
is stored, ``KEY.noisy.npy``, noisy frames of other levels and draws (``KEY.noisy.l01d02.npy``), ``KEY.json``. Frames
are uint16 or float32, mosaics [H, W] or packed planes [4, H / 2, W / 2]. Headers are USTAR with fixed time, owner and
mode, so the bytes depend only on the members.

Arrays are written without a copy, and SHA-256 is computed on the way. Reading maps one array into memory; its offset
comes from the tar headers. Timings: ``docs/performance.md``.
"""

from __future__ import annotations

import errno
import hashlib
import io
import math
import os
import tarfile
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import xxhash

from unprocess_gen.core.arrays import DESCRIPTIONS, FLOAT32, PACKED, UINT16, Array, Frame
from unprocess_gen.core.errors import DamageError
from unprocess_gen.core.files import array_xxh3, little_endian
from unprocess_gen.core.paths import AnyPath, any_path
from unprocess_gen.core.targets import LINEAR_RGB
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.keys import sample_key
from unprocess_gen.dataset.row import row_json, rows_of_json

RECORD_BYTES = 512
END = b"\0" * (2 * RECORD_BYTES)
ROW = "json"


def member_of(name: str, level: int, draw: int) -> str:
    """Member, without the key, of a frame or target of a pair."""
    return f"{name}.l{level:02d}d{draw:02d}.npy" if name == "noisy" and (level or draw) else f"{name}.npy"


def targets_cell(targets: Mapping[str, Array]) -> str:
    """Cell of a row that names and identifies its target."""
    return "".join(f"{name}:{FLOAT32}:{array_xxh3(array)}" for name, array in targets.items())


def shard_name(number: int) -> str:
    """File name of a shard."""
    return f"shard-{number:05d}.tar"


class ArrayFormat(NamedTuple):
    """Dtype (one of `DESCRIPTIONS`) and shape of a stored array."""

    dtype: str
    shape: tuple[int, ...]

    @property
    def description(self) -> str:
        """Dtype as the npy format spells it."""
        return DESCRIPTIONS[self.dtype]

    @property
    def size(self) -> int:
        """Bytes of the array without its npy header."""
        return np.dtype(self.description).itemsize * math.prod(self.shape)

    @property
    def header(self) -> bytes:
        """Npy header."""
        stream = io.BytesIO()
        facts = {"descr": self.description, "fortran_order": False, "shape": self.shape}
        np.lib.format.write_array_header_1_0(stream, facts)
        return stream.getvalue()

    def __str__(self) -> str:
        sides = " x ".join(map(str, reversed(self.shape)))
        return f"{sides} {'DN' if self.dtype == UINT16 else self.dtype}"


def array_format(dtype: str, layout: str, height: int, width: int) -> ArrayFormat:
    """Format of a frame."""
    shape = (4, height // 2, width // 2) if layout == PACKED else (height, width)
    return ArrayFormat(dtype, shape)


def _tar_header(name: str, size: int) -> bytes:
    info = tarfile.TarInfo(name)
    info.size = size
    return info.tobuf(format=tarfile.USTAR_FORMAT)


def _padding(size: int) -> int:
    return -size % RECORD_BYTES


_sync_data = getattr(os, "fdatasync", os.fsync)  # macOS has no fdatasync

MAX_PENDING_BYTES = 2**26
"""Bytes that wait for the thread of a `ShardWriter` before the caller waits too."""

SYNC_BYTES = 2**25
"""Bytes after which that thread syncs, so that little is left to sync when the shard is renamed into place."""


class ShardWriter:
    """Write one shard, computing its size and SHA-256.

    ``path`` must not exist; the caller deletes it after an error. ``bytes`` is the size so far. If ``threaded``, a
    second thread hashes, writes and syncs while the caller makes the next frames, which saves time if a core is idle.
    At most `MAX_PENDING_BYTES` and one frame wait; the caller must not change frames that it has added. Methods raise
    OSError.
    """

    def __init__(self, path: Path, threaded: bool = False) -> None:
        self._file: BinaryIO = path.open("xb", buffering=0)
        self._hash = hashlib.sha256()
        self._thread = ThreadPoolExecutor(1, "shard writer") if threaded else None
        self._pending: deque[tuple[int, Future[None]]] = deque()
        self._pending_bytes = 0
        self._unsynced = 0
        self.bytes = 0

    def __enter__(self) -> ShardWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *details: object) -> None:
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
        """SHA-256 of the bytes written so far, 64 hexadecimal digits."""
        self._wait(-1)
        return self._hash.hexdigest()

    def add_frame(self, key: str, member: str, frame: Array) -> None:
        """Append a frame of a sample."""
        header = ArrayFormat(frame.dtype.name, frame.shape).header
        self._member(f"{key}.{member}", len(header) + frame.nbytes, header, little_endian(frame).data)

    def add_pair(self, row: Row, arrays: Mapping[str, Array], is_first: bool) -> None:
        """Append the frames of a pair by name; clean frame and target only if it is the first one of its sample."""
        for name, stored in arrays_of(row).items():
            if is_first or name == "noisy":
                self.add_frame(sample_key(row), stored.member, arrays[name])

    def add_rows(self, key: str, row_json: bytes) -> None:
        """Append the JSON of a sample, after its frames."""
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
            self._wait(MAX_PENDING_BYTES)
            self._pending.append((size, self._thread.submit(self._put_and_sync, views)))
            self._pending_bytes += size

    def _wait(self, most: int) -> None:
        """Wait until at most ``most`` bytes are pending; raise what failed in the thread."""
        while self._pending and (self._pending_bytes > most or self._pending[0][1].done()):
            size, done = self._pending.popleft()
            self._pending_bytes -= size
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
    """Byte offset and the size of a tar member's content."""

    offset: int
    size: int


def read_index(path: AnyPath) -> dict[str, Member]:
    """Members of a shard by name; DamageError unless it is a complete tar archive."""
    index: dict[str, Member] = {}
    try:
        with path.open("rb") as stream:
            while (header := stream.read(RECORD_BYTES)) != END[:RECORD_BYTES]:
                info = tarfile.TarInfo.frombuf(header, "utf-8", "strict")
                if info.size < 0:
                    raise ValueError(f"member {info.name} has {info.size} bytes")
                index[info.name] = Member(stream.tell(), info.size)
                stream.seek(info.size + _padding(info.size), io.SEEK_CUR)
    except PermissionError as error:
        raise DamageError(f"{path}: cannot be read ({error.strerror})") from error
    except (tarfile.HeaderError, OSError, ValueError, OverflowError) as error:
        raise DamageError(f"{path}: not a complete shard ({error})") from error
    return index


def stored_rows(path: AnyPath) -> Iterator[Row]:
    """Read the rows of the pairs in a shard, in the order of the manifest; DamageError if they are not there."""
    index = read_index(path)
    try:
        with path.open("rb") as stream:
            for name in index:
                if name.endswith(f".{ROW}"):
                    stream.seek(index[name].offset)
                    yield from rows_of_json(stream.read(index[name].size))
    except (OSError, ValueError) as error:
        raise DamageError(f"{path}: {name} cannot be read ({error})") from error


def map_array(path: AnyPath, member: Member, array: ArrayFormat) -> Frame:
    """Array of a shard, mapped copy-on-write: writing to it does not change the file.

    The array of an object is a copy, read with one range request. Raises DamageError if the member is not an array of
    this format, or the file was deleted or truncated.
    """
    header = array.header
    try:
        content, skipped = any_path(path).mapped(member.offset, member.size)
    except (OSError, ValueError) as error:
        raise DamageError(f"{path}: the member at byte {member.offset} cannot be read ({error})") from error
    size = len(header) + array.size
    if member.size != size or content[skipped : skipped + len(header)] != header:
        raise DamageError(f"{path}: the member at byte {member.offset} is not an array of {array}")
    return np.ndarray(array.shape, np.dtype(array.description), content, skipped + len(header))


# ------------------------------------------------------------------------------------------------------- verifying


class ExpectedFrame(NamedTuple):
    """Member, XXH3-128 and format of a frame."""

    member: str
    digest: str
    array: ArrayFormat


def arrays_of(row: Row) -> dict[str, ExpectedFrame]:
    """Frames and the target of a row by name, in the order of their members."""
    layout, height, width = str(row["layout"]), int(row["height"] or 0), int(row["width"] or 0)
    dtype, clean_dtype = str(row["dtype"]), str(row["clean_dtype"] or row["dtype"])
    arrays = {"clean": (str(row["clean_xxh3"]), array_format(clean_dtype, layout, height, width))}
    if row["targets"]:
        side = int(row["burst_downscale"] or 1)
        shape = height * side, width * side, 3
        arrays[LINEAR_RGB] = str(row["targets"]).rpartition(":")[2], ArrayFormat(FLOAT32, shape)
    arrays["noisy"] = str(row["noisy_xxh3"]), array_format(dtype, layout, height, width)
    place = int(row["level"] or 0), int(row["draw"] or 0)
    return {name: ExpectedFrame(member_of(name, *place), *array) for name, array in arrays.items()}


def frames_of(sample: Sequence[Row]) -> list[ExpectedFrame]:
    """Frames and the target of a sample, given its rows, in the order of their members."""
    first, *others = sample
    return [*arrays_of(first).values(), *(arrays_of(row)["noisy"] for row in others)]


PIECE = 2**20


def check_members(path: Path, samples: Iterable[Sequence[Row]]) -> Iterator[tuple[str, str, str]]:
    """Compare every byte of a shard with what its samples must be, given their rows.

    Tar headers, npy headers, JSON and padding are compared byte by byte, arrays by digest.
    """
    with path.open("rb") as stream:
        for sample in samples:
            key, json = sample_key(sample[0]), row_json(sample)
            for member, digest, array in frames_of(sample):
                head = array.header
                size = len(head) + array.size
                problems = [*_check_bytes(stream, _tar_header(f"{key}.{member}", size), "tar header")]
                problems += _check_bytes(stream, head, "npy header")
                problems += _check_digest(stream, size - len(head), digest)
                problems += _check_bytes(stream, b"\0" * _padding(size), "padding")
                yield from ((key, member, what) for what in problems)
            content = _tar_header(f"{key}.{ROW}", len(json)) + json + b"\0" * _padding(len(json))
            yield from ((key, ROW, what) for what in _check_bytes(stream, content, "member"))
        rest = stream.read(len(END) + 1)
        if rest != END:
            yield "", "", "the end of the archive is missing" if len(rest) < len(END) else "something follows the end"


def _check_bytes(stream: BinaryIO, wanted: bytes, what: str) -> Iterator[str]:
    content = stream.read(len(wanted))
    if len(content) < len(wanted):
        yield f"its {what} is cut short"
    elif content != wanted:
        offset = next(i for i, (a, b) in enumerate(zip(content, wanted, strict=True)) if a != b)
        yield f"its {what} differs from what the manifest records, from byte {offset} on"


def _check_digest(stream: BinaryIO, size: int, wanted: str) -> Iterator[str]:
    digest, left = xxhash.xxh3_128(), size
    while left and (piece := stream.read(min(PIECE, left))):
        digest.update(piece)
        left -= len(piece)
    if left:
        yield f"its data are cut short by {left} bytes"
    elif digest.hexdigest() != wanted:
        yield f"the XXH3-128 of its data is {digest.hexdigest()}, the manifest records {wanted}"
