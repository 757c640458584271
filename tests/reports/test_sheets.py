"""Contact sheets agree with the dataset: tests compute every panel again and search for it in the picture."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make
from helpers.photographs import PHOTOS, fill, pixels
from helpers.promise_report import Figure
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from unprocess_gen import RawPairs
from unprocess_gen.core.errors import ConfigError, DamageError
from unprocess_gen.core.files import file_sha256
from unprocess_gen.core.tone_curves import linear_table
from unprocess_gen.dataset.manifest import plan_from_row
from unprocess_gen.reports.sheets import contact_sheet, panels, stages_sheet
from unprocess_gen.reports.sheets import pairs as sheet_pairs
from unprocess_gen.simulation.reference import isp as process
from unprocess_gen.simulation.reference import unprocess
from unprocess_gen.simulation.reference.cfa import PATTERNS, mosaic
from unprocess_gen.sources.loader import downscaled

HEIGHT, WIDTH = 60, 90
"""Size of the first photograph, which fits into a panel without scaling."""


@pytest.fixture(scope="module")
def gray_world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three photographs, two of 8 bits and one of 16, and a file that is no image."""
    folder = tmp_path_factory.mktemp("preview") / "few"
    folder.mkdir()
    Image.fromarray(pixels(3, HEIGHT, WIDTH)).save(folder / "a.png")
    Image.fromarray(pixels(4, 300, 500)).save(folder / "large.png")
    (folder / "none.png").write_bytes(b"no picture")
    cv2.imwrite(str(folder / "sixteen.png"), pixels(5, 41, 57, np.uint16))
    return folder


@pytest.fixture(scope="module")
def few(gray_world: Path, make: Make) -> Path:
    make(gray_world, gray_world.parent / "ds", "sensor.pattern=GBRG")
    return gray_world.parent / "ds"


def png(path: Path) -> np.ndarray:
    found = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
    assert found is not None
    return found


def codes(values: np.ndarray) -> np.ndarray:
    shown = np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)
    return shown[..., None].repeat(3, axis=2) if shown.ndim == 2 else shown


def places(sheet: np.ndarray, picture: np.ndarray) -> list[tuple[int, int]]:
    """Return the rows and columns at which a sheet contains a picture exactly."""
    height, width = picture.shape[:2]
    starts = np.lib.stride_tricks.sliding_window_view(sheet, (1, min(width, 16), 3))[:, :, 0, 0]
    corners = np.argwhere((starts == picture[0, :16]).all(axis=(2, 3)))
    return [(int(y), int(x)) for y, x in corners if np.array_equal(sheet[y : y + height, x : x + width], picture)]


# Panels ---------------------------------------------------------------------------------------------------


def test_sheet_contains_every_panel_exactly(few: Path, gray_world: Path, tmp_path: Path, figure: Figure) -> None:
    """Order: source and three views of the clean frame; below, difference and three views of the noisy frame."""
    clean, noisy, row = RawPairs(few)[0]
    plan = plan_from_row(row)
    low, high = {}, {}
    for name, raw in (("clean", clean), ("noisy", noisy)):
        low[name], high[name] = float(raw.min()), float(raw.max())
    difference = noisy.astype(float) - clean
    span = float(plan.white_level_dn - plan.black_level_dn)

    def common(raw: np.ndarray) -> np.ndarray:
        return np.sqrt(np.clip((raw.astype(float) - plan.black_level_dn) / span, 0, 1))

    expected = [
        codes(pixels(3, HEIGHT, WIDTH) / 255),
        *(
            codes(one)
            for one in (
                (clean - low["clean"]) / (high["clean"] - low["clean"]),
                common(clean),
                process.develop(clean, plan),
                (difference / (4 * np.sqrt(np.mean(difference**2))) + 1) / 2,
                (noisy - low["noisy"]) / (high["noisy"] - low["noisy"]),
                common(noisy),
                process.develop(noisy, plan),
            )
        ),
    ]

    [drawn] = contact_sheet.write_sheets(few, tmp_path, ["00000000"])
    sheet = png(drawn.files[0])

    found = [places(sheet, picture) for picture in expected]
    assert [len(places_) for places_ in found] == [1] * 8
    rows, columns = zip(*(places_[0] for places_ in found), strict=True)
    assert columns[:4] == columns[4:] == tuple(sorted(columns[:4]))
    assert len(set(rows[:4])) == len(set(rows[4:])) == 1
    assert rows[0] < rows[4]
    figure("preview", f"{sum(len(places_) == 1 for places_ in found)} of {len(expected)} panels found, pixel by pixel")


