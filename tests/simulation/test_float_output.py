"""Frames in float32 and packed planes: the pair without rounding, clipped or not, byte for byte reproducible."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.datasets import Make, Settings
from helpers.noise_fits import dataset_fits, fit_pair
from helpers.promise_report import Figure
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen import RawPairs
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.arrays import Frame
from unprocess_gen.planning.effect_selection import facts_for
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation import self_test as selftest
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.plan import REFERENCE, Plan
from unprocess_gen.simulation.reference import cfa as bayer
from unprocess_gen.simulation.reference.sensor import in_dn

FLOATS = ("output.dtype=float32", "output.layout=packed", "sensor.clip=none")
ORIGIN = 1, 57
GOLDEN = selftest.GOLDEN_PLANS
PLANS = {
    **{name: GOLDEN[name] for name in ("per_channel", "gray_mean", "plain", "physical")},
    "white": GOLDEN["physical"].replace(saturated_as="white"),
    "averaged": GOLDEN["physical"].replace(physics=selftest.GOLDEN_PHYSICS.replace(fixed_pattern_in_clean=True)),
    "poisson": GOLDEN["per_channel"].replace(noise_law="poisson"),
    "silent": GOLDEN["per_channel"].replace(effects=()),
}
"""One plan for each set of kernels."""


def normalised(plan: Plan, clip: str = "none", layout: str = "mosaic") -> Plan:
    return plan.replace(dtype="float32", sensor_clip=clip, layout=layout)


def dn(frame: Frame, plan: Plan) -> np.ndarray:
    return in_dn(frame, (plan.sensor.black_level_dn, plan.sensor.white_level_dn))


# Pairs ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("clip", ["none", "sensor", "black"])
@pytest.mark.parametrize("name", PLANS)
def test_kernels_equal_the_reference_byte_for_byte(name: str, clip: str, figure: Figure) -> None:
    plan, picture = normalised(PLANS[name], clip), selftest.golden_image()
    compiled, expected = (make_pair(picture, one, ORIGIN) for one in (plan, plan.replace(accuracy=REFERENCE)))
    assert compiled.clean.tobytes() == expected.clean.tobytes()
    assert compiled.noisy.tobytes() == expected.noisy.tobytes()
    assert compiled.counts == expected.counts
    changed = int((compiled.noisy != expected.noisy).sum())
    figure("float-output", f"{changed} of {expected.noisy.size} sites differ from the reference")


@pytest.mark.parametrize("name", PLANS)
def test_an_integer_frame_is_the_rounded_float_frame(name: str) -> None:
    """Values within 6e-5 DN (at 10 bits) of a rounding boundary are excluded; the cast to float32 may move them."""
    plan, picture = PLANS[name], selftest.golden_image()
    whole, exact = make_pair(picture, plan, ORIGIN), make_pair(picture, normalised(plan), ORIGIN)
    for rounded, frame in ((whole.clean, exact.clean), (whole.noisy, exact.noisy)):
        assert frame.dtype == np.float32
        value = dn(frame, plan)
        near_a_half = abs(value - np.floor(value) - 0.5) < 1e-4
        assert near_a_half.mean() < 0.01
        assert np.array_equal(np.clip(np.rint(value), 0, 1023)[~near_a_half], rounded[~near_a_half])


@pytest.mark.parametrize("name", ["per_channel", "physical"])
def test_clipped_counts_do_not_depend_on_the_clipping_mode(name: str) -> None:
    """With levels 64 and 1023 at 10 bits, values below DN 0 or above 1023 of the unclipped frame are counted."""
    free, sensor, black = (
        make_pair(selftest.golden_image(), normalised(PLANS[name], clip), ORIGIN)
        for clip in ("none", "sensor", "black")
    )
    value = free.noisy
    lowest = np.float32(-64 / 959)
    assert (free.counts.noisy_clipped_low, free.counts.noisy_clipped_high) == (0, 0)
    assert sensor.counts.noisy_clipped_low == int((value < lowest).sum())
    assert sensor.counts.noisy_clipped_high == int((value > 1).sum()) > 0
    assert sensor.counts.noisy_clipped_low + sensor.counts.noisy_clipped_high > 0
    assert black.counts.noisy_clipped_low == int((value < 0).sum()) > sensor.counts.noisy_clipped_low
    assert np.array_equal(sensor.noisy, np.clip(value, lowest, 1))
    assert np.array_equal(black.noisy, np.clip(value, 0, 1))
    assert free.clean.tobytes() == sensor.clean.tobytes() == black.clean.tobytes()


def test_unclipped_noise_has_mean_zero_in_black() -> None:
    """Tolerance: five standard errors. Clipped at black, the mean would be that of half a normal, σ/√(2π)."""
    black = np.zeros((512, 512, 3), dtype=np.uint8)
    plan = PLANS["per_channel"]
    std = np.sqrt(plan.noise.b_dn2) / 959
    free, clipped = (make_pair(black, normalised(plan, clip)).noisy for clip in ("none", "black"))
    assert abs(free.mean(dtype=np.float64)) < 5 * std / 512
    assert abs(free.var(dtype=np.float64) / std**2 - 1) < 5 * np.sqrt(2) / 512
    assert abs(clipped.mean(dtype=np.float64) - std / np.sqrt(2 * np.pi)) < 5 * 0.6 * std / 512


# Planes ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("origin", [(0, 0), (0, 1), (1, 0), (1, 1)])
@pytest.mark.parametrize("pattern", bayer.PATTERNS)
def test_planes_are_ordered_r_gr_gb_b_for_every_pattern(pattern: str, origin: tuple[int, int]) -> None:
    y, x = np.mgrid[0:6, 0:8]
    sites = np.array(bayer.tile(pattern, origin))
    channel = bayer.pack(sites[y % 2, x % 2].astype(np.uint16), pattern, origin)
    row = bayer.pack((y % 2).astype(np.uint16), pattern, origin)
    assert [set(np.unique(plane)) for plane in channel] == [{0}, {1}, {1}, {2}]
    assert np.array_equal(row[0], row[1])  # the first green lies in the rows of red
    assert np.array_equal(row[2], row[3])


@given(st.sampled_from(bayer.PATTERNS), st.integers(1, 9), st.integers(1, 9), st.sampled_from(["uint16", "float32"]))
def test_unpacking_is_the_inverse_of_packing(pattern: str, height: int, width: int, dtype: str) -> None:
    mosaic = np.random.default_rng(0).integers(0, 65536, (2 * height, 2 * width)).astype(dtype)
    planes = bayer.pack(mosaic, pattern)
    assert (planes.shape, planes.dtype) == ((4, height, width), mosaic.dtype)
    assert np.array_equal(bayer.unpack(planes, pattern), mosaic)


@pytest.mark.parametrize("shape", [(3, 4), (4, 3)])
def test_an_odd_side_cannot_be_packed(shape: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="even"):
        bayer.pack(np.zeros(shape, dtype=np.uint16), "RGGB")
    with pytest.raises(ValueError, match="even"):
        make_pair(np.zeros((*shape, 3), dtype=np.uint8), PLANS["silent"].replace(layout="packed"))


# Plans ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", ["brooks2019", "none", "oppo_reno10x"])
def test_float_frames_skip_quantisation(noise: str, settings: Settings) -> None:
    picture = selftest.golden_image()
    for overrides, rounded in ((FLOATS, False), ((), True)):
        config = settings(f"noise={noise}", *overrides)
        validate_config(config)
        plan = plan_image(config, "0" * 64, facts=facts_for(config, picture))
        assert ("quantise" in plan.noise.effects) == rounded
        assert ("quantise: float output is not rounded" in plan.noise.skipped) != rounded


# Datasets -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def packed(photos: Path, make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Dataset of packed planes in float32, which tests do not modify."""
    out = tmp_path_factory.mktemp("floats") / "ds"
    make(photos, out, "output.pairs_per_shard=5", "noise=brooks2019", *FLOATS)
    return out


