"""Faults in the noise of pairs, and how to plant them in a finished dataset whose digests then agree with its bytes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen import RawPairs
from unprocess_gen.core.arrays import Frame
from unprocess_gen.core.files import array_xxh3, file_sha256
from unprocess_gen.dataset.dataset_json import dataset_text, fingerprint, read_dataset
from unprocess_gen.dataset.shards import shard_name
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.plan import Plan

Fault = Callable[[NDArray[np.uint8], Frame, Plan, np.random.Generator], Frame]
"""Function of photograph, noisy frame, plan and random generator that returns another noisy frame."""


def unrounded(srgb: NDArray[np.uint8], plan: Plan) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return both frames of a pair in DN, not rounded and without limits."""
    effects = tuple(effect for effect in plan.noise.effects if effect != "quantise")
    pair = make_pair(srgb, plan.replace(dtype="float32", sensor_clip="none", effects=effects))
    span_dn, black_dn = plan.sensor.white_level_dn - plan.sensor.black_level_dn, plan.sensor.black_level_dn
    clean, noisy = (frame.astype(np.float64) * span_dn + black_dn for frame in (pair.clean, pair.noisy))
    return clean, noisy


def rounded(value_dn: NDArray[np.float64], plan: Plan) -> Frame:
    """Round and clip a frame as the sensor does."""
    return np.clip(np.rint(value_dn), 0, 2**plan.sensor.bits - 1).astype(np.uint16)


def black_level(srgb: NDArray[np.uint8], noisy: Frame, plan: Plan, draws: np.random.Generator) -> Frame:
    """Add 20 DN."""
    return rounded(noisy + 20.0, plan)


def with_numbers(**numbers: Any) -> Fault:
    """Simulate the noise of other physical numbers than those of the plan."""

    def simulate(srgb: NDArray[np.uint8], noisy: Frame, plan: Plan, draws: np.random.Generator) -> Frame:
        assert plan.noise.physics is not None
        return make_pair(srgb, plan.replace(physics=replace(plan.noise.physics, **numbers))).noisy

    return simulate


def swapped_greens(srgb: NDArray[np.uint8], noisy: Frame, plan: Plan, draws: np.random.Generator) -> Frame:
    """Swap the green sites of each tile."""
    other = noisy.copy()
    other[0::2, 1::2], other[1::2, 0::2] = noisy[1::2, 0::2], noisy[0::2, 1::2]
    return other


def swapped_red_and_blue(srgb: NDArray[np.uint8], noisy: Frame, plan: Plan, draws: np.random.Generator) -> Frame:
    """Swap the red and the blue site of each tile."""
    other = noisy.copy()
    other[0::2, 0::2], other[1::2, 1::2] = noisy[1::2, 1::2], noisy[0::2, 0::2]
    return other


def stripes(srgb: NDArray[np.uint8], noisy: Frame, plan: Plan, draws: np.random.Generator) -> Frame:
    """Add an offset to each column, with a tenth of the standard deviation of the read noise."""
    assert plan.noise.physics is not None
    _, exact = unrounded(srgb, plan)
    return rounded(exact + 0.1 * plan.noise.physics.read_std_dn * draws.standard_normal(exact.shape[1]), plan)


def uniform(srgb: NDArray[np.uint8], noisy: Frame, plan: Plan, draws: np.random.Generator) -> Frame:
    """Replace the noise by uniform noise of the same variance."""
    clean, _ = unrounded(srgb, plan)
    row_dn2 = (
        plan.noise.physics.row_std_dn**2 if plan.noise.physics is not None and "row" in plan.noise.effects else 0.0
    )
    slope, intercept = plan.noise.variance_line
    std = np.sqrt(slope * (clean - plan.sensor.black_level_dn) + intercept + row_dn2)
    return rounded(clean + std * draws.uniform(-(3**0.5), 3**0.5, clean.shape), plan)


def more_signal(srgb: NDArray[np.uint8], noisy: Frame, plan: Plan, draws: np.random.Generator) -> Frame:
    """Add 5 % of the signal."""
    clean, exact = unrounded(srgb, plan)
    return rounded(exact + 0.05 * (clean - plan.sensor.black_level_dn), plan)


def standard_deviation(clean: NDArray[np.float64], plan: Plan) -> NDArray[np.float64]:
    """Return the standard deviation of the noise that the plan states without row noise."""
    slope, intercept = plan.noise.variance_line
    return np.sqrt(slope * (clean - plan.sensor.black_level_dn) + intercept)


