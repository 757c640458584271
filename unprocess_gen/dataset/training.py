"""Prepare frames for training: packed planes, light and noise maps."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from unprocess_gen.core.arrays import Frame
from unprocess_gen.dataset.columns import Row
from unprocess_gen.simulation.reference import cfa


def pack(mosaic: Frame, pattern: str) -> Frame:
    """Convert a mosaic to packed planes.

    Parameters
    ----------
    mosaic : ndarray, [H, W]
        Frame or crop that begins at an even row and column; even height and width.
    pattern : str
        CFA pattern of its first four sites: RGGB, BGGR, GRBG or GBRG; in a row, ``pattern``. With MONO, the planes are
        the four sites of each 2x2 tile, row by row.

    Returns
    -------
    ndarray, [4, H / 2, W / 2]
        R, G of the red rows, G of the blue rows, B; a copy of the same dtype.

    Raises
    ------
    ValueError
        If a side is odd or the pattern is unknown.

    Examples
    --------
    >>> import numpy as np
    >>> import unprocess_gen as ug
    >>> ug.pack(np.array([[1, 2], [3, 4]], np.uint16), "BGGR").ravel().tolist()
    [4, 3, 2, 1]
    """
    return cfa.pack(mosaic, pattern)


def to_light(dn: ArrayLike, row: Row) -> NDArray[np.float32]:
    """Scale DN to 0 at the black level and 1 at the white level.

    Parameters
    ----------
    dn : array_like
        Frame, crop or planes in DN.
    row : mapping
        Manifest row: ``black_level_dn``, ``white_level_dn``.

    Returns
    -------
    ndarray of float32, same shape
        (DN - black) / (white - black). Not clipped, because clipping at 0 raises the mean of dark areas.

    Raises
    ------
    ValueError
        If the row has no levels.

    Examples
    --------
    >>> import unprocess_gen as ug
    >>> ug.to_light([240, 4095], {"black_level_dn": 240, "white_level_dn": 4095}).tolist()
    [0.0, 1.0]
    """
    black, span = _levels(row)
    return (np.asarray(dn).astype(np.float32) - np.float32(black)) / np.float32(span)


def noise_std(noisy: ArrayLike, row: Row) -> NDArray[np.float32]:
    """Estimate the standard deviation of the noise at each site of a noisy frame.

    Parameters
    ----------
    noisy : array_like
        Noisy frame, crop or planes in DN.
    row : mapping
        Manifest row: ``black_level_dn``, ``a_dn``, ``dark_variance_dn2`` and, for PRNU, ``prnu_std``, ``skipped`` and
        ``fixed_pattern_in_clean``.

    Returns
    -------
    ndarray of float32, same shape
        √max(0, a_dn · u + dark_variance_dn2 + (prnu_std · u)²), DN, with u = max(0, noisy - black). Divide by
        white - black for the scale of `to_light`.

    Raises
    ------
    ValueError
        If the row has no ``dark_variance_dn2``, or no levels.

    Notes
    -----
    The row says which terms hold: none with a_dn without shot noise, none with prnu_std if PRNU was skipped or the
    clean frame has it too. The noise of u raises the variance by the share prnu_std² on average, 1e-4 for 1 % of PRNU.
    The law holds below saturation, and for sites with the gain ``dn_per_e``.

    Examples
    --------
    >>> import unprocess_gen as ug
    >>> row = {"black_level_dn": 240, "white_level_dn": 4095, "a_dn": 2.0, "dark_variance_dn2": 25.0}
    >>> ug.noise_std([200, 240, 340], row).tolist()
    [5.0, 5.0, 15.0]
    """
    intercept = row.get("dark_variance_dn2")
    if intercept is None:
        raise ValueError("dark_variance_dn2 is missing from the row; expected a row of a pair, with all of its columns")
    black, _ = _levels(row)
    signal = np.maximum(np.asarray(noisy).astype(np.float32) - np.float32(black), 0)
    skipped = {reason.partition(":")[0] for reason in str(row.get("skipped") or "").split(";")}
    slope: Any = np.float32(0 if skipped & {"shot", "heteroscedastic"} else row["a_dn"] or 0)
    has_prnu = "prnu" not in skipped and not int(row.get("fixed_pattern_in_clean") or 0)
    if has_prnu and (prnu_std := float(row.get("prnu_std") or 0)):
        slope = np.float32(prnu_std**2) * signal + slope
    variance = slope * signal + np.float32(intercept)
    return np.asarray(np.sqrt(np.maximum(variance, 0)), dtype=np.float32)


def frame_noise_std(noisy: Frame, row: Row, *, of_white: bool) -> NDArray[np.float32]:
    """Estimate the noise of a uint16 or float32 frame as `noise_std`, in DN or in units of white."""
    black, span = _levels(row)
    noisy_dn = noisy if noisy.dtype == np.uint16 else noisy * np.float32(span) + np.float32(black)
    return noise_std(noisy_dn, row) / np.float32(span if of_white else 1)


def _levels(row: Row) -> tuple[int, int]:
    """Black level and range from black to white, DN."""
    black, white = row.get("black_level_dn"), row.get("white_level_dn")
    if black is None or white is None:
        raise ValueError("black_level_dn or white_level_dn is missing from the row; expected the row of a pair")
    return int(black), int(white) - int(black)
