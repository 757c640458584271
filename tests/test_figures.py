"""The article's figures: their counts by other means, the caption each reading fits, and what the command refuses."""

from __future__ import annotations

import html
import io
import re
from pathlib import Path

import numpy as np
import pytest
from conftest import Door, Settings, pixels
from PIL import Image

from unprocess_gen.cli import hydra_app as compose
from unprocess_gen.config.schema import GainsConfig, NoiseConfig
from unprocess_gen.config.serialization import read_option
from unprocess_gen.reports import paper_figures as figures
from unprocess_gen.reports import report_files
from unprocess_gen.reports.paper_figures import (
    INTERPRETATIONS,
    ImageSaturation,
    PaperFigure,
    PaperOptions,
    SaturationCounts,
)
from unprocess_gen.simulation.pair import reference_pair
from unprocess_gen.simulation.reference.cfa import PATTERNS
from unprocess_gen.sources.scenes import synthetic

FILES = [*(f"fig{number}.png" for number in range(2, 8)), "figures.html"]


@pytest.fixture(scope="module")
def recipes() -> PaperOptions:
    gains = {name: read_option(compose.conf_dir() / "gains" / f"{name}.yaml", GainsConfig) for name in figures.GAINS}
    return PaperOptions(gains, read_option(compose.conf_dir() / "noise" / f"{figures.AUTHORS_NOISE}.yaml", NoiseConfig))


@pytest.fixture(scope="module")
def drawn(settings: Settings, recipes: PaperOptions) -> list[PaperFigure]:
    """The figures of two built-in scenes."""
    return figures.draw_figures(settings("source.limit=2"), recipes)


def colours(png: bytes) -> int:
    """How many colours a picture holds."""
    rgb = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(np.uint32)
    return len(np.unique(rgb[..., 0] << 16 | rgb[..., 1] << 8 | rgb[..., 2]))


def test_every_figure_is_a_picture_of_something(drawn: list[PaperFigure]) -> None:
    assert [one.file for one in drawn] == FILES[:-1]
    least = {"fig4.png": 200, "fig6.png": 200, "fig7.png": 200}
    found = {one.file: colours(one.png) for one in drawn}
    assert {file: count for file, count in found.items() if count < least.get(file, 2000)} == {}


def test_every_caption_says_what_to_see_and_where_the_article_differs(drawn: list[PaperFigure]) -> None:
    assert [one.file for one in drawn if "Against the article: " not in " ".join(one.caption)] == []
    assert [one.file for one in drawn if re.search(r"nan|inf\b|\{", " ".join(one.caption))] == []


def test_counts_of_figure_6_are_those_of_algorithm_1(
    settings: Settings, recipes: PaperOptions, drawn: list[PaperFigure]
) -> None:
    (figure,) = (one for one in drawn if one.file == "fig6.png")
    srgb = synthetic.scene("dead_leaves-0")
    planes = srgb[0::2, 0::2, 0], srgb[0::2, 1::2, 1], srgb[1::2, 0::2, 1], srgb[1::2, 1::2, 2]
    before = sum(int((plane == 255).sum()) for plane in planes)
    subject = figures._subject(settings("source.limit=1"), recipes, figures.list_photographs(settings().source).sources)
    after = {name: reference_pair(srgb, subject.plans[name]).counts.saturated for name in figures.GAINS}

    said = {line[0]: tuple(int(cell.split()[0].replace(",", "")) for cell in line[2:4]) for line in figure.table[1:]}
    assert said == {name: (before, count) for name, count in after.items()}
    assert len(set(after.values())) > 2


def test_gains_above_one_saturate_and_those_below_do_not(drawn: list[PaperFigure]) -> None:
    (figure,) = (one for one in drawn if one.file == "fig6.png")
    before = {float(line[4].rstrip("%")) for line in figure.table[1:]}
    after = {line[0]: float(line[5].rstrip("%")) for line in figure.table[1:]}
    assert after["paper_max"] == after["fig6_top"] <= min(before)
    assert after["fig6_bottom"] > after["paper_min"] > after["paper_max"] > 0


@pytest.mark.parametrize(
    ("top", "bottom", "fits"), [(5, 9, True), (4, 6, True), (6, 9, False), (5, 5, False), (9, 5, False)]
)
def test_the_caption_of_figure_6_means_no_more_on_top_and_more_at_the_bottom(top: int, bottom: int, fits: bool) -> None:
    reading = INTERPRETATIONS[0]
    counted = {reading.top: [ImageSaturation(100, 5, top)], reading.bottom: [ImageSaturation(100, 5, bottom)]}
    assert SaturationCounts(counted).fitting(reading) == fits


