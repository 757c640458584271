"""Clean and noisy raw pairs from ordinary sRGB photographs.

``RawPairs(path)`` reads a finished dataset.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"
__all__ = ["RawPairs", "__version__"]

if TYPE_CHECKING:
    from unprocess_gen.dataset.reader import RawPairs


def __getattr__(name: str) -> Any:
    """Import the reader, and NumPy with it, only when it is asked for: the command line answers ``--help`` at once."""
    if name == "RawPairs":
        from unprocess_gen.dataset.reader import RawPairs

        return RawPairs
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
