"""Mixtures: each image draws an entry by weight; all its pairs share it, and other files do not change it."""

from __future__ import annotations

import math
from collections import Counter
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, Settings, TreeHash, text_rows
from helpers.photographs import fill

import unprocess_gen as ug
from unprocess_gen.config.serialization import dataset_yaml, parse_dataset_yaml
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.planning.mixture import WORD_COUNT, drawn_entry, image_config

FIRST, SECOND = (
    "{weight: 3, camera: sony_a7r, noise: imx385_iso3200}",
    "{weight: 1, camera: nexus_6p, noise: sony_a7s2, noise.iso: 1600, scene.exposure_ratio: 4, sensor: generic_14bit}",
)
MIXTURE = f"mixture=[{FIRST}, {SECOND}]"
PAIRS = ("noise.draws=2", "source.patch=[random,8,2]", "output.pairs_per_shard=8", "n_jobs=1")


def entries(out: Path) -> dict[str, set[tuple[str, ...]]]:
    """Return what the pairs of each source got."""
    got: dict[str, set[tuple[str, ...]]] = {}
    for row in text_rows(out):
        cells = tuple(row[name] for name in ("mixture", "camera", "noise", "bits", "exposure_ratio", "saturated_as"))
        got.setdefault(row["source"], set()).add(cells)
    return got


