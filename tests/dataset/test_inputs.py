"""Items for a network are the pairs, cut, flipped, scaled and packed by the functions of the package."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from conftest import Make

import unprocess_gen as ug
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.dataset.development import development_parameters
from unprocess_gen.simulation.reference.cfa import filters

PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG", "MONO")
FLIPS = ("horizontal", "vertical", "transpose")
FORMS = {
    "mosaic": (),
    "packed": ("output.layout=packed",),
    "float": ("output.dtype=float32", "sensor.pattern=GBRG"),
    "float_clean": ("output.clean_dtype=float32",),
    "mono": ("sensor.pattern=MONO",),
}


def colours(pattern: str, height: int, width: int) -> np.ndarray:
    """Letter of the filter of each site."""
    letters = np.array([*filters(pattern)]).reshape(2, 2)
    return np.tile(letters, (height // 2 + 1, width // 2 + 1))[:height, :width]


@pytest.mark.parametrize(("pattern", "how"), [*itertools.product(PATTERNS, FLIPS)])
@pytest.mark.parametrize("shape", [(8, 12), (9, 11), (8, 11), (9, 12)])
def test_flip_keeps_the_pattern(pattern: str, how: str, shape: tuple[int, int]) -> None:
    letters = colours(pattern, *shape)
    flipped = ug.flip(letters, how, pattern)
    np.testing.assert_array_equal(flipped, colours(pattern, *flipped.shape))
    before = [shape, shape[::-1]][how == "transpose"]
    assert all(size - 2 <= kept <= size for kept, size in zip(flipped.shape, before, strict=True))
    places = np.arange(letters.size).reshape(shape)
    kept = ug.flip(ug.flip(places, how, pattern), how, pattern)
    inner = tuple(slice((size - left) // 2, (size + left) // 2) for size, left in zip(shape, kept.shape, strict=True))
    np.testing.assert_array_equal(kept, places[inner])


@pytest.mark.parametrize("how", FLIPS)
def test_flip_of_a_developed_frame_is_the_developed_flip(how: str) -> None:
    srgb = np.random.default_rng(1).integers(0, 255, (20, 24, 3), np.uint8)
    pair = ug.make_pair(srgb, ug.load_config(["noise=none"]))
    flipped = ug.develop(ug.flip(pair.clean, how), pair.row)
    developed = np.moveaxis(ug.flip(np.moveaxis(ug.develop(pair.clean, pair.row), -1, 0), how), 0, -1)
    np.testing.assert_allclose(flipped[3:-3, 3:-3].astype(int), developed[3:-3, 3:-3], atol=1)


@pytest.mark.parametrize(("name", "inputs"), [*itertools.product(FORMS, ("mosaic", "packed"))])
def test_inputs_are_the_steps_one_by_one(name: str, inputs: str, tmp_path: Path, make: Make) -> None:
    make(None, tmp_path / "ds", "source.limit=2", "noise=sony_a7s2", "output.targets=[linear_rgb]", *FORMS[name])
    pairs = ug.RawPairs(tmp_path / "ds")
    item = ug.RawPairs(tmp_path / "ds", inputs=inputs, noise_map=True, rows=True)[1]
    row, span = pairs[1].row, pairs[1].row["white_level_dn"] - pairs[1].row["black_level_dn"]
    assert list(item) == ["noisy", "clean", "noise_std", "linear_rgb", "development", "row"]
    assert item["row"] == row
    np.testing.assert_equal(tuple(item["development"]), tuple(development_parameters(row)))
    for frame in ("noisy", "clean"):
        stored = getattr(pairs[1], frame)
        light = stored if stored.dtype == np.float32 else ug.to_light(stored, row)
        if name != "packed" and inputs == "packed":
            light = ug.pack(light, row["pattern"])
        elif name == "packed" and inputs == "mosaic":
            light, item[frame] = np.sort(light, axis=None), np.sort(item[frame], axis=None)
        np.testing.assert_array_equal(item[frame], light)
    assert item["noisy"].dtype == item["noise_std"].dtype == np.float32
    np.testing.assert_allclose(
        np.sort(item["noise_std"] * span, axis=None),
        np.sort(ug.noise_std(item["noisy"] * span + row["black_level_dn"], row), axis=None),
        rtol=1e-4,
    )
    clipped = ug.RawPairs(tmp_path / "ds", inputs=inputs, clip_black=True)[1]
    np.testing.assert_array_equal(
        clipped["clean"], np.maximum(ug.RawPairs(tmp_path / "ds", inputs=inputs)[1]["clean"], 0)
    )
    live = ug.LivePairs(tmp_path / "ds", inputs=inputs, noise_map=True, targets=["linear_rgb"])[1]
    for array in ("noisy", "clean", "noise_std", "linear_rgb"):
        np.testing.assert_array_equal(
            live[array], ug.RawPairs(tmp_path / "ds", inputs=inputs, noise_map=True)[1][array]
        )


def test_odd_sides_are_left_out_of_planes(dataset: Path) -> None:
    pairs, items = ug.RawPairs(dataset), ug.RawPairs(dataset, inputs="packed")
    odd = next(number for number, pair in enumerate(pairs) if any(side % 2 for side in pair.noisy.shape))
    height, width = pairs[odd].noisy.shape
    assert items[odd]["noisy"].shape == (4, height // 2, width // 2)
    for inputs, cut in (("mosaic", (0, 0)), ("packed", (height % 2, width % 2))):
        picture = ug.LivePairs(dataset, inputs=inputs, targets=["srgb"])[odd]["srgb"]
        assert picture.shape == (height - cut[0], width - cut[1], 3)


@pytest.mark.parametrize("layout", ["mosaic", "packed"])
def test_crops_and_flips_are_functions_of_epoch_and_number(layout: str, tmp_path: Path, make: Make) -> None:
    make(None, tmp_path / "ds", "source.limit=3", f"output.layout={layout}", "sensor.pattern=GRBG")
    options = {"patch": 8, "flip": True, "inputs": "mosaic", "noise_map": True}
    stored, live = ug.RawPairs(tmp_path / "ds", **options), ug.LivePairs(tmp_path / "ds", **options)
    seen = set()
    for epoch, number in itertools.product(range(12), range(3)):
        item = stored[epoch, number]
        np.testing.assert_array_equal(item["clean"], live[epoch, number]["clean"])
        np.testing.assert_array_equal(item["clean"], stored[epoch, number]["clean"])
        assert item["clean"].shape == item["noise_std"].shape == (8, 8)
        seen.add(item["clean"].tobytes())
    assert len(seen) > 30
    whole = ug.RawPairs(tmp_path / "ds", inputs="mosaic")[0]["clean"]
    windows = np.lib.stride_tricks.sliding_window_view(whole, (8, 8))[::1, ::1].reshape(-1, 8, 8)
    for epoch in range(12):
        crop = stored[epoch, 0]["clean"]
        ways = [crop, crop[::-1], crop[:, ::-1], crop[::-1, ::-1]]
        assert any((windows == way).all((1, 2)).any() for way in (*ways, *(way.T for way in ways)))


@pytest.mark.parametrize("how", FLIPS)
def test_flip_of_an_item_flips_all_its_arrays(how: str, tmp_path: Path, make: Make) -> None:
    make(None, tmp_path / "ds", "source.limit=1", "output.targets=[linear_rgb]", "sensor.pattern=BGGR")
    pairs = ug.RawPairs(tmp_path / "ds")
    sample, planes = ug.flip(pairs[0], how), ug.flip(ug.RawPairs(tmp_path / "ds", inputs="packed")[0], how)
    mosaic = ug.flip(
        pairs[0].noisy[: pairs[0].noisy.shape[0] // 2 * 2, : pairs[0].noisy.shape[1] // 2 * 2], how, "BGGR"
    )
    np.testing.assert_array_equal(planes["noisy"], ug.pack(ug.to_light(mosaic, sample.row), "BGGR"))
    assert sample.targets["linear_rgb"].shape == (*sample.noisy.shape, 3)
    reds = np.s_[1::2, 1::2]
    bounds = np.clip(ug.to_light(sample.clean, sample.row)[reds] - sample.targets["linear_rgb"][reds][..., 0], -1, 1)
    assert np.abs(bounds).max() < 1 / (sample.row["white_level_dn"] - sample.row["black_level_dn"])
    assert sample.row == pairs[0].row


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"inputs": "planes"}, "inputs='planes': unknown; expected mosaic, packed"),
        ({"noise_map": True}, "noise_map=True: has no effect on samples"),
        ({"rows": True}, "rows=True: has no effect on samples"),
        ({"flip": True}, "flip=True: leaves out sites; expected patch"),
        ({"patch": 7}, "patch=7: out of range; expected an even number from 2"),
    ],
)
def test_options_that_do_not_fit_are_refused(options: dict, message: str, dataset: Path) -> None:
    for reader in (ug.RawPairs, ug.LivePairs):
        with pytest.raises(ConfigError, match=message):
            reader(dataset, **options)


def test_wrong_flips_are_refused(dataset: Path) -> None:
    with pytest.raises(ConfigError, match=r"patch=4096: exceeds a pair of"):
        ug.RawPairs(dataset, patch=4096)[0]
    with pytest.raises(ValueError, match="how='left': unknown; expected one of horizontal"):
        ug.flip(np.zeros((4, 4)), "left")
