"""Read and write objects of S3, Google Cloud Storage and Azure; the only module that imports obstore.

An `ObjectPath` has the methods of `pathlib.Path` that readers of datasets call, so that the same code reads a local
folder and a URL. A missing object raises FileNotFoundError, like a missing file. Every other failure raises an error of
`core.errors` with one sentence that names the URL.

obstore reads credentials and endpoints from the environment (``AWS_ACCESS_KEY_ID``, ``AWS_ENDPOINT_URL``,
``GOOGLE_SERVICE_ACCOUNT``, ``AZURE_STORAGE_ACCOUNT_NAME``, …). It repeats requests that fail to connect, time out or
get a 5xx or 429 answer, with a growing delay, until `RETRY_TIMEOUT_S`. Design: ``docs/design/object_stores.md``.
"""

from __future__ import annotations

import enum
import io
import itertools
import os
import re
import shutil
import tempfile
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple, TypeVar

from unprocess_gen.core.errors import ConfigError, MachineError
from unprocess_gen.core.libraries import require

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

SCHEMES = {"s3": "AWS_ACCESS_KEY_ID", "gs": "GOOGLE_SERVICE_ACCOUNT", "az": "AZURE_STORAGE_ACCOUNT_NAME"}
"""Schemes of URLs, and the environment variable that a user most likely has to set for each."""

MISSING_BUCKET = ("NoSuchBucket", "ContainerNotFound")
"""Codes by which S3 and Google, and Azure, report that a bucket does not exist."""

REQUEST_TIMEOUT_S = 60
"""Longest time for one request; no request carries more than `MAX_PIECE` bytes."""

CONNECT_TIMEOUT_S = 5

MAX_RETRIES = 8

RETRY_TIMEOUT_S = 90
"""Time from the first attempt of a request after which it is not repeated."""

MIN_PIECE, MAX_PIECE = 2**16, 2**23
"""Bytes of a range request: the first one, and the most that sequential reading grows to."""

UPLOADS = 4
"""Pieces of `MAX_PIECE` bytes of one file that are uploaded at a time and are in memory."""

TEMPORARY_PREFIX = "unprocess_gen-"
"""Beginning of the names of temporary folders, by which a later run on this host finds those that a kill left."""

DELETED_AT_ONCE = 1000
"""Objects that one request deletes, the most that S3 allows."""

THREADS = 32
"""Requests at a time of `ObjectPath.each`."""

Item = TypeVar("Item")
Result = TypeVar("Result")

_URL = re.compile(rf"({'|'.join(SCHEMES)})://([^/]*)/*(.*?)/*", re.DOTALL)
_started_by: set[int] = set()


class ObjectChangedError(MachineError):
    """Report that an object is not the one that was listed: its ETag differs."""


class StoreAccessError(MachineError):
    """Report that a store refuses access, or that a bucket does not exist."""


class EntryKind(enum.Enum):
    """Kind of an entry of a folder."""

    FILE = "regular file or object"
    FOLDER = "folder or prefix"
    LOOP = "link to a folder that contains the link"
    OTHER = "pipe or device"
    BROKEN_LINK = "link to nothing"
    UNREADABLE = "entry whose status cannot be read"


class Entry(NamedTuple):
    """Entry of a folder.

    Attributes
    ----------
    path : str
        Path below the listed folder or prefix.
    size : int or None
        Size of a file in bytes.
    kind : EntryKind
        What the entry is.
    etag : str or None
        ETag of an object, if the store has ETags.
    problem : str
        Why the status of the entry cannot be read.
    """

    path: str
    size: int | None
    kind: EntryKind = EntryKind.FILE
    etag: str | None = None
    problem: str = ""


def is_url(text: object) -> bool:
    """True if a text is the URL of an object store: ``s3://…``, ``gs://…`` or ``az://…``."""
    return isinstance(text, str) and _URL.match(text) is not None


