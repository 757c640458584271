"""Our exceptions, and when to raise which.

* UnprocessGenError
  x ConfigError    the settings or the command line are wrong; raised before the first image; names the key, the
                   value and what is allowed (exit 2)
  x SourceError    one photograph cannot be used; carries a reason class; the runner turns it into a row and goes on
  x DamageError    a dataset is not what its manifest says (exit 4)
  x MachineError   the machine failed us: a full disk, an output folder that vanished (exit 5)
  x LockedError    another run holds this output (exit 11)

A wrong argument to a kernel is a plain ValueError. Anything else is a bug: let it rise (exit 1, with a traceback).
Every exception here takes one sentence, so that it survives the pickling between processes.
"""

from __future__ import annotations

REASONS = (
    "empty",
    "unreadable",
    "not_a_file",
    "unsupported",
    "truncated",
    "corrupt",
    "too_large",
    "cmyk",
    "alpha",
    "animated",
    "icc",
    "worker_died",
)
"""Why a photograph failed: the values of the manifest column ``reason``."""


class UnprocessGenError(Exception):
    """The root of the tree; ``exit_code`` is what the command line ends with."""

    exit_code = 1


class ConfigError(UnprocessGenError):
    """The settings are wrong: one sentence with the key, the value and what is allowed."""

    exit_code = 2


class DamageError(UnprocessGenError):
    """A dataset on disk differs from what it says of itself."""

    exit_code = 4


class MachineError(UnprocessGenError):
    """The machine failed: disk full, output vanished. One sentence with the path."""

    exit_code = 5


class SourceChangedError(MachineError):
    """Report that a source was changed or deleted since its row was made: one sentence with what to do."""


class LockedError(UnprocessGenError):
    """Another run holds the output folder."""

    exit_code = 11


class SourceError(UnprocessGenError):
    """One photograph cannot be used.

    Parameters
    ----------
    reason
        One of `REASONS`.
    text
        What was found, for people.
    sha256
        Digest of the bytes, where they could be read.
    """

    def __init__(self, reason: str, text: str, sha256: str | None = None) -> None:
        if reason not in REASONS:
            raise ValueError(f"reason is {reason!r}, expected one of {', '.join(REASONS)}")
        super().__init__(reason, text, sha256)
        self.reason = reason
        self.text = text
        self.sha256 = sha256

    def __str__(self) -> str:
        return f"{self.reason}: {self.text}"
