"""Local workers run in a pool of joblib."""

from __future__ import annotations

from pathlib import Path

import pytest

import unprocess_gen as ug


def test_workers_of_an_earlier_run_follow_to_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        ug.generate(ug.load_config(["source.limit=2", "output.pairs_per_shard=1", "n_jobs=2", "out=ds"]))
    first, second = (sorted((tmp_path / name / "ds" / "shards").iterdir()) for name in ("first", "second"))
    assert [path.name for path in first] == [path.name for path in second]
    assert len(second) == 2
