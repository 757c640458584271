"""`LivePairs` makes the stored pairs in epoch 0, and others that depend only on (seed, epoch, number) afterwards."""

from __future__ import annotations

import functools
import multiprocessing
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.datasets import Make
from helpers.photographs import fill

import unprocess_gen as ug
from unprocess_gen.core.errors import ConfigError, MachineError, SourceError
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.core.random_streams import CLIP_FRAMES, EPOCHS, frame_word
from unprocess_gen.simulation.pair import make_pair, reference_pair
from unprocess_gen.simulation.self_test import _PHYSICAL, GOLDEN_PLAN
from unprocess_gen.sources import synthetic

LEVELS = (
    "noise=sony_a7s2",
    "noise.levels=[1600,3200]",
    "noise.draws=2",
    "source.patch=[random,64,2]",
    "source.limit=2",
)


@pytest.fixture(scope="module")
def night(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset of two scenes with a physical profile, in random patches."""
    out = tmp_path_factory.mktemp("night") / "ds"
    make(None, out, "noise=sony_a7s2", "scene=night", "source.limit=2", "source.patch=[random,64,2]")
    return out


def digests(live: ug.LivePairs, item: tuple[int, int]) -> tuple[str, str]:
    """Digests of the clean and of the noisy frame."""
    sample = live[item]
    return array_xxh3(sample.clean), array_xxh3(sample.noisy)


def assert_same(live: ug.LivePairs, stored: ug.RawPairs) -> None:
    """Compare all pairs of epoch 0 with the stored ones."""
    assert len(live) == len(stored)
    for number in range(len(stored)):
        made, read = live[number], stored[number]
        assert (made.clean.dtype, made.noisy.dtype) == (read.clean.dtype, read.noisy.dtype)
        np.testing.assert_array_equal(made.clean, read.clean)
        np.testing.assert_array_equal(made.noisy, read.noisy)
        assert made.row == read.row


def test_epoch_0_of_overrides_is_the_dataset_that_they_give(make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", *LEVELS)
    assert_same(ug.LivePairs(LEVELS, redraw="all"), ug.RawPairs(tmp_path / "ds"))


def test_each_epoch_has_new_noise_and_the_same_clean_frames(night: Path) -> None:
    live = ug.LivePairs(night, cache="memory")
    items = [(epoch, number) for epoch in (*range(10), EPOCHS - 1) for number in range(len(live))]
    made = {item: digests(live, item) for item in items}
    assert len({noisy for _, noisy in made.values()}) == len(items)
    assert all(clean == made[0, number][0] for (_, number), (clean, _) in made.items())
    assert digests(ug.LivePairs(night, redraw="none"), (7, 1)) == made[0, 1]


def test_all_redraws_parameters_and_patches_and_keeps_the_body(night: Path) -> None:
    live = ug.LivePairs(night, redraw="all")
    rows = [live[epoch, 0].row for epoch in range(3)]
    for name in ("red_gain", "w_sony_a7r", "exposure_ratio", "noisy_xxh3", "clean_xxh3"):
        assert len({row[name] for row in rows}) == 3, name
    assert len({(row["patch_y"], row["patch_x"]) for row in rows}) == 3
    for name in ("stream_key", "source_sha256", "key", "sensor_unit", "body_key", "split"):
        assert len({row.get(name) for row in rows}) == 1, name
    assert [row.get("epoch") for row in rows] == [None, 1, 2]


def test_second_epoch_without_numbers_warns_once(night: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    live, repeated = ug.LivePairs(night), ug.LivePairs(night, redraw="none")
    for pairs in (live, repeated):  # a loop asks for an item after the last one too
        assert len(list(pairs)) == len(pairs)
    live[0, 0], repeated[0]
    with pytest.warns(UserWarning, match="sampler=EpochSampler") as warned:
        live[0]
    live[1]
    assert len(warned) == 1
    pickle.loads(pickle.dumps(live))[0]
    monkeypatch.setattr(multiprocessing, "parent_process", multiprocessing.current_process)
    with pytest.warns(UserWarning, match="sampler=EpochSampler"):  # a worker process knows nothing of other epochs
        pickle.loads(pickle.dumps(live))[0]


def test_fixed_patterns_are_the_same_in_every_epoch() -> None:
    plan = _PHYSICAL.replace(effects=("prnu", "column", "dsnu", "dead_pixels", "quantise"))
    first, later = (make_pair(_codes(), plan.replace(epoch=epoch)) for epoch in (0, 5))
    np.testing.assert_array_equal(first.noisy, later.noisy)


@pytest.mark.parametrize("plan", [GOLDEN_PLAN, _PHYSICAL], ids=["two numbers", "physical"])
def test_kernels_equal_the_reference_in_a_later_epoch(plan: Any) -> None:
    made, expected = (make(_codes(), plan.replace(epoch=3)) for make in (make_pair, reference_pair))
    np.testing.assert_array_equal(made.clean, expected.clean)
    np.testing.assert_array_equal(made.noisy, expected.noisy)
    assert array_xxh3(made.noisy) != array_xxh3(make_pair(_codes(), plan).noisy)


def test_an_epoch_has_words_of_its_own() -> None:
    words = {frame_word(frame, epoch) for frame in (0, 1, CLIP_FRAMES - 1) for epoch in (0, 1, EPOCHS - 1)}
    assert len(words) == 9
    assert frame_word(2**32 - 1) == 2**32 - 1
    for frame, epoch in ((CLIP_FRAMES, 1), (0, EPOCHS), (0, -1)):
        with pytest.raises(ValueError, match="out of range"):
            frame_word(frame, epoch)


@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_items_depend_on_no_process_and_no_order(method: str, night: Path, tmp_path: Path) -> None:
    live = ug.LivePairs(night, redraw="all", cache=tmp_path / "cache", patch=32)
    items = [(epoch, number) for epoch in (3, 0, 2) for number in range(len(live))]
    with multiprocessing.get_context(method).Pool(2) as pool:
        made = pool.map(functools.partial(digests, live), items, chunksize=1)
    again = pickle.loads(pickle.dumps(live))
    assert made[::-1] == [digests(again, item) for item in items[::-1]]


@pytest.mark.parametrize("redraw", ["noise", "all"])
def test_a_patch_is_the_crop_of_the_pair(redraw: str, dataset: Path) -> None:
    number = next(n for n, sample in enumerate(ug.RawPairs(dataset)) if min(sample.clean.shape) > 15)
    complete, cut = (ug.LivePairs(dataset, redraw=redraw, patch=side) for side in (None, 8))
    places = set()
    for epoch in range(4):
        crop, pair = cut[epoch, number], complete[epoch, number]
        y, x = crop.row["patch_y"], crop.row["patch_x"]
        assert (y % 2, x % 2, crop.row["width"], crop.row["height"]) == (0, 0, 8, 8)
        np.testing.assert_array_equal(crop.clean, pair.clean[y : y + 8, x : x + 8])
        np.testing.assert_array_equal(crop.noisy, pair.noisy[y : y + 8, x : x + 8])
        places.add((y, x))
    assert len(places) > 1


def test_light_and_targets(night: Path) -> None:
    names = ["variance", "noise_std", "srgb"]
    sample, stored = (ug.LivePairs(night, inputs=inputs, targets=names)[1, 2] for inputs in ("mosaic", None))
    row = stored.row
    span = row["white_level_dn"] - row["black_level_dn"]
    np.testing.assert_array_equal(sample["noisy"], ug.to_light(stored.noisy, row))
    np.testing.assert_array_equal(stored.targets["noise_std"], ug.noise_std(stored.noisy, row))
    assert "prnu" not in row["effects"]
    law = row["a_dn"] * (stored.clean.astype(float) - row["black_level_dn"]) + row["dark_variance_dn2"]
    np.testing.assert_allclose(stored.targets["variance"], law, rtol=1e-6)
    np.testing.assert_allclose(sample["variance"], law / span**2, rtol=1e-5)
    y, x = row["patch_y"], row["patch_x"]
    photograph = synthetic.picture(str(row["source"]))[y : y + 64, x : x + 64]
    np.testing.assert_array_equal(sample["srgb"], photograph)


def test_pixels_are_decoded_once_up_to_the_bound(tmp_path: Path, make: Make) -> None:
    fill(tmp_path / "photos", 3)
    make(tmp_path / "photos", tmp_path / "ds")
    stored = ug.RawPairs(tmp_path / "ds")
    size = stored[0].clean.size * 3 + 200
    live = ug.LivePairs(tmp_path / "ds", cache=tmp_path / "cache", cache_bytes=2 * size)
    assert_same(live, stored)
    files = sorted((tmp_path / "cache").iterdir())
    assert 1 <= len(files) <= 2
    assert sum(file.stat().st_size for file in files) <= 2 * size
    files[0].write_bytes(files[0].read_bytes()[:-99])
    unbounded = ug.LivePairs(tmp_path / "ds", redraw="none", cache=tmp_path / "cache")
    assert_same(unbounded, stored)
    for photograph in (tmp_path / "photos").iterdir():
        photograph.unlink()
    assert_same(unbounded, stored)


def test_datasets_are_joined_and_split(make: Make, tmp_path: Path) -> None:
    for name, seed in (("a", 0), ("b", 1)):
        make(None, tmp_path / name, "source.limit=4", f"seed={seed}", "split={train: 0.5, test: 0.5}")
    folders = [tmp_path / "a", tmp_path / "b"]
    assert_same(ug.LivePairs(folders), ug.RawPairs(folders))
    assert_same(ug.LivePairs([*map(str, folders)], split="test"), ug.RawPairs(folders, split="test"))
    with pytest.raises(ConfigError, match="LivePairs: split='val': no pair is in it"):
        ug.LivePairs(folders, split="val")


@pytest.mark.parametrize("setting", ["source.patch=null", "source.clips=true", "source.patch=[random,8,2]"])
def test_split_of_overrides_is_that_of_their_dataset(setting: str, make: Make, tmp_path: Path) -> None:
    for folder in range(4):
        photos = fill(tmp_path / f"photos/{folder}", 2, 2 * folder).parent
        shutil.copy(photos / "0/000.png", photos / f"{folder}/copy.png")
    overrides = [setting, "split={a: 0.4, 1: 0.6}", "noise.draws=2"]
    make(photos, tmp_path / "ds", *overrides)
    for split in ("a", "1"):
        assert_same(ug.LivePairs(overrides, photos, split=split), ug.RawPairs(tmp_path / "ds", split=split))


def test_split_that_overrides_do_not_give_is_refused() -> None:
    settings = ["source.limit=8", "split={train: 0.5, test: 0.5}"]
    assert sum(len(ug.LivePairs(settings, split=split)) for split in ("train", "test")) == 8
    with pytest.raises(ConfigError, match=r"split='val': no pair is in it; expected one of test, train$"):
        ug.LivePairs(settings, split="val")
    with pytest.raises(ConfigError, match="split='val': no pair is in it; there are no splits; set split="):
        ug.LivePairs(settings[:1], split="val")


def test_keys_and_columns_select_pairs_with_the_same_noise(night: Path) -> None:
    live = ug.LivePairs(night, redraw="all", patch=16)
    part = live[1:].select(patch=1)
    assert [row["key"] for row in part.rows] == ["00000000-p0001", "00000001-p0001"]
    for key, number in (("00000000-p0001", 1), ("00000001-p0001", 3)):
        assert digests(part, (2, key)) == digests(live, (2, key)) == digests(live, (2, number))
    planned = ug.LivePairs(LEVELS)
    rows = [planned[number].row for number in range(len(planned))]
    assert [planned[row["key"]].row for row in rows] == rows
    several = ug.LivePairs(night, patch=16, patches=3)
    assert digests(several.select(patch=1), (1, 4)) == digests(several, (1, 10))
    for live, key in ((planned, "00000000-p0000"), (several, "00000000-p0001"), (several, slice(3))):
        with pytest.raises(KeyError, match=r"names 4 pairs|an item is one patch of a pair; expected its number"):
            live[key]
    with pytest.raises(ConfigError, match="gen-dataset manifest"):
        planned.select(iso=1600)


def test_several_patches_of_a_pair_are_consecutive_items(night: Path) -> None:
    live, complete = ug.LivePairs(night, patch=16, patches=3), ug.LivePairs(night)
    assert len(live) == 3 * len(complete)
    sampler = ug.EpochSampler(len(live), block=3)
    assert sorted(sampler) == [(0, number) for number in range(len(live))]
    order = [number for _, number in sampler]
    assert all(order[n + k] == order[n] + k and order[n] % 3 == 0 for n in range(0, len(order), 3) for k in range(3))
    crops = [live[2, number] for number in range(3)]
    assert len({(crop.row["patch_y"], crop.row["patch_x"]) for crop in crops}) == 3
    corner = complete[2, 0].row
    for crop in crops:
        y, x = (crop.row[f"patch_{axis}"] - corner[f"patch_{axis}"] for axis in "yx")
        np.testing.assert_array_equal(crop.noisy, complete[2, 0].noisy[y : y + 16, x : x + 16])


def test_a_changed_source_is_reported(tmp_path: Path, make: Make) -> None:
    fill(tmp_path / "photos", 2)
    make(tmp_path / "photos", tmp_path / "ds")
    first = sorted((tmp_path / "photos").iterdir())[0]
    first.write_bytes(first.read_bytes() + b"\0")
    with pytest.raises(MachineError, match="changed since it was listed"):
        ug.LivePairs(tmp_path / "ds")[0]
    first.write_bytes(b"no image")
    with pytest.raises(SourceError):
        ug.LivePairs(ug.load_config(), root=tmp_path / "photos")[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"redraw": "some"}, "redraw='some': unknown; expected one of noise, all, none"),
        ({"targets": ["depth"]}, "targets="),
        ({"patch": 7}, "patch=7: out of range"),
        ({"patches": 2}, "patches=2: out of range"),
        ({"cache": "/dev/null/cache"}, "cannot be created"),
    ],
)
def test_bad_arguments_are_refused_in_one_line(arguments: dict[str, Any], message: str, dataset: Path) -> None:
    with pytest.raises(ConfigError, match=message) as refusal:
        ug.LivePairs(dataset, **arguments)
    assert "\n" not in str(refusal.value)


def test_grids_and_items_out_of_range_are_refused(dataset: Path) -> None:
    with pytest.raises(ConfigError, match="depends on the sizes of the images"):
        ug.LivePairs(["source.patch=64"])
    live = ug.LivePairs(dataset, patch=4096)
    with pytest.raises(ConfigError, match="patch=4096: exceeds a pair"):
        live[0]
    for item in (13, (EPOCHS, 0), (-1, 0)):
        with pytest.raises(IndexError):
            live[item]


def _codes() -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.random.default_rng(1).integers(0, 256, (33, 131, 3), dtype=np.uint8)
