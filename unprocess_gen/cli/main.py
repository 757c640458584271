"""Run ``gen-dataset``: call the function of a verb, and turn errors and signals into exit codes.

``--help`` and ``--version`` are answered before anything slow is imported.

Design: ``docs/design/command_line.md``.
"""

from __future__ import annotations

import itertools
import os
import re
import signal
import sys
from collections.abc import Callable, Sequence
from importlib import import_module

from unprocess_gen import __version__
from unprocess_gen.cli.arguments import Verb, parse, path_hint
from unprocess_gen.cli.exit_codes import BROKEN_PIPE
from unprocess_gen.cli.help import global_help, group_help, key_help, verb_help
from unprocess_gen.cli.messages import checked_streams, logging_to_stderr, report, report_error
from unprocess_gen.cli.process_limits import prepare_libraries
from unprocess_gen.cli.signals import SIGNALS
from unprocess_gen.cli.verbs import VERBS
from unprocess_gen.config.option_files import ADDED_GROUPS, conf_dir
from unprocess_gen.core.errors import RESUME, ConfigError, UnprocessGenError
from unprocess_gen.core.suggestions import did_you_mean

OPENCV_LIMITS = ("PIXELS", "WIDTH", "HEIGHT")
"""OpenCV refuses pictures above these limits if the environment sets them; here `source.max_pixels` decides."""


def main() -> int:
    """Run ``gen-dataset`` with the arguments of this process; return the exit code."""
    for limit in OPENCV_LIMITS:
        os.environ.pop(f"OPENCV_IO_MAX_IMAGE_{limit}", None)  # before OpenCV is loaded, and for the workers
    arguments = sys.argv[1:]
    with checked_streams(), SIGNALS:
        code = _exit_code(lambda: run(arguments), arguments)
        return _exit_code(sys.stdout.flush, arguments) or code


def run(arguments: Sequence[str]) -> int:
    """Run the verb of a command line without the program's name; return the verb's exit code."""
    verb, rest = find_verb(arguments)
    flags = rest[: rest.index("--")] if "--" in rest else rest
    if {"-h", "--help"} & set(flags):
        print(_help(verb_help(verb) if len(rest) < len(arguments) else "", flags), end="")
        return 0
    if "--version" in flags:
        print(f"unprocess_gen {__version__}")
        return 0
    prepare_libraries()
    call = parse(verb, rest)
    module, function = verb.run.split(".")
    with logging_to_stderr("quiet" in call.values):
        return int(getattr(import_module(f"unprocess_gen.cli.{module}"), function)(call))


def _help(verb: str, flags: Sequence[str]) -> str:
    """Return the help of the verb; without one, of the verb, group or key after ``--help``; else the program's help.

    The group may be named by one of its settings, such as ``noise.iso``.
    """
    word = next((word for flag, word in itertools.pairwise(flags) if flag in ("-h", "--help")), "-")
    if verb or word.startswith("-"):
        return verb or global_help(VERBS, conf_dir())
    prepare_libraries()
    from unprocess_gen.config.schema import GROUPS  # imports NumPy, too slow for the other kinds of help

    name = re.split("[.=]", word)[0]
    parts = [verb_help(VERBS[name])] if name in VERBS else []
    parts += [group_help(name, conf_dir())] if name in GROUPS or name in ADDED_GROUPS else []
    parts += key_help(name, conf_dir())
    if not parts:
        names = list(dict.fromkeys([*VERBS, *GROUPS, *ADDED_GROUPS]))
        raise ConfigError(
            f"--help {word}: no such verb or group; expected one of {', '.join(names)}{did_you_mean(name, names)}"
        )
    return "\n".join(parts)


def find_verb(arguments: Sequence[str]) -> tuple[Verb, list[str]]:
    """Return the verb of a command line, ``generate`` if the first word is none, and the arguments behind it.

    A first word of small letters is always a verb, even if a folder has that name.
    """
    if not arguments or not re.fullmatch("[a-z]+", arguments[0]):
        return VERBS["generate"], list(arguments)
    name, *rest = arguments
    if name not in VERBS:
        if {"-h", "--help"} & set(rest):
            return VERBS["generate"], list(arguments)
        hint = path_hint(name) or did_you_mean(name, VERBS)
        raise ConfigError(f"{name}: no such verb; expected {', '.join(VERBS)} or settings key=value{hint}")
    return VERBS[name], rest


def _exit_code(step: Callable[[], int | None], arguments: Sequence[str]) -> int:
    """Run a step, report what ends it in one line, and return its exit code. Bugs rise."""
    try:
        return step() or 0
    except BrokenPipeError:
        return BROKEN_PIPE
    except (KeyboardInterrupt, Exception) as error:
        # OmegaConf and LLVM may fail in their own way when they are interrupted
        if isinstance(error, KeyboardInterrupt) or SIGNALS.received is not None:
            return _report_signal(SIGNALS.received or signal.SIGINT, arguments)
        if isinstance(error, UnprocessGenError | PermissionError):
            return report_error(error)
        raise


def _report_signal(number: int, arguments: Sequence[str]) -> int:
    """Report in one line that a signal ended the command; return its exit code."""
    try:
        resumes = find_verb(arguments)[0].resumes
    except ConfigError:
        resumes = False
    what = "interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}"
    report(f"{what}; {RESUME}" if resumes else what)
    return 128 + number