def filtered(*weights: tuple[int, int, float]) -> Fault:
    """Add shifted noise to the noise: distances in rows and columns, and weights; its variance is kept."""

    def change(srgb: NDArray[np.uint8], noisy: Frame, plan: Plan, draws: np.random.Generator) -> Frame:
        clean, exact = unrounded(srgb, plan)
        std = standard_deviation(clean, plan)
        z = (exact - clean) / std
        terms = (weight * np.roll(z, (y, x), (0, 1)) for y, x, weight in weights)
        scale = sum(weight * weight for _, _, weight in weights) ** 0.5
        return rounded(clean + std * sum(terms) / scale, plan)

    return change


def blurred(share: float) -> Fault:
    """Give each of the eight neighbours of a site an eighth of a share of its noise."""
    places = ((y, x) for y in (-1, 0, 1) for x in (-1, 0, 1))
    return filtered(*((y, x, share / 8 if y or x else 1 - share) for y, x in places))


def white_sites(srgb: NDArray[np.uint8], noisy: Frame, plan: Plan, draws: np.random.Generator) -> Frame:
    """Set a share of 1e-4 of all sites to the largest DN."""
    return np.where(draws.random(noisy.shape) < 1e-4, 2**plan.sensor.bits - 1, noisy).astype(np.uint16)


def even_codes(srgb: NDArray[np.uint8], noisy: Frame, plan: Plan, draws: np.random.Generator) -> Frame:
    """Round to even DN."""
    _, exact = unrounded(srgb, plan)
    return rounded(2 * np.rint(exact / 2), plan)


def repeated_noise(srgb: NDArray[np.uint8], noisy: Frame, plan: Plan, draws: np.random.Generator) -> Frame:
    """Add the same normal deviates to every frame."""
    clean, _ = unrounded(srgb, plan)
    deviates = np.random.default_rng(0).standard_normal(clean.shape)
    return rounded(clean + standard_deviation(clean, plan) * deviates, plan)


SITE_FAULTS: dict[str, Fault] = {
    "blur of 5 % over 3 x 3 sites, variance kept": blurred(0.05),
    "correlation 0.05 of adjacent sites": filtered((0, 0, 1.0), (0, 1, 0.05)),
    "correlation 0.05 of diagonal sites": filtered((0, 0, 1.0), (1, -1, 0.05)),
    "correlation 0.05 of neighbours of a plane": filtered((0, 0, 1.0), (2, 0, 0.05)),
    "correlation 0.05 of diagonal neighbours of a plane": filtered((0, 0, 1.0), (2, 2, 0.05)),
    "a share of 1e-4 of white sites": white_sites,
    "even DN only": even_codes,
}
"""Faults that every kind of noise can have."""

FAULTS: dict[str, Fault] = {
    **SITE_FAULTS,
    "black level off by 20 DN": black_level,
    "row noise removed": with_numbers(row_std_dn=0.0),
    "green sites swapped": swapped_greens,
    "red and blue sites swapped": swapped_red_and_blue,
    "column stripes of a tenth of the read noise": stripes,
    "uniform noise of equal variance": uniform,
    "5 % more signal": more_signal,
}


def replace_noisy_frames(folder: Path, change: Callable[[Frame, Frame, dict[str, object]], Frame]) -> None:
    """Replace the noisy frames of a dataset, and make all digests those of the new bytes.

    ``change`` returns a frame of the same shape for a clean frame, a noisy frame and a row.
    """
    texts: dict[bytes, bytes] = {}
    for clean, noisy, row in RawPairs(folder):
        path = folder / "shards" / shard_name(int(row["shard"]))
        other = np.ascontiguousarray(change(clean, noisy, row))
        content, old = path.read_bytes(), noisy.tobytes()
        assert content.count(old) == 1
        digests = str(row["noisy_xxh3"]).encode(), array_xxh3(other).encode()
        path.write_bytes(content.replace(old, other.tobytes()).replace(*digests))
        texts[digests[0]] = digests[1]
    manifest = folder / "manifest.csv"
    content = manifest.read_bytes()
    for old_digest, new_digest in texts.items():
        content = content.replace(old_digest, new_digest)
    manifest.write_bytes(content)
    facts = read_dataset(folder / "dataset.json")
    for entry in facts["shards"]:
        if entry["file"] is not None:
            entry["sha256"] = file_sha256(folder / entry["file"])
    facts["manifest_sha256"] = hashlib.sha256(content).hexdigest()
    facts["fingerprint"] = fingerprint(facts["config_sha256"], facts["manifest_sha256"])
    (folder / "dataset.json").write_text(dataset_text(facts), encoding="utf-8")