def test_items_have_the_dtype_and_layout_of_their_rows(packed: Path) -> None:
    pairs = RawPairs(packed)
    assert len(pairs) == 12
    for clean, noisy, row in pairs:
        assert (row["dtype"], row["layout"]) == ("float32", "packed")
        assert clean.dtype == noisy.dtype == np.dtype("<f4")
        assert clean.shape == noisy.shape == (4, row["height"] // 2, row["width"] // 2)
        assert clean.min() >= 0
        assert clean.max() <= 1


def test_an_odd_side_loses_its_last_row_or_column(packed: Path) -> None:
    sizes = {str(row["source"]): (row["height"], row["width"]) for _, _, row in RawPairs(packed)}
    assert sizes["comma, and space.jpg"] == (22, 36)  # 23 x 37
    assert sizes["strip.bmp"] == (2, 40)  # 3 x 40


@pytest.mark.parametrize("accuracy", ["fast", pytest.param("reference", marks=pytest.mark.slow)])
def test_arrays_are_the_same_in_every_tier(accuracy: str, packed: Path, photos: Path, make: Make) -> None:
    out = packed.parent / accuracy
    make(photos, out, f"accuracy={accuracy}", "noise=brooks2019", *FLOATS)
    digests = [[(row["clean_xxh3"], row["noisy_xxh3"]) for *_, row in RawPairs(ds)] for ds in (packed, out)]
    assert digests[0] == digests[1]


@pytest.mark.parametrize(
    "overrides",
    [
        ("noise=heteroscedastic", "noise.a=0.02", "noise.b=0.01", *FLOATS),  # which rounding would hide
        ("output.layout=packed", "sensor.pattern=GRBG"),
    ],
)
def test_the_noise_of_the_arrays_fits_the_rows(overrides: tuple[str, ...], make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=1", *overrides)
    found = dataset_fits(tmp_path / "ds")
    assert len(found) == 1
    assert found[0].deviation < 5
    clean, noisy, row = RawPairs(tmp_path / "ds")[0]
    gain = "dn_per_e" if row["dn_per_e"] else "a_dn"  # the law of a physical profile follows from dn_per_e
    lying = fit_pair(clean, noisy, row | {gain: row[gain] * 1.1})
    assert lying is not None
    assert lying.deviation > 6
