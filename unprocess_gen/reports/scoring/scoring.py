"""Score a method on frames: a record for each frame, and means with intervals by ISO, exposure ratio, camera and level.

Definitions for users: ``docs/guides/score.md``. Reasons: ``docs/design/reports.md``.
"""

from __future__ import annotations

import json
import math
import re
import time
import traceback
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import BrokenExecutor
from functools import partial
from importlib.metadata import version
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import ConfigError, MachineError, UnprocessGenError
from unprocess_gen.core.files import write_file
from unprocess_gen.core.records import parse_json
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.manifest import csv_lines
from unprocess_gen.pipeline.executors.local import effective_jobs, run_pool
from unprocess_gen.pipeline.generate import PACKAGES
from unprocess_gen.pipeline.progress import with_bar
from unprocess_gen.reports.scoring.items import Item, Items
from unprocess_gen.reports.scoring.methods import load_method
from unprocess_gen.reports.scoring.metrics import Scores, target_scores

Record = dict[str, Any]
"""Facts of a frame, `FACTS`, and its scores."""
FACTS = ("key", "dataset", "source", "iso", "exposure_ratio", "camera", "level", "group")
GROUPS = FACTS[3:7]
"""Facts by which scores are always grouped."""
DIGITS, DRAWS, MOST_GROUPS = 6, 2000, 20
"""Decimal places of scores, draws of the bootstrap, and values of a fact that the table shows."""
LARGEST = 2.0**32
"""Bound of the values that a method returns; squares of larger ones would overflow."""


class MethodError(UnprocessGenError):
    """Method that failed or returned what cannot be scored: one sentence with the key."""

    exit_code = 3


def score_items(items: Items, method: str, n_jobs: int = 1) -> dict[str, Any]:
    """Score a method on items; the contents of ``score.json``. MethodError if the method fails."""
    work, jobs = partial(score_item, method, str(Path.cwd())), effective_jobs(n_jobs, items.number)
    results = map(work, items.items) if jobs == 1 else run_pool(work, items.items, jobs, in_order=True)
    try:
        records, times = zip(*with_bar(results, "item", items.number), strict=True)
    except BrokenExecutor:
        raise MachineError("score: a worker died, usually out of memory; expected more memory; use n_jobs=1") from None
    pairs = [record for of_item in records for record in of_item]
    facts = {"method": method, "data": items.data, "versions": {name: version(name) for name in PACKAGES}}
    return {**facts, **summaries(pairs), "pairs": pairs, "seconds_per_megapixel": float(f"{np.median(times):.3g}")}


def score_item(name: str, folder: str, item: Item) -> tuple[list[Record], float]:
    """Call a method, and compare each frame, or the target; the records, and seconds per megapixel."""
    method, noisy, rows, problem = load_method(name, folder), np.array(item.noisy), [dict(row) for row in item.rows], ""
    shapes = [noisy.shape[not item.is_clip :], *([] if item.target is None else [item.target.shape])]
    started = time.perf_counter()
    try:
        output = np.asarray(method(noisy, rows) if item.is_clip else method(noisy[0], rows[0]))
        seconds = (time.perf_counter() - started) / (noisy.size / 1e6)
        if output.dtype.kind not in "iuf" or output.shape not in shapes:
            problem = f"returned {output.dtype} {output.shape}; expected numbers {' or '.join(map(str, shapes))}"
        elif not (np.abs(output := output.astype(np.float64)) < LARGEST).all():
            problem = "returned NaN, infinity or values above 2^32; expected DN"
    except (Exception, SystemExit) as error:
        line, kind = traceback.extract_tb(error.__traceback__)[-1], type(error).__name__
        problem = f"raised {kind}: {error_in_one_line(error)} ({Path(line.filename).name}:{line.lineno})"
    if problem:
        raise MethodError(f"score: --method {name}: {rows[0]['key']}: {problem}")
    if item.target is not None and output.shape == item.target.shape:
        return [_record(item, item.rows[0], target_scores(item.target, output))], seconds
    frames = zip(item.rows, item.clean, output.reshape(noisy.shape), strict=True)
    return [_record(item, row, item.compare(clean, frame, row)) for row, clean, frame in frames], seconds


def _record(item: Item, row: Row, scores: Scores) -> Record:
    clip = None if row.get("burst_downscale") else row.get("clip")  # all bursts of a photograph are one source
    stated = re.search(r"_iso(\d+)", str(row.get("noise")))  # profiles of two numbers are named by their ISO
    iso = row.get("iso") or (stated and float(stated[1]))
    cells = {**row, "dataset": item.dataset, "source": clip or row["source"], "iso": iso}
    facts = {name: cells[name] for name in FACTS if cells.get(name) not in (None, "")}
    return facts | {name: _rounded(value) for name, value in scores.items()}


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(float(value), DIGITS)


# ------------------------------------------------------------------------------------------------- means and intervals


def summaries(records: Sequence[Record]) -> dict[str, Any]:
    """Means of all records, and by the values of each of `GROUPS`; by dataset and group if there are several."""
    tables = {"all": _summary(records)}
    for column in (*GROUPS, "dataset", "group"):
        groups = defaultdict[str, list[Record]](list)
        for record in sorted((record for record in records if column in record), key=itemgetter(column)):
            value = record[column]
            groups[f"{value:.8g}" if isinstance(value, float) else str(value)].append(record)
        if column in GROUPS or len(groups) > 1:
            tables[f"by_{column}"] = {name: _summary(group) for name, group in groups.items()}
    return tables


