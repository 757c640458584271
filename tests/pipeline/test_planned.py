"""`gen-dataset manifest` writes the rows of a dataset without its frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, TreeHash, text_rows

import unprocess_gen as ug
from unprocess_gen.core.errors import ConfigError

RECIPE = ("noise=sony_a7s2", "scene=night", "noise.draws=2", "source.patch=[random,64,2]", "split={a: 0.5, b: 0.5}")
EMPTY = {
    *("clean_xxh3", "noisy_xxh3", "clean_clipped_low", "clean_clipped_high", "noisy_clipped_low"),
    *("noisy_clipped_high", "saturated", "zero_variance", "light_clipped_high"),
}


@pytest.fixture(scope="module")
def folders(make: Make, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return the manifest and the dataset of a recipe."""
    place = tmp_path_factory.mktemp("planned")
    planned, complete = place / "planned", place / "complete"
    make(None, planned, *RECIPE, "source.limit=3", "output.frames=false")
    make(None, complete, *RECIPE, "source.limit=3")
    return planned, complete


def test_rows_are_those_of_the_dataset_except_cells_of_frames(folders: tuple[Path, Path]) -> None:
    planned, complete = map(text_rows, folders)
    assert not any((folders[0] / "shards").iterdir())
    for row, full in zip(planned, complete, strict=True):
        assert full.keys() - row.keys() == EMPTY
        assert row.items() <= full.items()


def test_live_pairs_of_a_manifest_are_those_of_the_dataset(folders: tuple[Path, Path]) -> None:
    live, stored = ug.LivePairs(folders[0]), ug.RawPairs(folders[1])
    assert len(live) == len(stored) == 12
    for made, read in zip((live[number] for number in range(12)), stored, strict=True):
        np.testing.assert_array_equal(made.clean, read.clean)
        np.testing.assert_array_equal(made.noisy, read.noisy)
        # what a run estimates once for each image, and does not read back from frames, is the same too
        assert dict(made.row) == read.row


def test_again_makes_the_frames(
    folders: tuple[Path, Path], run_main: RunMain, tree_hash: TreeHash, tmp_path: Path
) -> None:
    done = run_main("again", folders[0], "out=made", "output.frames=true", "n_jobs=1")
    assert (done.code, done.out.splitlines()[-1][:18]) == (0, "the same rows as /"), done
    assert tree_hash(tmp_path / "made") == tree_hash(folders[1])


def test_the_verb_writes_a_manifest_and_continues_it(run_main: RunMain, tmp_path: Path) -> None:
    call = ("manifest", "source.limit=2", "out=planned", "n_jobs=1")
    assert run_main(*call).out.startswith("planned: 2 pairs, no frames")
    assert run_main(*call).out.startswith("planned is complete: 2 pairs, no frames")
    assert run_main("verify", "planned").out == "planned is intact\n"
    refused = run_main("source.limit=2", "out=planned", "n_jobs=1")
    assert refused.code == 2 and "output.frames" in refused.err
    (tmp_path / "planned/manifest.csv").unlink()
    assert run_main("verify", "planned", "--repair").code == 0
    assert ug.LivePairs("planned")[1].noisy.dtype == np.uint16


def test_what_needs_frames_refuses_a_manifest(folders: tuple[Path, Path], run_main: RunMain, tmp_path: Path) -> None:
    planned = folders[0]
    with pytest.raises(ConfigError, match=r"has a manifest without frames .* ug.LivePairs"):
        ug.RawPairs(planned)
    for call in (("report", planned), ("preview", planned, "--to", "x"), ("dng", planned, "--keys=0", "--to", "x")):
        done = run_main(*call)
        assert (done.code, done.err.count("\n")) == (2, 1), done
        assert "without frames" in done.err
    assert run_main("replay", planned).code == run_main("verify", planned, "--regenerate=1").code == 2
    done = run_main("replay", planned, "--keys", "0", "--to", "arrays")
    assert (done.code, len([*(tmp_path / "arrays").iterdir()])) == (0, 8)
    assert "4 rows without digests" in done.out


def test_a_row_with_one_digest_is_no_row(folders: tuple[Path, Path], run_main: RunMain, tmp_path: Path) -> None:
    text = (folders[1] / "manifest.csv").read_text()
    digest = text_rows(folders[1])[0]["noisy_xxh3"]
    (tmp_path / "manifest.csv").write_text(text.replace(digest, ""))
    done = run_main("replay", "manifest.csv")
    assert (done.code, "noisy_xxh3 is empty" in done.err) == (4, True)
