"""Write results to stdout, and messages to stderr and a log file.

Messages go through the logger ``unprocess_gen``; the verbs' flags decide where they appear. A full stdout is a system
error, while a full stderr is ignored: it must not end a run.
"""

from __future__ import annotations

import logging
import os
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

from unprocess_gen.core.errors import ConfigError, MachineError, UnprocessGenError
from unprocess_gen.core.output_paths import check_log_file
from unprocess_gen.sources.image.codec_messages import REDIRECTED

LOGGER = logging.getLogger("unprocess_gen")
RESULTS = logging.getLogger("unprocess_gen.results")
"""What goes to stdout, once more for the log file; never shown on stderr."""


def print_result(text: object) -> None:
    """Print a line on stdout; with ``--log-file``, log it too."""
    print(text)
    RESULTS.info("%s", text)


def print_results(texts: Iterable[object]) -> None:
    """Print lines as `print_result` does, and flush: an error of stdout is raised here, not by a later step."""
    for text in texts:
        print_result(text)
    sys.stdout.flush()


def report_error(error: BaseException, job: str = "") -> int:
    """Report an error on stderr, in one line unless it is a bug; return the exit code. ``job`` is a prefix."""
    if isinstance(error, PermissionError) and error.filename is not None:  # wherever the file was opened
        path = os.fsdecode(error.filename)
        error = MachineError(f"{path}: {error.strerror}; expected read and write permissions")
    if isinstance(error, UnprocessGenError):
        report(f"{job}{error}", logging.ERROR)
        return error.exit_code
    traceback.print_exception(error)
    if LOGGER.handlers:
        RESULTS.error("%sunexpected error", job, exc_info=error)
    return 1


def report(message: str, level: int = logging.WARNING) -> None:
    """Show a message on stderr, also before the logger has been set up."""
    if LOGGER.handlers:
        LOGGER.log(level, "%s", message)
    else:
        print(f"gen-dataset: {message}", file=sys.stderr)


@contextmanager
def logging_to(quiet: bool = False, verbose: bool = False, log_file: str | None = None) -> Iterator[None]:
    """Show the messages of the logger ``unprocess_gen`` on stderr, and append them to a log file."""
    if quiet and verbose:
        raise ConfigError("--quiet and --verbose exclude each other; expected one of them")
    handlers = [_StderrHandler(), *([] if log_file is None else [_file_handler(log_file)])]
    LOGGER.setLevel(logging.WARNING if quiet else logging.DEBUG if verbose else logging.INFO)
    RESULTS.setLevel(logging.INFO)
    LOGGER.propagate = False
    for handler in handlers:
        LOGGER.addHandler(handler)
    try:
        yield
    finally:
        LOGGER.propagate = True
        LOGGER.setLevel(logging.NOTSET)
        for handler in handlers:
            LOGGER.removeHandler(handler)
            with suppress(OSError):  # what cannot be written to a full disk is dropped
                handler.close()


class _StderrHandler(logging.Handler):
    """Print each message on the current ``sys.stderr``, after the name of the program."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print one message; results are on stdout already."""
        if record.name != RESULTS.name:
            with REDIRECTED:
                print(f"gen-dataset: {record.getMessage()}", file=sys.stderr, flush=True)


def _file_handler(log_file: str) -> logging.Handler:
    """Return a handler that appends messages to a file; a full disk does not end the run."""
    check_log_file(Path(log_file), f"--log-file {log_file}")
    try:
        handler = logging.FileHandler(log_file, encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"--log-file {log_file}: cannot be written ({error.strerror}); expected a file name"
        ) from None
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    handler.handleError = lambda record: None  # type: ignore[method-assign]
    return handler


class _Stream:
    """Pass text on to stdout or stderr, and handle their errors in one place.

    A stream that fails becomes `os.devnull`, so that the interpreter's own flush at exit succeeds. An error of stdout
    is a MachineError, or BrokenPipeError if its reader ended.
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
    """Handle the errors of ``sys.stdout`` and ``sys.stderr`` until the end.

    Streams that the caller closed become `os.devnull`: otherwise the next file to be opened would get the number of
    stdout, and receive what C libraries print.
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
