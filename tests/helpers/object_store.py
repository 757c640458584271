"""An S3 server (moto), a proxy in front of it that delays, refuses and counts requests, and a server of one object."""

from __future__ import annotations

import functools
import json
import logging
import threading
import time
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from unprocess_gen.core import object_store
from unprocess_gen.core.object_store import ObjectPath

VARIABLES = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_REGION": "us-east-1"}

INJECTED = b"<Error><Code>Injected</Code><Message>by the test</Message></Error>"

Application = Callable[[dict[str, Any], Any], Iterable[bytes]]
"""A WSGI application."""

Answer = Callable[[str, str], int]
"""Return the status to answer a request (method, path) with instead of the server, or 0 to pass it on."""


@contextmanager
def serving(application: Application) -> Iterator[str]:
    """Serve an application from threads of this process; yield its endpoint."""
    from werkzeug.serving import make_server  # of the extra test, like moto

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = make_server("127.0.0.1", 0, application, threaded=True)
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()


@functools.cache
def s3_application() -> Application:
    """Return an S3 server whose objects are in memory."""
    from moto.server import DomainDispatcherApplication, create_backend_app

    return DomainDispatcherApplication(create_backend_app)


def create_bucket(endpoint: str, name: str) -> ObjectPath:
    """Create an empty bucket and return its URL."""
    with urllib.request.urlopen(urllib.request.Request(f"{endpoint}/{name}", method="PUT")) as answer:
        assert answer.status == 200
    return ObjectPath(f"s3://{name}")


def use(monkeypatch: pytest.MonkeyPatch, endpoint: str) -> None:
    """Let this process and those that it starts use a server."""
    for name, value in {**VARIABLES, "AWS_ENDPOINT_URL": endpoint}.items():
        monkeypatch.setenv(name, value)
    object_store._store.cache_clear()


def upload(folder: Path, to: ObjectPath) -> None:
    """Copy the files of a folder to keys below a URL."""
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            (to / path.relative_to(folder).as_posix()).write_bytes(path.read_bytes())


def assert_same(remote: ObjectPath, local: Path) -> None:
    """Check that a URL has exactly the objects of a local dataset, with the same bytes; apart from run facts."""
    names = {path.relative_to(local).as_posix() for path in local.rglob("*") if path.is_file()}
    assert {entry.path for entry in remote.walk_entries()} == names
    for name in names - {"dataset.json"}:
        assert (remote / name).read_bytes() == (local / name).read_bytes(), name
    facts, others = (json.loads((folder / "dataset.json").read_bytes()) for folder in (remote, local))
    for key in ("fingerprint", "shards", "pairs", "failed", "sites"):
        assert facts[key] == others[key]


def put(endpoint: str, path: ObjectPath, content: bytes) -> None:
    """Write an object past the proxy that this process uses."""
    from obstore.store import S3Store

    S3Store(path.bucket, endpoint=endpoint, client_options={"allow_http": True}).put(path.key, content)


def reply(environ: dict[str, Any], start_response: Any, status: int, body: bytes, **headers: str) -> Iterable[bytes]:
    """Read the request completely, and answer it."""
    environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
    names = {"Content-Length": str(len(body)), **{name.replace("_", "-"): text for name, text in headers.items()}}
    start_response(f"{status} by the test", list(names.items()))
    return [b"" if environ["REQUEST_METHOD"] == "HEAD" else body]


def line_of(environ: dict[str, Any]) -> tuple[str, str]:
    """Return the method of a request and its path, with the query."""
    return environ["REQUEST_METHOD"], urllib.parse.unquote(environ["RAW_URI"])


@dataclass
class Proxy:
    """An application in front of another, which delays and counts requests; ``answer`` may reply in its place."""

    application: Application
    target: str
    endpoint: str = ""
    answer: Answer = lambda method, path: 0
    delay_s: float = 0.0
    requests: list[tuple[str, str]] = field(default_factory=list)
    most_at_once: int = 0
    _active: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def __call__(self, environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        request = line_of(environ)
        with self._lock:
            self.requests.append(request)
            status = self.answer(*request)
            self._active += 1
            self.most_at_once = max(self.most_at_once, self._active)
        try:
            time.sleep(self.delay_s)
            if status:
                return reply(environ, start_response, status, INJECTED)
            return list(self.application(environ, start_response))
        finally:
            with self._lock:  # before the reply, after which the client can send its next request
                self._active -= 1

    def count(self, method: str) -> int:
        """Return the number of requests with a method."""
        return sum(used == method for used, _ in self.requests)


@contextmanager
def one_object_server(content: bytes) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Serve one object at every path; yield the endpoint and the WSGI environments of the requests so far."""
    requests: list[dict[str, Any]] = []
    facts = {"ETag": '"listed"', "Last_Modified": "Mon, 23 Nov 2026 00:00:00 GMT"}
    facts["Content_Range"] = f"bytes 0-{len(content) - 1}/{len(content)}"

    def answer(environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        requests.append(environ)
        is_read = environ["REQUEST_METHOD"] == "GET"
        return reply(environ, start_response, 206 if is_read else 201, content if is_read else b"", **facts)

    with serving(answer) as endpoint:
        yield endpoint, requests
