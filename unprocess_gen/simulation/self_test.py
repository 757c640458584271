"""Prove before a run that this process computes the same values as every other machine; takes three milliseconds.

There are four tests:

1. The exact tables have their published SHA-256.
2. Philox gives the known answers of Random123.
3. A kernel rounds a product and a sum separately, without a fused multiply-add.
4. Small golden pairs, simulated by the kernels of the plan, have their published digests.

A compiler, library or CPU that rounds differently fails here, before it writes a dataset. The golden pairs cover the
8-bit kernels, every distribution of the noise, both branches of the highlights, every phase of the CFA pattern
and both ends of the sensor's range. The 16-bit curves are checked when they are first read.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator, Sequence

import numpy as np

from unprocess_gen.core.arrays import FLOAT32, Float, Normalised, Srgb
from unprocess_gen.core.errors import MachineError
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.core.random_streams import philox4x32
from unprocess_gen.core.targets import LINEAR_RGB
from unprocess_gen.simulation.effects import PHYSICAL_EFFECTS
from unprocess_gen.simulation.kernels import burst
from unprocess_gen.simulation.kernels.jit import kernel, kernel_cache_folder, numba_config
from unprocess_gen.simulation.kernels.render import uses_float32
from unprocess_gen.simulation.lookup_tables import normal_table
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.plan import (
    EXACT,
    FAST,
    REFERENCE,
    CameraPlan,
    IspPlan,
    Motion,
    NoisePlan,
    Physics,
    Plan,
    ScenePlan,
    SensorPlan,
    SourcePlan,
)
from unprocess_gen.simulation.tone_curves import linear_table

KNOWN_ANSWERS = (
    # Random123's kat_vectors, philox4x32-10: counter, key, output.
    ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
    ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ),
)

GOLDEN_PLAN = Plan(
    seed=0,
    stream_key=0x0123456789ABCDEF,
    camera=CameraPlan(
        camera="custom", weights=(0.0, 0.0, 0.0, 0.0), red_gain=2.15, blue_gain=1.7, inverse_rgb_gain=0.8,
        rgb2cam=(0.5625, 0.3125, 0.125, 0.125, 0.75, 0.125, 0.03125, 0.21875, 0.75),
    ),
    isp=IspPlan("smoothstep", 2.2, "per_channel", highlight_threshold=0.9),
    source=SourcePlan(downscale=1, dequantize="off"),
    sensor=SensorPlan("GRBG", bits=10, black_level_dn=64, white_level_dn=1023),
    scene=ScenePlan("daylight", exposure_ratio=1.0),
    noise=NoisePlan(
        "imx385_iso25600", "gaussian", a_dn=55.0, b_dn2=2500.0, effects=("heteroscedastic",), skipped=(),
    ),
    accuracy=EXACT,
)  # fmt: skip
GOLDEN_PHYSICS = Physics(
    iso=3200.0, exposure_s=0.1, temperature_c=30.0, frame_size=(4096, 4096), sensor_unit="0",
    body_key=0xFEDCBA9876543210, fixed_pattern_in_clean=False,
    dn_per_e=4.0, prnu_std=0.01, dark_e=3.0, dark_offset="removed", hot_pixel_share=0.02, hot_pixel_e=40.0,
    full_well_e=300.0, read_law="tukey_lambda", read_shape=-0.1, read_std_dn=6.0, row_std_dn=2.0, column_std_dn=1.0,
    black_error_dn=(0.5, -0.25, 0.125, 1.0), dead_pixel_share=0.01,
)  # fmt: skip
_COUNTS = GOLDEN_PLAN.replace(physics=GOLDEN_PHYSICS, effects=("shot", "read", "row", "black_error", "quantise"))
_PHYSICAL = _COUNTS.replace(effects=PHYSICAL_EFFECTS, exposure_ratio=1.5, level=1, draw=2, frame=3)
GOLDEN_PLANS = {
    "per_channel": GOLDEN_PLAN,
    "gray_mean": GOLDEN_PLAN.replace(highlight="gray_mean"),
    "float32": GOLDEN_PLAN.replace(accuracy=FAST, bits=16, black_level_dn=4096, white_level_dn=65535),
    "reference": GOLDEN_PLAN.replace(accuracy=REFERENCE),
    "poisson": GOLDEN_PLAN.replace(noise_law="poisson"),
    "plain": _COUNTS,
    "gaussian_read": _COUNTS.replace(physics=GOLDEN_PHYSICS.replace(read_law="gaussian")),
    "physical": _PHYSICAL,
    "normalised": GOLDEN_PLAN.replace(dtype=FLOAT32, sensor_clip="none"),
    "normalised_counts": _PHYSICAL.replace(dtype=FLOAT32, sensor_clip="none"),
    "float_clean": GOLDEN_PLAN.replace(clean_dtype=FLOAT32),
    "float_clean_counts": _PHYSICAL.replace(clean_dtype=FLOAT32),
}
_LINEAR = "per_channel", "float32", "physical", "normalised", "normalised_counts", "float_clean", "float_clean_counts"
GOLDEN_PLANS |= {
    f"linear_{name}": GOLDEN_PLANS[name].replace(primaries="rec2020", ev=0.5, isp=IspPlan("none", "srgb", "none"))
    for name in _LINEAR
}
GOLDEN = {
    # XXH3-128 of the clean and of the noisy frame
    "per_channel": ("443ea2ae03acfbab1df2b27f58ddbe39", "249b904acb59298a603502c2424e4712"),
    "gray_mean": ("b4c0b18f1bbccbf881c82b00455253e9", "16f26b70e50c70f03babed405092f5b2"),
    "float32": ("9243174c79ef1c0b95c6fc62c480fbc8", "53fa7baa361ccd3954240d855bc1990c"),
    "reference": ("443ea2ae03acfbab1df2b27f58ddbe39", "249b904acb59298a603502c2424e4712"),
    "poisson": ("443ea2ae03acfbab1df2b27f58ddbe39", "858e7f718eab2ad15d0d340c7d9345eb"),
    "gaussian_read": ("443ea2ae03acfbab1df2b27f58ddbe39", "7d5c9bfb0a5bdc08fc5ba1b9349b858a"),
    "plain": ("443ea2ae03acfbab1df2b27f58ddbe39", "a3ed0176ff50cf595767857da127dd39"),
    "normalised": ("aa19fde7d361bcc67ca6c9e52c8d8634", "4de3ab500ebd73704139d53f4f3d8ee3"),
    "normalised_counts": ("db1e51d036e01d5eaca3d0ebedbab809", "b736820323ca89fa4671cefd469d875b"),
    "float_clean": ("aa19fde7d361bcc67ca6c9e52c8d8634", "249b904acb59298a603502c2424e4712"),
    "float_clean_counts": ("db1e51d036e01d5eaca3d0ebedbab809", "034a49f0e3f78996ab8d340da875038e"),
    "physical": ("ae069ed854a5cf392b7ed42acbf49489", "034a49f0e3f78996ab8d340da875038e"),
    "linear_per_channel": ("4da6ba240a32069b27a35be13644db76", "88d88fb2b7e08e2491c57b64b36cebc7"),
    "linear_float32": ("4774c6e816a14285feb8590098dfe45e", "ba4667260224bd6d8aae1e5d2955a3a8"),
    "linear_physical": ("34bb79872340b344993a8b22c85d2219", "dacd4243ba515f2d45fc46988ae2c838"),
    "linear_normalised": ("d266df2af19e2f10774416a0010e5ab5", "09cb06a86f7737d0502041e7b56984fd"),
    "linear_normalised_counts": ("1188c137a775ce4ec5d5541836dfd13e", "94d49d51c9967779877508be847f9ff8"),
    "linear_float_clean": ("d266df2af19e2f10774416a0010e5ab5", "88d88fb2b7e08e2491c57b64b36cebc7"),
    "linear_float_clean_counts": ("1188c137a775ce4ec5d5541836dfd13e", "dacd4243ba515f2d45fc46988ae2c838"),
}
GOLDEN_LIGHT = "86947ca9b575c89281b696e72c3f5a7e"
"""XXH3-128 of the light of a frame of a burst."""


def kernels(plans: Sequence[Plan], targets: Sequence[str] = ()) -> list[str]:
    """Names of the sets of kernels that simulate plans and targets; sets are compiled one by one, in seconds."""
    if LINEAR_RGB in targets and plans[0].motion is None:
        exact = [plan.replace(accuracy=EXACT) for plan in plans]
        plans = [*plans, *exact, *(plan.replace(clean_dtype=FLOAT32) for plan in exact)]
    sets: dict[str, None] = dict.fromkeys(["burst"] if any(plan.motion for plan in plans) else [])
    for plan in [plan.of_light for plan in plans]:
        noise = "electrons" if plan.counts_electrons else "gaussian"
        if plan.accuracy == REFERENCE:
            noise = "reference"
        elif plan.output.clean_normalised:
            noise = f"{'normalised' if plan.output.normalised else 'float_clean'}_{noise}"
        elif uses_float32(plan):
            noise = "float32"
        sets[f"linear_{noise}" if plan.source.is_linear and noise != "reference" else noise] = None
    return [*sets]


def are_compiled(kernel_set: str) -> bool:
    """True if nothing of a set of kernels is left to compile, so that the first pair does not wait.

    Another processor or version of Numba may compile again.
    """
    folder = kernel_cache_folder()
    has_run = folder is not None and (folder / f"{kernel_set}.run").exists()
    return has_run or kernel_set == "reference" or bool(numba_config.DISABLE_JIT)


def check(plans: Sequence[Plan], targets: Sequence[str] = (), advice: str = "") -> None:
    """Raise MachineError if this process computes other values than every other machine; end it with ``advice``."""
    for kernel_set in kernels(plans, targets):
        if failures(kernel_set):
            raise MachineError(
                f"the self-test failed: results differ ({'; '.join(failures(kernel_set))}); expected those of every "
                f"machine; try other versions of numpy and numba{advice}"
            )


@functools.cache
def failures(kernel_set: str) -> tuple[str, ...]:
    """Return a description of each failed test of a set of kernels, tested once per process."""
    return tuple(_failures(kernel_set))


def _failures(kernel_set: str) -> Iterator[str]:
    """Yield a description of each failed test."""
    try:
        _ = linear_table("smoothstep", 2.2, 256), normal_table()
    except MachineError as error:
        yield str(error)
        return
    for counter, key, answer in KNOWN_ANSWERS:
        words = philox4x32(tuple(np.array([word], dtype=np.uint64) for word in counter), key[0] | key[1] << 32)
        if tuple(int(word[0]) for word in words) != answer:
            yield f"Philox of {counter[0]:08x} differs from Random123"
    difference = np.zeros(8)
    _product_and_sum(np.full(8, 1 + 2.0**-30), np.full(8, -1 - 2.0**-29), difference)
    if difference.any():
        yield "a kernel uses a fused multiply-add"
    if kernel_set == "burst" and (digest := array_xxh3(_golden_light())) != GOLDEN_LIGHT:
        yield f"the golden light of a burst is {digest}, expected {GOLDEN_LIGHT}"
    for name in (name for name, plan in GOLDEN_PLANS.items() if kernels([plan]) == [kernel_set]):
        pair = make_pair(golden_image(GOLDEN_PLANS[name]), GOLDEN_PLANS[name], (1, 57))
        for member, digest in zip(("clean", "noisy"), GOLDEN[name], strict=True):
            if (actual := array_xxh3(getattr(pair, member))) != digest:
                yield f"the golden {member} frame ({name}) is {actual}, expected {digest}"
    folder = kernel_cache_folder()
    if folder is not None and not numba_config.DISABLE_JIT:
        with contextlib.suppress(OSError):  # only a message of progress depends on it
            (folder / f"{kernel_set}.run").touch()  # also after a failure: nothing is left to compile


@kernel
def _product_and_sum(x: Float, y: Float, out: Float) -> None:
    """Fill ``out`` with x² + y; its last bits show whether the square was rounded before the addition."""
    for n in range(out.shape[0]):
        out[n] = x[n] * x[n] + y[n]


def _golden_light() -> Normalised:
    """Light of a frame of a burst of the golden image."""
    light = burst.scene_light(golden_image(), GOLDEN_PLAN)
    return burst.frame_light(light, Motion(1.0, 0.01, 1.3, -0.01, 1.0, 2.7, 3), (0, 0), (0, 0), (5, 24))


def golden_image(plan: Plan = GOLDEN_PLAN) -> Srgb:
    """Return an image of 19 x 83 pixels made with integer arithmetic: ramps, every code, black and white stripes.

    As light of a linear source it is between -1/8 and nearly 4.
    """
    y, x = np.mgrid[0:19, 0:83]
    ramp = (x * 255 // 82, (x * 31 + y * 83) % 256, 255 - y * 255 // 18)
    image = np.stack(ramp, axis=-1).astype(np.uint8)
    image[:, 20:40] = 255
    image[:, 50:70] = 0
    if plan.source.is_linear:
        return image.astype(np.float32) / np.float32(64) - np.float32(0.125)
    return image
