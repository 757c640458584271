"""Settings of bursts that cannot be made are refused with one sentence, before anything is written."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.commands import RunMain

import unprocess_gen as ug
from unprocess_gen.core.errors import ConfigError

ONE = "source.burst={frames: 2}"


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (["source.burst={shfit: 3}"], "source.burst.shfit: no such key; .*; did you mean shift"),
        (["source.burst={frames: 101}"], "source.burst.frames=101: expected 1 to 100"),
        (["source.burst={shift: -1}"], "source.burst.shift=-1: expected 0 to 4096"),
        (["source.burst={rotation_deg: 46}"], "source.burst.rotation_deg=46: expected 0 to 45"),
        (["source.burst={downscale: 2.5}"], "source.burst.downscale=2.5: expected 1 to 64"),
        (["source.burst={ev: 3}"], "source.burst.ev=3: expected a list"),
        (["source.burst={phase: center}"], "source.burst.phase=center: expected one of centre, corner"),
        (["source.burst=5"], "source.burst=5: expected null, or a mapping"),
        (["source.burst.frames=7"], "source.burst.frames=7: .*write source.burst={frames: 7}"),
        ([ONE, "source=raw", "source.root=."], "source.kind=raw: a burst needs all colours"),
        ([ONE, "source.clips=true"], "source.clips=true: .*expected false"),
        ([ONE, "source.downscale=2"], "source.downscale=2: .*use source.burst.downscale"),
        ([ONE, "source.patch=100"], "source.patch=100: side=100 .*expected a multiple of 8 pixels"),
        ([ONE, "source.patch=[grid,96,20]"], "stride=20 .*expected a multiple of 8 pixels"),
        (
            ["source.burst={ev: [0, 16]}", "noise=imx385", "scene.exposure_s=100"],
            r"source.burst.ev=\[0.0, 16.0\]: exposure times .*change scene.exposure_s",
        ),
        (
            ["source.burst={ev: [0, 5]}", "source=linear", "scene.ev=60"],
            r"source.burst.ev=.*exposures from 60 to 65 stops; expected -64 to 64; change scene.ev",
        ),
    ],
)
def test_wrong_bursts_are_refused(settings: list[str], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        ug.load_config(settings)


@pytest.mark.parametrize("settings", [
    [ONE, "source.burst.frames=7"],
    [ONE, "source.burst=null"],
    ["source.burst={frames: 1, ev: [4, 16]}", "source=linear", "scene.ev=60"],  # the second exposure has no frame
])  # fmt: skip
def test_other_bursts_are_not(settings: list[str]) -> None:
    burst = ug.load_config(settings).source.burst
    assert burst is None or burst["frames"] in (1, 7)


@pytest.mark.parametrize("verb", ["accuracy", "explore"])
def test_verbs_of_single_frames_refuse_bursts(verb: str, run_main: RunMain) -> None:
    done = run_main(verb, ONE, *(["--no-browser"] if verb == "explore" else []))
    assert done.code == 2
    assert f"{verb} makes single frames; expected null" in done.err and done.err.count("\n") == 1


def test_functions_of_single_frames_refuse_bursts() -> None:
    for call in (lambda config: ug.CameraNoise(config), lambda config: ug.make_pair(np.ones((8, 8, 3), "u1"), config)):
        with pytest.raises(ConfigError, match=r"source.burst=.* makes single frames; expected null"):
            call(ug.load_config([ONE]))
