"""Pairs and readers have HTML for notebooks, and a `repr` of one line."""

from __future__ import annotations

import base64
import dataclasses
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.datasets import Make
from PIL import Image

import unprocess_gen as ug
from unprocess_gen.dataset import notebook
from unprocess_gen.dataset.notebook import pair_html


def pictures(text: str) -> list[np.ndarray[Any, Any]]:
    """Pictures in HTML, which names no colour."""
    assert not re.search("color|background|<script", text)
    return [np.array(Image.open(io.BytesIO(base64.b64decode(png)))) for png in re.findall('base64,([^"]+)', text)]


def test_small_pair_is_shown_site_by_site_and_as_developed() -> None:
    pair = ug.make_pair(np.full((48, 64, 3), 90, np.uint8), ug.load_config(["isp=linear", "gains=unity"]))
    clean, noisy, developed = pictures(pair._repr_html_())
    for codes, frame in ((clean, pair.clean), (noisy, pair.noisy)):
        light = np.clip(ug.to_light(frame, pair.row), 0, 1)
        assert np.abs(codes - 255 * np.sqrt(light)).max() <= 0.501
    np.testing.assert_array_equal(developed, ug.develop(pair.noisy, pair.row))


@pytest.mark.parametrize(
    ("shape", "shown"), [((600, 800), (150, 200)), ((2, 515), (2, 172)), ((1, 1), (2, 2)), ((255, 9), (256, 10))]
)
def test_thumbnail_keeps_tiles_and_fits(shape: tuple[int, int], shown: tuple[int, int]) -> None:
    tile = np.arange(4, dtype=np.uint16).reshape(2, 2)
    frame = np.tile(tile, (300, 400))[: shape[0], : shape[1]]
    small = notebook._thumbnail(frame)
    assert small.shape == shown
    if min(shape) > 1:
        np.testing.assert_array_equal(small, np.tile(tile, (shown[0] // 2, shown[1] // 2)))


def test_reader_shows_three_pairs(dataset: Path, make: Make, tmp_path: Path) -> None:
    other = tmp_path / "<b>&"
    make(None, other, "source.limit=2", "camera=sony_a7r", "split={one: 0.5, two: 0.5}", "output.layout=packed")
    text = ug.RawPairs([dataset, other])._repr_html_()
    assert len(pictures(text)) == 9
    assert "&lt;b&gt;&amp;" in text and "<b>" not in text
    assert text.count(">key</th>") == text.count(">camera</th>") == 3
    for live in (ug.LivePairs(other, patch=8, patches=2), ug.LivePairs(["source.limit=2"])):
        assert len(pictures(live._repr_html_())) == 3 * min(3, len(live))
    assert not pictures(ug.RawPairs(dataset, inputs="mosaic")._repr_html_())
    row = {**ug.RawPairs(dataset)[0].row, "source": "<script>"}
    assert "&lt;script" in pair_html(*ug.RawPairs(dataset)[0][:2], row)


def test_repr_is_one_short_line(dataset: Path, make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "clips", "source.clips=true", "source.limit=8")
    config, live = ug.load_config(["body=sony_a7s2", "split={a: 1}"]), ug.LivePairs(dataset)
    plan = ug.plan_image(np.zeros((8, 8, 3), np.uint8), config)
    clips, samples = ug.RawClips(tmp_path / "clips"), (ug.RawPairs(dataset)[0], live[3, 0])
    for value in (config, plan, *samples, clips, clips[0], live, live.rows, ug.EpochSampler(9, seed=3, block=3)):
        assert repr(value).startswith(f"{type(value).__name__}(") and "\n" not in repr(value) and len(repr(value)) < 200
    assert "key=00000000, dataset='ds'" in repr(samples[0]) and "body=sony_a7s2" in repr(config)
    many = ug.RawPairs([dataset] * 50)
    assert repr(many).endswith(", …], length=650)") and repr(many).count("/ds") == 5
    assert dataclasses.is_dataclass(config) and "block=3, state=(0, 0)" in repr(ug.EpochSampler(9, block=3))
