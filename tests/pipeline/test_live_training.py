"""Live pairs in a training: stored bytes in any loader, new noise in each epoch, the same stream after a kill."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.kinds import KINDS, Kind

import unprocess_gen as ug
from unprocess_gen.core.files import array_xxh3

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]
Items = list[tuple[str, str, dict[str, Any], dict[str, str]]]


def contents(sample: Any) -> tuple[str, str, dict[str, Any], dict[str, str]]:
    """Digests of the frames, row, and digests of the targets."""
    targets = {name: array_xxh3(target) for name, target in sample.targets.items()}
    return array_xxh3(sample.clean), array_xxh3(sample.noisy), dict(sample.row), targets


def items_of(pairs: Any) -> Items:
    return [contents(pairs[number]) for number in range(len(pairs))]


@pytest.mark.parametrize("kind", KINDS)
def test_epoch_0_is_the_stored_dataset(kind: str, made_kind: Kind, tmp_path: Path) -> None:
    stored = ug.RawPairs(made_kind(kind))
    names = list(stored[0].targets)
    for redraw in ("noise", "all", "none"):
        live = ug.LivePairs(made_kind(kind), redraw=redraw, cache=tmp_path / "cache", targets=names)
        assert items_of(live) == items_of(stored), redraw
    for split in {str(sample.row["split"]) for sample in stored} if kind == "split" else ():
        live = ug.LivePairs(made_kind(kind), split=split)
        assert items_of(live) == items_of(ug.RawPairs(made_kind(kind), split=split))


@pytest.mark.filterwarnings("ignore:This DataLoader will create 4 worker processes:UserWarning")
@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.parametrize("workers", [0, 1, 2, 4])
def test_loaders_give_the_same_items(workers: int, method: str, made_kind: Kind, tmp_path: Path) -> None:
    """Persistent workers and two ranks read two epochs in random order; epoch 0 is the stored dataset."""
    data = pytest.importorskip("torch.utils.data", reason="PyTorch is not installed")
    folders = [made_kind(name) for name in ("two numbers", "night", "dark frames", "split", "clips")]
    live = ug.LivePairs(folders, cache=tmp_path / "cache")
    expected = {(0, number): contents(sample) for number, sample in enumerate(ug.RawPairs(folders))}
    expected |= {(1, number): contents(live[1, number]) for number in range(len(live))}
    seen = set()
    for rank in range(2):
        sampler = ug.EpochSampler(len(live), seed=5, rank=rank, world=2)
        options = {"multiprocessing_context": method, "persistent_workers": True} if workers else {}
        loader = data.DataLoader(live, batch_size=3, sampler=sampler, num_workers=workers, collate_fn=list, **options)
        for epoch in range(2):
            order = ug.EpochSampler(len(live), seed=5, rank=rank, world=2)
            order.set_epoch(epoch)
            loaded = [sample for batch in loader for sample in batch]
            for item, (clean, noisy, row) in zip(order, loaded, strict=True):
                assert (array_xxh3(clean), array_xxh3(noisy)) == expected[item][:2]
                assert row["key"] == expected[item][2]["key"]
                seen.add(item)
    assert seen == set(expected)


def test_default_batches_have_frames_rows_and_targets(made_kind: Kind) -> None:
    data = pytest.importorskip("torch.utils.data", reason="PyTorch is not installed")
    folders = [made_kind(name) for name in ("two numbers", "night", "gray mean, no noise", "split")]
    live = ug.LivePairs(folders, patch=8, targets=["noise_std", "linear_rgb"])
    (clean, noisy, row, targets) = next(iter(data.DataLoader(live, batch_size=len(live), num_workers=1)))
    for number in range(len(live)):
        sample = live[number]
        np.testing.assert_array_equal(clean[number], sample.clean)
        np.testing.assert_array_equal(noisy[number], sample.noisy)
        assert row["a_dn"][number] == sample.row["a_dn"]
        assert row["camera"][number] == sample.row["camera"]
        for name in targets:
            np.testing.assert_array_equal(targets[name][number], sample.targets[name])
    (single,) = data.DataLoader(live, batch_size=None, sampler=[(1, 0)])
    assert single.row["key"] == live[1, 0].row["key"]


@pytest.mark.parametrize("inputs", ["mosaic", "packed"])
@pytest.mark.parametrize("reader", [ug.RawPairs, ug.LivePairs])
def test_batches_of_inputs_equal_the_items(reader: Any, inputs: str, made_kind: Kind) -> None:
    """Persistent workers read two epochs; cameras, laws, dtypes, layouts and sizes of the frames differ."""
    data = pytest.importorskip("torch.utils.data", reason="PyTorch is not installed")
    folders = [made_kind(name) for name in ("two numbers", "random patches, packed", "float32", "float clean", "clips")]
    targets = {"targets": ["variance", "srgb"]} if reader is ug.LivePairs else {}
    pairs = reader(folders, inputs=inputs, noise_map=True, rows=True, patch=4, flip=True, **targets)
    order, sampler = (ug.EpochSampler(len(pairs), seed=1) for _ in range(2))
    loader = data.DataLoader(pairs, batch_size=3, sampler=sampler, num_workers=2, persistent_workers=True)
    epochs = []
    for _ in range(2):
        items = pairs.__getitems__([*order])
        batches = [*loader]
        for name in items[0].keys() - {"development", "row"}:
            values = np.concatenate([batch[name] for batch in batches])
            np.testing.assert_array_equal(values, np.stack([item[name] for item in items]))
        for number, field in enumerate(items[0]["development"]._fields):
            values = np.concatenate([getattr(batch["development"], field) for batch in batches])
            np.testing.assert_array_equal(values, np.stack([item["development"][number] for item in items]))
        for name in ("key", "pattern", "a_dn", "row_std_dn"):
            values = np.concatenate([batch["row"][name] for batch in batches])
            np.testing.assert_array_equal(values, np.array([item["row"][name] for item in items]))
        epochs.append({item["row"]["key"]: item["noisy"].tobytes() for item in items})
    assert epochs[0].keys() == epochs[1].keys() and epochs[0] != epochs[1]


@pytest.mark.parametrize("kind", ["two numbers", "night"])
def test_10_000_items_differ(kind: str, made_kind: Kind) -> None:
    live = ug.LivePairs(made_kind(kind), cache="memory")
    epochs = -(-10_000 // len(live))
    digests = {array_xxh3(live[item].noisy) for item in itertools.product(range(epochs), range(len(live)))}
    assert len(digests) == epochs * len(live) >= 10_000


TRAINING = """
import sys
import unprocess_gen as ug
from unprocess_gen.core.files import array_xxh3
live = ug.LivePairs(sys.argv[1], redraw="all")
sampler = ug.EpochSampler(len(live), seed=2)
sampler.state = int(sys.argv[2]), int(sys.argv[3])
while sampler.state[0] < 40:
    for item in sampler:
        print(*item, array_xxh3(live[item].noisy), flush=True)
"""


def test_a_killed_training_goes_on_with_the_same_stream(made_kind: Kind) -> None:
    folder, rng, lines = made_kind("patches, levels and draws"), np.random.default_rng(0), list[str]()
    length = len(ug.LivePairs(folder))
    expected = training(folder, (0, 0))
    assert len(set(expected)) == 40 * length
    for _ in range(8):
        lines += training(folder, divmod(len(lines), length), float(rng.uniform(0.01, 0.3)))
    lines += training(folder, divmod(len(lines), length))
    assert lines == expected


def training(folder: Path, state: tuple[int, int], seconds: float | None = None) -> list[str]:
    """Return what a training prints until its end, or until it is killed so many seconds after its first item."""
    command = [sys.executable, "-c", TRAINING, str(folder), *map(str, state)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        if seconds is not None:
            time.sleep(seconds)
            process.send_signal(signal.SIGKILL)
        rest = process.stdout.read()
    text = first + rest
    return text[: text.rfind("\n") + 1].splitlines()
