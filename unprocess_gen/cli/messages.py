"""Send the messages of the logger ``unprocess_gen`` to stderr, as ``gen-dataset: MESSAGE``."""

from __future__ import annotations

import logging
import sys
from contextlib import suppress


class StderrHandler(logging.Handler):
    """Write each message as one line to the current ``sys.stderr``; a stderr that fails is ignored."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write one message."""
        with suppress(OSError, ValueError, AttributeError):
            print(f"gen-dataset: {record.getMessage()}", file=sys.stderr, flush=True)


def log_to_stderr(level: int = logging.INFO) -> None:
    """Send messages of at least ``level`` to stderr; a handler of an earlier call is replaced."""
    logger = logging.getLogger("unprocess_gen")
    for handler in logger.handlers[:]:
        if isinstance(handler, StderrHandler):
            logger.removeHandler(handler)
    logger.addHandler(StderrHandler())
    logger.setLevel(level)
    logger.propagate = False