def _summary(records: Sequence[Record]) -> dict[str, Any]:
    """Mean of each score with its interval, over the frames that have it; the others are counted as omitted."""
    names = dict.fromkeys(name for record in records for name in record if name not in FACTS)
    return {name: _interval(name, records) for name in names}


def _interval(name: str, records: Sequence[Record]) -> dict[str, Any]:
    sources = defaultdict[str, Any](lambda: np.zeros(2))
    for record in (record for record in records if record.get(name) is not None):
        sources[record["source"]] += record[name], 1
    sums, random = np.array([*sources.values()]).reshape(-1, 2), np.random.RandomState(0)
    draws = range(DRAWS if len(sums) > 1 else 0)  # one source does not show how sources differ
    drawn = [sums[random.randint(0, len(sums), len(sums), np.int64)].sum(axis=0) for _ in draws]
    total, count = sums.sum(axis=0)
    mean, ends = total / count if count else None, (None, None)
    if drawn:
        ends = mean + np.quantile([a / b - mean for a, b in drawn], (0.025, 0.975)) * _expansion(len(sums))
    mean, low, high = map(_rounded, (mean, *ends))
    numbers = {"frames": int(count), "omitted": len(records) - int(count), "sources": len(sums)}
    return {"mean": mean, "low": low, "high": high, **numbers}


def _expansion(sources: int) -> float:
    """Factor of the distances from the mean to the ends, because draws of few sources vary too little.

    √(n / (n - 1)) · t / z, with the 97.5 % quantiles of Student's t and of the normal distribution (Hesterberg,
    American Statistician 69, 2015); t by three terms in 1 / (n - 1), 24 % low for two sources, 1 % for four.
    """
    n = sources - 1
    return math.sqrt(sources / n) * (1 + 1.210365 / n + 1.440077 / n**2 + 1.304029 / n**3)


# ------------------------------------------------------------------------------------------------ comparison and files


def read_scores(file: Path, data: dict[str, Any]) -> dict[str, Any]:
    """Read a ``score.json`` of the same datasets; ConfigError if the file is none, or has other pairs."""
    try:
        other = dict[str, Any](parse_json(file.read_bytes()))
        sorted(_named(other))
        json.dumps(compare(other, other), allow_nan=False)
        same = [({*of["datasets"].values()}, of["keys"], of["split"]) for of in (data, other["data"])]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"score: --against {file}: {error_in_one_line(error)}; expected a score.json") from None
    if same[0] != same[1]:
        raise ConfigError(f"score: --against {file}: has other pairs; expected the same dataset, --keys and --split")
    return other


def compare(scored: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """Differences of a method's scores from those of another: means with intervals, as in ``score.json``."""
    own, others = _named(scored), _named(other)
    if differing := sorted(own.keys() ^ others.keys()):
        raise ConfigError(f"score: --against: only one method has scores of {differing[0][1]}; expected the same pairs")
    for key, record in own.items():
        for name in record.keys() - {*FACTS}:
            both = record[name], others[key].get(name)
            own[key] = own[key] | {name: None if None in both else _rounded(both[0] - both[1])}
    return {"method": other["method"], **summaries([*own.values()])}


def _named(scored: dict[str, Any]) -> dict[tuple[str, str], Record]:
    """Records by the digest of their dataset and key."""
    return {(scored["data"]["datasets"][record["dataset"]], record["key"]): record for record in scored["pairs"]}


def write_scores(scored: dict[str, Any], folder: Path) -> None:
    """Write ``score.json``, and ``score.csv`` with a line for each record."""
    names = sorted({name for record in scored["pairs"] for name in record}, key=[*FACTS, *scored["all"]].index)
    lines = csv_lines(({name: record.get(name) for name in names} for record in scored["pairs"]), names)
    write_file(folder / "score.json", json.dumps(scored, indent=1, allow_nan=False) + "\n")
    write_file(folder / "score.csv", f"{','.join(names)}\n".encode() + lines)


def score_table(tables: dict[str, Any]) -> Iterator[str]:
    """Lines of a table of means with intervals, [low, high]."""
    titles = [name for name in tables["all"] if not name.endswith("_unsaturated")]
    shown = [key for key in tables if key[:3] == "by_" and 1 < len(tables[key]) <= MOST_GROUPS]
    named = {f"{key[3:]} {name}": cells for key in shown for name, cells in tables[key].items()}
    width = max(map(len, ["all", *named]))
    yield "".join([f"{'':<{width}}  frames", *(f"  {title:<22}" for title in titles)]).rstrip()
    for label, cells in {"all": tables["all"], **named}.items():
        texts = [_cell(cells[title], 4 if "ssim" in title else 2) for title in titles if title in cells]
        frames = max(cell["frames"] + cell["omitted"] for cell in cells.values())
        yield "".join([f"{label:<{width}}  {frames:>6}", *(f"  {text:<22}" for text in texts)]).rstrip()


def _cell(cell: dict[str, Any], places: int) -> str:
    mean, low, high = ("–" if cell[end] is None else f"{cell[end]:.{places}f}" for end in ("mean", "low", "high"))
    return mean if low == "–" else f"{mean} [{low}, {high}]"
