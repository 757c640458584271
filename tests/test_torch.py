"""`unprocess_gen.torch.develop` gives the values of the reference before rounding, and their derivatives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.cases import slow_except
from helpers.datasets import Make

import unprocess_gen as ug
from unprocess_gen.dataset.row import plan_from_row
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference import isp
from unprocess_gen.simulation.reference.cfa import MONO, PATTERNS

torch = pytest.importorskip("torch", reason="PyTorch is not installed; it is no dependency")
from torch.utils.data import DataLoader, default_collate  # noqa: E402

from unprocess_gen.torch import develop, development_parameters  # noqa: E402

ISPS = {"smoothstep_gamma22": ("smoothstep", 2.2), "srgb": ("none", "srgb"), "gamma22": ("none", 2.2)}
ISPS["linear"] = ("none", 1.0)
HIGHLIGHTS = tuple(isp.HIGHLIGHTS)
CASES = [(look, highlight) for look in ISPS for highlight in HIGHLIGHTS]
QUICK = [("smoothstep_gamma22", "per_channel"), ("srgb", "gray_mean"), ("gamma22", "none")]
LIMIT = {torch.float64: 1e-9, torch.float32: 1e-5}


@pytest.fixture(scope="module")
def pair() -> ug.RawPair:
    """Return a pair of 33 x 46 random colours, dark ones and white among them, at low light and high gain."""
    srgb = np.random.default_rng(3).integers(0, 256, (33, 46, 3), np.uint8)
    srgb[:8] //= 16
    srgb[8:12] = 255
    return ug.make_pair(srgb, ug.load_config(["noise=imx385_iso12800", "gains=paper_max"]))


def with_look(pair: ug.RawPair, look: str, highlight: str, pattern: str = "RGGB") -> Plan:
    tone, gamma = ISPS[look]
    return pair.plan.replace(tone=tone, gamma=gamma, highlight=highlight, pattern=pattern)


def reference(frame: np.ndarray, plan: Plan) -> np.ndarray:
    """Return the reference before rounding, [3, H, W]."""
    return np.moveaxis(isp.develop(frame, plan), -1, 0)


def light_of(frame: np.ndarray, plan: Plan) -> np.ndarray:
    black, white = plan.sensor.black_level_dn, plan.sensor.white_level_dn
    return (frame - float(black)) / (white - black)


@pytest.mark.parametrize("dtype", LIMIT, ids=str)
def test_one_batch_of_all_kinds_equals_the_reference(dtype: Any, pair: ug.RawPair) -> None:
    plans = [with_look(pair, *case, (*PATTERNS, MONO)[number % 5]) for number, case in enumerate(CASES)]
    stacked = default_collate([development_parameters(plan) for plan in plans])
    expected = np.stack([reference(pair.noisy, plan) for plan in plans])
    light = torch.from_numpy(light_of(pair.noisy, pair.plan)).to(dtype).expand(len(plans), 1, -1, -1)
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        of_dn = develop(torch.from_numpy(pair.noisy).expand(len(plans), -1, -1), plans)
    finally:
        torch.set_default_dtype(before)
    assert of_dn.dtype == dtype and of_dn.shape == expected.shape
    np.testing.assert_allclose(of_dn.numpy(), expected, rtol=0, atol=LIMIT[dtype])
    if dtype == torch.float64:  # light of float32 has other values than DN
        np.testing.assert_allclose(develop(light, stacked).numpy(), expected, rtol=0, atol=LIMIT[dtype])
        codes = np.rint(of_dn.numpy()[0] * 255).astype(np.uint8)
        np.testing.assert_array_equal(np.moveaxis(codes, 0, -1), ug.develop(pair.noisy, plans[0]))


@pytest.mark.parametrize("highlight", HIGHLIGHTS)
@pytest.mark.parametrize("pattern", [*PATTERNS, MONO])
def test_planes_and_camera_rgb_equal_the_reference(pattern: str, highlight: str, pair: ug.RawPair) -> None:
    plan = with_look(pair, "smoothstep_gamma22", highlight, pattern)
    even = pair.noisy[:32]
    planes = torch.from_numpy(light_of(ug.pack(even, pattern), plan))
    np.testing.assert_allclose(develop(planes[None], plan)[0].numpy(), reference(even, plan), rtol=0, atol=1e-9)
    rgb = np.random.default_rng(5).random((7, 9, 3))
    expected = np.moveaxis(isp.process(rgb * plan.scene.exposure_ratio, plan), -1, 0)
    developed = develop(torch.from_numpy(np.moveaxis(rgb, -1, 0))[None], plan)[0]
    np.testing.assert_allclose(developed.numpy(), expected, rtol=0, atol=1e-9)


def test_the_smallest_mosaics_are_mirrored_like_the_reference(pair: ug.RawPair) -> None:
    for height, width in ((2, 2), (2, 5), (3, 2)):
        small = pair.noisy[20 : 20 + height, :width].copy()
        developed = develop(torch.from_numpy(light_of(small, pair.plan))[None], pair.plan)[0]
        np.testing.assert_allclose(developed.numpy(), reference(small, pair.plan), rtol=0, atol=1e-9)


@pytest.mark.parametrize(("look", "highlight"), slow_except(QUICK, CASES))
def test_gradients_equal_finite_differences(look: str, highlight: str, pair: ug.RawPair) -> None:
    plan = with_look(pair, look, highlight).replace(red_gain=1.2, blue_gain=1.1, inverse_rgb_gain=0.8)
    for shape in ((1, 4, 5), (1, 4, 2, 2), (1, 3, 3, 3)):
        generator = torch.Generator().manual_seed(0)
        light = torch.rand(shape, generator=generator, dtype=torch.float64) * 0.97 + 0.02
        developed = develop(light, plan)
        assert ((developed > 0) & (developed < 1)).double().mean() > 0.4  # most values are not clipped
        assert torch.autograd.gradcheck(lambda light: develop(light, plan), light.requires_grad_())


@pytest.mark.parametrize(("look", "highlight"), CASES)
def test_gradients_are_finite_at_black_white_and_beyond(look: str, highlight: str, pair: ug.RawPair) -> None:
    plan = with_look(pair, look, highlight)
    levels = [-1e3, -0.1, -1e-30, 0.0, 1e-40, 1e-30, 1e-12, 1e-8, plan.isp.highlight_threshold, 1.0, 1.1, 1e3]
    for dtype in LIMIT:
        flat = torch.tensor(levels, dtype=dtype)[:, None, None].repeat(1, 6, 6).requires_grad_()
        generator = torch.Generator().manual_seed(1)
        mixed = torch.tensor(levels, dtype=dtype)[torch.randint(len(levels), (40, 6, 6), generator=generator)]
        for light in (flat, mixed.requires_grad_()):
            developed = develop(light, plan)
            developed.sum().backward()
            assert developed.isfinite().all() and light.grad is not None and light.grad.isfinite().all()
        assert flat.grad is not None and not flat.grad[0].any() and not flat.grad[-1].any()  # clipped in all channels


def test_half_precision_gives_float32(pair: ug.RawPair) -> None:
    assert develop(torch.zeros(1, 4, 4, dtype=torch.float16), pair.row).dtype == torch.float32


@pytest.mark.parametrize(
    ("shape", "rows", "message"),
    [
        ((4, 4), 1, r"frames=\[4, 4\]: expected \[N, H, W\]"),
        ((1, 2, 4, 4), 1, r"frames=\[1, 2, 4, 4\]: expected"),
        ((1, 1, 4), 1, r"frames=\[1, 1, 1, 4\]: channels are missing; expected at least 2 x 2 sites"),
        ((3, 4, 4), 2, "rows=2: there are 3 frames; expected a row for each, or one for all"),
        ((3, 4, 4), 0, "rows=0: there are 3 frames; expected a row for each, or one for all"),
    ],
)
def test_wrong_frames_and_rows_are_refused(shape: tuple[int, ...], rows: int, message: str, pair: ug.RawPair) -> None:
    with pytest.raises(ValueError, match=message):
        develop(torch.zeros(shape), [pair.row] * rows)


def test_row_of_no_pair_is_refused(pair: ug.RawPair) -> None:
    with pytest.raises(ug.DamageError):
        develop(torch.zeros(1, 4, 4), {**pair.row, "gamma": "steep"})
    assert plan_from_row(pair.row).camera == pair.plan.camera


def test_data_loader_stacks_pairs_with_rows(make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.patch=64", "source.limit=2", "output.targets=[linear_rgb]")
    pairs = ug.RawPairs(tmp_path / "ds")
    (batch,) = DataLoader(pairs, batch_size=len(pairs))
    assert batch.noisy.dtype == torch.uint16 and tuple(batch.noisy.shape) == (len(pairs), 64, 64)
    assert batch.row["key"] == [pair.row["key"] for pair in pairs]
    assert tuple(batch.targets["linear_rgb"].shape) == (len(pairs), 64, 64, 3)
    flipped = ug.RawPairs(tmp_path / "ds", patch=16, flip=True)
    (batch,) = DataLoader(flipped, batch_size=len(pairs))
    np.testing.assert_array_equal(batch.noisy, np.stack([pair.noisy for pair in flipped]))
    assert tuple(batch.targets["linear_rgb"].shape) == (len(pairs), 16, 16, 3)


def test_inputs_and_their_parameters_develop_as_the_stored_pairs(make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.patch=[random,64,2]", "source.limit=3", "camera=choice")
    pairs = ug.RawPairs(tmp_path / "ds")
    expected = np.stack([reference(pair.noisy, plan_from_row(pair.row)) for pair in pairs])
    for inputs in ("mosaic", "packed"):
        items = [*ug.RawPairs(tmp_path / "ds", inputs=inputs)]
        batch = default_collate(items)
        developed = develop(batch["noisy"], batch["development"])
        np.testing.assert_allclose(developed.numpy(), expected, rtol=0, atol=LIMIT[torch.float32])
        alone = develop(torch.from_numpy(np.stack([items[1]["noisy"]] * 2)), items[1]["development"])
        assert torch.equal(alone, developed[[1, 1]])
