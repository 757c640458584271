"""Photographs in other colours pass through the pipeline: rows, replay, live pairs, plans, sheets and settings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, text_rows
from helpers.icc import PROFILES, para, profile_of_tags, tags_of
from helpers.photographs import pixels
from PIL import Image

import unprocess_gen as ug
from unprocess_gen.core.errors import DamageError, SourceChangedError
from unprocess_gen.pipeline.replay import PairRegenerator
from unprocess_gen.simulation.reference.primaries import PRIMARIES

heif = pytest.importorskip("pillow_heif")

PICTURE = pixels(7, 66, 90)
TABLES = profile_of_tags({**tags_of(PRIMARIES["p3"], para(0, 2.2)), b"A2B0": b"mft2" + bytes(60)})
OVERRIDES = "noise=sony_a7s2", "scene=night", "source.patch=[random,32,2]", "source.max_failed=1"


def save(picture: np.ndarray, path: Path, profile: bytes | None = None) -> None:
    options = {} if profile is None else {"icc_profile": profile}
    if path.suffix == ".heic":
        heif.from_pillow(Image.fromarray(picture)).save(path, quality=-1, chroma=444, matrix_coefficients=0, **options)
    else:
        Image.fromarray(picture).save(path, **options)


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    save(PICTURE, folder / "a_none.png")
    save(PICTURE, folder / "b_p3.png", PROFILES["Display P3"])
    save(PICTURE, folder / "c_adobe.png", PROFILES["Adobe RGB"])
    save(PICTURE, folder / "d_p3.heic", PROFILES["Display P3"])
    save(PICTURE, folder / "e_tables.png", TABLES)
    return folder


@pytest.fixture(scope="module")
def converted(photos: Path, make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset of `photos`, with a physical profile and patches."""
    out = tmp_path_factory.mktemp("converted") / "ds"
    make(photos, out, *OVERRIDES)
    return out


def test_rows_name_the_profile_and_the_reason(converted: Path) -> None:
    rows = text_rows(converted)
    assert [row["profile"] for row in rows[::2]] == ["sRGB", "Display P3", "Adobe RGB", "Display P3", ""]
    assert (rows[-1]["reason"], rows[-1]["status"]) == ("icc", "failed")
    assert [bool(row["pixels_xxh3"]) for row in rows] == [False] * 6 + [True] * 2 + [False]


def test_same_codes_in_other_colours_give_other_frames(photos: Path, make: Make, tmp_path: Path) -> None:
    make(photos, tmp_path / "ds", "source.max_failed=1", "noise=none", "camera=sony_a7r", "gains=fixed")
    none, p3, adobe, heic = (pair.clean.astype(int) for pair in ug.RawPairs(tmp_path / "ds"))
    assert min(np.abs(none - p3).mean(), np.abs(none - adobe).mean(), np.abs(p3 - adobe).mean()) > 4
    np.testing.assert_array_equal(p3, heic)


def test_every_pair_is_regenerated_from_its_row(converted: Path, photos: Path, run_main: RunMain) -> None:
    assert [result.complaint for result in ug.replay(converted / "manifest.csv", root=photos)] == [""] * 8
    assert run_main("verify", converted, "--regenerate", 8).code == 0


@pytest.mark.parametrize("redraw", ["noise", "all"])
def test_live_pairs_are_the_stored_ones_with_and_without_a_cache(
    converted: Path, photos: Path, tmp_path: Path, redraw: str
) -> None:
    stored = ug.RawPairs(converted)
    for cache in (None, tmp_path, tmp_path):  # the second time, pixels are in the cache
        live = ug.LivePairs(converted, photos, redraw, cache)
        for number in range(8):
            np.testing.assert_array_equal(live[0, number].clean, stored[number].clean)
            np.testing.assert_array_equal(live[0, number].noisy, stored[number].noisy)
    planned = ug.LivePairs(ug.load_config([*OVERRIDES, f"source.root={photos}"]), redraw=redraw)
    for number in range(8):
        first, second = planned[3, number], live[3, number]
        np.testing.assert_array_equal(first.clean, second.clean)
        assert (first.row["profile"], first.row["pixels_xxh3"]) == (second.row["profile"], second.row["pixels_xxh3"])


def test_wrong_profile_or_digest_of_a_row_is_found(converted: Path, photos: Path) -> None:
    row = dict(ug.RawPairs(converted)[2].row)
    with pytest.raises(DamageError, match="has the colour profile 'Display P3', the row records 'sRGB'"):
        PairRegenerator(str(photos)).regenerate({**row, "profile": "sRGB"})
    row = {**ug.RawPairs(converted)[6].row, "pixels_xxh3": "0" * 32}
    with pytest.raises(SourceChangedError, match=r"is decoded to other pixels: XXH3-128 is .*, the row records 0{32}"):
        PairRegenerator(str(photos)).regenerate(row)


def test_settings_without_conversion_have_no_column_and_read_srgb(photos: Path, make: Make, tmp_path: Path) -> None:
    """As datasets before the conversion, whose patterns have no HEIC either."""
    make(photos, tmp_path / "ds", "source.icc=ignore", "source.include=['*.png']")
    rows = text_rows(tmp_path / "ds")
    assert "profile" not in rows[0] and "pixels_xxh3" not in rows[0]
    assert all(result.complaint == "" for result in ug.replay(tmp_path / "ds" / "manifest.csv", root=photos))
    assert all(live.row["status"] == "ok" for live in ug.LivePairs(tmp_path / "ds", photos))


def test_only_srgb_passes_when_others_are_refused(photos: Path, make: Make, tmp_path: Path) -> None:
    make(photos, tmp_path / "ds", "source.icc=refuse", "source.max_failed=4")
    assert [row["reason"] for row in text_rows(tmp_path / "ds")] == ["", "icc", "icc", "icc", "icc"]


def test_synthetic_pictures_have_no_column(make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=1")
    assert "profile" not in text_rows(tmp_path / "ds")[0]


def test_plan_counts_profiles_and_refusals(run_main: RunMain, photos: Path) -> None:
    done = run_main("plan", f"source.root={photos}", "--all")
    assert "profiles  2 Display P3, 1 sRGB, 1 Adobe RGB, 1 refused" in done.out, done


def test_sheets_draw_the_stages_of_converted_photographs(run_main: RunMain, converted: Path, photos: Path) -> None:
    done = run_main("preview", converted, "--to", "sheets", "--stages", f"source.root={photos}")
    assert done.code == 0 and len([*Path("sheets").glob("*.stages.png")]) == 8, done
