"""Run ``gen-dataset``: call the function of a verb, and turn errors and signals into exit codes.

``--help`` and ``--version`` are answered before anything slow is imported.

Design: ``docs/design/command_line.md``.
"""

from __future__ import annotations

import os
import re
import signal
import sys
from collections.abc import Sequence

from unprocess_gen import __version__
from unprocess_gen.cli.arguments import Verb, parse, path_hint
from unprocess_gen.cli.exit_codes import BROKEN_PIPE
from unprocess_gen.cli.help import asked_help
from unprocess_gen.cli.messages import checked_streams, logging_to_stderr, report, report_error
from unprocess_gen.cli.process_limits import prepare_libraries
from unprocess_gen.cli.signals import SIGNALS
from unprocess_gen.cli.verbs import VERBS
from unprocess_gen.core.errors import RESUME, ConfigError, UnprocessGenError
from unprocess_gen.core.suggestions import did_you_mean

RESUMING = ("generate", "manifest", "part", "again", "build")
"""Verbs that continue interrupted work when they are run again."""

OPENCV_LIMITS = ("PIXELS", "WIDTH", "HEIGHT")
"""OpenCV refuses pictures above these limits if the environment sets them; here `source.max_pixels` decides."""


def main() -> int:
    """Run ``gen-dataset`` with the arguments of this process; return the exit code."""
    for limit in OPENCV_LIMITS:
        os.environ.pop(f"OPENCV_IO_MAX_IMAGE_{limit}", None)  # before OpenCV is loaded, and for the workers
    arguments = sys.argv[1:]
    with checked_streams(), SIGNALS:
        try:
            code = run(arguments)
            sys.stdout.flush()
        except (KeyboardInterrupt, Exception) as error:
            code = _report_end(error, arguments)
    return code


def run(arguments: Sequence[str]) -> int:
    """Run the verb of a command line without the program's name; return the verb's exit code."""
    verb, rest = find_verb(arguments)
    flags = rest[: rest.index("--")] if "--" in rest else rest
    if {"-h", "--help"} & set(flags):
        print(asked_help(VERBS, verb if len(rest) < len(arguments) else None, flags), end="")
        return 0
    if "--version" in flags:
        print(f"unprocess_gen {__version__}")
        return 0
    prepare_libraries()
    call = parse(verb, rest)
    with logging_to_stderr(call.quiet):
        return verb.run(call)


def find_verb(arguments: Sequence[str]) -> tuple[Verb, list[str]]:
    """Find the verb, which a first word of small letters always is, otherwise ``generate``, and what is behind it."""
    if not arguments or not re.fullmatch("[a-z]+", arguments[0]):
        return VERBS["generate"], list(arguments)
    name, *rest = arguments
    if name not in VERBS:
        hint = path_hint(name) or did_you_mean(name, VERBS)
        raise ConfigError(f"{name}: no such verb; expected {', '.join(VERBS)} or settings key=value{hint}")
    return VERBS[name], rest


def _report_end(error: BaseException, arguments: Sequence[str]) -> int:
    """Report in one line what ended the command; return its exit code. Bugs are raised."""
    if isinstance(error, BrokenPipeError):
        return BROKEN_PIPE
    if isinstance(error, KeyboardInterrupt) or SIGNALS.received is not None:
        # OmegaConf and LLVM may fail in their own way when they are interrupted
        number = SIGNALS.received or signal.SIGINT
        exec("")  # Python ends by SIGINT, whatever the exit code, if the last string it executed was interrupted
        try:
            resumes = find_verb(arguments)[0].name in RESUMING
        except ConfigError:
            resumes = False
        what = "interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}"
        report(f"{what}; {RESUME}" if resumes else what)
        return 128 + number
    if isinstance(error, UnprocessGenError | PermissionError):
        return report_error(error)
    raise error
