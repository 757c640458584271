"""Dark frames for tests: in memory, and as files of a folder."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from unprocess_gen.core.arrays import Raw


def banded(seed: int, shape: tuple[int, int] = (70, 90), black: int = 512, std: float = 3.0) -> Raw:
    """Return a dark frame with read noise, rows and columns, rounded."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(0, std, shape) + rng.normal(0, std / 2, (shape[0], 1)) + rng.normal(0, std / 3, (1, shape[1]))
    return np.clip(np.rint(black + noise), 0, 65535).astype(np.uint16)


def save_frames(folder: Path, count: int, **options: object) -> list[str]:
    """Write dark frames as NPY files; return their SHA-256."""
    folder.mkdir(parents=True, exist_ok=True)
    digests = []
    for number in range(count):
        path = folder / f"dark{number}.npy"
        np.save(path, banded(number, **options))  # type: ignore[arg-type]
        digests.append(hashlib.sha256(path.read_bytes()).hexdigest())
    return digests
