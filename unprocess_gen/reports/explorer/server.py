"""Serve the page on this machine."""

from __future__ import annotations

import logging
import socket
import threading
import webbrowser
from collections.abc import Callable

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.reports.explorer.exploration import Choices, Exploration

HOST = "127.0.0.1"


def serve(start: Exploration, choices: Choices, port: int, shows: bool, started: Callable[[str], None]) -> None:
    """Serve a page to browsers of this machine until a signal arrives; ``started`` receives its address.

    The server has a thread of its own, because an event loop drops exceptions that a signal raises in its callbacks.
    """
    from bokeh.server.server import Server
    from tornado.web import ErrorHandler

    from unprocess_gen.reports.explorer.page import Page

    try:
        with socket.create_server((HOST, port)) as probe:
            port = probe.getsockname()[1]
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        problem = f"cannot be used ({reason}); expected a free port; choose another, or leave --port out"
        raise ConfigError(f"--port {port}: {problem}") from None
    logging.getLogger("bokeh.server.views.ws").setLevel(logging.ERROR)  # it warns of pages closed while they compute
    server = Server({"/": lambda document: Page(start, choices, document).fill()}, port=port, address=HOST)
    # any port, for tunnels, but no other name that leads to this machine; the argument of Server takes no such pattern
    server._tornado.websocket_origins.update(f"{name}:*" for name in (HOST, "localhost"))
    # Tornado asks for no origin that equals the host of the request, which may be any name that leads to this machine
    server._tornado.add_handlers(r"(?!(?:127\.0\.0\.1|localhost)$).*", [(".*", ErrorHandler, {"status_code": 403})])
    server.start()
    thread = threading.Thread(target=server.io_loop.start, daemon=True)
    thread.start()
    address = f"http://{HOST}:{port}/"
    started(address)
    if shows:
        webbrowser.open(address)
    thread.join()
