"""Bands of raw levels that no code of an 8-bit photograph reaches."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.datasets import Settings

from unprocess_gen.core.types import Plan
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.reports.empty_bands import NO_BANDS, WIDE, band_widths, empty_bands, highlight_sentence
from unprocess_gen.simulation.pair import make_pair


@pytest.fixture(scope="module")
def plan(settings: Settings) -> Plan:
    config = settings("gains=paper_max", "camera=identity", "noise=none", "sensor=generic_16bit")
    return plan_image(config, "a" * 64)


def gray(code: int) -> np.ndarray:
    return np.full((8, 8, 3), code, dtype=np.uint8)


def test_widths_are_those_of_clean_frames(plan: Plan) -> None:
    widths = band_widths(plan)
    for code in (100, 253, 254):
        low, high = (make_pair(gray(one), plan).clean[:2, :2].astype(float) for one in (code, code + 1))
        measured = (high - low) / (65535 - 4096)
        red, green, blue = widths[code]
        assert np.abs(measured - [[red, green], [green, blue]]).max() < 2e-5


def test_the_two_brightest_codes_span_most_of_the_range(plan: Plan) -> None:
    bands = empty_bands(gray(254), plan)
    assert [round(width, 2) for width in bands.widest] == [0.78, 0.53, 0.73]
    assert (band_widths(plan)[:240] < WIDE).all()


def test_share_counts_sites_next_to_bands_by_channel(plan: Plan) -> None:
    srgb = np.full((10, 10, 3), 200, dtype=np.uint8)
    srgb[:5, :, 1] = 254
    assert empty_bands(srgb, plan).share == pytest.approx(0.25)
    srgb[:, :2, 0] = 254
    assert empty_bands(srgb, plan).share == pytest.approx(0.25 + 0.05)
    assert empty_bands(gray(255), plan).share == 0
    assert empty_bands(gray(240), plan).share == 0


def test_dithered_highlights_and_16_bit_codes_have_no_bands(plan: Plan) -> None:
    assert empty_bands(gray(254), plan.replace(dequantize="dither_all")) == NO_BANDS
    assert empty_bands(gray(254).astype(np.uint16) * 257, plan) == NO_BANDS
    assert empty_bands(gray(254), plan.replace(dequantize="dither")).share == 1


def test_sentence_has_share_widths_and_remedy(plan: Plan) -> None:
    sentence = highlight_sentence([empty_bands(gray(254), plan), NO_BANDS])
    assert sentence.startswith("50 % of the sites are highlights where 8-bit codes are coarse")
    assert "up to 78 % (R), 53 % (G), 73 % (B) of the raw range apart; source.dequantize=dither_all" in sentence
    assert highlight_sentence([NO_BANDS]) == highlight_sentence([]) == ""
