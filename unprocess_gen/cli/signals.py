"""Turn the signals that end a command into KeyboardInterrupt, and remember which one arrived.

Design: ``docs/design/command_line.md``.
"""

from __future__ import annotations

import os
import signal
import sys
import threading

ENDING_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""SIGINT, SIGTERM and, except on Windows, SIGHUP."""

REPEAT_S = 0.05
"""Delay before a dropped signal is sent again; LLVM's callbacks take far less."""


class Signals:
    """Raise KeyboardInterrupt for SIGINT, SIGTERM and SIGHUP while it is entered, unless the caller ignores them.

    Python drops exceptions that are raised while LLVM calls back into Python. Without `_repeat`, 3 of 47 SIGTERM at
    random times of a first run with ``n_jobs=1`` were lost, or ended with a traceback. ``received`` is the last signal.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._caught: list[int] = []
        self._timer = threading.Timer(0, lambda: None)

    def __enter__(self) -> None:
        self.received = None
        sys.unraisablehook = self._repeat
        self._caught = [number for number in ENDING_SIGNALS if signal.getsignal(number) != signal.SIG_IGN]  # nohup
        for number in self._caught:
            signal.signal(number, self._handle)

    def __exit__(self, *_: object) -> None:
        for number in self._caught:
            signal.signal(number, signal.SIG_DFL)  # a late signal ends the process without a traceback
        sys.unraisablehook = sys.__unraisablehook__
        self._timer.cancel()

    def _handle(self, number: int, _: object) -> None:
        self.received = number
        raise KeyboardInterrupt

    def _repeat(self, unraisable: sys.UnraisableHookArgs) -> None:
        """Send a signal again if the exception of its handler was dropped; pass anything else on."""
        if self.received is None or not isinstance(unraisable.exc_value, KeyboardInterrupt):
            sys.__unraisablehook__(unraisable)
            return
        self._timer.cancel()
        self._timer = threading.Timer(REPEAT_S, os.kill, (os.getpid(), self.received))  # interrupts system calls
        self._timer.start()


SIGNALS = Signals()
"""The signals of this process; `unprocess_gen.cli.main.main` enters it."""
