"""The script that draws the article's figures, and its counts against the reference."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest
from helpers.promise_report import Figure
from PIL import Image

import unprocess_gen as ug
from unprocess_gen.simulation.pair import make_pair, reference_pair

pytest.importorskip("matplotlib", reason="matplotlib is not installed")


def test_script_draws_every_figure_and_counts_saturated_sites(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], figure: Figure
) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "docs" / "figures"))
    draw = importlib.import_module("draw")
    draw.main(["source.limit=1", "source.downscale=2", f"out={tmp_path}"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(": ")[2][:4] for line in lines] == ["0 of", "1 of"]
    for number in range(1, 8):
        assert len(np.unique(np.asarray(Image.open(tmp_path / f"fig{number}.png").convert("RGB")))) > 50
    (photo,) = draw.photographs(ug.load_config(["source.limit=1", "source.downscale=2"]))
    made, expected = (
        [make(photo.srgb, plan).counts.saturated for plan in photo.plans.values()]
        for make in (make_pair, reference_pair)
    )
    assert made == expected and len(set(made)) > 2
    figure("paper-figures", f"{len(made)} of {len(made)} counts equal the reference: {sorted(set(made))} saturated")
