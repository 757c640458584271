"""The size of a run is estimated from image headers, and a run that does not fit the disk is refused at its start."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, Settings, TreeHash
from helpers.photographs import fill
from helpers.processes import ONE

from unprocess_gen import load_config
from unprocess_gen.config.schema import replaced
from unprocess_gen.core.errors import MachineError
from unprocess_gen.pipeline import sizes
from unprocess_gen.pipeline.run import shard_starts, shard_tasks
from unprocess_gen.sources.loader import list_photographs


def estimate(settings: Settings, root: Path | None, *overrides: str) -> sizes.SizeEstimate:
    config = settings(*overrides)
    config = replaced(config, {"source.root": None if root is None else str(root)})
    sources = list_photographs(config.source).sources
    tasks = shard_tasks(sources, shard_starts(sources, config.output))
    return sizes.estimate_shards(config, tasks)


@pytest.mark.parametrize(
    "overrides",
    [
        ("output.pairs_per_shard=5",),
        ("noise.levels=3", "noise.draws=2"),
        ("source.patch=8",),
        ("source.patch=[random,10,3]",),
        ("output.layout=packed", "output.dtype=float32"),
        ("output.clean_dtype=float32",),
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
    assert len(read) == sizes.HEADERS_READ
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
    config = replaced(config, {"source.root": str(fill(tmp_path / "p", 2))})
    tasks = shard_tasks(list_photographs(config.source).sources, (0, 1))
    config = replaced(config, {"out": str(tmp_path / "does/not/exist")})
    sizes.check_free_space(config, tasks, 1)
    monkeypatch.setattr(sizes, "estimate_shards", lambda *_: sizes.SizeEstimate(10**18, 10**18))
    with pytest.raises(MachineError, match="check_disk=false"):
        sizes.check_free_space(config, tasks, 1)


# Sources per shard ----------------------------------------------------------------------------------------------------

AUTO = "output.pairs_per_shard=auto"


def recorded_number(out: Path) -> int:
    found = re.search(r"^  pairs_per_shard: (\d+)$", (out / "config.yaml").read_text(), re.MULTILINE)
    assert found is not None
    return int(found[1])


def test_auto_chooses_shards_of_about_the_goal(make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sizes, "SHARD_BYTES", 50_000)
    summary = make(fill(tmp_path / "p", 30), tmp_path / "ds", AUTO)
    assert 25_000 < summary.bytes / summary.shards < 100_000
    assert recorded_number(tmp_path / "ds") == -(-30 // summary.shards)


def test_auto_gives_the_bytes_of_its_number(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tree_hash: TreeHash
) -> None:
    monkeypatch.setattr(sizes, "SHARD_BYTES", 50_000)
    source = fill(tmp_path / "p", 20)
    make(source, tmp_path / "auto", AUTO)
    make(source, tmp_path / "ds", f"output.pairs_per_shard={recorded_number(tmp_path / 'auto')}")
    assert tree_hash(tmp_path / "auto") == tree_hash(tmp_path / "ds")


def test_recorded_number_has_priority_when_resumed(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tree_hash: TreeHash
) -> None:
    monkeypatch.setattr(sizes, "SHARD_BYTES", 50_000)
    source = fill(tmp_path / "p", 20)
    make(source, tmp_path / "ds", AUTO)
    made = tree_hash(tmp_path / "ds")
    for path in (tmp_path / "ds/dataset.json", tmp_path / "ds/manifest.csv"):
        path.unlink()
    shutil.rmtree(tmp_path / "ds/shards")
    monkeypatch.setattr(sizes, "SHARD_BYTES", 100_000)
    make(source, tmp_path / "ds", AUTO)
    assert tree_hash(tmp_path / "ds") == made
    assert make(source, tmp_path / "ds", AUTO).made == 0


def test_auto_without_readable_source_is_the_default(settings: Settings, tmp_path: Path) -> None:
    (tmp_path / "p").mkdir()
    (tmp_path / "p/a.png").write_bytes(b"not a photograph")
    config = settings(AUTO, f"source.root={tmp_path / 'p'}")
    sources = list_photographs(config.source).sources
    assert sizes.resolve_pairs_per_shard(config, sources).output.pairs_per_shard == 8


@pytest.mark.parametrize("recorded", ["", "seed: 0", "output: [", "\0"])
def test_unreadable_record_is_left_to_other_checks(recorded: str, settings: Settings, tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(recorded)
    config = settings(AUTO, "source.limit=1", f"out={tmp_path}")
    sources = list_photographs(config.source).sources
    assert sizes.resolve_pairs_per_shard(config, sources).output.pairs_per_shard > 1


def test_plan_states_the_number_of_auto(
    run_main: RunMain, settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sizes, "SHARD_BYTES", 50_000)
    config = settings(f"source.root={fill(tmp_path / 'p', 20)}")
    number = sizes.fitting_pairs_per_shard(config, list_photographs(config.source).sources)
    done = run_main("plan", f"source.root={tmp_path / 'p'}", AUTO)
    assert done.code == 0, done.err
    assert re.search(rf"^pairs +(about )?20, in \d shards of {number}$", done.out, re.MULTILINE)


@pytest.mark.parametrize("verb", [("plan",), ()])
def test_too_many_shards_are_warned_of(
    verb: tuple[str, ...], run_main: RunMain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sizes, "MAX_SHARDS", 2)
    done = run_main(*verb, f"source.root={fill(tmp_path / 'p', 3)}", "out=ds", ONE, "n_jobs=1")
    assert done.code == 0, done.err
    found = " ".join((done.out + done.err).split())
    assert "output.pairs_per_shard=1: 3 shards; expected at most 2; output.pairs_per_shard=" in found
    assert " gives shards of about 256 MB" in found
    done = run_main(*verb, f"source.root={tmp_path / 'p'}", "out=other", "output.pairs_per_shard=2", "n_jobs=1")
    assert "expected at most" not in done.out + done.err


@pytest.mark.parametrize("text", ["${oc.env:PER_SHARD}", "'8'"])
def test_text_of_a_number_is_a_number(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PER_SHARD", "8")
    assert load_config([f"output.pairs_per_shard={text}"]).output.pairs_per_shard == 8
