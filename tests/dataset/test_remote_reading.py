"""Datasets in an object store: read, verified, replayed and reported as those in a folder."""

from __future__ import annotations

import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers import object_store as servers
from helpers.commands import RunMain
from helpers.object_store import Proxy

import unprocess_gen as ug
from unprocess_gen.core.errors import DamageError
from unprocess_gen.core.object_store import ObjectPath


@pytest.fixture
def remote(dataset: Path, bucket: ObjectPath) -> ObjectPath:
    """Return the URL of a copy of `dataset`."""
    servers.upload(dataset, bucket / "made" / "ds")
    return bucket / "made" / "ds"


def test_pairs_of_a_url_equal_those_of_the_folder(dataset: Path, remote: ObjectPath) -> None:
    local, pairs = ug.RawPairs(dataset), pickle.loads(pickle.dumps(ug.RawPairs(str(remote))))
    assert len(pairs) == len(local) and repr(pairs) == f"RawPairs('{remote}', length={len(local)})"
    assert pairs.dataset == local.dataset
    for one, other in zip(pairs, local, strict=True):
        assert one.row == other.row and one.clean.dtype == other.clean.dtype
        np.testing.assert_array_equal(one.clean, other.clean)
        np.testing.assert_array_equal(one.noisy, other.noisy)
    pairs[0].clean[0, 0] += 1  # arrays can be written to, and the dataset keeps its bytes
    np.testing.assert_array_equal(pairs[0].clean, local[0].clean)


def test_a_pair_takes_four_requests_once_its_shard_is_known(remote: ObjectPath, proxy: Proxy) -> None:
    pairs = ug.RawPairs(str(remote))
    _ = pairs[0]
    proxy.requests.clear()
    _ = pairs[1]
    assert len(proxy.requests) == 4


def test_sweep_of_a_url_is_read(dataset: Path, bucket: ObjectPath) -> None:
    servers.upload(dataset, bucket / "sweep" / "a")
    (bucket / "sweep" / "sweep.csv").write_bytes(b"folder,exit\na,0\nb,2\n")
    assert set(ug.RawPairs(str(bucket / "sweep")).dataset) == {"a"}


def test_missing_manifest_of_a_url_is_damage(bucket: ObjectPath) -> None:
    with pytest.raises(DamageError, match=f"{bucket}/none/manifest.csv: no such manifest"):
        ug.RawPairs(str(bucket / "none"))


def test_damage_of_a_url_is_found(dataset: Path, remote: ObjectPath, tmp_path: Path) -> None:
    copy = tmp_path / "ds"
    shutil.copytree(dataset, copy)
    content = bytearray((copy / "shards/shard-00001.tar").read_bytes())
    content[700] ^= 1
    (copy / "shards/shard-00001.tar").write_bytes(content)
    (copy / "shards/foreign").write_bytes(b"1")
    (copy / "shards/shard-00002.tar").unlink()
    for name in ("shard-00001.tar", "foreign"):
        (remote / "shards" / name).write_bytes((copy / "shards" / name).read_bytes())
    (remote / "shards" / "shard-00002.tar").delete()
    assert [str(damage) for damage in ug.verify(str(remote))] == [str(damage) for damage in ug.verify(copy)]


@pytest.mark.parametrize(
    ("arguments", "result"),
    [
        (("replay", "{}", "--keys", "0-2"), "3 pairs are the same, bit for bit; 0 are not"),
        (("replay", "{}/manifest.csv", "--keys", "1"), "1 pair is the same, bit for bit; 0 are not"),
        (("dng", "{}", "--keys", "2", "--to", "dng"), "dng: 2 DNG files written"),
        (("preview", "{}", "--keys", "4", "--to", "sheets"), "1 picture in sheets"),
        (("report", "{}", "--to", "page.html"), "page.html"),
        (("again", "{}", "out=again", "n_jobs=1"), "the same as {}, bit for bit"),
        (("verify", "{}", "--noise"), "{} is intact"),
        (("verify", "{}", "--regenerate", "2"), "{} is intact; 2 pairs regenerated, bit for bit"),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_verbs_read_datasets_of_a_url(
    arguments: tuple[str, ...], result: str, remote: ObjectPath, run_main: RunMain
) -> None:
    done = run_main(*(word.format(remote) for word in arguments))
    assert done.code == 0, done.err
    assert result.format(remote) in done.out


@pytest.mark.parametrize(
    ("arguments", "code", "error"),
    [
        (("verify", "{}/none"), 2, "verify: {}/none: no such folder"),
        (("verify", "{}", "--repair"), 0, ""),
        (("report", "{}"), 2, "report: {} is in an object store; expected a local file; give --to FILE"),
        (("replay", "s3://no-such-bucket/ds"), 5, "s3://no-such-bucket/ds: the bucket no-such-bucket does not exist"),
    ],
    ids=["missing", "repair of an intact dataset", "report without file", "bucket"],
)
def test_wrong_urls_end_in_one_line(
    arguments: tuple[str, ...], code: int, error: str, remote: ObjectPath, run_main: RunMain
) -> None:
    done = run_main(*(word.format(remote) for word in arguments))
    assert done.code == code
    assert error.format(remote) in done.err and done.err.count("\n") <= 1


def test_repair_of_a_url_is_refused(remote: ObjectPath, run_main: RunMain) -> None:
    (remote / "config.yaml").delete()
    done = run_main("verify", str(remote), "--repair")
    assert done.code == 2
    assert f"verify: --repair: {remote} is in an object store; expected a local copy of the dataset" in done.err
