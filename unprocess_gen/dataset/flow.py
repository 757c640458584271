"""Compute where the frames of a burst show what its first frame shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.dataset.columns import Row, rebuild
from unprocess_gen.dataset.keys import clip_identity
from unprocess_gen.dataset.reader import row_of_batch
from unprocess_gen.simulation.plan import Motion


def flow(rows: Sequence[Row] | Mapping[str, Any], k: int, inverse: bool = False) -> NDArray[np.float64]:
    """Compute the optical flow between the first frame of a burst and another frame, from their motion.

    Parameters
    ----------
    rows : sequence of mappings, or mapping of columns
        Manifest rows of the burst's frames, such as ``rows`` of a `Clip`; or ``row`` of an item with ``inputs`` and
        ``rows=True``, also as tensors.
    k : int
        Number of the other frame, from 0: its column ``frame``.
    inverse : bool
        Compute the flow from frame k to frame 0 instead.

    Returns
    -------
    ndarray of float64, [2, H, W]
        Displacements d of rows, then of columns, in pixels of the frames. Frame k shows at (i, j) + d[:, i, j] what
        frame 0 shows at (i, j). With ``inverse``, frame 0 shows there what frame k shows at (i, j).

    Raises
    ------
    ValueError
        If the rows are not those of one burst, or have no frame 0 or k.

    Notes
    -----
    At the resolution of the target, pixel p of frame k shows the position A p + b of the target (``motion_*`` of its
    row). Frame 0 shows the position p. The flow from frame 0 is the inverse of this map, in pixels of the frames::

        frame 0                      frame k
        +-----------+                +-----------+
        |           |       d        |        *  |      * is one point of the scene
        |     *-----+--------------->+------->   |
        |   (i, j)  |                |  (i, j) + d
        +-----------+                +-----------+

    To align frame k with frame 0, sample it at (i, j) + d.

    Examples
    --------
    >>> import unprocess_gen as ug
    >>> settings = ["source.burst={frames: 2, downscale: 2}", "source.limit=1", "out=bursts", "n_jobs=1"]
    >>> _ = ug.generate(ug.load_config(settings))
    >>> burst = ug.RawClips("bursts")[0]
    >>> burst.noisy.shape, ug.flow(burst.rows, 1).shape
    ((2, 224, 353), (2, 224, 353))
    """
    if isinstance(rows, Mapping):
        columns = [values.tolist() if hasattr(values, "tolist") else values for values in rows.values()]
        rows = [dict(zip(rows, cells, strict=True)) for cells in zip(*columns, strict=True)]
    first, other = (_row_of(rows, number) for number in (0, k))
    if clip_identity(first) != clip_identity(other):
        raise ValueError(f"flow: frames 0 and {k} are of different bursts; expected the rows of one burst")
    origin, moved = (rebuild(Motion, row) for row in (first, other))
    step, offset = moved.burst_downscale, moved.pixel_offset + (moved.burst_downscale - 1) / 2
    shape = int(first["height"] or 0), int(first["width"] or 0)
    y, x = (step * values.astype(float) + offset for values in np.indices(shape, sparse=True))
    start, end = (moved, origin) if inverse else (origin, moved)
    y, x = _inverse(end, *start.position(y, x))
    return np.stack(
        [(at - offset) / step - pixels for at, pixels in zip((y, x), np.indices(shape, sparse=True), strict=True)]
    )


def _row_of(rows: Sequence[Row], frame: int) -> Row:
    """Find the row of a frame of a burst."""
    found = [row_of_batch(row) for row in rows if row["frame"] == frame]
    if len(found) == 1 and found[0].get("motion_y") is not None:
        return found[0]
    numbers = [row["frame"] for row in rows]
    problem = "its row has no motion" if found else f"no frame of this number in the frames {numbers}"
    problem = f"{len(found)} rows have this number" if len(found) > 1 else problem
    raise ValueError(f"flow: frame {frame}: {problem}; expected the rows of a burst, as RawClips gives them")


def _inverse(motion: Motion, y: NDArray[np.float64], x: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Compute the high-resolution pixel of a frame that shows a position in the target."""
    y, x = y - motion.motion_y, x - motion.motion_x
    determinant = motion.motion_yy * motion.motion_xx - motion.motion_yx * motion.motion_xy
    return (
        (motion.motion_xx * y - motion.motion_yx * x) / determinant,
        (motion.motion_yy * x - motion.motion_xy * y) / determinant,
    )
