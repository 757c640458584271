"""Show how far a run is: a bar on a terminal, a line every few seconds elsewhere; both on stderr.

Messages go to the logger ``unprocess_gen``: progress and notes at level INFO, warnings at level WARNING. Progress is
shown only if the logger is enabled for INFO, as the command line enables it unless ``--quiet`` is given.
"""

from __future__ import annotations

import logging
import shutil
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from tqdm import tqdm

LOGGER = logging.getLogger("unprocess_gen")
LINE_S = 5.0
"""Seconds between progress lines if stderr is not a terminal."""
COMPILING = "compiling kernels, once per machine and version"
COMPILING_POLL_S = 0.1
COLUMNS = 80
"""Width of the bar on a terminal that reports none."""


class Progress:
    """Count finished items of a run and report them on stderr.

    Parameters
    ----------
    total, done : int
        Number of items, and how many an earlier run finished.
    label : str
        Name of the job and its place in a sweep, such as ``3/20 camera=sony_a7r``; empty for a single run.
    unit : str
        Name of one item, singular.
    """

    def __init__(self, total: int, done: int = 0, label: str = "", unit: str = "image") -> None:
        self._total, self._done, self._first, self._failed = total, done, done, 0
        self._prefix, self._unit = f"{label}: " if label else "", unit
        self._started = self._last_line = time.monotonic()
        enabled = LOGGER.isEnabledFor(logging.INFO)
        terminal = enabled and sys.stderr is not None and sys.stderr.isatty()
        self._lines = enabled and not terminal
        self._bar = tqdm(
            total=total,
            initial=done,
            desc=label or None,
            unit=unit,
            file=_Unfailing(),
            disable=not terminal,
            ncols=shutil.get_terminal_size((COLUMNS, 24)).columns or COLUMNS,
        )
        self._over = threading.Event()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._over.set()
        self._bar.close()

    def advance(self, items: int = 1, failed: int = 0) -> None:
        """Count finished items, of which ``failed`` failed."""
        self._failed += failed
        self._done += items
        self._bar.set_postfix(failed=self._failed, refresh=False)
        self._bar.update(items)
        now = time.monotonic()
        if self._lines and (now - self._last_line >= LINE_S or self._done == self._total):
            self._last_line = now
            rate = (self._done - self._first) / max(now - self._started, 1e-9)
            left = (self._total - self._done) / rate
            LOGGER.info(
                "%s%d/%d %ss, %.1f %ss/s, %d failed, %.0f s left",
                *(self._prefix, self._done, self._total, self._unit, rate, self._unit, self._failed, left),
            )

    def warn(self, message: str) -> None:
        """Log a warning; a bar is cleared first and redrawn below it."""
        self._bar.clear()
        LOGGER.warning("%s%s", self._prefix, message)
        self._bar.refresh()

    def report_compiling(self) -> None:
        """Report that kernels are being compiled, which takes seconds in which no item is finished."""
        self._bar.set_postfix_str(COMPILING)
        if self._lines:
            LOGGER.info("%s%d/%d %ss, %s", self._prefix, self._done, self._total, self._unit, COMPILING)

    def watch_compiling(self, marker: Path) -> None:
        """Report that kernels are being compiled as soon as the file ``marker`` exists.

        Only workers know whether the kernels they need are compiled, so they report it by creating the file.
        """
        threading.Thread(target=self._watch, args=(marker,), daemon=True).start()

    def _watch(self, marker: Path) -> None:
        while not marker.exists():
            if self._over.wait(COMPILING_POLL_S):
                return
        self.report_compiling()


class _Unfailing:
    """Write to stderr and ignore its errors, so that a terminal that was closed does not end the run."""

    encoding = getattr(sys.stderr, "encoding", None) or "ascii"

    def write(self, text: str) -> None:
        """Write text if stderr still accepts it."""
        with suppress(OSError, ValueError):
            sys.stderr.write(text)

    def flush(self) -> None:
        """Flush stderr if it still accepts text."""
        with suppress(OSError, ValueError):
            sys.stderr.flush()
