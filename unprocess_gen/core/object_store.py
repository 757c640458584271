"""Read and write objects of S3, Google Cloud Storage and Azure; the only module that imports obstore.

An `ObjectPath` has the methods of `pathlib.Path` that readers of datasets call, so that the same code reads a local
folder and a URL. A missing object raises FileNotFoundError, like a missing file. Every other failure raises an error of
`core.errors` with one sentence that names the URL.

obstore reads credentials and endpoints from the environment (``AWS_ACCESS_KEY_ID``, ``AWS_ENDPOINT_URL``,
``GOOGLE_SERVICE_ACCOUNT``, ``AZURE_STORAGE_ACCOUNT_NAME``, …), and repeats requests that fail. Design:
``docs/design/object_stores.md``.
"""

from __future__ import annotations

import io
import os
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from unprocess_gen.core.entries import Entry, EntryKind, Item, Result, hidden_part, started_ahead
from unprocess_gen.core.errors import ConfigError, MachineError
from unprocess_gen.core.libraries import require

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

SCHEMES = {"s3": "AWS_ACCESS_KEY_ID", "gs": "GOOGLE_SERVICE_ACCOUNT", "az": "AZURE_STORAGE_ACCOUNT_NAME"}
"""Schemes of URLs, and the environment variable that a user most likely has to set for each."""

MISSING_BUCKET = ("NoSuchBucket", "ContainerNotFound")
"""Codes by which S3 and Google, and Azure, report that a bucket does not exist."""

REQUEST_TIMEOUT_S = 300
"""Longest time for one request, which may read a complete shard."""

MAX_RETRIES, RETRY_TIMEOUT_S = 8, 90
"""Repetitions of a request, and the time from its first attempt after which it is not repeated."""

BUFFER = 2**18
"""Bytes of one request of a file that is read in pieces."""

PIECE = 2**23
"""Bytes of an upload's request; obstore sends four at a time."""

TEMPORARY_PREFIX = "unprocess_gen-"
"""Beginning of the names of temporary folders, by which a later run on this host finds those that a kill left."""

THREADS = 32
"""Requests at a time of `ObjectPath.map`."""

_URL = re.compile(rf"({'|'.join(SCHEMES)})://([^/]*)/*(.*?)/*", re.DOTALL)
_started_by: set[int] = set()


class ObjectChangedError(MachineError):
    """Report that an object is not the one that was listed: its ETag differs."""


