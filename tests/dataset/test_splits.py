"""Splits: each image is in one of them, whatever other files there are; several datasets are read as one."""

from __future__ import annotations

import math
import pickle
import shutil
from collections import Counter
from pathlib import Path

import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, Settings, TreeHash, text_rows
from helpers.photographs import fill

import unprocess_gen as ug
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.planning.plan import plan_image

SPLIT = "split={train: 0.5, val: 0.25, test: 0.25}"


def splits(out: Path) -> dict[str, set[str]]:
    """Return the splits of each source."""
    names: dict[str, set[str]] = {}
    for row in text_rows(out):
        names.setdefault(row["source"], set()).add(row["split"])
    return names


@pytest.fixture(scope="module")
def made(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of 24 photographs in three splits, in shards of 8."""
    folder = tmp_path_factory.mktemp("split")
    make(fill(folder / "photos", 24), folder / "ds", SPLIT)
    return folder / "ds"


def test_shares_are_within_binomial_bounds(settings: Settings) -> None:
    config, count = settings("split={train: 0.8, val: 0.15, rest: 0.05}"), 4000
    counts = Counter(plan_image(config, f"{number:064x}").split for number in range(count))
    for name, share in config.split.items():
        assert abs(counts[name] - share * count) < 5 * math.sqrt(count * share * (1 - share)), name


def test_split_does_not_depend_on_other_files_or_copies(made: Path, make: Make, tmp_path: Path) -> None:
    photos = fill(tmp_path / "photos", 30)
    (photos / "005.png").unlink()
    shutil.copy(photos / "007.png", photos / "000_copy.png")
    make(photos, tmp_path / "ds", SPLIT)
    before, after = splits(made), splits(tmp_path / "ds")
    assert {name: after[name] for name in before if name in after} == {
        name: before[name] for name in before if name in after
    }
    assert after["000_copy.png"] == after["007.png"]


def test_seed_changes_the_split_and_pixels_do_not_depend_on_it(made: Path, make: Make, tmp_path: Path) -> None:
    make(made.parent / "photos", tmp_path / "other", SPLIT, "seed=1")
    make(made.parent / "photos", tmp_path / "none", "seed=0")
    assert splits(tmp_path / "other") != splits(made)
    without = text_rows(tmp_path / "none")
    assert not any("split" in row for row in without)
    assert [row["noisy_xxh3"] for row in without] == [row["noisy_xxh3"] for row in text_rows(made)]


@pytest.mark.parametrize("overrides", [("source.clips=true",), ("source.patch=[grid,4]", "noise.draws=2")])
def test_frames_patches_and_draws_of_an_image_stay_together(
    overrides: tuple[str, ...], make: Make, tmp_path: Path
) -> None:
    for clip in range(6):
        fill(tmp_path / f"photos/{clip}", 3, 3 * clip)
    make(tmp_path / "photos", tmp_path / "ds", SPLIT, *overrides)
    column = "clip" if "clips" in overrides[0] else "source"
    of_image: dict[str, set[str]] = {}
    for row in text_rows(tmp_path / "ds"):
        of_image.setdefault(row[column], set()).add(row["split"])
    assert {len(names) for names in of_image.values()} == {1}
    assert len(set.union(*of_image.values())) > 1


def test_recorded_split_is_verified_replayed_regenerated_and_repaired(
    made: Path, run_main: RunMain, tree_hash: TreeHash, tmp_path: Path
) -> None:
    assert "split:\n  train: 0.5\n" in (made / "config.yaml").read_text()
    for call in (["verify", made], ["replay", made], ["again", made, "out=again", "n_jobs=1"]):
        assert run_main(*call).code == 0
    assert tree_hash(tmp_path / "again") == tree_hash(made)
    (tmp_path / "again/shards/shard-00001.tar").unlink()
    (tmp_path / "again/manifest.csv").unlink()
    assert run_main("verify", "again", "--repair").code == 0
    assert tree_hash(tmp_path / "again") == tree_hash(made)


def test_pairs_of_a_split_are_read_and_an_unknown_one_names_those_there_are(made: Path, dataset: Path) -> None:
    for name, count in Counter(row["split"] for row in text_rows(made)).items():
        pairs = pickle.loads(pickle.dumps(ug.RawPairs(made, split=name)))
        assert [pair.row["split"] for pair in pairs] == [name] * count
    with pytest.raises(ConfigError, match=r"split='vel': no pair is in it; expected one of test, train, val$"):
        ug.RawPairs(made, split="vel")
    with pytest.raises(ConfigError, match=r"split='val': no pair is in it; there are no splits; set split="):
        ug.RawPairs(dataset, split="val")


def test_plan_and_report_show_the_splits(made: Path, run_main: RunMain) -> None:
    planned = run_main("plan", SPLIT, f"source.root={made.parent}/photos", "out=planned").out
    assert "splits    train 0.5 (about 12), val 0.25 (about 6), test 0.25 (about 6) of 24 sources" in planned
    assert run_main("report", made, "--to", "page.html").code == 0
    counts = Counter(row["split"] for row in text_rows(made)).most_common()
    listed = ", ".join(f"{name} ({count})" for name, count in counts)
    assert f'<td>split</td><td class="w">{listed}</td>' in Path("page.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "value",
    ["{train: 0.5}", "{train: 1.5, val: -0.5}", "{}", "[train,val]", "{a/b: 1}"],
)
def test_wrong_splits_are_refused_in_one_line(value: str, run_main: RunMain, tmp_path: Path) -> None:
    done = run_main(f"split={value}", "out=ds")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "split=" in done.err
    assert not (tmp_path / "ds").exists()


# Several datasets -----------------------------------------------------------------------------------------------------


def test_several_datasets_are_read_as_one(made: Path, dataset: Path) -> None:
    pairs, first = ug.RawPairs([str(made), dataset]), ug.RawPairs(made)
    assert [pair.row for pair in pairs] == [*(pair.row for pair in first), *(pair.row for pair in ug.RawPairs(dataset))]
    assert pairs.dataset == (str(made),) * len(first) + (str(dataset),) * (len(pairs) - len(first))
    assert pairs[0].dataset == str(made)
    assert {pair.row["split"] for pair in ug.RawPairs([made, dataset], split="val")} == {"val"}
    assert repr(ug.RawPairs([made])) == f"RawPairs([{str(made)!r}], length=24)"
    with pytest.raises(ConfigError, match=r"RawPairs\(\[\]\): no dataset"):
        ug.RawPairs([])