def test_detail_equals_the_developed_complete_frame(few: Path, tmp_path: Path) -> None:
    clean, _, row = RawPairs(few)[1]
    at = panels.detail_window(clean.shape)

    [drawn] = contact_sheet.write_sheets(few, tmp_path, ["00000001"])

    part = codes(process.develop(clean, plan_from_row(row))[at.rows, at.columns])
    assert part.shape == (*panels.PANEL_PX, 3)
    assert len(places(png(drawn.files[0]), part)) == 1


def test_source_of_16_bits_is_shown(few: Path, tmp_path: Path) -> None:
    [drawn] = contact_sheet.write_sheets(few, tmp_path, ["00000003"])

    source = cv2.cvtColor(pixels(5, 41, 57, np.uint16), cv2.COLOR_BGR2RGB)
    assert drawn.missing_source == ""
    assert len(places(png(drawn.files[0]), codes(source / 65535))) == 1


def test_dark_scene_is_developed_as_bright_as_its_photograph(gray_world: Path, make: Make, tmp_path: Path) -> None:
    overrides = ("noise=sony_a7s2", "scene=night", "sensor=generic_16bit", "source.limit=1", "isp=linear")
    make(gray_world, tmp_path / "ds", *overrides, "camera=identity", "gains=unity")
    clean, _, row = RawPairs(tmp_path / "ds")[0]
    assert row["exposure_ratio"] > 10

    developed = process.to_codes(process.develop(clean, plan_from_row(row)))

    assert abs(float(developed.mean()) - float(pixels(3, HEIGHT, WIDTH).mean())) < 1


# The stages -----------------------------------------------------------------------------------------------------------


def test_all_steps_together_equal_the_unprocessing(few: Path) -> None:
    plan = plan_from_row(RawPairs(few)[0].row)
    source = pixels(3, HEIGHT, WIDTH)
    values = source / 255

    for step in stages_sheet.PROCESSING_STEPS:
        values = step.apply(values, plan)

    # 1 - v is rounded, and the steep end of the inverse tone curve takes its square root
    np.testing.assert_allclose(values, unprocess.camera_light(source, plan), rtol=0, atol=1e-7)


def test_stages_show_each_step_and_the_frames_of_the_dataset(few: Path, tmp_path: Path) -> None:
    clean, noisy, row = RawPairs(few)[0]
    plan = plan_from_row(row)
    source = pixels(3, HEIGHT, WIDTH)
    light = unprocess.linear_light(source, plan.tone, plan.gamma)
    camera = unprocess.apply_ccm(light, plan.rgb2cam)
    expected = [source, codes(light), codes(camera), codes(unprocess.camera_light(source, plan))]
    for raw in (clean, noisy):
        sites = np.zeros((*raw.shape, 3))
        level = np.sqrt(np.clip(process.to_light(raw, plan), 0, 1))
        for (y, x), channel in {(0, 0): 1, (0, 1): 2, (1, 0): 0, (1, 1): 1}.items():  # GBRG
            sites[y::2, x::2, channel] = level[y::2, x::2]
        expected.append(codes(sites))

    [drawn] = contact_sheet.write_sheets(few, tmp_path, ["00000000"], with_stages=True)

    assert [path.name for path in drawn.files] == ["00000000.png", "00000000.stages.png"]
    picture = png(drawn.files[1])
    assert [len(places(picture, one)) for one in expected] == [1] * len(expected)


def test_dithered_codes_have_their_own_stage(gray_world: Path, make: Make, tmp_path: Path) -> None:
    make(gray_world, tmp_path / "ds", "source.limit=1", "source.dequantize=dither")
    plan = plan_from_row(RawPairs(tmp_path / "ds")[0].row)
    source = pixels(3, HEIGHT, WIDTH)
    dithered = unprocess.dequantise(source, plan, linear_table(plan.tone, plan.gamma, 256))

    [drawn] = contact_sheet.write_sheets(tmp_path / "ds", tmp_path / "to", with_stages=True)

    picture = png(drawn.files[1])
    assert len(places(picture, source)) == 2  # 8 bits cannot show half a code
    assert len(places(picture, codes(unprocess.camera_light(dithered, plan)))) == 1
    assert len(places(picture, codes(unprocess.camera_light(source, plan)))) == 0


