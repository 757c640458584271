"""Read the inputs of methods: frames and clips of datasets as mosaics in DN, with their rows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.paths import AnyPath, folder_name
from unprocess_gen.core.targets import LINEAR_RGB
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.dataset_json import read_dataset
from unprocess_gen.dataset.keys import clip_identity
from unprocess_gen.dataset.reader import RawPairs, Sample, dataset_folders, mosaic_dn
from unprocess_gen.dataset.selection import select_pairs
from unprocess_gen.reports.scoring.metrics import Scores, frame_scores


class Item(NamedTuple):
    """Input of a method, and what its output is compared with.

    ``clean`` and ``noisy`` have a frame for each row. Unless the item is a clip, the method gets the frame and its row.
    ``compare`` compares each frame; an output of the shape of ``target`` is compared with the target. Rows have at
    least ``key`` and ``source``; ``group`` is optional.
    """

    dataset: str
    clean: Any
    noisy: Any
    rows: Sequence[Row]
    is_clip: bool = False
    target: Any = None
    compare: Callable[[Any, Float, Row], Scores] = frame_scores


class Items(NamedTuple):
    """Inputs of a method, read one after the other, their number, and what identifies them in the results.

    ``data["datasets"]`` has a digest of each dataset by its name.
    """

    data: dict[str, Any]
    number: int
    items: Iterable[Item]


def dataset_items(folder: AnyPath, keys: str | None = None, split: str | None = None) -> Items:
    """Select the frames of a dataset, or of all of a sweep, that have a 2 x 2 tile; ConfigError if there are none."""
    folders = {folder_name(dataset): dataset for dataset in dataset_folders(folder)}
    for dataset in [*folders.values()] or [folder]:
        if not (dataset / "dataset.json").exists():
            advice = "rerun its command, or run gen-dataset merge after parts"
            raise ConfigError(f"score: {dataset}: is not finished; expected a dataset.json; {advice}")
    chosen = {name: select_pairs(dataset / "manifest.csv", keys) for name, dataset in folders.items() if keys}
    wanted = {(name, row["key"]) for name, selected in chosen.items() for row in selected.rows.values()}
    pairs, groups = RawPairs(folder, split=split), dict[tuple[Any, ...], list[int]]()
    for number, row in enumerate(pairs.rows):
        has_tile = all(int(row[side] or 0) > 1 for side in ("height", "width"))
        if has_tile and (keys is None or (row["dataset"], row["key"]) in wanted):
            clip = clip_identity(row) if row["clip"] else (row["key"],)
            groups.setdefault((row["dataset"], *clip), []).append(number)
    if not groups:
        raise ConfigError(
            f"score: {folder}: none of the pairs has 2 x 2 sites; expected one; choose other --keys or --split"
        )
    digests = {name: read_dataset(dataset / "dataset.json")["fingerprint"] for name, dataset in folders.items()}
    data = {"name": folder_name(folder), "keys": keys, "split": split, "datasets": digests}
    return Items(data, len(groups), (_item([pairs[number] for number in group]) for group in groups.values()))


def _item(samples: Sequence[Sample]) -> Item:
    """Convert the frames of a pair or clip, without an odd last row or column."""
    rows, target = [sample.row for sample in samples], samples[0].targets.get(LINEAR_RGB)
    frames = [[mosaic_dn(frame, row) for frame in sample[:2]] for sample, row in zip(samples, rows, strict=True)]
    if len({clean.shape for clean, _ in frames}) > 1:
        raise ConfigError(
            f"score: clip {rows[0]['clip']} has frames of several sizes; expected one size; choose other clips"
        )
    height, width = (side // 2 * 2 for side in frames[0][0].shape)
    clean, noisy = (np.stack(part)[:, :height, :width] for part in zip(*frames, strict=True))
    is_burst = bool(rows[0].get("burst_downscale"))
    return Item(samples[0].dataset, clean, noisy, rows, bool(rows[0]["clip"]), target if is_burst else None)
