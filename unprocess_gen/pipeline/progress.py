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
from collections.abc import Iterable
from contextlib import suppress
from typing import TYPE_CHECKING, TypeVar

from tqdm import tqdm

from unprocess_gen.sources.image.codec_messages import REDIRECTED

if TYPE_CHECKING:
    from unprocess_gen.pipeline.tasks import RunContext

Item = TypeVar("Item")

LOGGER = logging.getLogger("unprocess_gen")
LINE_S = 5.0
"""Seconds between progress lines if stderr is not a terminal."""
COMPILING = "compiling kernels for this kind of noise and frames, once per environment"
POLL_S = 0.1
"""Time between two looks at the files by which workers report what they do."""
BAR_DELAY_S = 2.0
"""Time after which `with_bar` shows a bar."""
BAR_COLUMNS = 80
"""Width of the bar on a terminal that reports none."""


class Progress:
    """Count finished items of a run and report them on stderr.

    The time left follows from the rate since the first finished item, so that it leaves out compiling.

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
        self._total, self._done, self._shown, self._failed = total, done, done, 0
        self._prefix, self._unit = f"{label}: " if label else "", unit
        self._started = self._last_line = time.monotonic()
        self._first, self._has_begun = done, False
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
            ncols=shutil.get_terminal_size((BAR_COLUMNS, 24)).columns or BAR_COLUMNS,
        )
        self._over, self._lock = threading.Event(), threading.Lock()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *exception: object) -> None:
        self._over.set()
        self._bar.close()

    def advance(self, items: int = 1, failed: int = 0) -> None:
        """Count finished items, of which ``failed`` failed."""
        self._failed += failed
        self._done += items
        self._bar.set_postfix(failed=self._failed, refresh=False)
        self._show(self._done)

    def _show(self, done: int) -> None:
        """Show the number of finished items, unless more were shown before."""
        with self._lock:
            now = time.monotonic()
            if done < self._shown or (done == self._shown and done < self._total):
                return
            if not self._has_begun and done < self._total:  # compiling ends with the first item
                self._started, self._first = now, done
                self._bar.unpause()
            self._has_begun = True
            self._bar.update(done - self._shown)
            self._shown = done
            is_due = now - self._last_line >= LINE_S and done > self._first
            if self._lines and (is_due or done == self._total):
                self._last_line = now
                rate = (done - self._first) / max(now - self._started, 1e-9)
                left_s = (self._total - done) / rate if done < self._total else 0
                LOGGER.info(
                    "%s%d/%d %ss, %.1f %ss/s, %d failed, %.0f s left",
                    *(self._prefix, done, self._total, self._unit, rate, self._unit, self._failed, left_s),
                )

    def warn(self, message: str) -> None:
        """Log a warning; a bar is cleared first and redrawn below it."""
        self._bar.clear()
        LOGGER.warning("%s%s", self._prefix, message)
        self._bar.refresh()

    def watch(self, context: RunContext) -> None:
        """Report what worker processes do: compiling kernels, and images of shards that are not committed yet."""

        def look() -> None:
            is_compiling = False
            while not self._over.wait(POLL_S):
                if not is_compiling and context.compiling_path.exists():
                    is_compiling = True  # takes seconds in which no item is finished
                    self._bar.set_postfix_str(COMPILING)
                    if self._lines:
                        LOGGER.info("%s%d/%d %ss, %s", self._prefix, self._done, self._total, self._unit, COMPILING)
                self._show(min(self._done + context.images_in_progress(), self._total - 1))

        threading.Thread(target=look, daemon=True).start()


def with_bar(items: Iterable[Item], unit: str, total: int | None = None) -> Iterable[Item]:
    """Iterate over items, and show a bar on a terminal if it takes longer than `BAR_DELAY_S`."""
    is_shown = LOGGER.isEnabledFor(logging.INFO) and sys.stderr is not None and sys.stderr.isatty()
    return tqdm(items, total=total, unit=unit, file=_Unfailing(), leave=False, delay=BAR_DELAY_S, disable=not is_shown)


class _Unfailing:
    """Write to stderr and ignore its errors, so that a terminal that was closed does not end the run."""

    encoding = getattr(sys.stderr, "encoding", None) or "ascii"

    def write(self, text: str) -> None:
        """Write text if stderr still accepts it."""
        with REDIRECTED, suppress(OSError, ValueError):
            sys.stderr.write(text)

    def flush(self) -> None:
        """Flush stderr if it still accepts text."""
        with suppress(OSError, ValueError):
            sys.stderr.flush()
