"""Define the exceptions of the package and when to raise each.

* `UnprocessGenError`: base class

  * `ConfigError`: the config or the command line is wrong. It is raised before the first image (exit code 2).
  * `SourceError`: one source cannot be used. The run records its reason in a manifest row and continues.
  * `DamageError`: a dataset differs from its manifest (exit code 4).
  * `MachineError`: a system error, for example a full disk, or a source that changed (exit code 5).
  * `LockedError`: another run holds the output folder (exit code 11).

A wrong argument of a simulation function raises ValueError. Any other exception is a bug and ends the command line with
a traceback (exit code 1). Each exception here takes strings only, so that it can be pickled between processes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

RESUME = "finished shards are kept; run the same command again to resume"
"""What to do after a run ended early, for messages. It is also true of one part of a run."""

RESTORE = "restore the file, or regenerate the dataset"
"""What to do if a source of a dataset was changed or deleted."""

REASONS = {
    "empty": "the file has no bytes",
    "unreadable": "the file cannot be opened or read, or leads outside `source.root`",
    "not_a_file": "the name is not that of a regular file",
    "unsupported": "the format, the codec or the colours of the file are not supported",
    "truncated": "the end of the file is missing",
    "corrupt": "the content of the file contradicts itself or cannot be decoded",
    "too_large": "the image has more pixels than `source.max_pixels`, or is larger than the decoder reads",
    "too_small": "no patch, square of `source.downscale` or 2 x 2 tile fits; with "
    "status `filtered`, a side is shorter than `source.min_side`",
    "cmyk": "the pixels are printing inks",
    "alpha": "pixels are transparent, or could be",
    "animated": "the file contains several pictures",
    "icc": "the colours cannot be converted to sRGB (PQ, HLG, linear light, a profile of tables, or a damaged one); "
    "with `source.icc=refuse`, they are not those of sRGB",
    "worker_died": "four workers died at this source, usually out of memory; the next run tries it again",
}
"""Reasons for which a source fails, the values of the manifest column ``reason``, with their explanations."""


class UnprocessGenError(Exception):
    """Base class; the command line ends with ``exit_code``."""

    exit_code = 1


class ConfigError(UnprocessGenError):
    """Wrong config or command line: one sentence with the key, the value and the allowed values."""

    exit_code = 2


class UnknownKeyError(ConfigError, KeyError):
    """Key of a pair that a reader does not have, or that several of its pairs have."""

    __str__ = Exception.__str__  # of a KeyError it is a `repr`


class DamageError(UnprocessGenError):
    """Damaged dataset: its files differ from its manifest."""

    exit_code = 4


class MachineError(UnprocessGenError):
    """System error, such as a full disk or a deleted file: one sentence with the path."""

    exit_code = 5


class SourceChangedError(MachineError):
    """Report that a source was changed or deleted since its row was made: one sentence with what to do."""


class LockedError(UnprocessGenError):
    """Output folder that another run holds."""

    exit_code = 11


class SourceError(UnprocessGenError):
    """Source that cannot be used, for one of `REASONS`; ``sha256`` is that of its file, if it could be read.

    ``status`` is the value of the manifest column.
    """

    status = "failed"

    def __init__(self, reason: str, text: str, sha256: str | None = None) -> None:
        if reason not in REASONS:
            raise ValueError(f"reason is {reason!r}, expected one of {', '.join(REASONS)}")
        super().__init__(reason, text, sha256)
        self.reason = reason
        self.text = text
        self.sha256 = sha256

    def __str__(self) -> str:
        return f"{self.reason}: {self.text}"


class FilteredError(SourceError):
    """Source that the settings leave out (``source.min_side``), which is no failure."""

    status = "filtered"


@contextmanager
def refused_files(place: str, advice: str = "") -> Iterator[None]:
    """Raise each SourceError of the body as ConfigError: ``place``, its text and ``advice``.

    Keys of ``source.raw`` lose the group, because they are names of columns in tables of files.
    """
    try:
        yield
    except SourceError as error:
        raise ConfigError(f"{place} {error.text.replace('source.raw.', '')}{advice}") from error