def test_the_pictures_reading_fits_the_caption_and_the_formulas_does_not(
    settings: Settings, recipes: PaperOptions
) -> None:
    config = settings("source.limit=5")
    counted = figures._count(config, recipes, figures.list_photographs(config.source).sources)
    by_formula, by_pictures = (counted.fitting(reading) for reading in INTERPRETATIONS)
    assert by_formula == 0
    assert by_pictures >= 3


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("most", [8, 3])
def test_saturated_sites_have_the_colour_of_their_filter(pattern: str, most: int) -> None:
    sites = np.zeros((8, 12), dtype=bool)
    at = pattern.index("B")
    sites[at // 2 :: 2, at % 2 :: 2] = True
    shares = figures._channel_shares(sites, pattern, most)
    assert shares.max(axis=(0, 1)).tolist() == [0, 0, 1]
    assert most == 8 or shares[..., 2].min() == 1


def test_a_small_picture_keeps_the_mean_and_a_mosaic_its_four_sites() -> None:
    image = pixels(1, 64, 96)
    assert figures._shrunk(image, 24).shape == (16, 24, 3)
    np.testing.assert_allclose(figures._shrunk(image, 24).mean(axis=(0, 1)), image.mean(axis=(0, 1)), rtol=1e-12)
    board = np.indices((90, 90)).sum(axis=0) % 2
    assert np.unique(figures._shrunk(board, 30, of_sites=True)).tolist() == [0.5]


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(1, 1), (2, 2), (3, 40), (17, 131), (131, 17)])
def test_any_shape_of_photograph_is_drawn(
    shape: tuple[int, int], settings: Settings, recipes: PaperOptions, tmp_path: Path
) -> None:
    Image.fromarray(pixels(3, *shape)).save(tmp_path / "one.png")
    config = settings()
    config.source.root = str(tmp_path)
    assert len(figures.draw_figures(config, recipes)) == len(FILES) - 1


# The command ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch, drawn: list[PaperFigure]) -> None:
    """Have the command draw nothing new."""
    monkeypatch.setattr(figures, "draw_figures", lambda config, recipes: drawn)


@pytest.mark.usefixtures("quick")
def test_the_command_writes_one_folder_with_a_page_that_shows_every_figure(door: Door, tmp_path: Path) -> None:
    done = door("figures", "source.limit=2", "out=new/figs")
    assert (done.code, done.err) == (0, "")
    assert sorted(path.name for path in (tmp_path / "new/figs").iterdir()) == sorted(FILES)
    page = (tmp_path / "new/figs/figures.html").read_text(encoding="utf-8")
    assert re.findall(r'src="([^"]*)"', page) == FILES[:-1]
    assert "gen-dataset figures source.limit=2 out=new/figs" in page
    assert "<script" not in page


@pytest.mark.usefixtures("quick")
def test_without_out_the_figures_stand_in_a_folder_of_that_name(door: Door, tmp_path: Path) -> None:
    assert door("figures").code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["figures"]


@pytest.mark.parametrize("override", ["gains=unity", "gains.red=2", "noise=none", "isp=linear", "accuracy=fast"])
def test_what_the_article_sets_is_refused(override: str, door: Door, tmp_path: Path) -> None:
    done = door("figures", override, "out=figs")
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert f"figures: {override}: the article sets it; expected source, " in done.err
    assert list(tmp_path.iterdir()) == []


def test_patches_are_refused(door: Door, tmp_path: Path) -> None:
    done = door("figures", "source.patch=64", "out=figs")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "source.patch=64: the figures show whole photographs" in done.err
    assert list(tmp_path.iterdir()) == []


def test_without_matplotlib_one_line_names_the_extra(
    door: Door, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(report_files, "find_spec", lambda name: None)
    done = door("figures", "out=figs")
    assert done.code == 2
    assert done.err == "gen-dataset: figures: drawing needs matplotlib; pip install 'unprocess_gen[figures]'\n"
    assert list(tmp_path.iterdir()) == []


def test_a_photograph_that_cannot_be_read_is_named_and_the_next_one_shown(
    settings: Settings, recipes: PaperOptions, tmp_path: Path
) -> None:
    (tmp_path / "<a>.png").write_bytes(b"no picture")
    Image.fromarray(pixels(3, 1, 1)).save(tmp_path / "<b>.png")
    config = settings()
    config.source.root = str(tmp_path)
    page = figures.figures_page(figures.draw_figures(config, recipes), "command")
    assert "Photographs that cannot be read: &lt;a&gt;.png (unsupported)." in page
    assert html.unescape(page).count("On <b>.png") == 5
    assert "<a>" not in page and "<b>" not in page


def test_where_no_photograph_can_be_read_one_line_says_so(door: Door, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/a.png").write_bytes(b"no picture")
    done = door("figures", "source.root=photos", "out=figs")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "source.root=photos: none of 1 photographs can be read" in done.err
    assert not (tmp_path / "figs").exists()
