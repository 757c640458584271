"""Write results to stdout, and messages to stderr, also those of the logger ``unprocess_gen``."""

from __future__ import annotations

import logging
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from unprocess_gen.core.errors import MachineError, UnprocessGenError

LOGGER = logging.getLogger("unprocess_gen")


def print_results(*texts: object) -> None:
    """Print lines on stdout and flush: an error of stdout is raised here, not by a later step."""
    if texts:
        print(*texts, sep="\n", flush=True)


def report_error(error: BaseException, job: str = "") -> int:
    """Report an error on stderr, in one line unless it is a bug; return the exit code. ``job`` is a prefix."""
    if isinstance(error, PermissionError) and error.filename is not None:  # wherever the file was opened
        path = os.fsdecode(error.filename)
        error = MachineError(f"{path}: {error.strerror}; expected read and write permissions")
    if isinstance(error, UnprocessGenError):
        report(f"{job}{error}")
        return error.exit_code
    traceback.print_exception(error)
    return 1


def report(message: object) -> None:
    """Show a message on stderr, after the name of the program."""
    from unprocess_gen.sources.image.codec_messages import REDIRECTED

    with REDIRECTED:
        print(f"gen-dataset: {message}", file=sys.stderr, flush=True)


@contextmanager
def logging_to_stderr(quiet: bool = False) -> Iterator[None]:
    """Show the messages of the logger ``unprocess_gen`` on stderr; with ``quiet``, only warnings and errors."""
    handler = logging.Handler()
    handler.emit = lambda record: report(record.getMessage())  # type: ignore[method-assign]
    LOGGER.addHandler(handler)
    LOGGER.setLevel(logging.WARNING if quiet else logging.INFO)
    LOGGER.propagate = False
    try:
        yield
    finally:
        LOGGER.removeHandler(handler)
        LOGGER.setLevel(logging.NOTSET)
        LOGGER.propagate = True


class _Stream:
    """A stream whose errors are a MachineError (a broken pipe stays one) if it ``fails``, otherwise ignored.

    A failed stream becomes `os.devnull`, so that the interpreter's own flush at exit succeeds.
    """

    def __init__(self, stream: TextIO, fails: bool) -> None:
        self._stream, self._fails = stream, fails

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write text."""
        self._call(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        """Flush the stream."""
        self._call(self._stream.flush)

    def _call(self, method: Callable[..., object], *arguments: str) -> None:
        try:
            method(*arguments)
        except OSError as error:
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())
            if self._fails and isinstance(error, BrokenPipeError):
                raise
            if self._fails:
                problem = f"cannot be written ({error.strerror}); redirect it elsewhere and rerun"
                raise MachineError(f"stdout: {problem}") from error


@contextmanager
def checked_streams() -> Iterator[None]:
    """Handle the errors of ``sys.stdout``, and ignore those of ``sys.stderr``, which must not end a run.

    Closed streams become `os.devnull`: the next file would get the number of stdout, and what C libraries print.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            os.dup2(os.open(os.devnull, os.O_RDWR), number)
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", closefd=False))
    before = sys.stdout, sys.stderr
    for stream in before:
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # for terminals that cannot show a character
    sys.stdout, sys.stderr = _Stream(before[0], True), _Stream(before[1], False)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
