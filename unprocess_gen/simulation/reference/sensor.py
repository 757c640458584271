"""From light in [0, 1] to digital numbers, and noise profiles from the units they were published in to DN.

Rounding is half to even, then the clip, then the cast: a cast of a value out of range is undefined and differs between
processors, truncation would darken every frame by half a DN.
"""

from __future__ import annotations

import numpy as np

from unprocess_gen.core.types import FLOAT32, Float, Frame, Normalised, Raw


def to_dn(light: Float, black_level_dn: int, white_level_dn: int, brightest: float = 1.0) -> Float:
    """Clip light to [0, brightest] and map 0 and 1 to black and white, unrounded, ``[H, W]`` float64."""
    return np.clip(light, 0, brightest) * float(white_level_dn - black_level_dn) + float(black_level_dn)


def noisy_limits(bits: int, black_level_dn: int, clip: str) -> tuple[float, float]:
    """Return the lowest and highest DN of the noisy frame.

    ``clip`` is ``sensor`` (0 to 2**bits - 1, the pedestal stays), ``black`` (nothing below the black level) or
    ``none``.
    """
    if clip == "none":
        return -np.inf, np.inf
    return float(black_level_dn if clip == "black" else 0), float(2**bits - 1)


def quantise(value_dn: Float, low: float, high: float) -> Raw:
    """Round half to even, clip to [low, high], then cast to uint16."""
    return np.clip(np.rint(value_dn), low, high).astype(np.uint16)


def normalise(value_dn: Float, low: float, high: float, levels_dn: tuple[int, int]) -> Normalised:
    """Clip to [low, high], map black and white to 0 and 1 in float64, then round once, to float32."""
    black_dn, white_dn = levels_dn
    return ((np.clip(value_dn, low, high) - float(black_dn)) / float(white_dn - black_dn)).astype(np.float32)


def in_dn(frame: Frame, levels_dn: tuple[int, int]) -> Float:
    """Return a frame of either dtype in DN, float64: what `normalise` maps to 0 and 1 are the levels again."""
    black_dn, white_dn = levels_dn
    if frame.dtype != FLOAT32:
        return frame.astype(np.float64)
    return frame.astype(np.float64) * float(white_dn - black_dn) + float(black_dn)


def noise_in_dn(
    a: float,
    b: float,
    *,
    units: str,
    black: str,
    profile_levels_dn: tuple[int, int],
    sensor_levels_dn: tuple[int, int],
) -> tuple[float, float]:
    """Return (a_dn, b_dn2) of variance = a_dn·(x - black) + b_dn2 on the sensor, from a published profile.

    Parameters
    ----------
    a, b
        Slope and intercept of the variance, as published.
    units
        ``normalized`` (black at 0, white at 1: Brooks et al., the DNG NoiseProfile) or ``dn``.
    black
        ``subtracted`` where the variance is a function of DN above black, ``included`` where the black level is part of
        the signal (the article's a·raw + b): then b is moved by a times the profile's black level.
    profile_levels_dn, sensor_levels_dn
        Black and white level the profile was calibrated at, and those of the sensor; used for ``dn`` as the scale
        s = (W - B) / (W_profile - B_profile): a·s, b·s².
    """
    black_dn, white_dn = sensor_levels_dn
    if units == "normalized":
        scale = float(white_dn - black_dn)
    else:
        scale = (white_dn - black_dn) / (profile_levels_dn[1] - profile_levels_dn[0])
    if black == "included":
        b = b + a * profile_levels_dn[0]
    return a * scale, b * scale * scale
