"""Live bursts are the stored ones in epoch 0, and new bursts of the same picture later."""

import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unprocess_gen as ug
from unprocess_gen.core.errors import ConfigError, DamageError

NIGHT = ["body=sony_a7s2", "scene=night", "source.burst={frames: 3, ev: [0, -2], phase: corner, downscale: 2}"]
SETTINGS = {
    "patches": ["source.burst={frames: 3}", "source.patch=[random,256,2]", "noise.draws=2"],
    "packed_at_night": [*NIGHT, "source.patch=[random,128,1]", "output.layout=packed"],
    "linear": ["source=linear", "source.burst={frames: 3, ev: [0, 2], downscale: 2}", "source.patch=[random,128,1]"],
}
"""Settings: several draws, a physical profile with packed frames, and linear sources."""


@pytest.fixture(scope="module", params=SETTINGS)
def dataset(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """Folder and settings of a dataset of bursts."""
    folder = tmp_path_factory.mktemp(request.param) / "ds"
    settings = [*SETTINGS[request.param], "source.limit=2", "output.targets=[linear_rgb]", "n_jobs=1"]
    ug.generate(ug.load_config([*settings, f"out={folder}"]))
    return folder, settings


def same(one: Any, other: Any) -> bool:
    """True if frames and target of two bursts have the same bytes."""
    arrays = ((getattr(burst, name) for name in ("clean", "noisy", "target")) for burst in (one, other))
    return all(np.array_equal(*pair) for pair in zip(*arrays, strict=True))


def test_epoch_0_is_the_stored_dataset(dataset: tuple[Path, list[str]]) -> None:
    clips = ug.RawClips(dataset[0])
    for source in dataset:
        live = ug.LivePairs(source, redraw="all")
        assert len(live) == len(clips)
        for i, clip in enumerate(clips):
            assert same(live[0, i], clip)
            assert [row["noisy_xxh3"] for row in live[0, i].rows] == [row["noisy_xxh3"] for row in clip.rows]


def test_new_epochs_have_new_noise_or_motion(dataset: tuple[Path, list[str]]) -> None:
    stored = ug.RawClips(dataset[0])[1]
    noise, everything = (ug.LivePairs(dataset[0], redraw=redraw)[2, 1] for redraw in ("noise", "all"))
    assert np.array_equal(noise.clean, stored.clean)
    assert not np.array_equal(noise.noisy, stored.noisy)
    assert [row["motion_y"] for row in noise.rows] == [row["motion_y"] for row in stored.rows]
    assert all(a["motion_y"] != b["motion_y"] for a, b in zip(everything.rows[1:], stored.rows[1:], strict=True))
    assert [row["ev"] for row in everything.rows] == [row["ev"] for row in stored.rows]
    assert [row["exposure_s"] for row in everything.rows] == [row["exposure_s"] for row in stored.rows]


def test_items_depend_on_epoch_and_number_only(dataset: tuple[Path, list[str]]) -> None:
    live = ug.LivePairs(dataset[0], redraw="all", targets=["linear_rgb"])
    there = pickle.loads(pickle.dumps(live))
    assert same(there[3, 1], live[3, 1])
    assert same(ug.LivePairs(dataset[1], redraw="all", targets=["linear_rgb"])[3, 1], live[3, 1])


def test_a_crop_is_the_crop_of_the_burst_with_its_flow(dataset: tuple[Path, list[str]]) -> None:
    live, crops = (ug.LivePairs(dataset[0], redraw="all", targets=["linear_rgb"], patch=side) for side in (None, 32))
    burst, crop = live[1, 1], crops[1, 1]
    first, own = burst.rows[0], crop.rows[0]
    y, x = own["patch_y"] - first["patch_y"], own["patch_x"] - first["patch_x"]
    side = 2 if first["layout"] == "packed" else 1
    part = (..., slice(y // side, (y + 32) // side), slice(x // side, (x + 32) // side))
    assert np.array_equal(crop.clean, burst.clean[part])
    assert np.array_equal(crop.noisy, burst.noisy[part])
    step = first["burst_downscale"]
    assert np.array_equal(crop.target, burst.target[y * step : (y + 32) * step, x * step : (x + 32) * step])
    assert np.abs(ug.flow(crop.rows, 2) - ug.flow(burst.rows, 2)[:, y : y + 32, x : x + 32]).max() < 1e-9


@pytest.mark.parametrize("inputs", ["mosaic", "packed"])
def test_inputs_are_arrays_of_all_frames(dataset: tuple[Path, list[str]], inputs: str) -> None:
    options: dict[str, Any] = {"inputs": inputs, "noise_map": True, "rows": True}
    stored, live = ug.RawClips(dataset[0], **options), ug.LivePairs(dataset[0], targets=["linear_rgb"], **options)
    item, clip = stored[0], ug.RawClips(dataset[0])[0]
    assert item["noisy"].dtype == np.float32
    assert item["noisy"].shape[0] == item["noise_std"].shape[0] == len(item["row"]["iso"]) == 3
    assert np.array_equal(item["linear_rgb"], clip.target)
    assert item["motion"][:, 2].tolist() == [row["motion_y"] for row in clip.rows]
    assert all(np.array_equal(item[name], live[0, 0][name]) for name in ("clean", "noisy", "noise_std", "motion"))
    assert [type(batch) for batch in (stored.__getitems__([0]), live.__getitems__([(1, 0)]))] == [list, list]


@pytest.mark.parametrize(("options", "problem"), [
    ({"flip": True, "patch": 32}, "flip=True: not possible for bursts; expected no flip"),
    ({"targets": ["srgb"]}, "targets=.*srgb.*: .*only linear_rgb"),
])  # fmt: skip
def test_what_bursts_lack_is_refused(dataset: tuple[Path, list[str]], options: dict[str, Any], problem: str) -> None:
    with pytest.raises(ConfigError, match=f"LivePairs: {problem}"):
        ug.LivePairs(dataset[0], **options)


def test_single_frames_with_inputs_are_refused(dataset: tuple[Path, list[str]]) -> None:
    with pytest.raises(ConfigError, match=r"pairs differ in targets.*ug\.RawClips for bursts"):
        ug.RawPairs(dataset[0], inputs="mosaic")


def test_bursts_can_be_pickled(dataset: tuple[Path, list[str]]) -> None:
    for burst in (ug.RawClips(dataset[0])[0], ug.LivePairs(dataset[0])[1, 0]):
        there = pickle.loads(pickle.dumps(burst))
        assert same(there, burst)
        assert there.rows == [dict(row) for row in burst.rows]
        assert there.dataset == burst.dataset


def test_the_target_of_planes_has_the_sites_of_the_planes(tmp_path: Path) -> None:
    """Planes leave out an odd last row or column, and so does the target, at its resolution."""
    burst = "source.burst={frames: 2, downscale: 6, shift: 1}"
    ug.generate(ug.load_config([burst, "source.limit=1", "output.targets=[linear_rgb]", f"out={tmp_path / 'ds'}"]))
    clip = ug.RawClips(tmp_path / "ds")[0]
    assert clip.noisy.shape[1] % 2 or clip.noisy.shape[2] % 2
    height, width = (length // 2 * 2 * 6 for length in clip.noisy.shape[1:])
    for clips in (ug.RawClips, ug.LivePairs):
        item = clips(tmp_path / "ds", inputs="packed")[0]
        assert np.array_equal(item["linear_rgb"], clip.target[:height, :width])


def test_flips_of_clips_are_refused(dataset: tuple[Path, list[str]]) -> None:
    for clip in (ug.RawClips(dataset[0])[0], ug.RawClips(dataset[0], inputs="mosaic")[0]):
        with pytest.raises(ValueError, match="x: is a clip, whose motion cannot be flipped"):
            ug.flip(clip, "horizontal")


def test_a_loader_stacks_bursts(dataset: tuple[Path, list[str]]) -> None:
    data = pytest.importorskip("torch.utils.data", reason="PyTorch is not installed")
    options: dict[str, Any] = {"inputs": "packed", "rows": True}
    for bursts in (ug.RawClips(dataset[0], **options), ug.LivePairs(dataset[0], patch=32, **options)):
        batch = next(iter(data.DataLoader(bursts, batch_size=2)))
        assert batch["noisy"].shape[:3] == (2, 3, 4)
        assert batch["motion"].shape == (2, 3, 6)
        assert batch["linear_rgb"].shape[0] == 2
    for bursts in (ug.RawClips(dataset[0]), ug.LivePairs(dataset[0])):
        assert next(iter(data.DataLoader(bursts, batch_size=2))).targets["linear_rgb"].shape[0] == 2


@pytest.mark.parametrize(
    ("edits", "problem"),
    [
        ({"motion_yy": "1.7e308"}, "motion_yy=1.7e+308"),
        ({"motion_y": "-5000.0"}, "00000000-p0000-f00: a frame of the burst shows rows -"),
        ({"frame": "0"}, "not the first of the 3 frames"),
    ],
)
def test_edited_motion_is_damage(tmp_path: Path, edits: dict[str, str], problem: str) -> None:
    settings = ["source.burst={frames: 3, downscale: 2}", "source.patch=[random,64,1]", "source.limit=1", "n_jobs=1"]
    ug.generate(ug.load_config([*settings, f"out={tmp_path / 'ds'}"]))
    manifest = tmp_path / "ds/manifest.csv"
    header, first, row, last = (line.split(",") for line in manifest.read_text().splitlines())
    for name, value in edits.items():
        row[header.index(name)] = value
    manifest.write_text("".join(",".join(line) + "\n" for line in (header, first, row, last)))
    with pytest.raises(DamageError, match=re.escape(problem)):
        ug.LivePairs(tmp_path / "ds")[1, 0]
