"""Define the exit codes of ``gen-dataset``, with their meaning for ``--help`` and the documentation."""

from __future__ import annotations

from dataclasses import dataclass

from unprocess_gen.core.errors import ConfigError, DamageError, LockedError, MachineError, UnprocessGenError

DONE = 0
TOO_MANY_FAILED = 3
"""Exit code if more sources failed than ``source.max_failed`` allows."""

BROKEN_PIPE = 141
"""Exit code if stdout is a pipe whose reader ended, as for a process that SIGPIPE ends."""


@dataclass(frozen=True, slots=True)
class ExitCode:
    """One exit code, or several with the same meaning: a few words for ``--help``, sentences for the documentation."""

    codes: tuple[int, ...]
    summary: str
    meaning: str


EXIT_CODES = (
    ExitCode((DONE,), "done", "The command did what was asked."),
    ExitCode((UnprocessGenError.exit_code,), "a bug", "A bug of unprocess_gen; stderr has a traceback."),
    ExitCode(
        (ConfigError.exit_code,),
        "usage or settings",
        "An argument or a setting is wrong. One line on stderr names it, its value and what is expected; nothing was "
        "written.",
    ),
    ExitCode(
        (TOO_MANY_FAILED,),
        "more failed sources than max_failed",
        "The dataset is finished, and more sources failed than `source.max_failed` allows.",
    ),
    ExitCode(
        (DamageError.exit_code,),
        "damage found",
        "A dataset is damaged, or differs from its manifest; or the results of `replay` or `again` differ.",
    ),
    ExitCode(
        (MachineError.exit_code,),
        "system error (disk full, source changed)",
        "A system error, such as a full disk; a source that was changed or deleted; or `merge`, if parts are left.",
    ),
    ExitCode((LockedError.exit_code,), "output locked by another run", "Another run is writing to the same `out`."),
    ExitCode(
        (129, 130, 143),
        "ended by SIGHUP, SIGINT, SIGTERM",
        "A signal ended the command: SIGHUP, SIGINT (Ctrl+C) or SIGTERM. Finished shards are kept; a rerun resumes.",
    ),
    ExitCode((BROKEN_PIPE,), "reader of stdout ended", "The program that reads stdout ended, as `head` does."),
)
"""All exit codes. The exit code of a sweep, and of ``verify`` for a sweep, is that of its worst job."""
