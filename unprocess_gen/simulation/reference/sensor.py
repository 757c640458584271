"""Convert normalised light to DN, and published noise profiles to the sensor's DN.

Values are rounded half to even, clipped, then cast. Casting out-of-range values is undefined and differs between CPUs;
truncation would lower the mean by half a DN.
"""

from __future__ import annotations

import numpy as np

from unprocess_gen.core.arrays import FLOAT32, Float, Frame, Normalised, Raw


def to_dn(
    light: Float, black_level_dn: int, white_level_dn: int, brightest: float = 1.0, darkest: float = 0.0
) -> Float:
    """Clip light to ``darkest``, at most 0, and ``brightest``, at most 1; convert it to DN, without rounding."""
    return np.clip(light, darkest, brightest) * float(white_level_dn - black_level_dn) + float(black_level_dn)


def quantise(value_dn: Float, low: float, high: float) -> Raw:
    """Round half to even, clip to [low, high], then cast to uint16.

    Parameters
    ----------
    value_dn : ndarray of float64
        DN, any shape.
    low, high : float
        Limits in DN, in [0, 65535].

    Returns
    -------
    ndarray of uint16
        DN, same shape.
    """
    return np.clip(np.rint(value_dn), low, high).astype(np.uint16)


def normalise(value_dn: Float, low: float, high: float, levels_dn: tuple[int, int]) -> Normalised:
    """Clip DN to [low, high], map black and white to 0 and 1 in float64, then round once to float32."""
    black_dn, white_dn = levels_dn
    return ((np.clip(value_dn, low, high) - float(black_dn)) / float(white_dn - black_dn)).astype(np.float32)


def in_dn(frame: Frame, levels_dn: tuple[int, int]) -> Float:
    """Convert a frame of either dtype to DN.

    Parameters
    ----------
    frame : ndarray of uint16 or float32
        DN, or values normalised by `normalise`; any shape.
    levels_dn : (int, int)
        Black and white level.

    Returns
    -------
    ndarray of float64
        DN, same shape.
    """
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
    """Convert a published two-parameter noise profile to DN of the sensor.

    Parameters
    ----------
    a, b : float
        Slope and intercept of the noise variance, as published.
    units : str
        ``"normalized"``: black at 0, white at 1 (Brooks et al.; DNG NoiseProfile). ``"dn"``: DN of the profile's
        sensor.
    black : str
        ``"subtracted"`` if the published variance is a function of DN above black. ``"included"`` if it is a function
        of DN (the article's a·raw + b); then a times the profile's black level is added to b.
    profile_levels_dn : (int, int)
        Black and white level of the sensor that was calibrated.
    sensor_levels_dn : (int, int)
        Black and white level of the simulated sensor. For ``"dn"``, a is multiplied by
        s = (white - black) / (profile's white - profile's black), and b by s².

    Returns
    -------
    (float, float)
        a_dn (DN) and b_dn2 (DN²) of variance = a_dn·(x - black) + b_dn2.
    """
    black_dn, white_dn = sensor_levels_dn
    if units == "normalized":
        scale = float(white_dn - black_dn)
    else:
        scale = (white_dn - black_dn) / (profile_levels_dn[1] - profile_levels_dn[0])
    if black == "included":
        b = b + a * profile_levels_dn[0]
    return a * scale, b * scale * scale