# Averaging and fitting ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", [1, 2, 3])
@pytest.mark.parametrize("pattern", PATTERNS)
def test_averaged_mosaic_is_the_mosaic_of_averages(pattern: str, side: int) -> None:
    """Squares have equal pixels; incomplete squares at the right and bottom are ignored."""
    wanted = mosaic(pixels(1, 6, 8, np.uint16).astype(float), pattern)
    raw = np.zeros((6 * side, 8 * side), dtype=np.uint16)
    for y in range(2):
        for x in range(2):  # sites of one colour are two apart
            raw[y::2, x::2] = wanted[y::2, x::2].repeat(side, axis=0).repeat(side, axis=1)
    left_over = 0 if side == 1 else 3

    found = panels.average_mosaic(np.pad(raw, (0, left_over), constant_values=9), side)

    np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_channels_of_a_tile_are_means(pattern: str) -> None:
    flat = np.broadcast_to([3.0, 5.0, 9.0], (6, 8, 3))
    values = mosaic(flat, pattern)
    values[:2, :2] += np.array([[1, 2], [3, 4]])

    found = panels.tile_channels(values, pattern)

    added = {"RGGB": (1, 2.5, 4), "BGGR": (4, 2.5, 1), "GRBG": (2, 2.5, 3), "GBRG": (3, 2.5, 2)}[pattern]
    np.testing.assert_allclose(found[0, 0], np.array([3, 5, 9]) + added)
    np.testing.assert_array_equal(found[1:], flat[:2, :4])


@given(height=st.integers(1, 9000), width=st.integers(1, 9000))
def test_detail_begins_at_a_tile_and_average_is_fine_enough(height: int, width: int) -> None:
    at = panels.detail_window((height, width))

    for part, length, most in ((at.rows, height, panels.PANEL_PX[0]), (at.columns, width, panels.PANEL_PX[1])):
        assert part.start % 2 == 0
        assert 0 <= part.start < part.stop <= length
        assert part.stop - part.start == min(length, most)
    assert at.side == 1 or min(height, width) // (2 * at.side) >= 1
    assert at.side == 1 or height // at.side >= 2 * panels.PANEL_PX[0] or width // at.side >= 2 * panels.PANEL_PX[1]


@given(height=st.integers(1, 700), width=st.integers(1, 700))
def test_image_fits_its_panel_and_keeps_its_mean(height: int, width: int) -> None:
    values = np.full((height, width), 3.0)

    found = panels.fit_image(values, (40, 60))

    assert found.shape[0] <= 40
    assert found.shape[1] <= 60
    assert max(found.shape[0] / 40, found.shape[1] / 60) > 0.5
    np.testing.assert_allclose(found, 3.0, rtol=1e-6)


@given(st.text(st.characters(codec="ascii", categories=["L", "N", "P"]), max_size=60), st.integers(40, 300))
def test_wrapped_text_fits_and_loses_only_spaces(text: str, width_px: int) -> None:
    lines = panels.wrap_text(text, width_px)

    assert "".join(lines).replace(" ", "") == text.replace(" ", "")
    assert all(cv2.getTextSize(line, panels.FONT, panels.FONT_SCALE, 1)[0][0] <= width_px for line in lines)


# The overview ---------------------------------------------------------------------------------------------------------


def test_overview_has_one_strip_per_pair_in_manifest_order(few: Path) -> None:
    whole = contact_sheet.contact_sheet(few)
    strips = [contact_sheet.contact_sheet(few, [key]) for key in ("00000000", "00000001", "00000003")]

    assert whole.dtype == np.uint8
    assert whole.shape[2] == 3
    np.testing.assert_array_equal(whole, np.vstack(strips))
    np.testing.assert_array_equal(contact_sheet.contact_sheet(few, ["00000003", "00000000"]), np.vstack(strips[::2]))


def test_indices_and_ranges_select_pairs(few: Path) -> None:
    strips = [contact_sheet.contact_sheet(few, [key]) for key in ("00000000", "00000003")]

    np.testing.assert_array_equal(contact_sheet.contact_sheet(few, ["0", "2-3"]), np.vstack(strips))


def test_overview_without_photographs_shows_the_reason_and_the_frames(few: Path, tmp_path: Path) -> None:
    with_source = contact_sheet.contact_sheet(few, ["00000000"])
    without = contact_sheet.contact_sheet(few, ["00000000"], source=tmp_path)

    panel = panels.STRIP_PX[1] + 2 * panels.MARGIN_PX
    height = panels.STRIP_PX[0]
    assert without.shape[1] == with_source.shape[1]
    assert (without[:, :panel] < panels.EMPTY - 100).any()  # text of the reason
    np.testing.assert_array_equal(without[-height:, panel:], with_source[-height:, panel:])


