"""Capture what image codecs write to standard error.

libjpeg and libtiff fill in missing or broken data, return a picture, and report the damage on standard error only. The
promise that no damaged picture is decoded depends on these messages. Codecs write to file descriptor 2 directly.
So this module redirects the descriptor of the process to a temporary file during a decode, under a lock. What this
program prints waits for the lock, because it would be taken for a message of a codec. A decode takes 30 µs longer.
"""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager

REDIRECTED = threading.RLock()
"""Held while standard error is redirected; threads that print to it hold it too."""


@contextmanager
def captured() -> Iterator[bytearray]:
    """Redirect file descriptor 2 of the process; what codecs wrote is in the yielded array afterwards."""
    messages = bytearray()
    with REDIRECTED, tempfile.TemporaryFile(buffering=0) as spool:
        stderr = os.dup(2)
        os.dup2(spool.fileno(), 2)
        try:
            yield messages
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            spool.seek(0)
            messages += spool.read()
