"""Datasets of format 1 that an earlier version made are read, verified and replayed: those of ``format_1.zip``."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
from helpers.format_1 import ARCHIVE
from helpers.promise_report import Figure

import unprocess_gen as ug
from unprocess_gen.core.files import array_xxh3

DATASETS = {
    "burst": (3, "uint16", "uint16", (17, 25)),
    "clips": (4, "uint16", "uint16", (12, 16)),
    "dark_frames": (1, "uint16", "uint16", (12, 16)),
    "levels": (4, "float32", "float32", (6, 8)),
    "linear": (2, "uint16", "uint16", (24, 32)),
    "patches": (4, "uint16", "uint16", (4, 6, 6)),
    "photographs": (4, "uint16", "uint16", (12, 16)),
    "raw": (2, "uint16", "uint16", (32, 32)),
    "split": (6, "float32", "uint16", (12, 16)),
}
"""Pairs of each dataset, dtypes of its clean and noisy frames, and shape of the first."""


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the datasets and their sources, which had another path when they were made."""
    folder = tmp_path_factory.mktemp("format_1")
    with zipfile.ZipFile(ARCHIVE) as archive:
        archive.extractall(folder)
    return folder


def test_archive_is_small_and_has_every_kind(kept: Path) -> None:
    assert ARCHIVE.stat().st_size < 300_000
    assert {path.name for path in kept.iterdir()} == DATASETS.keys()


@pytest.mark.parametrize("kind", DATASETS)
def test_kept_dataset_is_read_verified_and_replayed(kept: Path, kind: str, figure: Figure) -> None:
    dataset, sources, darks = (kept / kind / name for name in ("ds", "sources", "darks"))
    pairs = ug.RawPairs(dataset)
    first = pairs[0]
    assert (len(pairs), first.clean.dtype, first.noisy.dtype, first.noisy.shape) == DATASETS[kind]
    for clean, noisy, row in pairs:
        assert (array_xxh3(clean), array_xxh3(noisy)) == (row["clean_xxh3"], row["noisy_xxh3"])
        assert ug.develop(noisy, row).shape == (row["height"], row["width"], 3)
    assert ug.verify(dataset) == []
    done = ug.replay(dataset, root=sources, dark_frames=darks if darks.exists() else None)
    assert [(one.key, one.complaint, one.compared) for one in done] == [(row["key"], "", True) for row in pairs.rows]
    figure("kept-datasets", f"{kind}: {len(done)} of {len(pairs)} pairs are the same")


@pytest.mark.parametrize("kind", sorted(DATASETS.keys() - {"burst", "dark_frames"}))  # no folder of dark frames
def test_live_pairs_of_a_kept_dataset_are_its_pairs(kept: Path, kind: str) -> None:
    live = ug.LivePairs(kept / kind / "ds", root=kept / kind / "sources", redraw="none")
    for number, (clean, noisy, row) in enumerate(ug.RawPairs(kept / kind / "ds")):
        assert (live[number].clean == clean).all() and (live[number].noisy == noisy).all()
        assert dict(live[number].row) == row


def test_burst_of_a_kept_dataset_is_read_and_made(kept: Path) -> None:
    (stored,) = ug.RawClips(kept / "burst" / "ds")
    live = ug.LivePairs(kept / "burst" / "ds", root=kept / "burst" / "sources", redraw="none")[0]
    assert (live.clean == stored.clean).all() and (live.noisy == stored.noisy).all()
    assert stored.target is not None and stored.target.shape == (34, 50, 3)
    assert np.abs(ug.flow(stored.rows, 2)).max() > 0.1 and (ug.flow(stored.rows, 0) == 0).all()


def test_clips_splits_targets_and_failures_of_kept_datasets_are_read(kept: Path) -> None:
    clips = ug.RawClips(kept / "clips" / "ds")
    assert [(clip.noisy.shape, [row["frame"] for row in clip.rows]) for clip in clips] == [((2, 12, 16), [0, 1])] * 2
    parts = [ug.RawPairs(kept / "split" / "ds", split=name) for name in ("train", "val")]
    assert sum(map(len, parts)) == 6 and all(row["split"] == "val" for row in parts[1].rows)
    light = ug.RawPairs(kept / "linear" / "ds")[0].targets["linear_rgb"]
    assert (light.dtype, light.shape) == (np.float32, (24, 32, 3))
    table = (kept / "photographs" / "ds" / "manifest.csv").read_text(encoding="utf-8")
    assert ",half.png," in table and table.count(",failed,truncated,") == 1
