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
from helpers.dark_frames import save_frames
from helpers.datasets import Make
from helpers.photographs import fill
from PIL import Image

import unprocess_gen as ug
from unprocess_gen.core.files import array_xxh3

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]
KINDS = {
    "two numbers": ("noise=imx385_iso3200",),
    "poisson law": ("noise=heteroscedastic", "noise.a=3", "noise.b=20", "noise.law=poisson"),
    "random levels": ("noise=brooks2019", "camera=choice"),
    "night": ("noise=sony_a7s2", "scene=night"),
    "every effect": ("noise=nikon_d850", "scene=low_light", "effects.all=on", "noise.full_well_e=60000"),
    "patches, levels and draws": ("noise=sony_a7s2", "noise.levels=[1600,3200]", "noise.draws=2", "source.patch=8"),
    "random patches, packed": ("noise=imx385_iso3200", "output.layout=packed", "source.patch=[random,8,3]"),
    "float32": ("noise=sony_a7s2", "scene=daylight", "output.dtype=float32"),
    "float clean": ("noise=imx385_iso3200", "output.clean_dtype=float32"),
    "fixed patterns in clean": ("noise=sony_a7s2", "effects.prnu=on", "clean.includes_fixed_pattern=true"),
    "reference": ("noise=imx385_iso3200", "accuracy=reference"),
    "fast": ("noise=imx385_iso3200", "accuracy=fast"),
    "gray mean, no noise": ("noise=none", "gains.highlight=gray_mean", "isp=srgb"),
    "downscaled, dithered": ("noise=imx385_iso3200", "source.downscale=2", "source.dequantize=dither"),
    "targets": ("noise=sony_a7s2", "output.targets=[linear_rgb]"),
    "split": ("noise=imx385_iso3200", "split={train: 0.5, test: 0.5}"),
}
Items = list[tuple[str, str, dict[str, Any], dict[str, str]]]


@pytest.fixture(scope="module")
def made(make: Make, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A dataset of each kind of three photographs; also of clips, of synthetic pictures and of dark frames."""
    folder = tmp_path_factory.mktemp("kinds")
    fill(folder / "photos", 3)
    for clip, number in itertools.product(("a", "b"), range(2)):
        (folder / "clips" / clip).mkdir(parents=True, exist_ok=True)
        pixels = np.random.default_rng(number).integers(0, 256, (40, 50, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / "clips" / clip / f"{number}.png")
    save_frames(folder / "darks", 3)
    sources = dict.fromkeys(KINDS, folder / "photos") | {"clips": folder / "clips", "scenes": None, "dark frames": None}
    kinds = KINDS | {
        "clips": ("noise=sony_a7s2", "scene=night", "source.clips=true"),
        "scenes": ("noise=imx385_iso3200", "source.limit=2"),
        "dark frames": DARK_FRAMES,
    }
    sources["dark frames"] = folder / "photos"
    datasets = {}
    for name, overrides in kinds.items():
        more = [f"noise.dark_frames={folder / 'darks'}"] if name == "dark frames" else []
        make(sources[name], folder / "ds" / name, *overrides, *more, "n_jobs=1")
        datasets[name] = folder / "ds" / name
    return datasets


DARK_FRAMES = ("noise=sony_a7s2", "noise.iso=1600", "sensor=generic_14bit")


def contents(sample: Any) -> tuple[str, str, dict[str, Any], dict[str, str]]:
    """Digests of the frames, row, and digests of the targets."""
    targets = {name: array_xxh3(target) for name, target in sample.targets.items()}
    return array_xxh3(sample.clean), array_xxh3(sample.noisy), dict(sample.row), targets


def items_of(pairs: Any) -> Items:
    return [contents(pairs[number]) for number in range(len(pairs))]


def test_epoch_0_is_the_stored_dataset(made: dict[str, Path], tmp_path: Path) -> None:
    for name, folder in made.items():
        stored = ug.RawPairs(folder)
        names = list(stored[0].targets)
        for redraw in ("noise", "all", "none"):
            live = ug.LivePairs(folder, redraw=redraw, cache=tmp_path / "cache", targets=names)
            assert items_of(live) == items_of(stored), (name, redraw)
    for split in ("train", "test"):
        folder = made["split"]
        if split in {sample.row["split"] for sample in ug.RawPairs(folder)}:
            assert items_of(ug.LivePairs(folder, split=split)) == items_of(ug.RawPairs(folder, split=split))


@pytest.mark.filterwarnings("ignore:This DataLoader will create 4 worker processes:UserWarning")
@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.parametrize("workers", [0, 1, 2, 4])
def test_loaders_give_the_same_items(workers: int, method: str, made: dict[str, Path], tmp_path: Path) -> None:
    """Persistent workers and two ranks read two epochs in random order; epoch 0 is the stored dataset."""
    data = pytest.importorskip("torch.utils.data", reason="PyTorch is not installed")
    folders = [made[name] for name in ("two numbers", "night", "dark frames", "split", "clips")]
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


def test_default_batches_have_frames_rows_and_targets(made: dict[str, Path]) -> None:
    data = pytest.importorskip("torch.utils.data", reason="PyTorch is not installed")
    folders = [made[name] for name in ("two numbers", "night", "gray mean, no noise", "split")]
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


@pytest.mark.parametrize("kind", ["two numbers", "night"])
def test_10_000_items_differ(kind: str, made: dict[str, Path]) -> None:
    live = ug.LivePairs(made[kind], cache="memory")
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


def test_a_killed_training_goes_on_with_the_same_stream(made: dict[str, Path]) -> None:
    folder, rng, lines = made["patches, levels and draws"], np.random.default_rng(0), list[str]()
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
