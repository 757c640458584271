"""An S3 server (moto) in a process of its own, and a proxy in front of it that delays, breaks and counts requests."""

from __future__ import annotations

import http.client
import socket
import subprocess
import sys
import threading
import time
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from helpers.processes import ended_with_tests, free_port
from unprocess_gen.core import object_store
from unprocess_gen.core.object_store import ObjectPath

START_S = 60

VARIABLES = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_REGION": "us-east-1"}

INJECTED = b"<Error><Code>Injected</Code><Message>by the test</Message></Error>"

Answer = Callable[[str, str], int]
"""Return the status to answer a request (method, path) with instead of the server, or 0 to pass it on."""


@contextmanager
def moto_server(log: Path) -> Iterator[str]:
    """Start an S3 server; yield its endpoint."""
    port = free_port()
    endpoint = f"http://127.0.0.1:{port}"
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    with (
        log.open("w") as stream,
        subprocess.Popen(command, stdout=stream, stderr=stream, start_new_session=True) as process,
        ended_with_tests(process),
    ):
        try:
            _wait_for(process, port)
            yield endpoint
        finally:
            process.terminate()


def _wait_for(process: subprocess.Popen[bytes], port: int) -> None:
    end = time.monotonic() + START_S
    while time.monotonic() < end:
        assert process.poll() is None, "the S3 server ended"
        with socket.socket() as client:
            if client.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.05)
    raise AssertionError("the S3 server did not start")


def create_bucket(endpoint: str, name: str) -> ObjectPath:
    """Create an empty bucket and return its URL."""
    request = urllib.request.Request(f"{endpoint}/{name}", method="PUT")
    with urllib.request.urlopen(request) as answer:
        assert answer.status == 200
    return ObjectPath(f"s3://{name}")


def variables(endpoint: str) -> dict[str, str]:
    """Return the environment variables by which obstore finds the server."""
    return {**VARIABLES, "AWS_ENDPOINT_URL": endpoint}


def use(monkeypatch: pytest.MonkeyPatch, endpoint: str) -> None:
    """Let this process and those that it starts use a server."""
    for name, value in variables(endpoint).items():
        monkeypatch.setenv(name, value)
    object_store._store.cache_clear()


def upload(folder: Path, to: ObjectPath) -> None:
    """Copy the files of a folder to keys below a URL."""
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            (to / path.relative_to(folder).as_posix()).write_bytes(path.read_bytes())


@dataclass
class Proxy:
    """Forward requests to a server, delayed and counted; ``answer`` may reply in its place."""

    endpoint: str
    target: str
    answer: Answer = lambda method, path: 0
    delay_s: float = 0.0
    requests: list[tuple[str, str]] = field(default_factory=list)
    most_at_once: int = 0
    _active: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def count(self, method: str) -> int:
        """Return the number of requests with a method."""
        return sum(used == method for used, _ in self.requests)


@contextmanager
def proxy(target: str) -> Iterator[Proxy]:
    """Start a proxy in front of a server."""
    state = Proxy("", target)

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        wbufsize = -1
        disable_nagle_algorithm = True

        def forward(self) -> None:
            content = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            path = urllib.parse.unquote(self.path)
            with state._lock:
                state.requests.append((self.command, path))
                status = state.answer(self.command, path)
                state._active += 1
                state.most_at_once = max(state.most_at_once, state._active)
            try:
                time.sleep(state.delay_s)
                reply = (status, [], INJECTED) if status else self.passed_on(content)
            finally:
                with state._lock:  # before the reply, after which the client can send its next request
                    state._active -= 1
            self.reply(*reply)

        def passed_on(self, content: bytes) -> tuple[int, list[tuple[str, str]], bytes]:
            server = http.client.HTTPConnection(urllib.parse.urlsplit(state.target).netloc)
            try:
                server.request(self.command, self.path, content, dict(self.headers))
                answer = server.getresponse()
                return answer.status, answer.getheaders(), answer.read()
            finally:
                server.close()

        def reply(self, status: int, headers: list[tuple[str, str]], content: bytes) -> None:
            self.send_response_only(status)
            for name, value in headers:
                if name.lower() not in ("content-length", "connection", "transfer-encoding"):
                    self.send_header(name, value)
            size = dict(headers).get("Content-Length") if self.command == "HEAD" else None
            self.send_header("Content-Length", size or str(len(content)))
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(content)
            self.wfile.flush()

        do_GET = do_PUT = do_HEAD = do_POST = do_DELETE = forward  # noqa: N815

        def log_message(self, *arguments: object) -> None:
            pass

    class Server(ThreadingHTTPServer):
        daemon_threads = True

        def handle_error(self, request: object, client_address: object) -> None:
            pass  # clients that were killed in the middle of an answer

    server = Server(("127.0.0.1", 0), Handler)
    state.endpoint = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        yield state
    finally:
        server.shutdown()
        server.server_close()


@dataclass(frozen=True)
class Request:
    """Hold a request that a server got; names of headers are in lower case."""

    method: str
    path: str
    headers: dict[str, str]


@contextmanager
def one_object_server(content: bytes) -> Iterator[tuple[str, list[Request]]]:
    """Start a server that answers every request as if for one object; yield its endpoint and the requests so far."""
    requests: list[Request] = []

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def answer(self) -> None:
            self.rfile.read(int(self.headers.get("Content-Length") or 0))
            headers = {name.lower(): value for name, value in self.headers.items()}
            requests.append(Request(self.command, urllib.parse.unquote(self.path), headers))
            body = content if self.command == "GET" else b""
            self.send_response_only({"GET": 206, "PUT": 201}[self.command])
            for name, value in {
                "Content-Length": str(len(body)),
                "Content-Range": f"bytes 0-{len(content) - 1}/{len(content)}",
                "ETag": '"listed"',
                "Last-Modified": "Mon, 23 Nov 2026 00:00:00 GMT",
            }.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

        do_GET = do_PUT = answer  # noqa: N815

        def log_message(self, *arguments: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", requests
    finally:
        server.shutdown()
        server.server_close()


def put(endpoint: str, path: ObjectPath, content: bytes) -> None:
    """Write an object past the proxy that this process uses."""
    from obstore.store import S3Store

    store = S3Store(path.bucket, endpoint=endpoint, client_options={"allow_http": True})
    store.put(path.key, content)
