"""The figures of the article: counts computed independently, captions, and errors of the verb."""

from __future__ import annotations

import html
import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Settings
from helpers.photographs import pixels
from helpers.promise_report import Figure
from PIL import Image

from unprocess_gen.config.schema import replaced
from unprocess_gen.reports.paper import figures as paper_figures
from unprocess_gen.reports.paper import pictures as figure_pictures
from unprocess_gen.reports.paper.figures import INTERPRETATIONS, Saturation
from unprocess_gen.reports.paper.pictures import PaperFigure
from unprocess_gen.simulation.pair import reference_pair
from unprocess_gen.simulation.reference.cfa import PATTERNS
from unprocess_gen.sources.scenes import synthetic

FILES = [*(f"fig{number}.png" for number in range(1, 8)), "figures.html"]


@pytest.fixture(scope="module")
def drawn(settings: Settings) -> list[PaperFigure]:
    """The figures for two built-in scenes."""
    return paper_figures.draw_figures(settings("source.limit=2"))


def named(drawn: list[PaperFigure], file: str) -> PaperFigure:
    (figure,) = (figure for figure in drawn if figure.file == file)
    return figure


def table_lines(figure: PaperFigure) -> list[Sequence[str]]:
    assert figure.table is not None
    return list(figure.table.lines)


def page_text(drawn: list[PaperFigure]) -> str:
    """Return the page of figures in one line."""
    return " ".join(paper_figures.figures_page(drawn, "command").split())


def colours(png: bytes) -> int:
    """Return the number of colours in a picture."""
    rgb = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(np.uint32)
    return len(np.unique(rgb[..., 0] << 16 | rgb[..., 1] << 8 | rgb[..., 2]))


def test_every_figure_has_many_colours(drawn: list[PaperFigure]) -> None:
    assert [figure.file for figure in drawn] == FILES[:-1]
    least = {"fig4.png": 200, "fig6.png": 200, "fig7.png": 200}
    assert [figure.file for figure in drawn if colours(figure.png) < least.get(figure.file, 2000)] == []


def test_every_caption_compares_with_the_article(drawn: list[PaperFigure]) -> None:
    captions = page_text(drawn).split("<figcaption>")[1:]
    assert len(captions) == len(drawn)
    assert all("Against the article: " in caption for caption in captions)
    assert not re.search(r">[^<]*(nan|inf\b|\{)", "".join(captions))


def test_counts_of_figure_6_agree_with_the_reference(
    settings: Settings, drawn: list[PaperFigure], figure: Figure
) -> None:
    srgb = synthetic.scene("dead_leaves-0")
    planes = srgb[0::2, 0::2, 0], srgb[0::2, 1::2, 1], srgb[1::2, 0::2, 1], srgb[1::2, 1::2, 2]
    before = sum(int((plane == 255).sum()) for plane in planes)
    subject = paper_figures.load_figure_source(settings("source.limit=1"))
    after = {name: reference_pair(srgb, subject.plans[name]).counts.saturated for name in paper_figures.GAINS}

    listed = {
        line[0]: tuple(int(cell.split()[0].replace(",", "")) for cell in line[2:4])
        for line in table_lines(named(drawn, "fig6.png"))
    }
    assert listed == {name: (before, count) for name, count in after.items()}
    assert len(set(after.values())) > 2
    figure(
        "paper-figures",
        f"{len(after)} of {len(listed)} counts equal the reference: {sorted(set(after.values()))} saturated sites",
    )


def test_only_gains_above_one_add_saturation(drawn: list[PaperFigure]) -> None:
    lines = table_lines(named(drawn, "fig6.png"))
    before = {float(line[4].rstrip("%")) for line in lines}
    after = {line[0]: float(line[5].rstrip("%")) for line in lines}
    assert after["paper_max"] == after["fig6_top"] <= min(before)
    assert after["fig6_bottom"] > after["paper_min"] > after["paper_max"] > 0


@pytest.mark.parametrize(
    ("top", "bottom", "fits"), [(5, 9, True), (4, 6, True), (6, 9, False), (5, 5, False), (9, 5, False)]
)
def test_match_means_more_saturation_in_the_bottom_row_only(top: int, bottom: int, fits: bool) -> None:
    interpretation = INTERPRETATIONS[0]
    counted = Saturation([100], [5], {interpretation.top: [top], interpretation.bottom: [bottom]})
    assert counted.count_matching(interpretation) == fits


