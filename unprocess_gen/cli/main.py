"""The entry point of ``gen-dataset``: dispatch to a verb; turn errors and signals into exit codes.

``--help`` and ``--version`` are answered before anything slow is imported.

Design: ``docs/design/command_line.md``.
"""

from __future__ import annotations

import logging
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType

from unprocess_gen import __version__
from unprocess_gen.cli.arguments import Verb, parse
from unprocess_gen.cli.help import global_help, verb_help
from unprocess_gen.cli.messages import LOGGER, RESULTS, checked_streams, logging_to, report, report_error
from unprocess_gen.cli.verbs import VERBS
from unprocess_gen.config.option_files import conf_dir
from unprocess_gen.core.errors import ConfigError, UnprocessGenError
from unprocess_gen.core.limits import prepare_libraries
from unprocess_gen.core.suggestions import did_you_mean

OPENCV_LIMITS = ("PIXELS", "WIDTH", "HEIGHT")
"""OpenCV refuses pictures above these limits if the environment sets them; here `source.max_pixels` decides."""

BROKEN_PIPE = 141
"""Exit code if stdout is a pipe whose reader ended, as for a process that SIGPIPE ends."""

ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

KEPT = "finished shards are kept; rerun to resume"


class TerminationSignal(BaseException):
    """SIGTERM or SIGHUP arrived; ``number`` is the signal's."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def main() -> int:
    """Run ``gen-dataset`` with the arguments of this process.

    Returns
    -------
    int
        The exit code; see ``gen-dataset --help``.
    """
    for limit in OPENCV_LIMITS:
        os.environ.pop(f"OPENCV_IO_MAX_IMAGE_{limit}", None)  # before OpenCV is loaded, and for the workers
    arguments = sys.argv[1:]
    with checked_streams(), _SIGNALS:
        code = _exit_code(lambda: run(arguments), arguments)
        return _exit_code(_flush_stdout, arguments) or code


def run(arguments: Sequence[str]) -> int:
    """Dispatch to the verb.

    Parameters
    ----------
    arguments : sequence of str
        The command line without the program's name.

    Returns
    -------
    int
        Exit code of the verb.

    Raises
    ------
    UnprocessGenError
        If the arguments are wrong, or the verb fails.
    """
    verb, rest = find_verb(arguments)
    flags = rest[: rest.index("--")] if "--" in rest else rest
    if {"-h", "--help"} & set(flags):
        print(global_help(VERBS, conf_dir()) if len(rest) == len(arguments) else verb_help(verb), end="")
        return 0
    if "--version" in flags:
        print(f"unprocess_gen {__version__}")
        return 0
    prepare_libraries()
    call = parse(verb, rest)
    values = call.values
    with logging_to("quiet" in values, "verbose" in values, values.get("log_file")):
        LOGGER.debug("unprocess_gen %s, Python %s: %s", __version__, sys.version.split()[0], list(arguments))
        code = _exit_code(lambda: verb.run(call), arguments)
        RESULTS.info("exit code %d", code)
        return code


def find_verb(arguments: Sequence[str]) -> tuple[Verb, list[str]]:
    """Return the verb of a command line and the arguments behind it.

    A first word of small letters is always a verb, even if a folder has that name.

    Parameters
    ----------
    arguments : sequence of str
        The command line without the program's name.

    Returns
    -------
    verb : Verb
        ``generate`` if the first word is no verb.
    rest : list of str
        The arguments of the verb.

    Raises
    ------
    ConfigError
        If there is no such verb.
    """
    if not arguments or not re.fullmatch("[a-z]+", arguments[0]):
        return VERBS["generate"], list(arguments)
    name, *rest = arguments
    if name not in VERBS:
        if {"-h", "--help"} & set(rest):
            return VERBS["generate"], list(arguments)
        hint = did_you_mean(name, VERBS)
        if not hint and Path(name).exists():
            hint = f"; {name} is a file or folder: write source.root={name}"
        raise ConfigError(f"{name}: no such verb; expected {', '.join(VERBS)} or settings key=value{hint}")
    return VERBS[name], rest


def _exit_code(step: Callable[[], int], arguments: Sequence[str]) -> int:
    """Run a step; report what ends it in one line, and return the exit code. Bugs rise."""
    try:
        return step()
    except BrokenPipeError:
        return BROKEN_PIPE
    except KeyboardInterrupt:
        return _report_signal(signal.SIGINT, arguments)
    except TerminationSignal as error:
        return _report_signal(error.number, arguments)
    except Exception as error:
        if _SIGNALS.received is not None:  # OmegaConf and LLVM may fail in their own way when they are interrupted
            return _report_signal(_SIGNALS.received, arguments)
        if isinstance(error, UnprocessGenError):
            return report_error(error)
        if LOGGER.handlers:
            RESULTS.error("unexpected error", exc_info=error)
        raise


def _flush_stdout() -> int:
    sys.stdout.flush()
    return 0


# ------------------------------------------------------------------------------------------------------------ signals


class _Signals:
    """Turn signals into exceptions while it is entered: SIGINT, SIGTERM and SIGHUP, unless the caller ignores them.

    Python drops exceptions that are raised while LLVM calls back into Python. Without `_repeat`, 3 of 47 SIGTERM at
    random times of a first run with ``n_jobs=1`` were lost, or ended with a traceback and exit code 1.

    Attributes
    ----------
    received : int or None
        The last signal; None if there was none.
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
            self._timer = threading.Timer(self.REPEAT_S, os.kill, (os.getpid(), self.received))
            self._timer.daemon = True
            self._timer.start()


_SIGNALS = _Signals()


def _report_signal(number: int, arguments: Sequence[str]) -> int:
    """Report in one line that a signal ended the command; return its exit code."""
    try:
        resumes = find_verb(arguments)[0].resumes
    except ConfigError:
        resumes = False
    what = "interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}"
    report(f"{what}; {KEPT}" if resumes else what, logging.WARNING)
    return 128 + number
