"""The size of a run is estimated from image headers, and a run that does not fit the disk is refused at its start."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, Settings
from helpers.photographs import fill, pixels
from helpers.processes import ONE
from PIL import Image

from unprocess_gen.pipeline import sizes


@pytest.mark.parametrize(
    "overrides",
    [
        ("noise.levels=3", "noise.draws=2", "source.patch=[random,10,3]"),
        ("output.layout=packed", "output.dtype=float32", "output.targets=[linear_rgb]"),
    ],
)
def test_estimate_is_the_arrays_and_8_kb_a_pair(
    overrides: tuple[str, ...], settings: Settings, make: Make, tmp_path: Path
) -> None:
    (tmp_path / "p").mkdir()
    Image.fromarray(pixels(0, 40, 62)).save(tmp_path / "p" / "a.png")
    made = make(tmp_path / "p", tmp_path / "ds", *overrides)
    assert abs(sizes.source_bytes(settings(*overrides), 40, 62) - made.bytes) <= 8000 * made.pairs


@pytest.fixture
def little_space(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sizes, "free_bytes", lambda path: 20_000)


@pytest.mark.usefixtures("little_space")
def test_run_larger_than_the_disk_is_refused_with_5(tmp_path: Path, run_main: RunMain) -> None:
    (fill(tmp_path / "p", 4) / "000.png").write_bytes(b"not a photograph")
    done = run_main("source.root=p", ONE, "n_jobs=1")
    assert (done.code, done.out, done.err.count("\n")) == (5, "", 1)
    found = re.fullmatch(
        r"gen-dataset: out=ds: not enough disk space for 4 sources; expected about (\d+) free bytes, found 20000; free "
        r"space, choose another out, or set check_disk=false to start anyway\n",
        done.err,
    )
    assert found and 20_000 < int(found[1]) < 60_000
    assert list((tmp_path / "ds").iterdir()) == []
    assert run_main("source.root=p", ONE, "n_jobs=1", "source.max_failed=1", "check_disk=false").code == 0


def test_resumed_run_needs_space_only_for_missing_shards(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = fill(tmp_path / "p", 3)
    with monkeypatch.context() as patch:
        patch.setattr("unprocess_gen.pipeline.generate._finish", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            make(source, tmp_path / "ds", ONE)
    (tmp_path / "ds/shards/shard-00001.tar").unlink()
    monkeypatch.setattr(sizes, "free_bytes", lambda path: 20_000)
    assert make(source, tmp_path / "ds", ONE).made == 1


def test_scenes_and_folders_that_do_not_exist_yet_are_measured(make: Make, tmp_path: Path) -> None:
    assert make(None, tmp_path / "does/not/exist", "source.limit=1").pairs == 1
