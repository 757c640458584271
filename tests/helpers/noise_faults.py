"""Faults in the noise of pairs, and how to plant them in a finished dataset whose digests then agree with its bytes."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen import RawPairs
from unprocess_gen.core.arrays import Float, Frame
from unprocess_gen.core.files import array_xxh3, file_sha256
from unprocess_gen.dataset.dataset_json import dataset_text, fingerprint, read_dataset
from unprocess_gen.dataset.shards import shard_name
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.plan import Plan


@dataclass
class NoisyPair:
    """A photograph, its noisy frame and its plan, and random numbers; a fault gives it another noisy frame."""

    srgb: NDArray[np.uint8]
    noisy: Frame
    plan: Plan
    draws: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    @functools.cached_property
    def unrounded(self) -> tuple[Float, Float]:
        """Return both frames in DN, not rounded and without limits."""
        effects = tuple(effect for effect in self.plan.noise.effects if effect != "quantise")
        pair = make_pair(self.srgb, self.plan.replace(dtype="float32", sensor_clip="none", effects=effects))
        sensor = self.plan.sensor
        span_dn, black_dn = sensor.white_level_dn - sensor.black_level_dn, sensor.black_level_dn
        clean, noisy = (frame.astype(np.float64) * span_dn + black_dn for frame in (pair.clean, pair.noisy))
        return clean, noisy

    @property
    def signal(self) -> Float:
        return self.unrounded[0] - self.plan.sensor.black_level_dn

    def std(self, more_dn2: float = 0.0) -> Float:
        """Return the standard deviation of the noise that the plan states without row noise."""
        slope, intercept = self.plan.noise.variance_line
        std: Float = np.sqrt(slope * self.signal + intercept + more_dn2)
        return std

    def with_noise(self, noise: Float) -> Frame:
        """Return the clean frame with noise in standard deviations."""
        return self.rounded(self.unrounded[0] + self.std() * noise)

    def rounded(self, value_dn: Float) -> Frame:
        """Round and clip a frame as the sensor does."""
        return np.clip(np.rint(value_dn), 0, 2**self.plan.sensor.bits - 1).astype(np.uint16)


Fault = Callable[[NoisyPair], Frame]
"""Function that returns another noisy frame of a pair."""


def with_numbers(**numbers: Any) -> Fault:
    """Simulate the noise of other physical numbers than those of the plan."""

    def simulate(pair: NoisyPair) -> Frame:
        assert pair.plan.physics is not None
        return make_pair(pair.srgb, pair.plan.replace(**numbers)).noisy

    return simulate


def swapped(first: tuple[int, int], second: tuple[int, int]) -> Fault:
    """Swap two sites of each tile."""

    def swap(pair: NoisyPair) -> Frame:
        other = pair.noisy.copy()
        for (y, x), (from_y, from_x) in ((first, second), (second, first)):
            other[y::2, x::2] = pair.noisy[from_y::2, from_x::2]
        return other

    return swap


def stripes(pair: NoisyPair) -> Frame:
    """Add an offset to each column, with a tenth of the standard deviation of the read noise."""
    assert pair.plan.physics is not None
    offsets = 0.1 * pair.plan.physics.read_std_dn * pair.draws.standard_normal(pair.noisy.shape[1])
    return pair.rounded(pair.unrounded[1] + offsets)


def uniform(pair: NoisyPair) -> Frame:
    """Replace the noise by uniform noise of the same variance."""
    physics = pair.plan.physics
    row_dn2 = physics.row_std_dn**2 if physics is not None and "row" in pair.plan.noise.effects else 0.0
    noise = pair.std(row_dn2) * pair.draws.uniform(-(3**0.5), 3**0.5, pair.noisy.shape)
    return pair.rounded(pair.unrounded[0] + noise)


def filtered(*weights: tuple[int, int, float]) -> Fault:
    """Add shifted noise to the noise: distances in rows and columns, and weights; its variance is kept."""
    scale = sum(weight * weight for _, _, weight in weights) ** 0.5

    def change(pair: NoisyPair) -> Frame:
        clean, noisy = pair.unrounded
        z = (noisy - clean) / pair.std()
        return pair.with_noise(sum(weight * np.roll(z, (y, x), (0, 1)) for y, x, weight in weights) / scale)

    return change


BLUR = [(y, x, 0.05 / 8 if y or x else 0.95) for y in (-1, 0, 1) for x in (-1, 0, 1)]
"""Each of the eight neighbours of a site gets an eighth of 5 % of its noise."""

SITE_FAULTS: dict[str, Fault] = {
    "blur of 5 % over 3 x 3 sites, variance kept": filtered(*BLUR),
    "correlation 0.05 of adjacent sites": filtered((0, 0, 1.0), (0, 1, 0.05)),
    "correlation 0.05 of diagonal sites": filtered((0, 0, 1.0), (1, -1, 0.05)),
    "correlation 0.05 of neighbours of a plane": filtered((0, 0, 1.0), (2, 0, 0.05)),
    "correlation 0.05 of diagonal neighbours of a plane": filtered((0, 0, 1.0), (2, 2, 0.05)),
    "a share of 1e-4 of white sites": lambda pair: pair.rounded(
        np.where(pair.draws.random(pair.noisy.shape) < 1e-4, np.inf, pair.noisy)
    ),
    "even DN only": lambda pair: pair.rounded(2 * np.rint(pair.unrounded[1] / 2)),
}
"""Faults that every kind of noise can have."""

FAULTS: dict[str, Fault] = {
    **SITE_FAULTS,
    "black level off by 20 DN": lambda pair: pair.rounded(pair.noisy + 20.0),
    "row noise removed": with_numbers(row_std_dn=0.0),
    "green sites swapped": swapped((0, 1), (1, 0)),
    "red and blue sites swapped": swapped((0, 0), (1, 1)),
    "column stripes of a tenth of the read noise": stripes,
    "uniform noise of equal variance": uniform,
    "5 % more signal": lambda pair: pair.rounded(pair.unrounded[1] + 0.05 * pair.signal),
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
