"""Kinds of datasets: settings that decide what a pair is made of."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

KINDS = {
    "two numbers": ("noise=imx385_iso3200",),
    "poisson law": ("noise=heteroscedastic", "noise.a=3", "noise.b=20", "noise.law=poisson"),
    "random levels": ("noise=brooks2019", "camera=choice"),
    "night": ("noise=sony_a7s2", "scene=night"),
    "every effect": ("noise=nikon_d850", "scene=low_light", "effects.all=on", "noise.full_well_e=60000"),
    "patches, levels and draws": ("noise=sony_a7s2", "noise.levels=[1600,3200]", "noise.draws=2", "source.patch=8"),
    "random patches, packed": ("noise=imx385_iso3200", "output.layout=packed", "source.patch=[random,8,3]"),
    "float32": ("noise=sony_a7s2", "scene=daylight", "output.dtype=float32"),
    "float clean": ("noise=imx385_iso3200", "output.clean_dtype=float32"),
    "fixed patterns in clean": ("noise=sony_a7s2", "effects.prnu=on", "clean.includes_fixed_pattern=true"),
    "reference": ("noise=imx385_iso3200", "accuracy=reference"),
    "fast": ("noise=imx385_iso3200", "accuracy=fast"),
    "gray mean, no noise": ("noise=none", "gains.highlight=gray_mean", "isp=srgb"),
    "downscaled, dithered": ("noise=imx385_iso3200", "source.downscale=2", "source.dequantize=dither"),
    "targets": ("noise=sony_a7s2", "output.targets=[linear_rgb]"),
    "split": ("noise=imx385_iso3200", "split={train: 0.5, test: 0.5}"),
    "clips": ("noise=sony_a7s2", "scene=night", "source.clips=true"),
    "scenes": ("noise=imx385_iso3200", "source.limit=2"),
    "dark frames": ("noise=sony_a7s2", "noise.iso=1600", "sensor=generic_14bit"),
    "filtered": ("noise=imx385_iso3200", "source.min_side=13"),
    "raw clips": (
        *("source.kind=raw", "source.clips=true", "source.raw.pattern=GRBG", "source.raw.black_dn=501"),
        *("source.raw.white_dn=15001", "source.patch=[random,32,2]", "noise.draws=2", "noise=heteroscedastic"),
        *("noise.levels=[{a: 2, b: 4}, {a: 6, b: 20}]", "split={train: 0.5, val: 0.5}"),
    ),
}

SOURCES = {"clips": "clips", "raw clips": "raw", "scenes": None}
"""Their sources, where they are not three photographs: a folder, or None for the built-in pictures."""

Kind = Callable[[str], Path]
"""Type of the fixture `made_kind`."""
