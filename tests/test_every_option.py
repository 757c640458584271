"""Every option of every config group is accepted by every entry of the API, or refused for a reason that is listed."""

from __future__ import annotations

import itertools
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.cases import slow_except
from helpers.commands import RunMain
from helpers.photographs import pixels
from PIL import Image

import unprocess_gen as ug
from unprocess_gen.config.option_files import conf_dir
from unprocess_gen.dataset.dng import encode

OPTIONS = sorted(f"{path.parent.name}={path.stem}" for path in conf_dir().glob("*/*.yaml"))
ADDED = {
    "body=imx385": ["noise.iso=1600"],  # the scene has ISO 100, for which the sensor has no numbers
    "noise=imx385": ["noise.iso=1600"],
    "camera=custom": ["camera.xyz2cam=[1,0,0,0,1,0,0,0,1]"],
    "noise=heteroscedastic": ["noise.a=2", "noise.b=9"],
    "sensor=source": ["source=raw"],
    "experiment=bracket_hdr": ["source.patch=[random,4,1]"],  # the pictures have 24 x 32 pixels
    "experiment=brooks2019_training": ["source.patch=[random,4,1]"],
    "experiment=hdr_scenes": ["source.patch=[random,4,1]"],
    "experiment=ntire_burst_sr": ["source.patch=[random,8,1]", "source.burst.shift=2"],
    "experiment=raw_low_light": ["source.patch=[random,4,1]"],
    "experiment=raw_training": ["source.patch=[random,4,1]"],
}
"""Values that an option lacks on purpose."""

RAW = ["source=raw", "sensor=source", "experiment=raw_low_light", "experiment=raw_training"]
LINEAR = ["source=linear", "experiment=hdr_scenes", "experiment=bracket_hdr"]
SWEEPS = [option for option in OPTIONS if option.startswith("sweep=")]
ARRAYS = ("plan_image", "make_pair", "CameraNoise")
REFUSED = {
    **{(option, entry): "source.kind=raw: .* works on pixels of photographs" for option in RAW for entry in ARRAYS},
    **{("noise=imx385_rvdd", entry): r"noise.levels=.* 2 pairs of an image" for entry in ARRAYS},
    **{("experiment=rvdd_like", entry): r"noise.levels=.* 2 pairs of an image" for entry in ARRAYS},
    **{("experiment=brooks2019_training", entry): "source.patch=.* complete frames" for entry in ARRAYS[:2]},
    **{(option, entry): "is uint8" for option in LINEAR[:1] for entry in ARRAYS[:2]},
    **{(option, "CameraNoise"): "source.kind=linear: CameraNoise works on" for option in LINEAR},
    **{
        (option, entry): "source.(patch|burst)=.* (complete|single) frames|is uint8"
        for option in LINEAR[1:]
        for entry in ARRAYS[:2]
    },
    **{("experiment=ntire_burst_sr", entry): "source.(patch|burst)=|output.layout=packed: Camera" for entry in ARRAYS},
    ("experiment=brooks2019_training", "CameraNoise"): "source.downscale=2: CameraNoise keeps the geometry",
}
"""Reason of each refusal that is right: arrays are photographs, and have one pair that is the complete frame."""

KERNELS = {min(options) for _, options in itertools.groupby(OPTIONS, lambda option: option.partition("=")[0])}
KERNELS |= {"gains=by_light", "sensor=source"}
"""Options whose pairs are simulated in the quick tests: one of each group, and two that other parts must interpret."""


def overrides_of(option: str, folder: Path) -> list[str]:
    """Return the overrides that choose an option, with a folder of one source that it can use."""
    root = folder / ("raw" if option in RAW else "photos")
    root.mkdir()
    if option in LINEAR:
        np.save(root / "a.npy", pixels(1, 24, 32) / np.float32(64))
    if option in RAW:
        pair = ug.make_pair(pixels(1, 24, 32), ug.load_config(["sensor=generic_14bit"]))
        (root / "a.dng").write_bytes(encode(pair.noisy, pair.row, "noisy"))
    else:
        Image.fromarray(pixels(1, 24, 32)).save(root / "a.png")
    added = "+" if option.startswith(("experiment=", "sweep=")) else ""
    return [added + option, *ADDED.get(option, []), f"source.root={root}", f"out={folder}/ds", "n_jobs=1"]


def assert_entries(option: str, entries: dict[str, Callable[[], Any]]) -> None:
    """Assert that each entry accepts the option, or refuses it as listed."""
    for name, call in entries.items():
        if (reason := REFUSED.get((option, name))) is None:
            call()
        else:
            with pytest.raises((ug.ConfigError, ValueError), match=reason):
                call()


@pytest.mark.parametrize("option", [option for option in OPTIONS if option not in SWEEPS])
def test_every_option_is_planned(option: str, tmp_path: Path) -> None:
    config = ug.load_config(overrides_of(option, tmp_path))
    entries = {
        "plan_image": lambda: ug.plan_image(pixels(1, 24, 32), config),
        "CameraNoise": lambda: ug.CameraNoise(config),
        "LivePairs": lambda: ug.LivePairs(config)[0, 0] if option in RAW else ug.LivePairs(config),
    }
    assert_entries(option, entries)


@pytest.mark.parametrize("option", slow_except(KERNELS, [option for option in OPTIONS if option not in SWEEPS]))
def test_option_is_simulated(option: str, run_main: RunMain, tmp_path: Path) -> None:
    overrides, picture = overrides_of(option, tmp_path), pixels(1, 24, 32)
    if option == "executor=dask":
        overrides.append("executor=local")  # a cluster has its own tests
    assert_entries(
        option,
        {
            "make_pair": lambda: ug.make_pair(picture, ug.load_config(overrides)),
            "CameraNoise": lambda: ug.CameraNoise(overrides)(picture, index=0),
        },
    )
    live = ug.LivePairs(overrides)
    assert run_main("plan", *overrides).code == 0
    ug.generate(ug.load_config(overrides))
    read = ug.RawPairs if ug.load_config(overrides).source.burst is None else ug.RawClips
    stored = read(tmp_path / "ds")
    assert len(stored) == len(live) > 0
    np.testing.assert_array_equal(live[0, 0].noisy, stored[0].noisy)
    shutil.rmtree(tmp_path / "ds")


@pytest.mark.parametrize("option", slow_except({"sweep=gain_extremes"}, SWEEPS))
def test_sweeps_are_planned_and_are_no_config(option: str, run_main: RunMain, tmp_path: Path) -> None:
    overrides = overrides_of(option, tmp_path)
    for entry in (ug.load_config, ug.CameraNoise, ug.LivePairs):
        with pytest.raises(ug.ConfigError, match=re.escape("the overrides describe a sweep; expected one config")):
            entry(overrides)
    assert run_main("plan", *overrides).code == 0


def test_tables_name_options_that_exist() -> None:
    assert {*ADDED, *RAW, *KERNELS, *(option for option, _ in REFUSED)} <= {*OPTIONS}
