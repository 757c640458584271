"""The size of a run is estimated from image headers, and a run that does not fit the disk is refused at its start."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, Settings
from helpers.photographs import fill

from unprocess_gen.core.errors import MachineError
from unprocess_gen.pipeline import sizes
from unprocess_gen.pipeline.generate import shard_tasks
from unprocess_gen.sources.loader import list_photographs

ONE = "output.pairs_per_shard=1"


def estimate(settings: Settings, root: Path | None, *overrides: str) -> sizes.SizeEstimate:
    config = settings(*overrides)
    config.source.root = None if root is None else str(root)
    tasks = shard_tasks(list_photographs(config.source).sources, config.output.pairs_per_shard)
    return sizes.estimate_shards(config, tasks)


@pytest.mark.parametrize(
    "overrides",
    [
        ("output.pairs_per_shard=5",),
        ("noise.levels=3", "noise.draws=2"),
        ("source.patch=8",),
        ("source.patch=[random,10,3]",),
        ("output.layout=packed", "output.dtype=float32"),
        ("source.downscale=2",),
    ],
    ids=lambda overrides: overrides[0],
)
def test_estimated_bytes_equal_the_shards(
    overrides: tuple[str, ...], photos: Path, settings: Settings, make: Make, tmp_path: Path
) -> None:
    make(photos, tmp_path / "ds", *overrides)
    written = [path.stat().st_size for path in (tmp_path / "ds/shards").iterdir()]
    estimated = estimate(settings, photos, *overrides)
    assert (estimated.total, estimated.largest_shard) == (sum(written), max(written))


def test_estimated_bytes_of_scenes_equal_the_shards(settings: Settings, make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=2")
    assert estimate(settings, None, "source.limit=2").total == make(None, tmp_path / "ds", "source.limit=2").bytes


def test_failing_sources_count_no_bytes(settings: Settings, make: Make, tmp_path: Path) -> None:
    source = fill(tmp_path / "p", 3)
    (source / "000.png").write_bytes(b"")
    (source / "001.png").write_bytes(b"not a photograph")
    summary = make(source, tmp_path / "ds", "source.max_failed=2")
    assert estimate(settings, source).total == summary.bytes


def test_long_listing_is_estimated_from_a_bounded_sample(
    settings: Settings, make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = fill(tmp_path / "p", 100)
    read: list[Any] = []
    read_bytes = sizes.read_bytes
    monkeypatch.setattr(sizes, "read_bytes", lambda *given: (read.append(given), read_bytes(*given))[1])
    estimated = estimate(settings, source)
    assert len(read) == sizes.SAMPLE
    assert estimated.total == pytest.approx(make(source, tmp_path / "ds").bytes, rel=0.05)


@pytest.fixture
def little_space(monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(sizes, "free_bytes", lambda path: 20_000)
    return 20_000


def test_run_larger_than_the_disk_is_refused_with_5(little_space: int, tmp_path: Path, run_main: RunMain) -> None:
    fill(tmp_path / "p", 3)
    done = run_main("source.root=p", ONE, "n_jobs=1")
    assert (done.code, done.out, done.err.count("\n")) == (5, "", 1)
    found = re.fullmatch(
        r"gen-dataset: out=ds: not enough disk space for 3 shards; expected about (\d+) free bytes "
        r"\((\d+) for the largest shard\), found 20000; free space, choose another out, or set check_disk=false to "
        r"start anyway\n",
        done.err,
    )
    assert found and little_space < int(found[1]) < 60_000 and int(found[2]) < little_space
    assert list((tmp_path / "ds").iterdir()) == []


def test_check_disk_false_starts_anyway(little_space: int, tmp_path: Path, make: Make) -> None:
    assert make(fill(tmp_path / "p", 3), tmp_path / "ds", ONE, "check_disk=false").pairs == 3


def test_resumed_run_needs_space_only_for_missing_shards(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = fill(tmp_path / "p", 3)
    with monkeypatch.context() as patch:
        patch.setattr("unprocess_gen.pipeline.generate.Workspace.finish", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            make(source, tmp_path / "ds", ONE)
    (tmp_path / "ds/shards/shard-00001.tar").unlink()
    monkeypatch.setattr(sizes, "free_bytes", lambda path: 20_000)
    assert make(source, tmp_path / "ds", ONE).made == 1


def test_true_free_space_is_compared(tmp_path: Path, settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    config = settings(ONE)
    config.source.root = str(fill(tmp_path / "p", 2))
    tasks = shard_tasks(list_photographs(config.source).sources, 1)
    sizes.check_free_space(config, tasks, tmp_path / "does/not/exist")
    monkeypatch.setattr(sizes, "estimate_shards", lambda *_: sizes.SizeEstimate(10**18, 10**18))
    with pytest.raises(MachineError, match="check_disk=false"):
        sizes.check_free_space(config, tasks, tmp_path)
