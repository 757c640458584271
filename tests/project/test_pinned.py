"""Small datasets have the bytes that format 1 began with."""

from __future__ import annotations

import builtins
import json
import math
import operator
from collections.abc import Iterable
from functools import reduce
from pathlib import Path

import numpy as np
import pytest
from helpers.promise_report import Figure

import unprocess_gen as ug
from unprocess_gen.core.files import file_sha256

RECORDED = Path(__file__).parent / "format_1.json"
"""SHA-256 of the files of each dataset, by `digests`. A change of bytes records them again, and gives the reason."""

SETTINGS = {
    "two_numbers": ["output.pairs_per_shard=1", "source.patch=[random,64,2]", "noise.draws=2"],
    "physical": ["source.patch=[random,64,1]", "body=sony_a7s2", "scene=night", "sensor.units=2"],
    "levels": ["noise=brooks2019", "noise.levels=3", "camera=choice", "split={train: 0.5, val: 0.5}"],
    "float": ["output.clean_dtype=float32", "output.targets=[linear_rgb]", "isp=srgb", "gains=by_light"],
    "all_on": ["body=nikon_d850", "effects.all=on", "clean.includes_fixed_pattern=true"],
    "planned": [
        "output.frames=false",
        "body=canon_70d",
        "noise.iso=[log_uniform,800,3200]",
        "source.patch=[grid,64,64]",
    ],
    "mono": ["sensor=generic_16bit", "sensor.pattern=MONO", "noise=imx385_iso3200_rvdd"],
}


def digests(name: str, folder: Path) -> dict[str, str]:
    """Make a dataset, and return the SHA-256 of each file except ``dataset.json``."""
    ug.generate(ug.load_config([*SETTINGS[name], "source.limit=2", "seed=7", f"out={folder}", "n_jobs=1"]))
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "dataset.json")
    return {path.relative_to(folder).as_posix(): file_sha256(path) for path in files}


@pytest.mark.parametrize("name", SETTINGS)
def test_pinned_dataset_has_the_recorded_bytes(name: str, tmp_path: Path, figure: Figure) -> None:
    recorded = json.loads(RECORDED.read_text())[name]
    assert digests(name, tmp_path / "ds") == recorded
    figure("pinned-datasets", f"{name}: {len(recorded)} of {len(recorded)} files have the recorded SHA-256")


@pytest.mark.parametrize("settings", [["body=canon_70d", "effects.all=on"], ["sensor.pattern=MONO"]])
def test_no_number_depends_on_how_python_adds_floats(settings: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """``sum`` compensates rounding errors from Python 3.12 on, and not before."""

    def exact_sum(values: Iterable[float], start: float = 0) -> float:
        terms = [start, *values]
        return math.fsum(terms) if any(isinstance(term, float) for term in terms) else reduce(operator.add, terms)

    config, rows = ug.load_config(settings), []
    for add in (exact_sum, lambda values, start=0: reduce(operator.add, values, start)):
        monkeypatch.setattr(builtins, "sum", add)
        rows.append([ug.make_pair(np.full((2, 2, 3), 99, np.uint8), config, key=key).row for key in range(20)])
    assert rows[0] == rows[1]
