"""Before a process makes data, it shows that it computes what every other machine does. It takes three milliseconds.

Four proofs, from the ground up: the exact tables have their published digests; Philox gives Random123's known answers;
a product and a sum in a kernel are rounded one after the other, not at once; and a small picture becomes the very pair
that it became on every machine before, through the same compiled kernels that make the dataset. A compiler, a library
or a processor that rounds otherwise shows up here, not in data that somebody trained on for a week. The golden pair
covers the 8-bit kernel, both branches of the highlights, every pattern phase and both ends of the sensor; the 16-bit
curves are held to their digests when they are first read.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from unprocess_gen.core.errors import MachineError
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.core.jit import is_cached, kernel
from unprocess_gen.core.lookup_tables import normal_table
from unprocess_gen.core.random_streams import philox4x32
from unprocess_gen.core.tone_curves import linear_table
from unprocess_gen.core.types import FLOAT32, IN_FLOAT32, READABLE, Float, Physics, Plan, Srgb
from unprocess_gen.simulation.kernels import clean
from unprocess_gen.simulation.kernels import float_draws as floats
from unprocess_gen.simulation.kernels import gaussian as fused
from unprocess_gen.simulation.kernels import gaussian_float32 as single
from unprocess_gen.simulation.kernels import physical as electrons
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.reference.noise import EFFECTS

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
    downscale=1,
    dequantize="off",
    scene="daylight",
    exposure_ratio=1.0,
    camera="custom",
    weights=(0.0, 0.0, 0.0, 0.0),
    rgb2cam=(0.5625, 0.3125, 0.125, 0.125, 0.75, 0.125, 0.03125, 0.21875, 0.75),
    red_gain=2.15,
    blue_gain=1.7,
    inverse_rgb_gain=0.8,
    tone="smoothstep",
    gamma=2.2,
    highlight="per_channel",
    highlight_threshold=0.9,
    pattern="GRBG",
    bits=10,
    black_level_dn=64,
    white_level_dn=1023,
    sensor_clip="sensor",
    saturated="noisy",
    noise="imx385_iso25600",
    noise_law="gaussian",
    a_dn=55.0,
    b_dn2=2500.0,
    effects=("heteroscedastic",),
    skipped=(),
    accuracy="exact",
    methods=(),
)
GOLDEN_PHYSICS = Physics(
    iso=3200.0,
    exposure_s=0.1,
    temperature_c=30.0,
    dn_per_e=4.0,
    prnu_std=0.01,
    dark_e=3.0,
    dark_offset="removed",
    hot_pixel_share=0.02,
    hot_pixel_e=40.0,
    full_well_e=300.0,
    read_law="tukey",
    read_shape=-0.1,
    read_std_dn=6.0,
    row_std_dn=2.0,
    column_std_dn=1.0,
    black_error_dn=(0.5, -0.25, 0.125, 1.0),
    dead_pixel_share=0.01,
    sensor_unit="0",
    body_key=0xFEDCBA9876543210,
    fixed_pattern_in_clean=False,
)
GOLDEN_PLANS = {
    "per_channel": GOLDEN_PLAN,
    "gray_mean": replace(GOLDEN_PLAN, highlight="gray_mean"),
    "float32": replace(GOLDEN_PLAN, methods=(IN_FLOAT32,), bits=16, black_level_dn=4096, white_level_dn=65535),
    "readable": replace(GOLDEN_PLAN, methods=(READABLE,)),
    "plain": replace(
        GOLDEN_PLAN,
        physics=GOLDEN_PHYSICS,
        effects=("shot", "read", "row", "black_error", "quantise"),
    ),
    "near": replace(
        GOLDEN_PLAN,
        highlight="gray_mean",
        physics=GOLDEN_PHYSICS,
        effects=("shot", "read", "quantise"),
        law_distance=0.01,
        methods=("shot:gaussian_where_near",),
    ),
    "physical": replace(
        GOLDEN_PLAN, physics=GOLDEN_PHYSICS, effects=EFFECTS, exposure_ratio=1.5, level=1, draw=2, frame=3
    ),
}
GOLDEN_PLANS |= {
    "normalised": replace(GOLDEN_PLAN, dtype=FLOAT32, sensor_clip="none"),
    "normalised_counts": replace(GOLDEN_PLANS["physical"], dtype=FLOAT32, sensor_clip="none"),
}
GOLDEN = {
    # XXH3-128 of the clean and of the noisy frame
    "per_channel": ("443ea2ae03acfbab1df2b27f58ddbe39", "249b904acb59298a603502c2424e4712"),
    "gray_mean": ("b4c0b18f1bbccbf881c82b00455253e9", "16f26b70e50c70f03babed405092f5b2"),
    "float32": ("9243174c79ef1c0b95c6fc62c480fbc8", "53fa7baa361ccd3954240d855bc1990c"),
    "readable": ("443ea2ae03acfbab1df2b27f58ddbe39", "249b904acb59298a603502c2424e4712"),
    "plain": ("443ea2ae03acfbab1df2b27f58ddbe39", "a3ed0176ff50cf595767857da127dd39"),
    "near": ("b4c0b18f1bbccbf881c82b00455253e9", "c0308c77164902cd319646844ca0b470"),
    "normalised": ("aa19fde7d361bcc67ca6c9e52c8d8634", "4de3ab500ebd73704139d53f4f3d8ee3"),
    "normalised_counts": ("db1e51d036e01d5eaca3d0ebedbab809", "f5e3fd88d4091be074264896a692346f"),
    "physical": ("ae069ed854a5cf392b7ed42acbf49489", "034a49f0e3f78996ab8d340da875038e"),
}
PROVED_BY = {
    "one_normal": ("per_channel", "gray_mean"),
    "float32": ("float32",),
    "plain": ("plain", "near"),
    "physical": ("physical",),
    "readable": ("readable",),
    "normalised": ("normalised",),
    "normalised_counts": ("normalised", "normalised_counts"),
}
"""Which golden pairs prove which kernels: those that a plan does not need would take seconds to compile."""

OUTER = {
    "one_normal": (fused._fill_pairs,),
    "float32": (single._fill_pairs32,),
    "plain": (electrons._fill_shot_read_pair,),
    "physical": (electrons._fill_physical_pair, electrons._fill_prnu_response),
    "readable": (),
    "normalised": (clean._fill_clean_frame, *floats.NORMAL_KERNELS),
    "normalised_counts": (clean._fill_clean_frame, *floats.NORMAL_KERNELS, *floats.COUNT_KERNELS),
}
"""The kernels that bring all others of their kind with them."""


def are_compiled(kernels: str) -> bool:
    """Whether the machine code of some of `PROVED_BY` lies ready, so that the first pair does not wait for it."""
    return all(is_cached(kernel) for kernel in OUTER[kernels])


def kernels(plan: Plan) -> str:
    """Return which of `PROVED_BY` make the pair of a plan."""
    if plan.readable:
        return "readable"
    if plan.normalised:
        return "normalised_counts" if plan.counts_electrons else "normalised"
    if plan.counts_electrons:
        return "plain" if electrons.has_only_shot_and_read(plan) else "physical"
    return "float32" if plan.in_float32 else "one_normal"


def check(kernels: str, way_out: str = "") -> None:
    """Raise MachineError, with every proof that failed, where this process computes differently."""
    if failures(kernels):
        raise MachineError(
            f"the self-test failed: {'; '.join(failures(kernels))}; this machine computes differently from others: "
            f"try other versions of numpy and numba{way_out}"
        )


@functools.lru_cache(maxsize=len(PROVED_BY))
def failures(kernels: str) -> tuple[str, ...]:
    """Return each proof of some of `PROVED_BY` that failed, in words; once in a process."""
    return tuple(_failures(kernels))


def _failures(kernels: str) -> Iterator[str]:
    try:
        _ = linear_table("smoothstep", 2.2, 256), normal_table()
    except MachineError as error:
        yield str(error)
        return
    for counter, key, answer in KNOWN_ANSWERS:
        words = philox4x32(tuple(np.array([word], dtype=np.uint64) for word in counter), key[0] | key[1] << 32)
        if tuple(int(word[0]) for word in words) != answer:
            yield f"Philox of {counter[0]:08x} is not Random123's"
    rest = np.zeros(8)
    _product_and_sum(np.full(8, 1 + 2.0**-30), np.full(8, -1 - 2.0**-29), rest)
    if rest.any():
        yield "a kernel multiplies and adds in one rounding"
    for name in PROVED_BY[kernels]:
        wanted = GOLDEN[name]
        pair = make_pair(golden_picture(), GOLDEN_PLANS[name], (1, 57))
        for which, frame, digest in zip(("clean", "noisy"), (pair.clean, pair.noisy), wanted, strict=True):
            if (found := array_xxh3(frame)) != digest:
                yield f"the golden {which} frame ({name}) is {found}, expected {digest}"


@kernel
def _product_and_sum(x: Float, y: Float, out: Float) -> None:
    """Fill ``out`` with x² + y, whose last bits show whether the square was rounded before the sum."""
    for n in range(out.shape[0]):
        out[n] = x[n] * x[n] + y[n]


def golden_picture() -> Srgb:
    """Return a picture of 19 x 83 pixels in integer arithmetic: ramps, every code, and stripes of black and white."""
    y, x = np.mgrid[0:19, 0:83]
    ramp = (x * 255 // 82, (x * 31 + y * 83) % 256, 255 - y * 255 // 18)
    picture = np.stack(ramp, axis=-1).astype(np.uint8)
    picture[:, 20:40] = 255
    picture[:, 50:70] = 0
    return picture