class ObjectPath:
    """Address an object, or all objects below a prefix, by a URL.

    Instances can be pickled. They hold no connection.

    Parameters
    ----------
    url : str
        ``SCHEME://BUCKET/KEY`` with a scheme of `SCHEMES`. Keys are not percent-decoded.

    Attributes
    ----------
    scheme, bucket, key : str
        Parts of the URL; ``key`` has no leading or trailing slash.

    Raises
    ------
    ConfigError
        If the URL has another form or no bucket.
    """

    def __init__(self, url: str) -> None:
        parts = _URL.fullmatch(url)
        if parts is None or not parts[2]:
            expected = ", ".join(f"{scheme}://BUCKET/…" for scheme in SCHEMES)
            raise ConfigError(f"{url}: not the URL of an object store; expected {expected}")
        self.scheme, self.bucket, self.key = parts.groups()

    def __str__(self) -> str:
        return "/".join(filter(None, (f"{self.scheme}://{self.bucket}", self.key)))

    def __repr__(self) -> str:
        return f"ObjectPath({str(self)!r})"

    def __truediv__(self, name: str) -> ObjectPath:
        return ObjectPath(f"{self}/{name}")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ObjectPath) and str(self) == str(other)

    def __hash__(self) -> int:
        return hash(str(self))

    @property
    def name(self) -> str:
        """Return the last part of the key, or the bucket's name without a key."""
        return (self.key or self.bucket).rpartition("/")[2]

    @property
    def parent(self) -> ObjectPath:
        """Return the URL without its last part."""
        return ObjectPath(f"{self.scheme}://{self.bucket}/{self.key.rpartition('/')[0]}")

    @property
    def parents(self) -> tuple[ObjectPath, ...]:
        """URLs of the prefixes above this one, the nearest first."""
        return (self.parent, *self.parent.parents) if self.key else ()

    def resolve(self) -> ObjectPath:
        """Return the URL itself; object stores have no links."""
        return self

    # -------------------------------------------------------------------------------------------------- as a folder

    def walk_entries(self, recursive: bool = True) -> Iterator[Entry]:
        """Yield the objects below this prefix in the order of the store, without holding the listing in memory.

        Empty objects ``FOLDER/``, by which consoles show folders, are omitted if they are followed by objects below
        them; obstore lists them without the slash.
        """
        held: Entry | None = None
        for entry in self._listed(recursive):
            if held is not None and not entry.path.startswith(f"{held.path}/"):
                yield held
            held = None
            if entry.size:
                yield entry
            else:
                held = entry
        if held is not None:
            yield held

    def _listed(self, recursive: bool) -> Iterator[Entry]:
        prefix = f"{self.key}/" if self.key else ""
        with _request(self) as (obstore, store):
            if recursive:
                chunks = obstore.list(store, self.key or None, chunk_size=1000)
            else:
                chunks = iter([obstore.list_with_delimiter(store, self.key or None)["objects"]])
            for facts in itertools.chain.from_iterable(chunks):
                if facts["path"] != self.key:
                    yield Entry(facts["path"].removeprefix(prefix), facts["size"], etag=facts["e_tag"])

    def entries(self) -> dict[str, int]:
        """Names one level below this prefix: sizes in bytes of objects, -1 for prefixes."""
        with _request(self) as (obstore, store):
            listed = obstore.list_with_delimiter(store, self.key or None)
        sizes = {facts["path"]: facts["size"] for facts in listed["objects"] if facts["path"] != self.key}
        sizes |= dict.fromkeys(listed["common_prefixes"], -1)
        return {name.rstrip("/").rpartition("/")[2]: size for name, size in sizes.items()}

    def iterdir(self) -> Iterator[ObjectPath]:
        """Yield the objects and prefixes one level below this one."""
        return (self / name for name in self.entries())

    def mkdir(self, mode: int = 0, parents: bool = False, exist_ok: bool = True) -> None:
        """Check that the bucket exists; a prefix needs no creation."""
        self.is_dir()

    def is_dir(self) -> bool:
        """True if any object is below this prefix."""
        return next(self.walk_entries(), None) is not None

    def is_file(self) -> bool:
        """True if an object has this key."""
        return self._head() is not None

    def exists(self) -> bool:
        """True if an object has this key or is below it."""
        return self.is_file() or self.is_dir()

    is_listed = exists

    def entry(self) -> Entry:
        """Describe this prefix or object; raise FileNotFoundError if there is none."""
        if self.is_dir():
            return Entry(self.name, None, EntryKind.FOLDER)
        entry = self._head()
        if entry is None:
            raise FileNotFoundError(2, "no such object", str(self))
        return entry

    def size(self) -> int | None:
        """Size of the object in bytes, None if there is no such object."""
        entry = self._head()
        return None if entry is None else entry.size

    def stat(self) -> SimpleNamespace:
        """Return the size of the object as ``st_size``; FileNotFoundError if there is none."""
        size = self.size()
        if size is None:
            raise FileNotFoundError(2, "no such object", str(self))
        return SimpleNamespace(st_size=size)

    def _head(self) -> Entry | None:
        if not self.key:
            return None
        try:
            with _request(self) as (obstore, store):
                facts = obstore.head(store, self.key)
        except FileNotFoundError:
            return None
        return Entry(self.name, facts["size"], etag=facts["e_tag"])

    # ------------------------------------------------------------------------------------------------------ reading

    def open(self, mode: str = "rb", etag: str | None = None, first_piece: int = MIN_PIECE) -> io.BufferedReader:
        """Open the object as a seekable binary file for reading; the first read is the first request.

        Reading raises ObjectChangedError if the object has another ETag than ``etag``. Requests begin with
        ``first_piece`` bytes and grow to `MAX_PIECE` while reading is sequential.
        """
        if mode != "rb":
            raise ValueError(f"mode={mode}: objects are opened for reading only")
        return io.BufferedReader(_RangeReader(self, etag, min(first_piece, MAX_PIECE)))

    @contextmanager
    def open_listed(self, size: int, etag: str | None = None) -> Iterator[tuple[BinaryIO, int]]:
        """Open an object of a listing; yield the open file and the listed size, which the ETag proves."""
        with self.open("rb", etag, max(size, 1)) as stream:
            yield stream, size

    def read_bytes(self, etag: str | None = None) -> bytes:
        """Return the content of the object; raise FileNotFoundError, ObjectChangedError or MachineError."""
        with self.open("rb", etag, MAX_PIECE) as stream:
            return stream.read()

    def read_text(self, encoding: str = "utf-8") -> str:
        """Return the content of the object as text."""
        return self.read_bytes().decode(encoding)

    def mapped(self, offset: int, size: int) -> tuple[bytearray, int]:
        """Read a part of the object with one request, as bytes that can be written to; see `LocalPath.mapped`."""
        with self.open("rb", first_piece=size) as stream:
            stream.seek(offset)
            content = bytearray(stream.read(size))
        if len(content) < size:
            raise ValueError("the object ends before")
        return content, 0

    @contextmanager
    def local_copy(self) -> Iterator[Path]:
        """Provide a temporary copy of the object on the local disk."""
        with tempfile.TemporaryDirectory(prefix=TEMPORARY_PREFIX) as folder:
            file = Path(folder) / self.name
            with self.open(first_piece=MAX_PIECE) as source, file.open("wb") as copy:
                shutil.copyfileobj(source, copy, MAX_PIECE)
            yield file

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Apply a function that waits for the store to items, `THREADS` at a time; yield the results in order."""
        with ThreadPoolExecutor(THREADS, "requests") as pool:
            for future in started_ahead(pool, function, items, THREADS):
                yield future.result()

    # ------------------------------------------------------------------------------------------------------ writing

    def write_bytes(self, content: bytes) -> None:
        """Write the object; readers see the former object or the new one, never a part."""
        self._put(content, "overwrite")

    def write(self, content: bytes, unfinished: str = "") -> None:
        """Write the object as `write_bytes`; an object store needs no folder of unfinished files."""
        self.write_bytes(content)

    def create(self, content: bytes, unfinished: str = "") -> bool:
        """Write the object unless it exists; return whether it was written.

        A repeated request can find the object that its first attempt wrote. The result is then False although this
        process wrote the object, so callers compare the content.
        """
        try:
            self._put(content, "create")
        except FileExistsError:
            return False
        return True

    def commit(self, file: Path) -> None:
        """Put a finished file as the object and delete it; an interrupted upload leaves no object."""
        self._put(file, "overwrite")
        file.unlink()

    def _put(self, content: bytes | Path, mode: Any) -> None:
        with _request(self) as (obstore, store):
            obstore.put(store, self.key, content, mode=mode, chunk_size=MAX_PIECE, max_concurrency=UPLOADS)

    def delete(self) -> None:
        """Delete the object; an object that does not exist is no error."""
        with suppress(FileNotFoundError), _request(self) as (obstore, store):
            obstore.delete(store, self.key)

    def delete_all(self) -> None:
        """Delete the object, and all objects below this prefix."""
        prefix = f"{self.key}/" if self.key else ""
        entries = self.walk_entries()
        while keys := [prefix + entry.path for entry in itertools.islice(entries, DELETED_AT_ONCE)]:
            with suppress(FileNotFoundError), _request(self) as (obstore, store):
                obstore.delete(store, keys)
        self.delete()

    def scratch_place(self, unfinished: str) -> tuple[Path, str]:
        """Local folder for unfinished files, ``TMPDIR``, and the first letters of the names of its folders."""
        return Path(tempfile.gettempdir()), TEMPORARY_PREFIX


def started_ahead(
    pool: ThreadPoolExecutor,
    function: Callable[[Item], Result],
    items: Iterable[Item],
    most: int,
    size: Callable[[Item], int] = lambda item: 0,
    most_bytes: int = 0,
) -> Generator[Future[Result], None, None]:
    """Yield the calls of a function in the order of the items.

    Up to ``most`` calls have begun, of items whose sizes sum to at most ``most_bytes``; one call is always allowed.
    """
    started: deque[tuple[Future[Result], int]] = deque()
    try:
        for item in items:
            while started and (len(started) == most or sum(begun for _, begun in started) + size(item) > most_bytes):
                yield started.popleft()[0]
            started.append((pool.submit(function, item), size(item)))
        while started:
            yield started.popleft()[0]
    finally:
        for future, _ in started:
            future.cancel()


class _RangeReader(io.RawIOBase):
    """Read an object by range requests. All of them ask for the ETag of the first answer."""

    def __init__(self, path: ObjectPath, etag: str | None = None, first_piece: int = MIN_PIECE) -> None:
        super().__init__()
        self._path, self._etag, self._size = path, etag, -1
        self._piece, self._start, self._position = memoryview(b""), 0, 0
        self._first_piece = self._piece_size = first_piece

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._position

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        if whence == io.SEEK_END:
            offset += self._path.stat().st_size
        elif whence == io.SEEK_CUR:
            offset += self._position
        if offset < 0:
            raise ValueError(f"position {offset} is before the start of {self._path}")
        self._position = offset
        return offset

    def readinto(self, buffer: WriteableBuffer) -> int:
        view = memoryview(buffer).cast("B")
        if not view:
            return 0
        piece = self._at_position(len(view))[: len(view)]
        view[: len(piece)] = piece
        self._position += len(piece)
        return len(piece)

    def _at_position(self, wanted: int) -> memoryview:
        """Return bytes from the position on, fetched if necessary; none only at the end of the object."""
        end = self._start + len(self._piece)
        if not self._start <= self._position < end:
            sequential = self._position == end and end > 0
            self._piece_size = min(2 * self._piece_size, MAX_PIECE) if sequential else self._first_piece
            size = max(self._piece_size, min(wanted, MAX_PIECE))
            self._piece, self._start = self._fetch(self._position, size), self._position
        return self._piece[self._position - self._start :]

    def _fetch(self, start: int, size: int) -> memoryview:
        if 0 <= self._size <= start:
            return memoryview(b"")
        options = {"range": (start, start + size), **({"if_match": self._etag} if self._etag else {})}
        try:
            with _request(self._path) as (obstore, store):
                answer = obstore.get(store, self._path.key, options=options)
                content = memoryview(answer.bytes())
        except _EndOfObjectError:
            return memoryview(b"")
        self._size, self._etag = answer.meta["size"], self._etag or answer.meta["e_tag"]
        return content


# ------------------------------------------------------------------------------------------------ obstore's own terms


class _EndOfObjectError(Exception):
    """Report that a range begins behind the last byte."""


@lru_cache(maxsize=64)
def _store(scheme: str, bucket: str) -> Any:
    """Return obstore's client of a bucket."""
    from obstore.store import from_url

    return from_url(
        f"{scheme}://{bucket}",
        # an endpoint of http:// is used as given: obstore would otherwise need AWS_ALLOW_HTTP=true as well
        client_options={
            "allow_http": True,
            "timeout": timedelta(seconds=REQUEST_TIMEOUT_S),
            "connect_timeout": timedelta(seconds=CONNECT_TIMEOUT_S),
        },
        retry_config={
            "max_retries": MAX_RETRIES,
            "retry_timeout": timedelta(seconds=RETRY_TIMEOUT_S),
            "backoff": {"init_backoff": timedelta(seconds=0.2), "max_backoff": timedelta(seconds=10), "base": 2},
        },
    )