def test_eight_evenly_spaced_pairs_are_shown_by_default(dataset: Path, tmp_path: Path) -> None:
    shown = [drawn.key for drawn in contact_sheet.write_sheets(dataset, tmp_path)]

    assert shown == [f"{i * len(PHOTOS) // 8:08d}" for i in range(8)]


def test_frames_of_any_size_are_shown(dataset: Path, tmp_path: Path) -> None:
    """The sizes include 1 x 1 and 3 x 40."""
    keys = [str(pair.row["key"]) for pair in RawPairs(dataset)]

    drawn = list(contact_sheet.write_sheets(dataset, tmp_path, keys, with_stages=True))

    assert [one.key for one in drawn] == keys
    assert all(one.missing_source == "" and len(one.files) == 2 for one in drawn)


def test_packed_planes_are_shown_as_a_mosaic(gray_world: Path, make: Make, tmp_path: Path) -> None:
    sheets = []
    for layout in ("mosaic", "packed"):
        make(gray_world, tmp_path / layout, "source.include=[large.png]", f"output.layout={layout}")
        [drawn] = contact_sheet.write_sheets(tmp_path / layout, tmp_path / "sheets" / layout, with_stages=True)
        sheets.append([png(file) for file in drawn.files])

    assert len(sheets[0]) == 2
    for mosaic_sheet, packed_sheet in zip(*sheets, strict=True):
        np.testing.assert_array_equal(mosaic_sheet, packed_sheet)


def test_float_frames_are_shown_in_dn(gray_world: Path, make: Make, tmp_path: Path) -> None:
    one = ("source.include=[large.png]", "output.layout=packed")
    make(gray_world, tmp_path / "whole", *one)
    make(gray_world, tmp_path / "float", *one, "output.dtype=float32")
    wholes, floats = (next(iter(sheet_pairs.selected_pairs(tmp_path / name, (), None))) for name in ("whole", "float"))

    assert np.abs(floats.clean - wholes.clean.astype(np.float64)).max() <= 0.5 + 1e-3  # rounding, and float32
    assert np.abs(floats.noisy - wholes.noisy.astype(np.float64)).max() <= 0.5 + 1e-3
    sheets = [contact_sheet.pair_sheet(shown).astype(int) for shown in (wholes, floats)]
    assert sheets[0].shape == sheets[1].shape
    assert np.abs(sheets[0] - sheets[1]).mean() < 1