@pytest.fixture(scope="module")
def mixed(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of 12 photographs and two entries, with two draws of the noise of two patches each."""
    folder = tmp_path_factory.mktemp("mixture")
    make(fill(folder / "photos", 12), folder / "ds", MIXTURE, *PAIRS)
    return folder / "ds"


def test_shares_are_within_binomial_bounds(settings: Settings) -> None:
    config, count = settings("mixture=[{weight: 0.5}, {weight: 0.3, isp: srgb}, {weight: 0.2, gains: unity}]"), 4000
    counts = Counter(image_config(config, f"{number:064x}").mixture for number in range(count))
    for number, share in enumerate((0.5, 0.3, 0.2)):
        assert abs(counts[number] - share * count) < 5 * math.sqrt(count * share * (1 - share)), number


@pytest.mark.parametrize("weights", [(1,), (3, 1), (7, 1, 3), (1, 2**60, 1)])
def test_words_are_divided_exactly(weights: tuple[int, ...]) -> None:
    end = 0
    for number, weight in enumerate(weights):
        start, end = end, end + weight
        first, last = (-((-place * WORD_COUNT) // sum(weights)) for place in (start, end))
        assert drawn_entry(weights, first) == drawn_entry(weights, last - 1) == number
        assert abs(Fraction(last - first, WORD_COUNT) - Fraction(weight, sum(weights))) <= Fraction(1, WORD_COUNT)


def test_pairs_of_an_image_share_the_entry_that_its_row_names(mixed: Path) -> None:
    got = entries(mixed)
    assert all(len(cells) == 1 for cells in got.values())
    assert set.union(*got.values()) == {
        ("0", "sony_a7r", "imx385_iso3200", "12", "1.0", "noisy"),
        ("1", "nexus_6p", "sony_a7s2", "14", "4.0", "white"),
    }


def test_a_pair_is_that_of_its_entry_alone(mixed: Path, make: Make, tmp_path: Path) -> None:
    alone = ["camera=nexus_6p", "noise=sony_a7s2", "noise.iso=1600", "scene.exposure_ratio=4", "sensor=generic_14bit"]
    make(mixed.parent / "photos", tmp_path / "ds", *alone, *PAIRS)
    for pair, single in zip(ug.RawPairs(mixed), ug.RawPairs(tmp_path / "ds"), strict=True):
        if pair.row["mixture"] == 1:
            np.testing.assert_array_equal(pair.noisy, single.noisy)
            assert {**pair.row, "mixture": None} == single.row


def test_entry_does_not_depend_on_other_files(mixed: Path, make: Make, tmp_path: Path) -> None:
    photos = fill(tmp_path / "photos", 15)
    (photos / "005.png").unlink()
    make(photos, tmp_path / "ds", MIXTURE, *PAIRS)
    before, after = entries(mixed), entries(tmp_path / "ds")
    assert len(before.keys() & after.keys()) == 11
    assert {name: after[name] for name in before.keys() & after} == {
        name: before[name] for name in before if name in after
    }


def test_frames_of_a_clip_share_the_entry(make: Make, tmp_path: Path) -> None:
    for clip in range(6):
        fill(tmp_path / "clips" / str(clip), 2, first=2 * clip)
    clips = tmp_path / "clips"
    make(clips, tmp_path / "ds", MIXTURE, f"source.root={clips}", "source.clips=true")
    by_clip: dict[str, set[str]] = {}
    for row in text_rows(tmp_path / "ds"):
        by_clip.setdefault(row["clip"], set()).add(row["mixture"])
    assert Counter(map(len, by_clip.values())) == {1: 6}
    assert len(set.union(*by_clip.values())) == 2


def test_mixture_of_a_file_gives_the_same_dataset(
    mixed: Path, run_main: RunMain, tree_hash: TreeHash, tmp_path: Path
) -> None:
    folder = tmp_path / "own" / "experiment"
    folder.mkdir(parents=True)
    text = f"# @package _global_\nmixture:\n- {FIRST}\n- {SECOND}\n"
    (folder / "mixed.yaml").write_text(text, encoding="utf-8")
    arguments = "--config-dir", str(tmp_path / "own"), "+experiment=mixed"
    assert run_main(*arguments, *PAIRS, f"source.root={mixed.parent / 'photos'}", "out=ds").code == 0
    assert tree_hash(Path("ds")) == tree_hash(mixed)
    refused = run_main(*arguments, *PAIRS, "sensor=generic_10bit", "out=other")
    assert refused.code == 2
    assert "mixture[1].sensor: sensor=generic_10bit is set outside of the mixture too" in refused.err
    conflict = text.replace("sensor: generic_14bit", "sensor.bits: 14")
    (folder / "mixed.yaml").write_text(f"{conflict}sensor:\n  bits: 13\n", encoding="utf-8")
    refused = run_main(*arguments, *PAIRS, "out=other")
    assert "mixture[1].sensor.bits: sensor.bits=13 is set outside of the mixture too" in refused.err
    assert not Path("other").exists()


@pytest.mark.slow
def test_again_parts_verify_and_repair_follow_the_mixture(mixed: Path, run_main: RunMain, tree_hash: TreeHash) -> None:
    place = f"source.root={mixed.parent / 'photos'}"
    assert run_main("again", str(mixed), "out=again", "n_jobs=1").code == 0
    run_main("prepare", "parts=2", MIXTURE, *PAIRS, place, "out=parts")
    for part in ("0", "1"):
        assert run_main("part", "parts", part).code == 0
    assert run_main("merge", "parts").code == 0
    assert tree_hash(Path("parts")) == tree_hash(Path("again")) == tree_hash(mixed)
    (Path("again") / "manifest.csv").unlink()
    assert "restored from the rows in the shards" in run_main("verify", "again", "--repair").out
    (Path("again") / "manifest.csv").unlink()
    (Path("again") / "shards" / "shard-00000.tar").unlink()
    assert "regenerated from the settings" in run_main("verify", "again", "--repair", place).out
    assert tree_hash(Path("again")) == tree_hash(mixed)
    assert run_main("replay", "again").code == 0


def test_live_pairs_redraw_the_entry_in_each_epoch(mixed: Path) -> None:
    photos = mixed.parent / "photos"
    planned = ug.LivePairs([MIXTURE, *PAIRS, f"source.root={photos}"], redraw="all")
    stored, recorded = ug.RawPairs(mixed), ug.LivePairs(mixed, redraw="all")
    drawn = set()
    for number, pair in enumerate(stored):
        assert pair.row == recorded[number].row == planned[number].row
        again = recorded[1, number]
        assert again.row["camera"] == ("sony_a7r", "nexus_6p")[again.row["mixture"]]
        drawn.add((pair.row["mixture"], again.row["mixture"]))
    assert drawn == {(0, 0), (0, 1), (1, 0), (1, 1)}


def test_plan_shows_shares_and_effects_of_each_entry(mixed: Path, run_main: RunMain) -> None:
    done = run_main("plan", MIXTURE, *PAIRS, f"source.root={mixed.parent / 'photos'}")
    for number, weight, expected in ((0, 3, "9.0"), (1, 1, "3.0")):
        count = sum(cells.copy().pop()[0] == str(number) for cells in entries(mixed).values())
        share = f"weight {weight} of 4: about {expected} of 12 sources, {count} in this listing"
        assert share in " ".join(done.out.split())
    assert "noise     imx385_iso3200: a=" in done.out
    assert "row mean" in done.out  # the table of effects of the physical entry


def test_config_yaml_keeps_every_entry(settings: Settings) -> None:
    config = settings(MIXTURE, "effects.assumed=use", "accuracy=fast")
    text = dataset_yaml(config)
    read, _ = parse_dataset_yaml(text)
    assert dataset_yaml(read) == text
    assert "mixture" not in dataset_yaml(settings())
    assert "assumed: use" in text  # of the second entry


@pytest.mark.parametrize(
    ("override", "problem"),
    [
        ("mixture=[]", "mixture=[]: expected null, or a list of up to 64 entries"),
        ("mixture=[3]", "mixture[0]: 3: expected a mapping"),
        ("mixture=[{camera: convex}]", "mixture[0].weight=null: expected more than 0"),
        ("mixture=[{weight: 1}, {weight: -1}]", "mixture[1].weight=-1: expected more than 0"),
        ("mixture=[{weight: 1}, {weight: 1, noise: sony}]", "mixture[1].noise=sony: no such option"),
        ("mixture=[{weight: 1, noise.iso: -3, noise: sony_a7s2}]", "mixture[0].noise.iso=-3: expected an ISO above 0"),
        ("mixture=[{weight: 1, output: webdataset}]", "mixture[0]: output: no such key; an entry has weight, camera"),
        ("mixture=[{weight: 1, sensor: {bit: 3}}]", "mixture[0].sensor.bit=3: no such key; sensor has bits"),
        ("mixture=[{weight: 1, sensor: {bits: 3}, sensor.bits: 3}]", "mixture[0].sensor.bits: is set twice"),
        ("mixture=[{weight: 1, noise.draws: 2}, {weight: 1}]", "mixture[1].noise: 1 x 1 pairs of an image"),
        ("mixture=[{weight: 1, noise: sony_a7s2, noise.iso: 100, noise.dark_frames: x}]", "one camera at one ISO"),
    ],
)
def test_bad_entries_are_refused_by_their_place(override: str, problem: str, settings: Settings) -> None:
    with pytest.raises(ConfigError) as refused:
        settings(override)
    assert problem in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_key_of_an_entry_cannot_be_set_or_swept_outside(run_main: RunMain) -> None:
    done = run_main("-m", "camera=nexus_6p,convex", MIXTURE, "out=sweep")
    assert done.code == 2
    assert "mixture[0].camera: camera=nexus_6p is set outside of the mixture too" in done.err
    assert not Path("sweep").exists()