@contextmanager
def _request(path: ObjectPath) -> Iterator[tuple[Any, Any]]:
    """Provide obstore and the client of a bucket; turn exceptions of the body into exceptions of this module."""
    require("obstore", f"{path}: object stores need obstore", "remote", ", or give a local path")
    import obstore
    from obstore import exceptions

    _check_process(path)
    try:
        yield obstore, _store(path.scheme, path.bucket)
    except exceptions.AlreadyExistsError:
        raise FileExistsError(17, "the object exists", str(path)) from None
    except exceptions.PreconditionError:
        raise ObjectChangedError(f"{path}: has another ETag than when it was listed") from None
    except (exceptions.PermissionDeniedError, exceptions.UnauthenticatedError) as error:
        raise _error(path, error, is_refused=True) from None
    except (exceptions.BaseError, OSError, ValueError) as error:
        raise _error(path, error) from None


def _error(path: ObjectPath, error: Exception, is_refused: bool = False) -> Exception:
    """Return an error of obstore as one of this module's errors."""
    reason = _reason(error)
    if any(code in reason for code in MISSING_BUCKET):
        return StoreAccessError(
            f"{path}: the bucket {path.bucket} does not exist ({reason}); create it, or correct its name"
        )
    if isinstance(error, FileNotFoundError):
        return FileNotFoundError(2, "no such object", str(path))
    if is_refused or reason.startswith(("401", "403")):  # the latter from a service of credentials
        return StoreAccessError(
            f"{path}: access was refused ({reason}); expected credentials in the environment, such as "
            f"{SCHEMES[path.scheme]}"
        )
    if reason.startswith("416"):
        return _EndOfObjectError()
    return MachineError(f"{path}: the object store failed ({reason}); rerun when it answers")


def _reason(error: Exception) -> str:
    """Return the short form of an error of obstore, whose message has some forty lines."""
    text = str(error)
    status, code, message = (
        re.search(pattern, text)
        for pattern in (r"status code: (\d{3}[^:\n]*)", r"<Code>([^<]*)</Code>", r"<Message>([^<]*)</Message>")
    )
    if status is not None:
        return ", ".join(part[1].strip() for part in (status, code, message) if part is not None)
    return re.sub(r"^.* - ", "", text.partition("\n")[0])[:300]


def _check_process(path: ObjectPath) -> None:
    """Refuse a forked copy of a process that has used obstore: its threads are not copied, and each call would hang."""
    if _started_by and os.getpid() not in _started_by:
        raise MachineError(
            f"{path}: object stores cannot be used in a forked process; expected a new process; start workers with "
            "multiprocessing_context='spawn' or 'forkserver'"
        )
    _started_by.add(os.getpid())