class StoreAccessError(MachineError):
    """Report that a store refuses access, or that a bucket does not exist."""


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
        """Last part of the key, or the bucket's name without a key."""
        return (self.key or self.bucket).rpartition("/")[2]

    @property
    def parent(self) -> ObjectPath:
        """URL without its last part."""
        return ObjectPath(f"{self.scheme}://{self.bucket}/{self.key.rpartition('/')[0]}")

    @property
    def parents(self) -> tuple[ObjectPath, ...]:
        """URLs of the prefixes above this one, the nearest first."""
        return (self.parent, *self.parent.parents) if self.key else ()

    def resolve(self) -> ObjectPath:
        """URL itself; object stores have no links."""
        return self

    # -------------------------------------------------------------------------------------------------- as a folder

    def walk_entries(self, recursive: bool = True, enters_hidden: bool = True) -> Iterator[Entry]:
        """Yield the objects below this prefix in the order of the store, without holding the listing in memory.

        A hidden prefix is yielded instead of its objects, on request.
        """
        prefix = f"{self.key}/" if self.key else ""
        hidden = ""
        with _request(self) as (obstore, store):
            if recursive:
                chunks = obstore.list(store, self.key or None, chunk_size=1000)
            else:
                chunks = iter([obstore.list_with_delimiter(store, self.key or None)["objects"]])
            for chunk in chunks:
                for facts in chunk:
                    path = facts["path"].removeprefix(prefix)
                    if facts["path"] == self.key:
                        continue
                    if enters_hidden or not (part := hidden_part(path)):
                        yield Entry(path, facts["size"], etag=facts["e_tag"])
                    elif part != hidden:
                        yield Entry(hidden := part, None, EntryKind.HIDDEN)

    def entries(self) -> dict[str, int]:
        """Names one level below this prefix: sizes in bytes of objects, -1 for prefixes."""
        with _request(self) as (obstore, store):
            listed = obstore.list_with_delimiter(store, self.key or None)
        sizes = {facts["path"]: facts["size"] for facts in listed["objects"] if facts["path"] != self.key}
        sizes |= dict.fromkeys(listed["common_prefixes"], -1)
        return {name.rstrip("/").rpartition("/")[2]: size for name, size in sizes.items()}

    def mkdir(self, mode: int = 0, parents: bool = False, exist_ok: bool = True) -> None:
        """Check that the bucket exists; a prefix needs no creation."""
        self.is_dir()

    def is_dir(self) -> bool:
        """True if any object is below this prefix."""
        return next(self.walk_entries(), None) is not None

    def is_file(self) -> bool:
        """True if an object has this key."""
        return self.size() is not None

    def exists(self) -> bool:
        """True if an object has this key or is below it."""
        return self.is_file() or self.is_dir()

    is_listed = exists

    def entry(self) -> Entry:
        """Describe this prefix or object; raise FileNotFoundError if there is none."""
        return Entry(self.name, None, EntryKind.FOLDER) if self.is_dir() else self._object()

    def size(self) -> int | None:
        """Size of the object in bytes, None if there is no such object."""
        with suppress(FileNotFoundError):
            return self._object().size
        return None

    def _object(self) -> Entry:
        """Describe the object; FileNotFoundError if there is none."""
        if not self.key:
            raise FileNotFoundError(2, "no such object", str(self))
        with _request(self) as (obstore, store):
            facts = obstore.head(store, self.key)
        return Entry(self.name, facts["size"], etag=facts["e_tag"])

    # ------------------------------------------------------------------------------------------------------ reading

    def open(self, mode: str = "rb") -> io.BufferedReader:
        """Open the object as a seekable binary file for reading."""
        return io.BufferedReader(_Reader(self), BUFFER)

    @contextmanager
    def open_listed(self, size: int, etag: str | None = None, start: int = 0) -> Iterator[tuple[BinaryIO, int]]:
        """Read an object of a listing from a byte on; yield the bytes as a file and the listed size.

        Raises ObjectChangedError unless the object has the listed ETag, if that is given.
        """
        options = {"if_match": etag} if etag else {}
        with _request(self) as (obstore, store):
            answer = obstore.get(store, self.key, options=options | ({"range": (start, size)} if start else {}))
            content = bytes(answer.bytes())
        yield io.BytesIO(content), size

    def read_bytes(self) -> bytes:
        """Content of the object; raises FileNotFoundError or MachineError."""
        with self.open_listed(0) as (file, _):
            return file.read()

    def read_text(self, encoding: str = "utf-8") -> str:
        """Content of the object as text."""
        return self.read_bytes().decode(encoding)

    def mapped(self, offset: int, size: int) -> tuple[bytearray, int]:
        """Read a part of the object with one request, as bytes that can be written to; see `LocalPath.mapped`."""
        with _request(self) as (obstore, store):
            content = bytearray(obstore.get_range(store, self.key, start=offset, length=size))
        if len(content) < size:
            raise ValueError("the object ends before")
        return content, 0

    @contextmanager
    def local_copy(self) -> Iterator[Path]:
        """Provide a temporary copy of the object on the local disk."""
        with tempfile.TemporaryDirectory(prefix=TEMPORARY_PREFIX) as folder:
            file = Path(folder) / self.name
            with _request(self) as (obstore, store), file.open("wb") as copy:
                for chunk in obstore.get(store, self.key).stream():
                    copy.write(chunk)
            yield file

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Apply a function that waits for the store to items, `THREADS` at a time; yield the results in order."""
        with ThreadPoolExecutor(THREADS, "requests") as pool:
            for future in started_ahead(pool, function, items, THREADS):
                yield future.result()

    # ------------------------------------------------------------------------------------------------------ writing

    def write_bytes(self, content: bytes, unfinished: str = "") -> None:
        """Write the object; readers see the former object or the new one, never a part."""
        self._put(content, "overwrite")

    write = write_bytes

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
            obstore.put(store, self.key, content, mode=mode, chunk_size=PIECE, max_concurrency=4)

    def delete(self) -> None:
        """Delete the object; an object that does not exist is no error."""
        with suppress(FileNotFoundError), _request(self) as (obstore, store):
            obstore.delete(store, self.key)

    def delete_all(self) -> None:
        """Delete the object, and all objects below this prefix."""
        prefix = f"{self.key}/" if self.key else ""
        if keys := [prefix + entry.path for entry in self.walk_entries()]:
            with suppress(FileNotFoundError), _request(self) as (obstore, store):
                obstore.delete(store, keys)
        self.delete()

    def scratch_place(self, unfinished: str) -> tuple[Path, str]:
        """Local folder for unfinished files, ``TMPDIR``, and the first letters of the names of its folders."""
        return Path(tempfile.gettempdir()), TEMPORARY_PREFIX


class _Reader(io.RawIOBase):
    """Adapt obstore's reader to a file of the standard library."""

    def __init__(self, path: ObjectPath) -> None:
        super().__init__()
        self._path = path
        with _request(path) as (obstore, store):
            self._file = obstore.open_reader(store, path.key, buffer_size=BUFFER)

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return int(self._file.seek(offset, whence))

    def readinto(self, buffer: WriteableBuffer) -> int:
        view = memoryview(buffer).cast("B")
        with _request(self._path):
            content = self._file.read(len(view))
        view[: len(content)] = content
        return len(content)


@lru_cache(maxsize=64)
def _store(scheme: str, bucket: str) -> Any:
    """Client of obstore for a bucket."""
    from obstore.store import from_url

    return from_url(
        f"{scheme}://{bucket}",
        # an endpoint of http:// is used as given: obstore would otherwise need AWS_ALLOW_HTTP=true as well
        client_options={"allow_http": True, "timeout": timedelta(seconds=REQUEST_TIMEOUT_S)},
        retry_config={"max_retries": MAX_RETRIES, "retry_timeout": timedelta(seconds=RETRY_TIMEOUT_S)},
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
    """Turn an error of obstore into one of this module's."""
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
    return MachineError(f"{path}: the object store failed ({reason}); rerun when it answers")


def _reason(error: Exception) -> str:
    """Short form of an error of obstore, whose message has some forty lines."""
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
