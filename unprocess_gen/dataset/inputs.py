"""Cut, flip and convert pairs to network inputs: the options that `RawPairs` and `LivePairs` share."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import PACKED
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.fields import number_or_text
from unprocess_gen.core.random_streams import even_corner
from unprocess_gen.core.targets import LINEAR_RGB
from unprocess_gen.dataset.columns import Row, Value
from unprocess_gen.dataset.development import FILTERS, DevelopmentParameters
from unprocess_gen.dataset.row import COLUMNS
from unprocess_gen.dataset.training import frame_noise_std, to_light
from unprocess_gen.simulation.reference import cfa

INPUTS = ("mosaic", PACKED)
FLIPS: dict[str, Callable[[NDArray[Any]], NDArray[Any]]] = {
    "horizontal": lambda sites: sites[..., ::-1],
    "vertical": lambda sites: sites[..., ::-1, :],
    "transpose": lambda sites: np.swapaxes(sites, -1, -2),
}
"""Ways to flip, in the order in which an item is flipped."""

PICTURES = ("srgb", LINEAR_RGB)
"""Targets whose last axis is the channel; others have the sites of the frames."""

TEXTS = {column.name for column in COLUMNS if column.type is number_or_text}
"""Columns with numbers in some pairs and text in others."""


@dataclass(frozen=True, slots=True)
class Options:
    """Arguments that change an item, documented by `RawPairs` and `LivePairs`; ``reader`` is the name of the class."""

    reader: str
    patch: int | None = None
    flip: bool = False
    inputs: str | None = None
    noise_map: bool = False
    rows: bool = False
    clip_black: bool = False

    def __post_init__(self) -> None:
        if self.inputs not in (None, *INPUTS):
            known = ", ".join(INPUTS)
            raise ConfigError(f"{self.reader}: inputs={self.inputs!r}: unknown; expected {known}, or None for samples")
        for name in ("noise_map", "rows", "clip_black"):
            if getattr(self, name) and self.inputs is None:
                raise ConfigError(f"{self.reader}: {name}=True: has no effect on samples; expected inputs='packed'")
        if self.patch is not None and (self.patch < 2 or self.patch % 2):
            raise ConfigError(f"{self.reader}: patch={self.patch}: out of range; expected an even number from 2")
        if self.flip and self.patch is None:
            raise ConfigError(f"{self.reader}: flip=True: changes sizes; expected patch, the side of all items")

    @property
    def side(self) -> int | None:
        """Side of the square to cut, with the site on each side that a flip may leave out."""
        return self.patch if self.patch is None else self.patch + 2 * self.flip

    def place(self, words: tuple[int, int], height: int, width: int) -> tuple[int, int]:
        """Corner of the square, chosen by random ``words``; ConfigError if the pair is smaller."""
        side = self.side or 0
        if side > min(height, width):
            problem = f"patch={self.patch}: exceeds a pair of {width} x {height} pixels"
            less = ", less 2 for flip=True" if self.flip else ""
            raise ConfigError(f"{self.reader}: {problem}; expected at most its shorter side{less}")
        return even_corner(words, side, height, width)

    def item(
        self,
        sample: Any,
        columns: Row,
        words: tuple[int, int],
        development: Callable[[], DevelopmentParameters],
        **cells: Value,
    ) -> Any:
        """Flip a sample that has been cut, and convert it to a dict if ``inputs`` is set.

        ``columns`` are levels, pattern, layout and noise of the row; ``cells`` are columns that some rows lack.
        """
        if self.flip:  # by the lowest bits, which do not decide the corner
            hows = tuple(how for bit, how in enumerate(FLIPS) if words[0] >> bit & 1)
            sample = cut(_flipped_sample(sample, columns, hows), columns, (0, 0), self.patch or 0)
        if self.inputs is None:
            return sample
        frames = {"noisy": sample.noisy, "clean": sample.clean}
        arrays = {
            name: to_light(frame, columns) if frame.dtype == np.uint16 else frame for name, frame in frames.items()
        }
        if self.clip_black:
            arrays = {name: np.maximum(light, 0) for name, light in arrays.items()}
        if self.noise_map:
            arrays["noise_std"] = frame_noise_std(sample.noisy, columns, of_white=True)
        arrays = {name: self._layout(name, array, columns) for name, array in (arrays | sample.targets).items()}
        row = {"row": stackable_row(sample.row, cells)} if self.rows else {}
        return {**arrays, "development": development(), **row}

    def _layout(self, name: str, sites: NDArray[Any], columns: Row) -> NDArray[Any]:
        """Copy of an array as picture, mosaic or planes, according to ``inputs``."""
        pattern, is_picture = str(columns["pattern"]), name in PICTURES
        if columns["layout"] == PACKED and not is_picture:
            return np.array(sites) if self.inputs == PACKED else cfa.unpack(sites, pattern)
        if self.inputs == "mosaic":
            return np.array(sites)
        return np.array(_even(sites)) if is_picture else cfa.pack(_even(sites), pattern)


def stackable_row(row: Row, cells: Row) -> dict[str, Any]:
    """Row whose columns have one type in every pair: NaN instead of None, text if some pairs have text."""
    cells = {**cells, **{name: math.nan if value is None else value for name, value in row.items()}}
    return {name: str(value) if name in TEXTS else value for name, value in cells.items()}


def cut(sample: Any, columns: Row, corner: tuple[int, int], side: int) -> Any:
    """Sample with views of the arrays in a square at an even row and column."""

    def part(name: str, array: NDArray[Any]) -> NDArray[Any]:
        scale = 2 if columns["layout"] == PACKED and name not in PICTURES else 1
        y, x = (slice(start // scale, (start + side) // scale) for start in corner)
        return array[:, y, x] if scale == 2 else array[y, x]

    return _changed(sample, part)


def flip(x: Any, how: str, pattern: str = "RGGB") -> Any:
    """Flip a mosaic or an item so that it keeps its CFA pattern.

    Sites are moved, not computed. Mirroring an even width changes the phase of the colours, so the first and last
    column are left out; likewise rows of an even height. A transposition that exchanges red and blue leaves out the
    first and last row and column. Transposition turns banding along rows into banding along columns.

    Parameters
    ----------
    x : ndarray, [..., H, W]; or an item of `RawPairs` or `LivePairs`
        Mosaics; or a `Sample` or dict, whose arrays are all flipped. The row does not change.
    how : str
        ``"horizontal"`` (columns in reverse order), ``"vertical"`` (rows), or ``"transpose"`` (rows become columns).
    pattern : str
        CFA pattern of mosaics: RGGB, BGGR, GRBG, GBRG, or MONO, which leaves out nothing. Items have their own.

    Returns
    -------
    ndarray, Sample or dict
        Copies, of the type of ``x``.

    Raises
    ------
    ValueError
        If ``how`` or ``pattern`` is unknown, or ``x`` is a clip.

    Examples
    --------
    >>> import numpy as np
    >>> import unprocess_gen as ug
    >>> ug.flip(np.array([[1, 2, 3, 4], [5, 6, 7, 8]]), "horizontal")
    array([[3, 2],
           [7, 6]])
    """
    if how not in FLIPS:
        raise ValueError(f"how={how!r}: unknown; expected one of {', '.join(FLIPS)}")
    if hasattr(x, "rows") or (isinstance(x, Mapping) and "frame" in x):
        raise ValueError("x: is a clip, whose motion cannot be flipped; expected a pair or a mosaic")
    if isinstance(x, Mapping):
        pattern = FILTERS[int(x["development"].pattern)]
        is_packed = x["noisy"].ndim == 3
        return {
            name: _flipped_sites(name, value, (how,), pattern, is_packed) if isinstance(value, np.ndarray) else value
            for name, value in x.items()
        }
    if hasattr(x, "row"):
        return _flipped_sample(x, x.row, (how,))
    return _flipped(np.asarray(x), (how,), pattern)


def _flipped_sample(sample: Any, columns: Row, hows: tuple[str, ...]) -> Any:
    pattern, is_packed = str(columns["pattern"]), columns["layout"] == PACKED
    return _changed(sample, lambda name, array: _flipped_sites(name, array, hows, pattern, is_packed))


def _flipped_sites(
    name: str, array: NDArray[Any], hows: tuple[str, ...], pattern: str, is_packed: bool
) -> NDArray[Any]:
    """Flip an array of an item: a picture, planes, or a mosaic."""
    if name in PICTURES:
        return np.moveaxis(_flipped(np.moveaxis(array, -1, 0), hows, pattern), 0, -1)
    if is_packed:
        return cfa.pack(_flipped(cfa.unpack(array, pattern), hows, pattern), pattern)
    return _flipped(array, hows, pattern)


def _flipped(sites: NDArray[Any], hows: tuple[str, ...], pattern: str) -> NDArray[Any]:
    """Flip the last two axes, and leave out what the phase of the pattern requires."""
    top, left = _corner(hows, pattern, sites.shape[-2] % 2, sites.shape[-1] % 2)
    for how in hows:
        sites = FLIPS[how](sites)
    height, width = sites.shape[-2:]
    return sites[..., top : height - top, left : width - left].copy()  # PyTorch takes no negative strides


@functools.cache
def _corner(hows: tuple[str, ...], pattern: str, *odd: int) -> tuple[int, int]:
    """First row and column at which flipped sites have the pattern."""
    tile = np.array([*cfa.filters(pattern)]).reshape(2, 2)
    sites = np.tile(tile, (3, 3))[: 4 + odd[0], : 4 + odd[1]]
    for how in hows:
        sites = FLIPS[how](sites)
    corners = ((y, x) for y in (0, 1) for x in (0, 1))
    return next((y, x) for y, x in corners if (sites[y : y + 2, x : x + 2] == tile).all())


def _changed(sample: Any, change: Callable[[str, NDArray[Any]], NDArray[Any]]) -> Any:
    """Sample of the same pair with changed arrays."""
    targets = {name: change(name, target) for name, target in sample.targets.items()}
    frames = change("clean", sample.clean), change("noisy", sample.noisy)
    return type(sample)(*frames, sample.row, sample.dataset, targets)


def _even(sites: NDArray[Any]) -> NDArray[Any]:
    """Rows and columns of complete 2x2 tiles."""
    return sites[: len(sites) // 2 * 2, : sites.shape[1] // 2 * 2]