def test_built_in_scenes_have_a_source_panel(make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=1")

    [drawn] = contact_sheet.write_sheets(tmp_path / "ds", tmp_path / "to")

    assert drawn.missing_source == ""


@pytest.mark.parametrize(
    ("keys", "count"), [(["00000001"], 8), (["00000001-p0002"], 2), (["00000001-p0002-l01d00", "00000000-p0000"], 3)]
)
def test_key_of_an_image_or_patch_selects_all_its_pairs(
    gray_world: Path, make: Make, tmp_path: Path, keys: list[str], count: int
) -> None:
    make(gray_world, tmp_path / "ds", "source.patch=[random,32,4]", "noise.levels=2")

    drawn = list(contact_sheet.write_sheets(tmp_path / "ds", tmp_path / "to", keys))

    assert len(drawn) == len({one.files[0].name for one in drawn}) == count
    assert not any(one.missing_source for one in drawn)


def test_patch_is_shown_with_its_part_of_the_source(gray_world: Path, make: Make, tmp_path: Path) -> None:
    make(gray_world, tmp_path / "ds", "source.patch=[random,32,2]", "source.limit=1")
    row = RawPairs(tmp_path / "ds")[1].row
    y, x = row["patch_y"], row["patch_x"]

    drawn = list(contact_sheet.write_sheets(tmp_path / "ds", tmp_path / "to"))

    part = pixels(3, HEIGHT, WIDTH)[y : y + 32, x : x + 32]
    assert len(places(png(drawn[1].files[0]), part)) == 1


def test_downscaled_source_is_shown_downscaled(gray_world: Path, make: Make, tmp_path: Path) -> None:
    make(gray_world, tmp_path / "ds", "source.downscale=2", "source.limit=1")

    [drawn] = contact_sheet.write_sheets(tmp_path / "ds", tmp_path / "to")

    assert drawn.missing_source == ""
    assert len(places(png(drawn.files[0]), codes(downscaled(pixels(3, HEIGHT, WIDTH), 2) / 65535))) == 1


# The command ----------------------------------------------------------------------------------------------------------


def test_preview_writes_the_sheets_of_the_keys(few: Path, run_main: RunMain, tmp_path: Path) -> None:
    done = run_main("preview", few, "--keys", "00000000,00000003", "--to", "sheets", "--stages")

    assert (done.code, done.err) == (0, "")
    assert done.out == "4 pictures in sheets\n"
    names = {path.name for path in (tmp_path / "sheets").iterdir()}
    assert names == {f"{key}{kind}.png" for key in ("00000000", "00000003") for kind in ("", ".stages")}


def test_preview_replaces_its_own_sheets(few: Path, run_main: RunMain, tmp_path: Path) -> None:
    for keys in ("0", "3", "0"):
        assert run_main("preview", few, "--keys", keys, "--to", "sheets").code == 0
    with Image.open(tmp_path / "sheets/00000003.png") as sheet:
        sheet.load()
        assert sheet.info["unprocess_gen"] == f"manifest_sha256={file_sha256(few / 'manifest.csv')}"


@pytest.mark.parametrize("name", ["00000000.png", "00000012-p0007-l01d02.stages.png"])
def test_preview_refuses_a_folder_with_other_sheets(
    name: str, few: Path, gray_world: Path, run_main: RunMain, tmp_path: Path
) -> None:
    (tmp_path / "sheets").mkdir()
    (tmp_path / "sheets/photograph.png").write_bytes(b"not a sheet")
    shutil.copy(gray_world / "a.png", tmp_path / "sheets" / name)
    before = (tmp_path / "sheets" / name).read_bytes()
    done = run_main("preview", few, "--to", "sheets")
    assert (done.code, done.out) == (2, "")
    assert done.err == (
        f"gen-dataset: --to sheets: {name} is not a sheet of {few}; expected a folder without sheets of other "
        "datasets; choose another folder, or remove them\n"
    )
    assert sorted(path.name for path in (tmp_path / "sheets").iterdir()) == sorted([name, "photograph.png"])
    assert (tmp_path / "sheets" / name).read_bytes() == before


@pytest.mark.parametrize("inside", ["", "sheets"])
def test_preview_refuses_the_folder_of_the_photographs(
    inside: str, few: Path, gray_world: Path, run_main: RunMain
) -> None:
    before = sorted(gray_world.rglob("*"))
    done = run_main("preview", few, "--to", gray_world / inside)
    assert done.code == 2
    assert done.err.startswith(f"gen-dataset: --to {gray_world / inside}: is inside the folder of the photographs, ")
    assert sorted(gray_world.rglob("*")) == before


def test_preview_refuses_sheets_of_another_dataset(
    few: Path, gray_world: Path, make: Make, run_main: RunMain, tmp_path: Path
) -> None:
    make(gray_world, tmp_path / "other", "sensor.pattern=GBRG", "seed=1")
    assert run_main("preview", "other", "--keys", "0", "--to", "sheets").code == 0
    done = run_main("preview", few, "--keys", "3", "--to", "sheets")
    assert done.code == 2
    assert "00000000.png is not a sheet of" in done.err
    assert not (tmp_path / "sheets/00000003.png").exists()


Spoil = Callable[[Path], None]


def deleted(folder: Path) -> None:
    (folder / "a.png").unlink()


def changed(folder: Path) -> None:
    size = (folder / "a.png").stat().st_size
    (folder / "a.png").write_bytes(b"x" * size)


def longer(folder: Path) -> None:
    with (folder / "a.png").open("ab") as file:
        file.write(b"more")


@pytest.mark.parametrize(("spoil", "reason"), [(deleted, "No such file"), (changed, "a.png"), (longer, "changed")])
def test_changed_photograph_is_named_and_its_panel_omitted(
    few: Path, gray_world: Path, run_main: RunMain, tmp_path: Path, spoil: Spoil, reason: str
) -> None:
    shutil.copytree(gray_world, tmp_path / "moved")
    spoil(tmp_path / "moved")

    done = run_main("preview", few, "--keys=00000000,00000001", "--to=to", "--source=moved", "--stages")

    assert done.code == 5
    assert "; restore the file, or regenerate the dataset\n" in done.err
    assert done.out == "3 pictures in to\n"
    assert done.err.startswith("gen-dataset: 00000000 (a.png): the source's panel and the stages are omitted: ")
    assert reason in done.err
    assert done.err.count("\n") == 1


def test_other_content_of_the_same_size_is_detected(few: Path, make: Make, tmp_path: Path, run_main: RunMain) -> None:
    for number in (1, 2):
        folder = tmp_path / str(number)
        folder.mkdir()
        cv2.imwrite(str(folder / "flat.bmp"), np.full((20, 30, 3), 60 * number, dtype=np.uint8))
    make(tmp_path / "1", tmp_path / "ds")

    done = run_main("preview", "ds", "--to=to", "--source=2")

    assert "flat.bmp): the source's panel is omitted: it has changed: its SHA-256 differs" in done.err
    assert done.code == 5


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--keys", "77"), "--keys 77: "),
        (("--keys", "00000000,"), "--keys 00000000,: '' is no key; "),
        (("--keys", "00000002"), "--keys 00000002: failed (unsupported), so it has no frames"),
        (("--source", "nowhere"), "source.root=nowhere: no such folder or file"),
        (("--to", "file"), "--to file: is a file; expected a folder"),
        (("--draw", "1"), "preview: --draw: no such flag; expected --keys, --to, --source"),
    ],
)
def test_wrong_argument_gives_one_line_and_writes_nothing(
    few: Path, run_main: RunMain, tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    (tmp_path / "file").write_text("")

    done = run_main("preview", few, "--to", "sheets", *arguments)

    assert done.code == 2
    assert done.err.startswith(f"gen-dataset: {words}")
    assert done.err.count("\n") == 1
    assert not (tmp_path / "sheets").exists()


def test_error_for_unknown_key_explains_keys(few: Path, tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError,
        match=r"has no such key; it has keys from 00000000 to 00000003; .* 00000003-p0007 .* 00000003-l01d02",
    ):
        list(contact_sheet.write_sheets(few, tmp_path, ["12"]))


@pytest.mark.parametrize("arguments", [(), ("--to", "x"), ("source.root=x", "--to", "x")])
def test_dataset_argument_is_required(run_main: RunMain, arguments: tuple[str, ...]) -> None:
    done = run_main("preview", *arguments)

    assert (done.code, done.err) == (2, "gen-dataset: preview: expected the folder of a dataset\n")


def test_folder_argument_is_required(few: Path, run_main: RunMain) -> None:
    assert (
        run_main("preview", few).err
        == "gen-dataset: preview: --to is missing; expected the folder to write to; give --to FOLDER\n"
    )


@pytest.mark.parametrize("inside", ["", "shards"])
def test_sheets_are_not_written_into_the_dataset(few: Path, run_main: RunMain, inside: str) -> None:
    done = run_main("preview", few, "--to", few / inside)

    assert done.code == 2
    assert "expected a folder outside of datasets" in done.err


def test_dataset_without_a_pair_is_refused(make: Make, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "none.png").write_bytes(b"no picture")
    make(tmp_path / "photos", tmp_path / "ds")

    with pytest.raises(ConfigError, match="every source failed"):
        list(contact_sheet.write_sheets(tmp_path / "ds", tmp_path / "to"))


def test_folder_without_a_dataset_is_damage(tmp_path: Path) -> None:
    with pytest.raises(DamageError, match="no such manifest"):
        contact_sheet.contact_sheet(tmp_path)


def test_missing_shard_is_damage(make: Make, tmp_path: Path) -> None:
    make(fill(tmp_path / "photos", 2), tmp_path / "ds")
    (tmp_path / "ds" / "shards" / "shard-00000.tar").unlink()

    with pytest.raises(DamageError, match=r"shard-00000\.tar"):
        contact_sheet.contact_sheet(tmp_path / "ds")


def test_uncreatable_folder_is_refused(few: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")

    with pytest.raises(ConfigError, match="Not a directory"):
        list(contact_sheet.write_sheets(few, tmp_path / "file" / "sheets"))


def test_stages_need_the_source(few: Path) -> None:
    clean, noisy, row = RawPairs(few)[0]

    with pytest.raises(ValueError, match=r"00000000: the source is not available .*deleted"):
        stages_sheet.stages_sheet(sheet_pairs.SheetPair(clean, noisy, row, plan_from_row(row), None, "deleted"))
