"""Types of the arrays that packages exchange, and names of their dtypes and layouts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Srgb = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32]
"""Pixels of a source: display-referred codes, codes of camera RGB, or the light of a linear source (float32)."""
Raw = NDArray[np.uint16]
Normalised = NDArray[np.float32]
Frame = Raw | Normalised
"""Frame of a dataset: DN (uint16), or normalised to 0 at black and 1 at white (float32); mosaic or packed planes."""
Array = Frame | Srgb
"""Frame or target of a pair."""
Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

UINT16, FLOAT32 = "uint16", "float32"
"""Dtypes of frames."""
UINT8 = "uint8"
"""Dtype of most photographs."""
MOSAIC, PACKED = "mosaic", "packed"
"""Layouts of frames: ``[H, W]``, or ``[4, H / 2, W / 2]`` (`cfa.pack`)."""

DESCRIPTIONS = {UINT8: "|u1", UINT16: "<u2", FLOAT32: "<f4"}
"""NumPy descriptions of the dtypes in files: little-endian."""


def last_code(pixels: Srgb) -> int:
    """Largest code of display-referred pixels."""
    return int(256**pixels.itemsize) - 1
