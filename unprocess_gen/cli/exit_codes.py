"""Define the exit codes of ``gen-dataset``, with their meaning for ``--help`` and the documentation."""

from __future__ import annotations

DONE, TOO_MANY_FAILED, BROKEN_PIPE = 0, 3, 141
"""Exit codes that no exception has; others are ``exit_code`` of the exceptions of `core.errors`."""

EXIT_CODES = {
    "0": "done",
    "1": "a bug: stderr has a traceback",
    "2": "wrong usage or settings: one line names the key, its value and what is expected; nothing was written",
    "3": "finished, but more sources failed than source.max_failed allows; or a method failed that score called",
    "4": "a dataset is damaged, or differs from what it records",
    "5": "a system error (disk full, output deleted), a source that changed, or parts that are missing",
    "11": "another run holds this output",
    "129, 130, 143": "ended by SIGHUP, SIGINT or SIGTERM; finished shards are kept, and a rerun resumes",
    "141": "the program that reads stdout ended, as head does",
}
"""Meaning of all exit codes. The exit code of a sweep, and of ``verify`` for a sweep, is that of its worst job."""
