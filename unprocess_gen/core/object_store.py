"""Read and write objects of S3, Google Cloud Storage and Azure; the only module that imports obstore.

An `ObjectPath` has the methods of `pathlib.Path` that readers of datasets call, so that the same code reads a local
folder and a URL. A missing object raises FileNotFoundError, like a missing file. Every other failure raises an error of
`core.errors` with one sentence that names the URL.

obstore reads credentials and endpoints from the environment (``AWS_ACCESS_KEY_ID``, ``AWS_ENDPOINT_URL``,
``GOOGLE_SERVICE_ACCOUNT``, ``AZURE_STORAGE_ACCOUNT_NAME``, …). It repeats requests that fail to connect, time out or
get a 5xx or 429 answer, with a growing delay, until `RETRY_TIMEOUT_S`. Measurements: ``docs/design/object_stores.md``.
"""

from __future__ import annotations

import io
import itertools
import os
import re
import tempfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from unprocess_gen.core.errors import ConfigError, MachineError

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

DELETED_AT_ONCE = 1000
"""Objects that one request deletes, the most that S3 allows."""

THREADS = 32
"""Requests at a time of `in_threads`."""

Item = TypeVar("Item")
Result = TypeVar("Result")

_URL = re.compile(rf"({'|'.join(SCHEMES)})://([^/]*)/*(.*?)/*", re.DOTALL)
_started_by: set[int] = set()


class ObjectChangedError(MachineError):
    """Report that an object is not the one that was listed: its ETag differs."""


class StoreAccessError(MachineError):
    """Report that a store refuses access, or that a bucket does not exist."""


class ObjectFacts(NamedTuple):
    """Hold an entry of a listing: key below the listed prefix, size in bytes, ETag (None if the store has none)."""

    key: str
    size: int
    etag: str | None


class ObjectStat(NamedTuple):
    """Hold the size of an object in bytes, under the name that `os.stat_result` gives it."""

    st_size: int


