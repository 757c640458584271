"""Contact sheets agree with the dataset: tests compute every panel again and search for it in the picture."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make
from helpers.photographs import PHOTOS, pixels
from helpers.promise_report import Figure
from PIL import Image

import unprocess_gen as ug
from unprocess_gen import RawPairs
from unprocess_gen.dataset.row import plan_from_row
from unprocess_gen.reports import panels, sheets
from unprocess_gen.simulation.reference import isp as process
from unprocess_gen.simulation.reference import unprocess
from unprocess_gen.simulation.reference.cfa import PATTERNS, mosaic
from unprocess_gen.sources import synthetic

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


def test_sheet_contains_every_panel_exactly(few: Path, tmp_path: Path, figure: Figure) -> None:
    """Order: source, clean raw and developed; below, noisy raw and developed, and the difference."""
    clean, noisy, row = RawPairs(few)[0]
    plan = plan_from_row(row)
    difference = noisy.astype(float) - clean
    span = float(plan.sensor.white_level_dn - plan.sensor.black_level_dn)
    shown = [pixels(3, HEIGHT, WIDTH) / 255]
    for raw in (clean, noisy):
        light = np.sqrt(np.clip((raw.astype(float) - plan.sensor.black_level_dn) / span, 0, 1))
        shown += [light, process.develop(raw, plan)]
    shown.append((difference / (4 * np.sqrt(np.mean(difference**2))) + 1) / 2)

    [drawn] = sheets.write_sheets(few, tmp_path, "0")
    sheet = png(drawn.files[0])

    found = [places(sheet, codes(picture)) for picture in shown]
    assert [len(places_) for places_ in found] == [1] * 6
    rows, columns = zip(*(places_[0] for places_ in found), strict=True)
    assert columns[:3] == columns[3:] == tuple(sorted(columns[:3]))
    assert len(set(rows[:3])) == len(set(rows[3:])) == 1
    assert rows[0] < rows[3]
    figure("preview", f"{sum(len(places_) == 1 for places_ in found)} of {len(shown)} panels found, pixel by pixel")


def test_detail_equals_the_developed_complete_frame(few: Path, tmp_path: Path) -> None:
    clean, _, row = RawPairs(few)[1]

    [drawn] = sheets.write_sheets(few, tmp_path, "1")

    part = codes(process.develop(clean, plan_from_row(row))[panels.detail_window(clean.shape)])
    assert part.shape == (*panels.PANEL_PX, 3)
    assert len(places(png(drawn.files[0]), part)) == 1


# The stages -----------------------------------------------------------------------------------------------------------


def test_stages_show_each_step_and_the_frames_of_the_dataset(few: Path, tmp_path: Path) -> None:
    clean, noisy, row = RawPairs(few)[0]
    plan = plan_from_row(row)
    source = pixels(3, HEIGHT, WIDTH)
    light = unprocess.linear_light(source, plan.isp.tone, plan.isp.gamma)
    camera = unprocess.apply_ccm(light, plan.camera.rgb2cam)
    expected = [source, codes(light), codes(camera), codes(unprocess.camera_light(source, plan))]
    for raw in (clean, noisy):
        sites = np.zeros((*raw.shape, 3))
        level = np.sqrt(np.clip(process.to_light(raw, plan), 0, 1))
        for (y, x), channel in {(0, 0): 1, (0, 1): 2, (1, 0): 0, (1, 1): 1}.items():  # GBRG
            sites[y::2, x::2, channel] = level[y::2, x::2]
        expected.append(codes(sites))

    [drawn] = sheets.write_sheets(few, tmp_path, "0", with_stages=True)

    assert [path.name for path in drawn.files] == ["00000000.png", "00000000.stages.png"]
    picture = png(drawn.files[1])
    assert [len(places(picture, one)) for one in expected] == [1] * len(expected)


# Averaging and fitting ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("panel_px", [(4, 6), (60, 90)], ids=["reduced", "enlarged"])
@pytest.mark.parametrize("reduction", [1, 2, 3])
@pytest.mark.parametrize("pattern", PATTERNS)
def test_planes_average_sites_of_one_colour(pattern: str, reduction: int, panel_px: tuple[int, int]) -> None:
    """Blocks of one colour each are reduced to these colours, or enlarged."""
    colours = pixels(1, 4, 6, np.uint16).astype(float)
    raw = mosaic(colours.repeat(2 * reduction, axis=0).repeat(2 * reduction, axis=1), pattern)

    shown = panels.planes_to_rgb(panels.average_planes(raw, panel_px), pattern)

    block = shown.shape[0] // 4
    np.testing.assert_allclose(shown, colours.repeat(block, axis=0).repeat(block, axis=1), rtol=1e-6)


# The overview ---------------------------------------------------------------------------------------------------------


def test_overview_has_one_strip_per_pair_in_manifest_order(few: Path) -> None:
    headings = ["00000000 a.png", "00000001 large.png", "00000003 sixteen.png"]
    strips = [*sheets.overview(few)]
    assert [heading for heading, _ in strips] == headings
    assert [heading for heading, _ in sheets.overview(few, "3,0")] == headings[::2]
    assert all(len(drawn) == 6 and all(panel.overview is not None for panel in drawn) for _, drawn in strips)


def test_overview_without_photographs_shows_the_reason_and_the_frames(few: Path, tmp_path: Path) -> None:
    [(_, with_source)], [(_, without)] = (sheets.overview(few, "0", source) for source in (None, tmp_path))
    assert without[0].overview is None and without[0].note.startswith("not available: ")
    for one, other in zip(without[1:], with_source[1:], strict=True):
        np.testing.assert_array_equal(one.overview, other.overview)


def test_finest_detail_is_the_box_with_most_texture() -> None:
    frame = np.full((400, 600, 3), 90, np.uint8)
    frame[:, :200] = 200  # a strong edge is no detail
    frame[300:340, 400:440] = np.random.default_rng(0).integers(60, 120, (40, 40, 3))
    row, column = panels.finest_detail(frame, (60, 60))
    rows, columns = panels.detail_window(frame.shape[:2], (60, 60), (row, column))
    assert rows.stop - rows.start == columns.stop - columns.start == 60 and rows.start % 2 == columns.start % 2 == 0
    assert rows.start <= 300 < 340 <= rows.stop and columns.start <= 400 < 440 <= columns.stop
    assert panels.detail_window((400, 600), (60, 60), (0, 599)) == (slice(0, 60), slice(540, 600))


def test_frames_of_any_size_are_shown(dataset: Path, tmp_path: Path) -> None:
    """The sizes include 1 x 1 and 3 x 40; by default, eight evenly spaced pairs are shown."""
    keys = [str(pair.row["key"]) for pair in RawPairs(dataset)]
    drawn = list(sheets.write_sheets(dataset, tmp_path, ",".join(keys), with_stages=True))
    assert [pair.key for pair in drawn] == keys
    assert all(pair.missing_source == "" and len(pair.files) == 2 for pair in drawn)
    shown = [pair.key for pair in sheets.write_sheets(dataset, tmp_path)]
    assert shown == [f"{i * len(PHOTOS) // 8:08d}" for i in range(8)]


def test_float_frames_are_shown_in_dn(gray_world: Path, make: Make, tmp_path: Path) -> None:
    pairs = []
    for dtype in ("uint16", "float32"):
        settings = ("source.include=[large.png]", "output.layout=packed", f"output.dtype={dtype}")
        make(gray_world, tmp_path / dtype, *settings)
        pairs.append(next(iter(sheets.selected_pairs(tmp_path / dtype, "", None))))
    for rounded, exact in zip(*((pair.clean, pair.noisy) for pair in pairs), strict=True):
        assert np.abs(exact - rounded.astype(np.float64)).max() <= 0.5 + 1e-3  # rounding, and float32


@pytest.mark.parametrize("key", ["00000000", "00000000-p0001"])
def test_patch_is_shown_with_its_part_of_the_source(key: str, gray_world: Path, make: Make, tmp_path: Path) -> None:
    make(gray_world, tmp_path / "ds", "source.patch=[random,32,2]", "source.limit=1", "noise.levels=2")
    row = RawPairs(tmp_path / "ds")[3].row
    y, x = row["patch_y"], row["patch_x"]

    drawn = list(sheets.write_sheets(tmp_path / "ds", tmp_path / "to", key))

    assert len(drawn) == (4 if key == "00000000" else 2)
    part = pixels(3, HEIGHT, WIDTH)[y : y + 32, x : x + 32]
    assert len(places(png(drawn[-1].files[0]), part)) == 1


def test_root_may_be_one_photograph(gray_world: Path, make: Make, tmp_path: Path) -> None:
    photograph = sorted(gray_world.iterdir())[0]
    make(photograph, tmp_path / "ds")
    (pair,) = sheets.selected_pairs(tmp_path / "ds", "", photograph)
    assert pair.source is not None
    with Image.open(photograph) as picture:
        assert np.array_equal(pair.source, np.asarray(picture))


# The command ----------------------------------------------------------------------------------------------------------


def test_preview_writes_the_sheets_of_the_keys_of_one_dataset(
    few: Path, dataset: Path, run_main: RunMain, tmp_path: Path
) -> None:
    done = run_main("preview", few, "--keys", "00000000,00000003", "--to", "sheets", "--stages")
    assert (done.code, done.out, done.err) == (0, "4 pictures in sheets\n", "")
    before = {path.name: path.read_bytes() for path in (tmp_path / "sheets").iterdir()}
    assert before.keys() == {f"{key}{kind}.png" for key in ("00000000", "00000003") for kind in ("", ".stages")}

    done = run_main("preview", dataset, "--keys", "3", "--to", "sheets")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert done.err.startswith(f"gen-dataset: --to sheets: 00000000.png is not a sheet of {dataset}; ")
    assert {path.name: path.read_bytes() for path in (tmp_path / "sheets").iterdir()} == before
    assert run_main("preview", few, "--keys", "1", "--to", "sheets").code == 0  # more sheets of the same dataset


@pytest.mark.parametrize("inside", ["", "sheets"])
def test_preview_refuses_the_folder_of_the_photographs(
    inside: str, few: Path, gray_world: Path, run_main: RunMain
) -> None:
    before = sorted(gray_world.rglob("*"))
    done = run_main("preview", few, "--to", gray_world / inside)
    assert done.code == 2
    assert done.err.startswith(f"gen-dataset: --to {gray_world / inside}: is inside the folder of the photographs, ")
    assert sorted(gray_world.rglob("*")) == before


@pytest.mark.parametrize(("content", "reason"), [(None, "No such file"), (b"x", "a.png")])
def test_changed_photograph_is_named_and_its_panel_omitted(
    few: Path, gray_world: Path, run_main: RunMain, tmp_path: Path, content: bytes | None, reason: str
) -> None:
    shutil.copytree(gray_world, tmp_path / "moved")
    photograph = tmp_path / "moved" / "a.png"
    size = photograph.stat().st_size
    photograph.unlink()
    if content is not None:
        photograph.write_bytes(content * size)

    done = run_main("preview", few, "--keys=00000000,00000001", "--to=to", "source.root=moved", "--stages")

    assert (done.code, done.out, done.err.count("\n")) == (5, "3 pictures in to\n", 1)
    assert done.err.startswith("gen-dataset: 00000000 (a.png): the source's panel and the stages are omitted: ")
    assert done.err.endswith("; restore the file, or regenerate the dataset\n")
    assert reason in done.err


def test_moved_photographs_are_omitted(gray_world: Path, make: Make, run_main: RunMain, tmp_path: Path) -> None:
    photos = shutil.copytree(gray_world, tmp_path / "photos")
    make(photos, tmp_path / "ds", "source.limit=1")
    photos.rename(tmp_path / "moved")
    done = run_main("preview", "ds", "--to", "to")
    assert (done.code, done.out, "panel is omitted" in done.err) == (5, "1 picture in to\n", True)
    assert run_main("report", "ds").code == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("DS --to sheets --keys 77", "--keys 77: "),
        ("DS --to sheets --keys 00000002", "--keys 00000002: failed (unsupported), so it has no frames"),
        ("DS --to sheets source.root=nowhere", "source.root=nowhere: no such folder or file"),
        ("DS --to file", "--to file: is a file; expected a folder"),
        ("DS --to DS/sheets", "--to DS/sheets: is inside the dataset "),
    ],
)
def test_wrong_argument_gives_one_line_and_writes_nothing(
    few: Path, run_main: RunMain, tmp_path: Path, arguments: str, words: str
) -> None:
    (tmp_path / "file").write_text("")

    done = run_main("preview", *arguments.replace("DS", str(few)).split())

    assert done.code == 2
    assert done.err.startswith(f"gen-dataset: {words.replace('DS', str(few))}")
    assert done.err.count("\n") == 1
    assert not (tmp_path / "sheets").exists()


def test_frames_of_a_burst_are_shown_before_and_after_alignment(tmp_path: Path) -> None:
    settings = ["source.burst={frames: 2, downscale: 2, ev: [0, -1]}", "source.limit=1", "n_jobs=1"]
    ug.generate(ug.load_config([*settings, f"out={tmp_path / 'ds'}"]))
    (_, first), (_, second) = sheets.overview(tmp_path / "ds", "0")
    *_, base, before, after = second
    assert (len(first), len(second), base.title) == (6, 9, "frame 0, clean")
    assert before.overview is not None
    assert after.overview is not None
    assert after.overview.std() < before.overview.std() / 3


def test_the_source_of_a_burst_is_its_target(tmp_path: Path) -> None:
    settings = ["source.burst={frames: 2, downscale: 4}", "source.patch=[random,128,1]", "source.limit=1", "n_jobs=1"]
    ug.generate(ug.load_config([*settings, f"out={tmp_path / 'ds'}"]))
    (pair, *_) = sheets.selected_pairs(tmp_path / "ds", "0", None)
    assert pair.source is not None
    assert pair.source.shape == (128, 128, 3)
    y, x = 4 * int(pair.row["patch_y"] or 0), 4 * int(pair.row["patch_x"] or 0)
    assert np.array_equal(pair.source, synthetic.picture(str(pair.row["source"]))[y : y + 128, x : x + 128])
