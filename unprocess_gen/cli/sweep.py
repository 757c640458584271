"""Name the folders of a sweep's jobs, and write ``sweep.csv``."""

from __future__ import annotations

import io
import os
from collections.abc import Container, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from unprocess_gen.core.errors import RESUME, ConfigError

if TYPE_CHECKING:
    from unprocess_gen.pipeline.generate import Summary

SEVERITY = (0, 3, 11, 4, 2, 5, 1)
"""Exit codes from good to bad; a sweep exits with the worst code of its jobs."""

NOT_IN_NAMES = ("out", "n_jobs", "source.root", "source.list", "executor", "self_test", "check_disk", "sweep", "hydra")
"""Settings that are not in the names of folders: they do not decide a dataset's bytes, or describe the sweep."""

LONGEST_FOLDER_NAME = 200
"""Longest name of a folder, bytes; file systems allow 255."""

SHARES = ("clean_clipped_low", "clean_clipped_high", "noisy_clipped_low", "noisy_clipped_high", "saturated")
"""Counts of CFA sites whose fractions are columns of ``sweep.csv``, with ``_share`` appended."""

FIRST_COLUMNS = ("folder", "overrides")
LAST_COLUMNS = ("rows", "failed", "filtered", *(f"{name}_share" for name in SHARES), "seconds", "bytes", "exit")
"""Columns of ``sweep.csv`` before and after the columns of the swept keys."""


def named_overrides(overrides: Iterable[str], swept: Container[str] = ()) -> list[str]:
    """Overrides that name a job's folder, sorted as in Hydra's ``override_dirname``; with swept places of sources."""

    def is_named(key: str) -> bool:
        differs = key in swept and key.startswith("source.")
        return differs or not any(key == name or key.startswith(f"{name}.") for name in NOT_IN_NAMES)

    return sorted(override for override in overrides if is_named(override.lstrip("+").partition("=")[0]))


def job_folder(overrides: Sequence[str]) -> str:
    """Name of a job's folder; a long one is cut, and ends with a digest."""
    import hashlib

    name = ",".join(overrides).replace("%", "%25").replace("/", "%2F") or "default"
    if len(os.fsencode(name)) <= LONGEST_FOLDER_NAME:
        return name
    digest = hashlib.sha256(os.fsencode(name)).hexdigest()[:16]
    return os.fsencode(name)[: LONGEST_FOLDER_NAME - 20].decode(errors="ignore") + "-" + digest


def worst(exit_codes: Iterable[int]) -> int:
    """Exit code of a sweep: the worst of its jobs' (`SEVERITY`), 0 without any."""
    return max(exit_codes, key=SEVERITY.index, default=0)


def result_cells(summary: Summary) -> dict[str, str]:
    """Cells of a dataset in ``sweep.csv``; ``seconds`` is left out if the job found it complete."""
    sites = summary.sites
    shares = {f"{name}_share": repr(sites[name] / sites["all"]) for name in SHARES} if sites["all"] else {}
    seconds = {"seconds": f"{summary.seconds:.3f}"} if summary.made else {}
    return {
        "rows": str(summary.rows),
        "failed": str(sum(summary.failed.values())),
        "filtered": str(summary.filtered),
        "bytes": str(summary.bytes),
        **shares,
        **seconds,
    }


def write_row(out: Path, row: Mapping[str, str]) -> None:
    """Write the row of a job to ``sweep.csv``, in the place of an earlier one, whose time remains if there is no other.

    So the indices of `RawPairs` do not change.
    """
    import csv

    from unprocess_gen.core.files import machine_errors
    from unprocess_gen.core.locks import LockFile
    from unprocess_gen.core.output_paths import enclosing_dataset
    from unprocess_gen.core.paths import LocalPath
    from unprocess_gen.dataset.reader import SWEEP_TABLE, read_sweep_table

    if not out.is_dir() or enclosing_dataset(out) is not None:  # the job was refused
        return
    path = out / SWEEP_TABLE
    with machine_errors(out, RESUME):
        lock = LockFile(out / "sweep.csv.lock")
        lock.acquire(wait=True)  # several processes may sweep into one folder
        try:
            rows = {other["folder"]: other for other in (read_sweep_table(path) if path.exists() else ())}
            if row["folder"] in rows and row.get("exit") == str(ConfigError.exit_code):
                return  # the folder is that of another job, whose row stays
            rows[row["folder"]] = {"seconds": rows.get(row["folder"], {}).get("seconds", ""), **row}
            table = io.StringIO()
            columns = [*FIRST_COLUMNS, *swept_keys(rows.values()), *LAST_COLUMNS]
            writer = csv.DictWriter(table, columns, restval="", lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows.values())
            LocalPath(path).write(table.getvalue().encode(), str(out))
        finally:
            lock.release()


def swept_keys(rows: Iterable[Mapping[str, str]]) -> list[str]:
    """Keys that a sweep varies: the columns of its table between the columns of every sweep."""
    return list(dict.fromkeys(key for row in rows for key in row if key not in {*FIRST_COLUMNS, *LAST_COLUMNS}))
