"""Write results to stdout, and messages to stderr and a log file.

Messages go through the logger ``unprocess_gen``; the verbs' flags decide where they appear. A full stdout is a system
error, while a full stderr is ignored: it must not end a run. Streams that the caller closed become ``/dev/null``.
"""

from __future__ import annotations

import logging
import os
import sys
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

from unprocess_gen.core.errors import ConfigError, MachineError, UnprocessGenError
from unprocess_gen.core.output_paths import check_log_file
from unprocess_gen.sources.image.codec_messages import REDIRECTED

LOGGER = logging.getLogger("unprocess_gen")
RESULTS = logging.getLogger("unprocess_gen.results")
"""What goes to stdout, once more for the log file; never shown on stderr."""

LOG_FORMAT = "%(asctime)s %(levelname)s %(message)s"


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
        LOGGER.disabled = False  # Hydra disables all loggers that exist when it starts an application
        LOGGER.log(level, "%s", message)
    else:
        print(f"gen-dataset: {message}", file=sys.stderr)


@contextmanager
def logging_to(quiet: bool = False, verbose: bool = False, log_file: str | None = None) -> Iterator[None]:
    """Show the messages of the logger ``unprocess_gen`` on stderr, and append them to a log file."""
    if quiet and verbose:
        raise ConfigError("--quiet and --verbose exclude each other; expected one of them")
    handlers: list[logging.Handler] = [_StderrHandler()]
    if log_file is not None:
        check_log_file(Path(log_file), f"--log-file {log_file}")
        try:
            handlers.append(_FileHandler(log_file, encoding="utf-8"))
        except OSError as error:
            raise ConfigError(
                f"--log-file {log_file}: cannot be written ({error.strerror}); expected a file name"
            ) from None
        handlers[-1].setFormatter(logging.Formatter(LOG_FORMAT))
    before = LOGGER.level, LOGGER.propagate, RESULTS.level
    LOGGER.setLevel(logging.WARNING if quiet else logging.DEBUG if verbose else logging.INFO)
    LOGGER.propagate = False
    LOGGER.disabled = RESULTS.disabled = False
    RESULTS.setLevel(logging.INFO)
    for handler in handlers:
        LOGGER.addHandler(handler)
    try:
        yield
    finally:
        for handler in handlers:
            LOGGER.removeHandler(handler)
            handler.close()
        level, LOGGER.propagate, results_level = before
        LOGGER.setLevel(level)  # assigning the attribute would leave logging's cache of enabled levels stale
        RESULTS.setLevel(results_level)


class _StderrHandler(logging.Handler):
    """Print each message on the current ``sys.stderr``, after the name of the program."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print one message; results are on stdout already."""
        if record.name != RESULTS.name:
            with REDIRECTED:
                print(f"gen-dataset: {record.getMessage()}", file=sys.stderr, flush=True)


class _FileHandler(logging.FileHandler):
    """Append messages to a file; a full disk does not end the run."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 (the name is logging's)
        """Drop a message that cannot be written."""

    def close(self) -> None:
        """Close the file; what cannot be written is dropped."""
        with suppress(OSError):
            super().close()


# ---------------------------------------------------------------------------------------------------- stdout, stderr


class _Stream:
    """Pass text on to a stream; handle its errors in one place."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write text."""
        try:
            return self._stream.write(text)
        except OSError as error:
            self._failed(error)
            return len(text)

    def flush(self) -> None:
        """Flush the stream."""
        try:
            self._stream.flush()
        except OSError as error:
            self._failed(error)

    def _failed(self, error: OSError) -> None:
        """Let the interpreter's own flush at exit succeed, which would otherwise change the exit code to 120."""
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())


class _Stdout(_Stream):
    """Raise an error of stdout as MachineError; BrokenPipeError remains as it is."""

    def _failed(self, error: OSError) -> None:
        super()._failed(error)
        if isinstance(error, BrokenPipeError):
            raise error
        raise MachineError(f"stdout: cannot be written ({error.strerror}); redirect it elsewhere and rerun") from error


@contextmanager
def checked_streams() -> Iterator[None]:
    """Replace ``sys.stdout`` and ``sys.stderr`` by streams whose errors are handled; restore them at the end.

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
    sys.stdout, sys.stderr = _Stdout(before[0]), _Stream(before[1])
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
