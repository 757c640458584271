"""Frames of bursts: frame 0 is the mean of the target, brackets expose it, and nothing else decides the bytes."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.datasets import Make

import unprocess_gen as ug
from unprocess_gen.core.source import Source
from unprocess_gen.pipeline.pairs import PairSettings, PlannedImage, plan_pixels
from unprocess_gen.sources.image.decode import Photograph

PICTURE = np.random.default_rng(2).integers(0, 256, (150, 171, 3), np.uint8)


def planned(*settings: str) -> PlannedImage:
    config = ug.load_config(["source.patch=[grid,48]", *settings])
    return plan_pixels(PairSettings.read(config), Photograph(PICTURE, 1), Source(0, "a", "a", 0), "0" * 64)


def frames(image: PlannedImage) -> list[tuple[Any, Any, Any]]:
    """Plans, pairs and targets of all frames."""
    made = []
    for sample in image.samples():
        pair = next(sample.pairs())
        made.append((sample.plans[0], pair, sample.targets(["linear_rgb"], pair).get("linear_rgb")))
    return made


@pytest.mark.parametrize("pattern", ["RGGB", "MONO"])
def test_brackets_are_quantised_means_of_the_target(pattern: str) -> None:
    """Without motion, all frames show the target, exposed by 2^ev and clipped at white."""
    burst = "source.burst={frames: 4, shift: 0, rotation_deg: 0, downscale: 3, ev: [0, -3, 2]}"
    made = frames(planned(burst, "camera=identity", "gains=unity", f"sensor.pattern={pattern}"))
    target, black, white = made[0][2], 240, 4095
    mean = target.reshape(16, 3, 16, 3, 3).mean(axis=(1, 3), dtype=np.float64)
    colour = np.array([[0, 1], [1, 2]])[np.indices((16, 16))[0] % 2, np.indices((16, 16))[1] % 2]
    sites = mean.mean(axis=2) if pattern == "MONO" else np.take_along_axis(mean, colour[..., None], 2)[..., 0]
    for (plan, pair, own), ev in zip(made[:4], (0, -3, 2, 0), strict=True):
        exact = np.clip(sites * 2.0**ev, 0, 1) * (white - black) + black
        assert plan.scene.ev == ev and (own is None) == (plan.place.frame > 0)
        assert np.abs(pair.clean - exact).max() <= 0.5 + 2.0**-16 * 4 * (white - black)
    assert (made[2][1].clean == white).any() and np.array_equal(made[3][1].clean, made[0][1].clean)
    assert not np.array_equal(made[3][1].noisy, made[0][1].noisy)  # because noise is new


def test_exposure_times_and_dark_current_follow_and_effects_are_common() -> None:
    body = ("noise=sony_a7s2", "body=sony_a7s2", "scene=night", "sensor=sony_a7s2")
    evs = (-8, 0, 4)
    image = planned(f"source.burst={{frames: 3, downscale: 1, ev: {list(evs)}}}", *body)
    first = image.plans[1].numbers
    for plan, ev in zip(image.plans, evs, strict=True):
        assert plan.numbers.exposure_s == first.exposure_s * 2.0**ev
        assert plan.numbers.dark_e == pytest.approx(first.dark_e * 2.0**ev, rel=1e-12)
    alone = [planned(f"source.burst={{frames: 3, downscale: 1, ev: [{ev}]}}", *body).plans[0] for ev in evs]
    union = set().union(*(plan.noise.effects for plan in alone))
    assert all(set(plan.noise.effects) == union for plan in image.plans)
    assert len({plan.noise.effects for plan in alone}) > 1


@pytest.mark.parametrize("settings", [(), ("noise=sony_a7s2", "body=sony_a7s2", "scene=night")])
def test_patches_alone_more_frames_and_the_reference_tier_give_the_same_bytes(settings: tuple[str, ...]) -> None:
    burst = "source.burst={{frames: {}, shift: 5, rotation_deg: 2, downscale: 2, phase: corner}}"
    image = planned(burst.format(2), *settings)
    complete = frames(image)
    assert len(image.patches) > 1 and image.plans[1].motion is not None
    alone = frames(dataclasses.replace(image, patches=image.patches[1:2]))
    reference = frames(planned(burst.format(2), "accuracy=reference", *settings))
    more = frames(planned(burst.format(3), *settings))
    for others in (alone, reference[2:4], more[3:5]):
        for (_, pair, target), (_, other, its) in zip(complete[2:4], others, strict=True):
            assert pair.clean.tobytes() == other.clean.tobytes() and pair.noisy.tobytes() == other.noisy.tobytes()
            assert (target is None) == (its is None) and (target is None or target.tobytes() == its.tobytes())


@pytest.mark.slow
def test_workers_and_replay_give_the_same_bytes(make: Make, tmp_path: Path, tree_hash: Any) -> None:
    settings = "source.burst={frames: 2, downscale: 2}", "source.patch=[random,64,2]", "source.limit=2"
    chosen = *settings, "output.pairs_per_shard=1", "output.targets=[linear_rgb]"
    for n_jobs in (1, 2):
        make(None, tmp_path / f"ds{n_jobs}", *chosen, n_jobs=n_jobs)
    assert tree_hash(tmp_path / "ds1") == tree_hash(tmp_path / "ds2")
    assert [result.complaint for result in ug.replay(tmp_path / "ds1", "00000001-p0001")] == ["", ""]