def test_multiplication_matches_the_caption_and_division_does_not(settings: Settings) -> None:
    counted = paper_figures.load_figure_source(settings("source.limit=5")).saturation
    by_formula, by_pictures = (counted.count_matching(interpretation) for interpretation in INTERPRETATIONS)
    assert by_formula == 0
    assert by_pictures >= 3


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("most", [8, 3])
def test_saturated_sites_have_the_colour_of_their_filter(pattern: str, most: int) -> None:
    sites = np.zeros((8, 12), dtype=bool)
    at = pattern.index("B")
    sites[at // 2 :: 2, at % 2 :: 2] = True
    shares = figure_pictures.channel_fractions(sites, pattern, most)
    assert shares.max(axis=(0, 1)).tolist() == [0, 0, 1]
    assert most == 8 or shares[..., 2].min() == 1


def test_block_means_keep_mean_and_cfa_sites() -> None:
    image = pixels(1, 64, 96)
    assert figure_pictures.block_means(image, 24).shape == (16, 24, 3)
    np.testing.assert_allclose(
        figure_pictures.block_means(image, 24).mean(axis=(0, 1)), image.mean(axis=(0, 1)), rtol=1e-12
    )
    board = np.indices((90, 90)).sum(axis=0) % 2
    assert np.unique(figure_pictures.block_means(board, 30, is_mosaic=True)).tolist() == [0.5]


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(1, 1), (2, 2), (3, 40), (17, 131), (131, 17)])
def test_photographs_of_any_shape_are_drawn(shape: tuple[int, int], settings: Settings, tmp_path: Path) -> None:
    Image.fromarray(pixels(3, *shape)).save(tmp_path / "one.png")
    config = settings()
    config = replaced(config, {"source.root": str(tmp_path)})
    assert len(paper_figures.draw_figures(config)) == len(FILES) - 1


# The command ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch, drawn: list[PaperFigure]) -> None:
    """Let the verb write figures that are already drawn."""
    monkeypatch.setattr(paper_figures, "draw_figures", lambda config: drawn)


@pytest.mark.usefixtures("quick")
def test_figures_writes_pictures_and_a_page_that_shows_them(run_main: RunMain, tmp_path: Path) -> None:
    done = run_main("figures", "source.limit=2", "out=new/figs")
    assert (done.code, done.err) == (0, "")
    assert sorted(path.name for path in (tmp_path / "new/figs").iterdir()) == sorted(FILES)
    page = (tmp_path / "new/figs/figures.html").read_text(encoding="utf-8")
    assert re.findall(r'src="([^"]*)"', page) == FILES[:-1]
    assert "gen-dataset figures source.limit=2 out=new/figs" in page
    assert "<script" not in page


@pytest.mark.usefixtures("quick")
def test_default_folder_is_named_figures(run_main: RunMain, tmp_path: Path) -> None:
    assert run_main("figures").code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["figures"]


@pytest.mark.parametrize("override", ["gains=unity", "gains.red=2", "noise=none", "isp=linear", "accuracy=fast"])
def test_settings_fixed_by_the_article_are_refused(override: str, run_main: RunMain, tmp_path: Path) -> None:
    done = run_main("figures", override, "out=figs")
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert f"figures: {override}: the article sets it; expected source, " in done.err
    assert list(tmp_path.iterdir()) == []


def test_patches_are_refused(run_main: RunMain, tmp_path: Path) -> None:
    done = run_main("figures", "source.patch=64", "out=figs")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "source.patch=64: the figures show complete photographs" in done.err
    assert list(tmp_path.iterdir()) == []


def test_missing_library_gives_one_line_that_names_the_extra(
    run_main: RunMain, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("unprocess_gen.core.libraries.find_spec", lambda name: None)
    done = run_main("figures", "out=figs")
    assert done.code == 2
    assert (
        done.err
        == "gen-dataset: figures: drawing needs matplotlib; in the source folder, run: pip install '.[figures]'\n"
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_unreadable_photograph_is_named_and_the_next_one_shown(settings: Settings, tmp_path: Path) -> None:
    (tmp_path / "<a>.png").write_bytes(b"no picture")
    Image.fromarray(pixels(3, 1, 1)).save(tmp_path / "<b>.png")
    config = settings()
    config = replaced(config, {"source.root": str(tmp_path)})
    page = page_text(paper_figures.draw_figures(config))
    assert "Photographs that cannot be read: &lt;a&gt;.png (unsupported)." in page
    assert html.unescape(page).count("On <b>.png") == 5
    assert "<a>" not in page and "<b>" not in page


def test_no_readable_photograph_gives_one_line(run_main: RunMain, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/a.png").write_bytes(b"no picture")
    done = run_main("figures", "source.root=photos", "out=figs")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "source.root=photos: none of 1 photographs can be read" in done.err
    assert not (tmp_path / "figs").exists()
