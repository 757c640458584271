"""Round to integers with operations that vectorise on every processor.

Adding 1.5·2**52 to a float64, or 1.5·2**23 to a float32, rounds half to even and leaves the integer in the low mantissa
bits. Subtracting the constant again gives the rounded float. Valid for magnitudes up to 2**51 and 2**22. Conversions
from float64 to integers give the same numbers, but do not vectorise without AVX-512.
"""

from __future__ import annotations

import numpy as np

ROUND, ROUND32 = 1.5 * 2.0**52, np.float32(1.5 * 2.0**23)
