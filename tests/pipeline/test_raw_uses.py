"""Raw sources have the uses of photographs: clips, levels, parts, clusters, stores and pictures."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import object_store as servers
from helpers.cases import slow_except
from helpers.commands import RunMain
from helpers.dask_cluster import dask_cluster
from helpers.datasets import TreeHash

import unprocess_gen as ug
from unprocess_gen.core.object_store import ObjectPath

SETTINGS = (
    "source.kind=raw", "source.clips=true", "source.raw.pattern=GRBG", "source.raw.black_dn=501",
    "source.raw.white_dn=15001", "source.patch=[random,32,2]", "noise.draws=2", "split={train: 0.5, val: 0.5}",
    "noise=heteroscedastic", "noise.levels=[{a: 2, b: 4}, {a: 6, b: 20}]", "output.pairs_per_shard=2", "n_jobs=1",
)  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with two clips of three numbered raw frames each, and their dataset ds."""
    folder = tmp_path_factory.mktemp("raw")
    for clip in "ab":
        (folder / "clips" / clip).mkdir(parents=True)
        for number in range(3):
            dn = np.random.default_rng(ord(clip) + number).integers(500, 15000, (48, 64)).astype(np.uint16)
            assert cv2.imwrite(str(folder / "clips" / clip / f"{number:04}.png"), dn)
    ug.generate(ug.load_config([*SETTINGS, f"source.root={folder / 'clips'}", f"out={folder / 'ds'}"]))
    return folder


def test_clips_levels_draws_and_splits_are_in_the_rows(made: Path) -> None:
    rows = [pair.row for pair in ug.RawPairs(made / "ds")]
    assert len(rows) == 6 * 2 * 2 * 2
    for clip in "ab":
        of_clip = [row for row in rows if row["source"].startswith(f"{clip}/")]
        assert {row["frame"] for row in of_clip} == {0, 1, 2}
        for name in ("patch_y", "patch_x"):
            assert len({row[name] for row in of_clip if row["patch"] == 0}) == 1
        for name in ("split", "bits"):
            assert len({row[name] for row in of_clip}) == 1
    assert {(row["level"], row["draw"]) for row in rows} == {(0, 0), (0, 1), (1, 0), (1, 1)}
    assert {(row["bits"], row["black_level_dn"]) for row in rows} == {(14, 501)}


USES = {
    "regenerate": (("verify", "ds", "--regenerate", "8"), "8 pairs regenerated, bit for bit"),
    "replay": (("replay", "ds", "source.root=clips"), "0 are not"),
    "preview": (("preview", "ds", "--keys", "0", "--to", "pictures"), "pictures"),
    "dng": (("dng", "ds", "--keys", "0", "--to", "dngs"), "16 DNG files written"),
    "report": (("report", "ds"), "report.html"),
    "noise": (("verify", "ds", "--noise"), "0 wrong"),
    "again": (("again", "ds", "out=copy"), "the same as ds, bit for bit"),
    "plan": (("plan", *SETTINGS[:6], "source.root=clips"), "on this sensor (black 501, white 15001)"),
}


@pytest.mark.parametrize("use", slow_except(("regenerate", "preview", "dng", "plan"), USES))
def test_commands_accept_datasets_of_raw_frames(use: str, made: Path, run_main: RunMain, tmp_path: Path) -> None:
    for name in ("ds", "clips"):
        shutil.copytree(made / name, tmp_path / name)
    arguments, expected = USES[use]
    done = run_main(*arguments)
    assert (done.code, expected in done.out) == (0, True), done


def test_lost_shard_is_repaired(made: Path, run_main: RunMain, tmp_path: Path, tree_hash: TreeHash) -> None:
    ds = shutil.copytree(made / "ds", tmp_path / "ds")
    (ds / "shards/shard-00001.tar").unlink()
    assert run_main("verify", "ds", "--repair").code == 0
    assert tree_hash(ds) == tree_hash(made / "ds")


def test_parts_make_the_bytes_of_one_run(made: Path, run_main: RunMain, tmp_path: Path, tree_hash: TreeHash) -> None:
    settings = *SETTINGS, f"source.root={made / 'clips'}", "out=ds"
    calls = ("part", "0/2", *settings), ("part", "1/2", *settings), ("merge", "ds")
    assert [run_main(*call).code for call in calls] == [0] * 3
    assert tree_hash(tmp_path / "ds") == tree_hash(made / "ds")


@pytest.mark.slow
def test_clusters_and_stores_make_the_bytes_of_one_run(
    made: Path, bucket: ObjectPath, run_main: RunMain, tmp_path: Path, tree_hash: TreeHash
) -> None:
    servers.upload(made / "clips", bucket / "clips")
    with dask_cluster(tmp_path) as cluster:
        done = run_main(*SETTINGS, f"source.root={made / 'clips'}", "out=ds", *cluster.overrides)
    assert (done.code, tree_hash(tmp_path / "ds")) == (0, tree_hash(made / "ds")), done.err
    done = run_main(*SETTINGS, f"source.root={bucket / 'clips'}", f"out={bucket / 'ds'}")
    assert done.code == 0, done.err
    facts = [json.loads((place / "dataset.json").read_bytes()) for place in (bucket / "ds", made / "ds")]
    assert facts[0]["shards"] == facts[1]["shards"]
    assert not ug.verify(str(bucket / "ds"))
