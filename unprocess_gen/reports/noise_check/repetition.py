"""Simulate the noise of a pair again from its clean frame: the same sensor, with other random numbers.

The repetition is what the row says the noisy frame could be. Fixed patterns of the camera body, defects, dark frames
and column offsets are those of the row, so both noisy frames have them. The reference simulates it, although kernels
take a tenth of the time: a fault of the kernels, which make datasets, would be in both frames, and not be found.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.calibration.planes import TILE
from unprocess_gen.core.arrays import Float, Frame
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.reader import mosaic_dn
from unprocess_gen.dataset.row import patch_from_row, plan_from_row
from unprocess_gen.simulation.facts import DarkPixels
from unprocess_gen.simulation.frames import Patch
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.plan_slots import slots_of
from unprocess_gen.simulation.reference import electrons

EPOCH = 2**14 - 1
"""Epoch of the random numbers; that of datasets is 0."""
LEAST_STD_DN = 1.0
"""Least standard deviation of noise in rounded frames; below it, codes depend on the light before rounding."""
LARGEST_Z = 8.0
"""Bound of z, so that few defects do not decide a mean."""
FAR_Z = 16.0
"""Distance of outliers, in standard deviations."""

Single = NDArray[np.float32]


class Noise(NamedTuple):
    """Noise of the pair with a key, and of its repetition; frames are in DN, without an odd last row or column.

    ``noisy_dn``, ``z`` and ``is_far`` [2, H, W] have the noisy frame, then its repetition. ``weight`` is 1 / std of
    shot and read noise, 0 at sites that are not used. ``z`` is noise over std without the median of each plane,
    limited to ±`LARGEST_Z`; ``is_far`` marks sites beyond `FAR_Z`, ``is_hot`` hot pixels whose mean is far beyond.
    """

    key: str
    plan: Plan
    clean_dn: Float
    noisy_dn: Float
    weight: Single
    z: Single
    is_far: NDArray[np.bool_]
    is_hot: NDArray[np.bool_]

    @property
    def rounding_dn2(self) -> float:
        """Variance of the rounding of the clean frame, DN²."""
        return 0.0 if self.plan.output.clean_normalised else 1 / 12


def measure_noise(clean: Frame, noisy: Frame, row: Row, dark_pixels: DarkPixels | None = None) -> Noise | None:
    """Measure the noise of a pair and of its repetition; None if its dark frame is not available."""
    plan, patch = plan_from_row(row), patch_from_row(row)
    if plan.dark is not None and dark_pixels is None:
        return None
    frames = (mosaic_dn(frame, row).astype(np.float64) for frame in (clean, noisy))
    clean_dn, own_dn = (dn[: len(dn) // 2 * 2, : dn.shape[1] // 2 * 2] for dn in frames)
    noisy_dn = np.stack([own_dn, _repetition(clean_dn, plan, patch, dark_pixels)])
    std = _usable_std(clean_dn, plan)
    weight = np.divide(1.0, std, out=np.zeros_like(std), where=std > 0)
    noise_dn = noisy_dn - clean_dn
    for y, x in TILE:
        of_repetition = noise_dn[1, y::2, x::2][std[y::2, x::2] > 0]
        noise_dn[:, y::2, x::2] -= np.median(of_repetition) if of_repetition.size else 0.0
    z = (noise_dn * weight).astype(np.float32)
    return Noise(
        key=str(row["key"]),
        plan=plan,
        clean_dn=clean_dn,
        noisy_dn=noisy_dn,
        weight=weight.astype(np.float32),
        z=np.clip(z, -LARGEST_Z, LARGEST_Z),
        is_far=np.abs(z) > FAR_Z,
        is_hot=_hot_sites(plan, patch, weight),
    )


def _hot_sites(plan: Plan, patch: Patch, weight: Float) -> NDArray[np.bool_]:
    """Sites whose mean excess is three times as far as outliers, so that each frame shows it."""
    bright = slots_of(plan).patterns.bright
    if bright is None:
        return np.zeros(weight.shape, np.bool_)
    mean_e = electrons.bright_means_e(bright, (weight.shape[0], weight.shape[1]), patch.origin)
    return np.asarray(mean_e * plan.numbers.dn_per_e * weight > 3 * FAR_Z)


def _usable_std(clean_dn: Float, plan: Plan) -> Float:
    """Standard deviation of shot and read noise, [H, W] DN; 0 at sites that are not used.

    These are at clipped light, of photographs at black, where many sites can have the same light before rounding.
    """
    black_dn, brightest_dn = plan.sensor.black_level_dn, plan.brightest_dn
    std = np.sqrt(electrons.noise_variance(clean_dn, plan))
    is_used = std >= (0.0 if plan.output.clean_normalised and plan.output.normalised else LEAST_STD_DN)
    for end_dn in (plan.darkest_dn, brightest_dn, black_dn + (brightest_dn - black_dn) * plan.scene.exposure):
        is_used &= np.abs(clean_dn - end_dn) > 0.5
    return np.asarray(std * is_used)


def _repetition(clean_dn: Float, plan: Plan, patch: Patch, dark_pixels: DarkPixels | None) -> Float:
    """Simulate a noisy frame for a clean one, [H, W] DN; light before rounding is drawn within half a DN."""
    black_dn, origin, again = plan.sensor.black_level_dn, patch.origin, plan.replace(epoch=EPOCH)
    light_dn = clean_dn
    if not plan.output.clean_normalised:
        light_dn = clean_dn + np.random.default_rng(plan.stream_key).uniform(-0.5, 0.5, clean_dn.shape)
    if plan.averaged:  # the clean frame contains the fixed patterns
        light_dn = light_dn - (electrons.average(np.full_like(clean_dn, black_dn), plan, origin) - black_dn)
    noisy_dn = electrons.noisy(np.clip(light_dn, plan.darkest_dn, plan.brightest_dn), again, origin, dark_pixels)
    own_dn, other_dn = (
        electrons.columns_dn(slots_of(drawn).columns, (1, clean_dn.shape[1]), origin) for drawn in (plan, again)
    )
    noisy_dn += own_dn - other_dn
    return np.clip(noisy_dn if plan.output.normalised else np.rint(noisy_dn), *plan.sensor.limits_dn)