def is_url(text: object) -> bool:
    """Return whether a text is the URL of an object store, rather than a path.

    Parameters
    ----------
    text : object
        Value of ``source.root`` or ``out``, or a path.

    Returns
    -------
    bool
        True for ``s3://…``, ``gs://…`` and ``az://…``.
    """
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

    # -------------------------------------------------------------------------------------------------- as a folder

    def objects(self, recursive: bool = True) -> Iterator[ObjectFacts]:
        """List the objects below this prefix, without holding the listing in memory.

        Parameters
        ----------
        recursive : bool
            Whether to list objects whose key has further slashes.

        Yields
        ------
        ObjectFacts
            In the order of the store. Empty objects ``FOLDER/``, by which consoles show folders, are omitted if they
            are followed by objects below them; obstore lists them without the slash.
        """
        held: ObjectFacts | None = None
        for found in self._listed(recursive):
            if held is not None and not found.key.startswith(f"{held.key}/"):
                yield held
            held = None
            if found.size:
                yield found
            else:
                held = found
        if held is not None:
            yield held

    def _listed(self, recursive: bool) -> Iterator[ObjectFacts]:
        prefix = f"{self.key}/" if self.key else ""
        with _request(self) as (obstore, store):
            if recursive:
                chunks = obstore.list(store, self.key or None, chunk_size=1000)
            else:
                chunks = iter([obstore.list_with_delimiter(store, self.key or None)["objects"]])
            for chunk in chunks:
                for found in chunk:
                    if found["path"] != self.key:
                        yield ObjectFacts(found["path"].removeprefix(prefix), found["size"], found["e_tag"])

    def iterdir(self) -> Iterator[ObjectPath]:
        """Yield the objects and prefixes one level below this one."""
        return (self / name for name in self.entries())

    def entries(self) -> dict[str, int]:
        """Return what is one level below this prefix: names and sizes of objects, and -1 for the names of prefixes."""
        with _request(self) as (obstore, store):
            found = obstore.list_with_delimiter(store, self.key or None)
        sizes = {facts["path"]: facts["size"] for facts in found["objects"] if facts["path"] != self.key}
        sizes |= dict.fromkeys(found["common_prefixes"], -1)
        return {name.rstrip("/").rpartition("/")[2]: size for name, size in sizes.items()}

    def is_dir(self) -> bool:
        """Return whether any object is below this prefix."""
        return next(self.objects(), None) is not None

    def is_file(self) -> bool:
        """Return whether an object has this key."""
        return self.facts() is not None

    def exists(self) -> bool:
        """Return whether an object has this key or is below it."""
        return self.is_file() or self.is_dir()

    # ------------------------------------------------------------------------------------------------------ reading

    def facts(self) -> ObjectFacts | None:
        """Return name, size and ETag of the object; None if there is none."""
        if not self.key:
            return None
        try:
            with _request(self) as (obstore, store):
                found = obstore.head(store, self.key)
        except FileNotFoundError:
            return None
        return ObjectFacts(self.name, found["size"], found["e_tag"])

    def stat(self) -> ObjectStat:
        """Return the size of the object; FileNotFoundError if there is none."""
        facts = self.facts()
        if facts is None:
            raise FileNotFoundError(2, "no such object", str(self))
        return ObjectStat(facts.size)

    def open(self, mode: str = "rb", etag: str | None = None, first_piece: int = MIN_PIECE) -> io.BufferedReader:
        """Open the object as a seekable binary file.

        Parameters
        ----------
        mode : {"rb"}
            Objects are opened for reading only.
        etag : str, optional
            The ETag that the object must have.
        first_piece : int
            Bytes of the first request; later ones grow to `MAX_PIECE` while reading is sequential.

        Returns
        -------
        binary file
            Its methods raise as `read_bytes`. The first read is the first request.
        """
        if mode != "rb":
            raise ValueError(f"mode={mode}: objects are opened for reading only")
        return io.BufferedReader(_RangeReader(self, etag, min(first_piece, MAX_PIECE)))

    def read_bytes(self, etag: str | None = None) -> bytes:
        """Return the content of the object.

        Parameters
        ----------
        etag : str, optional
            The ETag that the object must have.

        Returns
        -------
        bytes
            The content.

        Raises
        ------
        FileNotFoundError
            If there is no such object.
        ObjectChangedError
            If the object has another ETag.
        MachineError
            If the store does not answer.
        """
        with self.open("rb", etag, MAX_PIECE) as stream:
            return stream.read()

    def read_text(self, encoding: str = "utf-8") -> str:
        """Return the content of the object as text."""
        return self.read_bytes().decode(encoding)

    def read_range(self, start: int, size: int, etag: str | None = None) -> bytes:
        """Return ``size`` bytes from byte ``start`` on, or fewer at the end of the object; raise as `read_bytes`."""
        reader = _RangeReader(self, etag, first_piece=min(size, MAX_PIECE))
        reader.seek(start)
        pieces = bytearray()
        while len(pieces) < size and (piece := reader.read(size - len(pieces))):
            pieces += piece
        return bytes(pieces)

    # ------------------------------------------------------------------------------------------------------ writing

    def write_bytes(self, content: bytes) -> None:
        """Write the object; readers see the former object or the new one, never a part."""
        self._put(content, "overwrite")

    def create(self, content: bytes) -> bool:
        """Write the object unless it exists; return whether it was written.

        A repeated request can find the object that its first attempt wrote. The result is then False although this
        process wrote the object, so callers compare the content.
        """
        try:
            self._put(content, "create")
        except FileExistsError:
            return False
        return True

    def put_file(self, file: Path) -> None:
        """Write a local file as the object; an interrupted upload leaves no object."""
        self._put(file, "overwrite")

    def _put(self, content: bytes | Path, mode: Any) -> None:
        with _request(self) as (obstore, store):
            obstore.put(store, self.key, content, mode=mode, chunk_size=MAX_PIECE, max_concurrency=UPLOADS)

    def delete(self) -> None:
        """Delete the object; an object that does not exist is no error."""
        with suppress(FileNotFoundError), _request(self) as (obstore, store):
            obstore.delete(store, self.key)

    def delete_all(self) -> None:
        """Delete all objects below this prefix."""
        prefix = f"{self.key}/" if self.key else ""
        found = self.objects()
        while keys := [prefix + facts.key for facts in itertools.islice(found, DELETED_AT_ONCE)]:
            with suppress(FileNotFoundError), _request(self) as (obstore, store):
                obstore.delete(store, keys)


AnyPath = Path | ObjectPath
"""A local path, or the URL of an object or prefix."""


def any_path(text: str | os.PathLike[str] | ObjectPath) -> AnyPath:
    """Return the path that a text names.

    Parameters
    ----------
    text : str, path-like or ObjectPath
        A local path, or a URL of an object store.

    Returns
    -------
    Path or ObjectPath
        `ObjectPath` only for a text that `is_url` accepts; a local path stays a local path.
    """
    if isinstance(text, ObjectPath):
        return text
    return ObjectPath(text) if isinstance(text, str) and is_url(text) else Path(text)


def open_text(path: AnyPath) -> io.TextIOWrapper:
    """Open a UTF-8 text file for reading, with its line ends.

    Parameters
    ----------
    path : Path or ObjectPath
        The file.

    Returns
    -------
    text file
        The caller closes it.
    """
    return io.TextIOWrapper(path.open("rb"), encoding="utf-8", newline="")


def folder_name(path: AnyPath) -> str:
    """Return the name of a folder, for ``.`` and ``..`` too.

    Parameters
    ----------
    path : Path or ObjectPath
        The folder.

    Returns
    -------
    str
        Its last part.
    """
    return path.name if isinstance(path, ObjectPath) else path.name or path.resolve().name


