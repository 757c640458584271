"""A sweep's bookkeeping: the folder of each job, ``sweep.csv``, and what the whole came to."""

from __future__ import annotations

import csv
import hashlib
import os
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

SEVERITY = (0, 3, 11, 4, 2, 5, 1)
"""Exit codes from good to bad: a sweep ends with the worst of its jobs."""

NOT_IN_NAMES = ("out", "n_jobs", "self_test", "check_disk", "source.root")
"""Settings that do not tell one job's data from another's."""

LONGEST_NAME = 200


@dataclass(frozen=True, slots=True)
class Job:
    """One dataset of a sweep, as ``sweep.csv`` tells it; ``rows`` and ``failed`` are None where none was made."""

    folder: str
    overrides: str
    rows: int | None
    failed: int | None
    exit: int


def overrides_text(overrides: Iterable[str]) -> str:
    """Return a job's overrides in one line, sorted, as Hydra's ``override_dirname`` spells them."""
    return ",".join(sorted(override for override in overrides if override.split("=")[0] not in NOT_IN_NAMES))


def folder_name(text: str) -> str:
    """Return the folder of a job: its overrides, slashes encoded, a long name cut and told apart by its digest."""
    name = text.replace("%", "%25").replace("/", "%2F") or "default"
    if len(os.fsencode(name)) <= LONGEST_NAME:
        return name
    return os.fsencode(name)[: LONGEST_NAME - 20].decode(errors="ignore") + "-" + _digest(name)


def _digest(name: str) -> str:
    return hashlib.sha256(os.fsencode(name)).hexdigest()[:16]


def worst(exit_codes: Iterable[int]) -> int:
    """Return the exit code of a whole sweep."""
    return max(exit_codes, key=SEVERITY.index, default=0)


def write_table(out: Path, jobs: Sequence[Job]) -> None:
    """Write ``sweep.csv`` anew, where the sweep's folder exists; rows of other sweeps into it are kept."""
    if not out.is_dir():
        return
    path = out / "sweep.csv"
    ours = {job.folder for job in jobs}
    earlier = [cells for cells in _read(path) if cells[0] not in ours]
    aside = out / "sweep.csv.part"
    with aside.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(field.name for field in fields(Job))
        writer.writerows(astuple(job) for job in jobs)
        writer.writerows(earlier)
    os.replace(aside, path)


def _read(path: Path) -> list[list[str]]:
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            return [cells for cells in csv.reader(stream) if cells][1:]
    except FileNotFoundError:
        return []
