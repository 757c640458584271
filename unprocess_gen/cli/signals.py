"""Turn the signals that end a command into exceptions, and remember that one arrived.

Design: ``docs/design/command_line.md``.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from types import FrameType

ENDING_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""SIGINT, SIGTERM and, except on Windows, SIGHUP."""


class TerminationSignal(BaseException):
    """SIGTERM or SIGHUP arrived; ``number`` is the signal's."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


class Signals:
    """Turn signals into exceptions while it is entered: SIGINT, SIGTERM and SIGHUP, unless the caller ignores them.

    Python drops exceptions that are raised while LLVM calls back into Python. Without `_repeat`, 3 of 47 SIGTERM at
    random times of a first run with ``n_jobs=1`` were lost, or ended with a traceback. ``received`` is the last signal.
    """

    REPEAT_S = 0.05
    """Delay before a dropped signal is sent again; LLVM's callbacks take far less."""

    def __init__(self) -> None:
        self.received: int | None = None
        self._caught: list[int] = []
        self._timer: threading.Timer | None = None
        self._hook = sys.unraisablehook

    def __enter__(self) -> None:
        self.received = None
        self._hook, sys.unraisablehook = sys.unraisablehook, self._repeat
        self._caught = [number for number in ENDING_SIGNALS if signal.getsignal(number) != signal.SIG_IGN]  # nohup
        for number in self._caught:
            signal.signal(number, self._handle)

    def __exit__(self, *_: object) -> None:
        for number in self._caught:
            signal.signal(number, signal.SIG_DFL)  # a late signal ends the process without a traceback
        sys.unraisablehook = self._hook
        if self._timer is not None:
            self._timer.cancel()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.received = number
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        raise TerminationSignal(number)

    def _repeat(self, unraisable: sys.UnraisableHookArgs) -> None:
        """Send a signal again if the exception of its handler was dropped; pass anything else on."""
        if not isinstance(unraisable.exc_value, KeyboardInterrupt | TerminationSignal):
            sys.__unraisablehook__(unraisable)
        elif self.received is not None:
            if self._timer is not None:
                self._timer.cancel()
            self._timer = threading.Timer(self.REPEAT_S, _send, (self.received,))
            self._timer.daemon = True
            self._timer.start()


def _send(number: int) -> None:
    """Send a signal to this process."""
    if sys.platform == "win32":
        signal.raise_signal(number)  # os.kill ends the process there
    else:
        os.kill(os.getpid(), number)  # interrupts the main thread's system call, unlike raise_signal


SIGNALS = Signals()
"""The signals of this process; `unprocess_gen.cli.main.main` enters it."""