def in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Apply a function that waits for a store to many items.

    Parameters
    ----------
    function : callable
        Takes an item; `THREADS` calls run at a time.
    items : iterable
        Any number; they are taken as results are used.

    Yields
    ------
    object
        Results in the order of the items.
    """
    waiting: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(THREADS, "requests") as pool:
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) >= THREADS:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


@contextmanager
def local_copy(path: AnyPath, etag: str | None = None) -> Iterator[Path]:
    """Provide a file on the local disk.

    Parameters
    ----------
    path : Path or ObjectPath
        A local file is used in place.
    etag : str, optional
        The ETag that an object must have.

    Yields
    ------
    Path
        The file itself, or a temporary copy of the object that is deleted afterwards.

    Raises
    ------
    FileNotFoundError
        If there is no such object.
    OSError
        If the local disk is full or fails.
    MachineError
        If the store does not answer.
    """
    if isinstance(path, Path):
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="unprocess_gen-") as folder:
        file = Path(folder) / path.name
        reader = _RangeReader(path, etag, first_piece=MAX_PIECE)
        with file.open("wb") as stream:
            while piece := reader.read(MAX_PIECE):
                stream.write(piece)
        yield file


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
            offset += self._known_size()
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

    def readall(self) -> bytes:
        pieces = []
        while piece := self._at_position(MIN_PIECE):
            pieces.append(piece)
            self._position += len(piece)
        return b"".join(pieces)

    def _at_position(self, wanted: int) -> memoryview:
        """Return bytes from the position on, fetched if necessary; none only at the end of the object."""
        end = self._start + len(self._piece)
        if not self._start <= self._position < end:
            sequential = self._position == end and end > 0
            self._piece_size = min(2 * self._piece_size, MAX_PIECE) if sequential else self._first_piece
            size = max(self._piece_size, min(wanted, MAX_PIECE))
            self._piece, self._start = self._fetch(self._position, size), self._position
        return self._piece[self._position - self._start :]

    def _known_size(self) -> int:
        if self._size < 0:
            self._size = self._path.stat().st_size
        return self._size

    def _fetch(self, start: int, size: int) -> memoryview:
        if 0 <= self._size <= start:
            return memoryview(b"")
        options = {"range": (start, start + size), **({"if_match": self._etag} if self._etag else {})}
        try:
            with _request(self._path) as (obstore, store):
                found = obstore.get(store, self._path.key, options=options)
                content = memoryview(found.bytes())
        except _EndOfObjectError:
            return memoryview(b"")
        self._size, self._etag = found.meta["size"], self._etag or found.meta["e_tag"]
        return content


# ------------------------------------------------------------------------------------------------ obstore's own terms


class _EndOfObjectError(Exception):
    """A range begins behind the last byte."""


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
    """Provide obstore and the client of a bucket; turn the exceptions of the body into those of this module."""
    try:
        import obstore
        from obstore import exceptions
    except ImportError:
        raise ConfigError(
            f"{path}: object stores need obstore; in the source folder, run: pip install '.[remote]', or give a "
            "local path"
        ) from None
    _check_process(path)
    try:
        yield obstore, _store(path.scheme, path.bucket)
    except FileNotFoundError as error:
        reason = _reason(error)
        if _is_missing_bucket(reason):
            raise _no_bucket(path, reason) from None
        raise FileNotFoundError(2, "no such object", str(path)) from None
    except exceptions.AlreadyExistsError:
        raise FileExistsError(17, "the object exists", str(path)) from None
    except exceptions.PreconditionError:
        raise ObjectChangedError(f"{path}: has another ETag than when it was listed") from None
    except (exceptions.PermissionDeniedError, exceptions.UnauthenticatedError) as error:
        raise _no_access(path, _reason(error)) from None
    except (exceptions.BaseError, OSError, ValueError) as error:
        reason = _reason(error)
        if reason.startswith("416"):
            raise _EndOfObjectError from None
        if _is_missing_bucket(reason):
            raise _no_bucket(path, reason) from None
        if reason.startswith(("401", "403")):  # from a service of credentials
            raise _no_access(path, reason) from None
        raise MachineError(f"{path}: the object store failed ({reason}); rerun when it answers") from None


def _no_access(path: ObjectPath, reason: str) -> StoreAccessError:
    return StoreAccessError(
        f"{path}: access was refused ({reason}); expected credentials in the environment, such as "
        f"{SCHEMES[path.scheme]}"
    )


def _is_missing_bucket(reason: str) -> bool:
    return any(code in reason for code in MISSING_BUCKET)


def _no_bucket(path: ObjectPath, reason: str) -> StoreAccessError:
    return StoreAccessError(
        f"{path}: the bucket {path.bucket} does not exist ({reason}); create it, or correct its name"
    )


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
