"""Make, generate, verify and develop pairs from Python: the functions that `unprocess_gen` exports.

`generate`, `verify` and `replay` do the work of the verbs of these names, without signal handlers or exit codes.
Exceptions carry the sentence that the command line prints. `load_config` is in `config.composition`, `RawPairs` in
`dataset.reader`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from unprocess_gen.config.interpretation import noise_levels
from unprocess_gen.config.schema import Config
from unprocess_gen.config.source_validation import require_kind
from unprocess_gen.config.validation import validate_config
from unprocess_gen.config.values import refusal
from unprocess_gen.core.arrays import PACKED, Frame, Srgb
from unprocess_gen.core.errors import ConfigError, SourceError
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.core.paths import any_path
from unprocess_gen.core.source import Source
from unprocess_gen.dataset.columns import Row, Value
from unprocess_gen.dataset.dataset_json import recorded_places
from unprocess_gen.dataset.keys import key_text
from unprocess_gen.dataset.reader import mosaic_dn, row_of_batch
from unprocess_gen.dataset.row import pair_row, plan_from_row
from unprocess_gen.dataset.selection import select_rows
from unprocess_gen.pipeline import generate as _generate
from unprocess_gen.pipeline import replay as _replay
from unprocess_gen.pipeline import verify as _verify
from unprocess_gen.pipeline.pairs import PairSettings, PlannedImage, plan_pixels
from unprocess_gen.simulation import self_test
from unprocess_gen.simulation.frames import Pair, Patch
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference import isp
from unprocess_gen.sources.image.decode import Photograph
from unprocess_gen.sources.linear.pixels import linear_photograph, linear_pixels
from unprocess_gen.sources.loader import downscaled
from unprocess_gen.sources.patches import list_patches

ARRAY_NAME = "array"
"""The column ``source`` of a pair made from an array."""

PathLike = str | os.PathLike[str]


class RawPair:
    """Clean and noisy raw frame of one array of pixels.

    Attributes
    ----------
    clean, noisy : ndarray
        uint16 mosaics [H, W] in DN; other ``output.dtype`` and ``output.layout`` as in a dataset.
    plan : Plan
        All parameters of the pair.
    counts : Counts
        Sites that were clipped, saturated or have no variance.
    row : dict
        Manifest row of the pair: value by column. ``source_sha256`` is the digest of the array, or of ``key``. Built on
        first access.
    """

    def __init__(self, pair: Pair, plan: Plan, source: Source, patch: Patch) -> None:
        self.clean = pair.clean
        self.noisy = pair.noisy
        self.counts = pair.counts
        self.plan = plan
        self._source = source
        self._patch = patch

    @cached_property
    def row(self) -> dict[str, Any]:
        """Manifest row of the pair."""
        pair = Pair(self.clean, self.noisy, self.counts)
        digests = array_xxh3(self.clean), array_xxh3(self.noisy)
        identity = self._source.sha256 or ""
        return dict(pair_row(key_text(0), self._source, identity, 1, 0, self.plan, pair, digests, self._patch))

    def __repr__(self) -> str:
        return f"RawPair({self.clean.dtype} {list(self.clean.shape)}, noise={self.plan.noise.noise})"

    def _repr_html_(self) -> str:
        from unprocess_gen.dataset.notebook import pair_html  # imports Pillow

        return pair_html(mosaic_dn(self.clean, self.row), mosaic_dn(self.noisy, self.row), self.row)


def plan_image(srgb: ArrayLike, config: Config, *, seed: int | None = None, key: str | int | None = None) -> Plan:
    """Draw all parameters of one image.

    Parameters
    ----------
    srgb : array_like of uint8 or uint16, [H, W, 3]
        Display-referred codes, R, G, B; with ``source.kind=linear``, light in float16 or float32.
    config : Config
        From `load_config`. ``source.root`` and ``source.limit`` are ignored.
    seed : int, optional
        Replaces ``config.seed``.
    key : str or int, optional
        Identity of the image, from which its random streams follow together with the seed; by default a digest of the
        array. It is not the ``key`` of a manifest row: the ``source_sha256`` of a row gives the parameters of that row.

    Returns
    -------
    Plan
        Parameters of the first noise level and draw.

    Raises
    ------
    ConfigError
        If the config is incomplete or not allowed, or ``source.patch`` or ``source.burst`` is set.
    TypeError
        If ``config`` is not a config.
    ValueError
        If ``srgb`` has another dtype or shape.

    Examples
    --------
    A plan keeps gains, matrix and noise for other pixels:

    >>> import numpy as np
    >>> import unprocess_gen as ug
    >>> srgb = np.full((64, 96, 3), 128, np.uint8)
    >>> plan = ug.plan_image(srgb, ug.load_config(), seed=7)
    >>> darker = ug.make_pair(srgb // 2, plan)
    >>> darker.row["red_gain"] == plan.camera.red_gain
    True
    """
    settings = array_settings(config, seed)
    return plan_array(array_pixels(srgb, config.source.kind == "linear"), settings, key)[1].plans[0]


def make_pair(
    srgb: ArrayLike, config: Config | Plan, *, seed: int | None = None, key: str | int | None = None
) -> RawPair:
    """Make the clean and the noisy raw frame of one image.

    The same array, config, seed and key give the same pair on every machine.

    Parameters
    ----------
    srgb : array_like of uint8 or uint16, [H, W, 3]
        Display-referred codes, R, G, B; with ``source.kind=linear``, light in float16 or float32. Downscaled and
        dequantized as the config or plan requires.
    config : Config or Plan
        From `load_config` or `plan_image`. ``source.root`` and ``source.limit`` are ignored.
    seed : int, optional
        Replaces ``config.seed``. Not with a plan.
    key : str or int, optional
        Identity of the image, not the ``key`` of a manifest row; see `plan_image`. Not with a plan.

    Returns
    -------
    RawPair
        Clean and noisy frame, plan and manifest row.

    Raises
    ------
    ConfigError
        If the config is incomplete or not allowed, ``source.patch`` or ``source.burst`` is set, or ``seed`` or ``key``
        come with a plan.
    MachineError
        If the self-test of the kernels fails on this machine.
    TypeError
        If ``config`` is neither a config nor a plan.
    ValueError
        If ``srgb`` has another dtype or shape.

    Examples
    --------
    >>> import numpy as np
    >>> import unprocess_gen as ug
    >>> srgb = np.full((64, 96, 3), 128, np.uint8)
    >>> config = ug.load_config(["camera=sony_a7r", "noise=imx385_iso3200"])
    >>> pair = ug.make_pair(srgb, config)
    >>> pair
    RawPair(uint16 [64, 96], noise=imx385_iso3200)
    >>> pair.row["black_level_dn"], pair.row["white_level_dn"]
    (240, 4095)
    """
    is_linear = config.source.is_linear if isinstance(config, Plan) else _check_complete(config) == "linear"
    pixels = array_pixels(srgb, is_linear)
    if not isinstance(config, Plan):
        source, image = plan_array(pixels, array_settings(config, seed), key)
    elif config.dark is not None:
        raise ConfigError("make_pair: the plan names a dark frame, whose folder it lacks; expected a config")
    elif config.source.is_raw:
        raise ConfigError("make_pair: the plan is of a raw frame; expected that of a photograph; use ug.LivePairs")
    elif config.motion is not None:
        raise ConfigError("make_pair: the plan is of a burst; expected that of a photograph; use ug.LivePairs")
    elif seed is None and key is None:
        recorded, patches = _recorded(pixels, config.source.downscale, config.output.layout)
        plan = config.replace(pixels_xxh3=array_xxh3(pixels)) if is_linear else config
        source, image = _array_source(pixels, None), PlannedImage(recorded, (plan,), patches)
    else:
        raise ConfigError("make_pair: a plan has its own seed and key; expected them with a config only")
    if isinstance(config, Plan) or config.self_test == "stop":
        self_test.check(image.plans[:1])
    patch, plan, pair = next(image.pairs())
    return RawPair(pair, plan, source, patch)


def generate(config: Config) -> _generate.Summary:
    """Generate the dataset that a config describes, or resume it.

    Progress is shown on stderr. Failed sources are counted in the result; ``source.max_failed`` is not applied.

    Parameters
    ----------
    config : Config
        From `load_config`; ``config.out`` is the folder of the dataset.

    Returns
    -------
    Summary
        Pairs, failures by reason, shards, bytes and seconds.

    Raises
    ------
    ConfigError
        If the config is not allowed, or ``out`` cannot be used or was begun with other settings or sources.
    LockedError
        If another run holds ``out``.
    DamageError
        If ``out`` is a finished dataset with missing files.
    MachineError
        If the disk is full or fails, or a source was changed or deleted.
    TypeError
        If ``config`` is not a config.

    Examples
    --------
    Two of the synthetic pictures, in one process:

    >>> import unprocess_gen as ug
    >>> summary = ug.generate(ug.load_config(["source.limit=2", "n_jobs=1", "out=ds"]))
    >>> summary.pairs, summary.shards
    (2, 1)
    """
    _check_complete(config)
    validate_config(config)
    return _generate.generate(config)


def verify(folder: PathLike) -> list[_verify.Damage]:
    """Compare every byte of a dataset, or of all datasets of a sweep, with what it records.

    Parameters
    ----------
    folder : path-like
        Folder of the dataset or of the sweep.

    Returns
    -------
    list of Damage
        Empty if every byte is as it was written. For a sweep ``file`` begins with the folder of the dataset.

    Raises
    ------
    DamageError
        If the folder contains no finished dataset.
    MachineError
        If a file exists but cannot be read.

    Examples
    --------
    The dataset of the example of `generate`:

    >>> import unprocess_gen as ug
    >>> ug.verify("ds")
    []
    """
    path = any_path(folder)
    if not _verify.is_sweep(path):
        return _verify.verify(path)
    return [
        dataclasses.replace(damage, file=f"{result.folder}/{damage.file}")
        for result in _verify.verify_sweep(path)
        for damage in result.damages
    ]


def replay(
    folder: PathLike,
    keys: int | str | Iterable[str | int] | None = None,
    *,
    root: PathLike | None = None,
    to: PathLike | None = None,
    dark_frames: PathLike | None = None,
) -> list[_replay.ReplayResult]:
    """Regenerate pairs from their manifest rows and sources, and compare them bit for bit.

    Parameters
    ----------
    folder : path-like
        Folder of the dataset, or a ``manifest.csv``.
    keys : int, str, or iterable of str and int, optional
        Source indices, ranges and keys: ``3``, ``"3,7-9"`` or ``[3, "7-9", "00000003-p0007"]``; all rows if omitted.
    root : path-like, optional
        Folder of the sources; by default the one that ``dataset.json`` records.
    to : path-like, optional
        Folder to write the arrays to, as ``KEY.clean.npy`` and ``KEY.noisy.npy``.
    dark_frames : path-like, optional
        Folder of the dark frames; by default the one that ``dataset.json`` records.

    Returns
    -------
    list of ReplayResult
        One for each pair; ``complaint`` is empty if the pair is identical.

    Raises
    ------
    ConfigError
        If a key does not exist, or the sources' folder is unknown.
    DamageError
        If the manifest cannot be read.
    MachineError
        If the self-test fails or the arrays cannot be written.

    Examples
    --------
    The dataset of the example of `generate`:

    >>> import unprocess_gen as ug
    >>> [(result.key, result.complaint) for result in ug.replay("ds", keys="0-1")]
    [('00000000', ''), ('00000001', '')]
    """
    manifest = any_path(folder)
    manifest = manifest / "manifest.csv" if manifest.is_dir() else manifest
    if keys is not None and not isinstance(keys, str):
        keys = str(keys) if isinstance(keys, int) else ",".join(map(str, keys))
    rows = select_rows(manifest, keys)
    given = (None if place is None else os.fspath(place) for place in (root, dark_frames))
    places = recorded_places(manifest.parent, *given)
    return list(_replay.replay(rows, places.root, None if to is None else Path(to), places.dark_frames))


def develop(raw: Frame, row: Mapping[str, Value] | Plan) -> NDArray[np.uint8]:
    """Render a raw frame as an sRGB photograph.

    Parameters
    ----------
    raw : ndarray of uint16 or float32
        Clean or noisy frame in the ``dtype`` and ``layout`` of the row: mosaic [H, W] or packed planes.
    row : mapping or Plan
        Manifest row or plan of the pair.

    Returns
    -------
    ndarray of uint8, [H, W, 3]
        Display-referred codes, R, G, B. Noise is kept; clipped light does not come back.

    Raises
    ------
    DamageError
        If the row is not the row of a pair.
    TypeError
        If ``row`` is neither a mapping nor a plan.
    ValueError
        If the frame has fewer than 2 x 2 sites, or another shape or dtype than the row states.

    Examples
    --------
    >>> import numpy as np
    >>> import unprocess_gen as ug
    >>> pair = ug.make_pair(np.full((64, 96, 3), 128, np.uint8), ug.load_config())
    >>> ug.develop(pair.noisy, pair.row).shape
    (64, 96, 3)
    """
    if not isinstance(row, (Mapping, Plan)):
        raise TypeError(f"row is {type(row).__name__}; expected a manifest row or a plan: develop(raw, row)")
    plan = row if isinstance(row, Plan) else plan_from_row(row_of_batch(row))
    recorded: Row = {
        "pattern": plan.sensor.pattern,
        "layout": plan.output.layout,
        "dtype": plan.output.dtype,
        "clean_dtype": plan.output.clean_dtype,
        "black_level_dn": plan.sensor.black_level_dn,
        "white_level_dn": plan.sensor.white_level_dn,
    }
    dimensions = 3 if plan.output.layout == PACKED else 2
    if np.ndim(raw) != dimensions:
        raise ValueError(f"raw has {np.ndim(raw)} dimensions, expected {dimensions} for layout={plan.output.layout}")
    expected = [np.dtype(name) for name in (plan.output.dtype, plan.output.clean_dtype) if name]
    if raw.dtype not in expected:
        raise ValueError(
            f"raw is {raw.dtype}; expected {' or '.join(map(str, expected))}, as the row states; convert light back "
            "with np.rint(light * (white - black) + black).clip(0, 2**bits - 1).astype(np.uint16)"
        )
    return isp.to_codes(isp.develop(mosaic_dn(raw, recorded), plan)).astype(np.uint8)


def array_pixels(srgb: ArrayLike, is_linear: bool = False) -> Srgb:
    """Convert an array to pixels in native byte order; ValueError for another dtype or shape, or no pixel."""
    pixels = np.asarray(srgb)
    if is_linear:
        try:
            return linear_pixels(pixels)
        except SourceError as error:
            raise ValueError(f"srgb {error.text}") from error
    if pixels.dtype.kind != "u" or pixels.dtype.itemsize > 2 or pixels.ndim != 3 or pixels.shape[2] != 3:
        advice = ", or source.kind=linear" if pixels.dtype.kind == "f" else ""
        raise ValueError(f"srgb is {pixels.dtype} {list(pixels.shape)}, expected uint8 or uint16 [H, W, 3]{advice}")
    if not pixels.size:
        raise ValueError(f"srgb is {list(pixels.shape)}, expected at least one pixel")
    return np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("="))


def array_settings(config: Config, seed: int | None = None) -> PairSettings:
    """Validate the settings of pairs of arrays; ConfigError if an array would have several pairs."""
    settings = PairSettings.read(_config_for_arrays(config, seed))
    for key, pairs in (("levels", len(noise_levels(config.noise))), ("draws", config.noise.draws)):
        if pairs > 1:
            advice = "call make_pair once for each level or seed, or generate a dataset"
            raise refusal(
                f"noise.{key}", getattr(config.noise, key), f"{pairs} pairs of an image; expected one; {advice}"
            )
    return settings


def plan_array(pixels: Srgb, settings: PairSettings, key: str | int | None) -> tuple[Source, PlannedImage]:
    """Plan the pair of an array; its identity is the digest of ``key``, or of the array itself."""
    config, source = settings.config, _array_source(pixels, key)
    recorded, _ = _recorded(pixels, config.source.downscale, config.output.layout)
    photograph = Photograph(recorded, 1)
    if config.source.kind == "linear":
        photograph = dataclasses.replace(linear_photograph(config.source, pixels), srgb=recorded)
    return source, plan_pixels(settings, photograph, source, source.sha256 or "")


def _array_source(pixels: Srgb, key: str | int | None) -> Source:
    """Describe an array as a source: its SHA-256 is that of ``key`` if it is one, else of dtype, shape and bytes."""
    if key is None:
        digest = hashlib.sha256(f"{pixels.dtype.name} {'x'.join(map(str, pixels.shape))}\n".encode())
        digest.update(np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("<")).data)
        sha256 = digest.hexdigest()
    elif len(text := str(key)) == 64 and set(text) <= set("0123456789abcdef"):
        sha256 = text
    else:
        sha256 = hashlib.sha256(text.encode()).hexdigest()
    return Source(0, ARRAY_NAME, ARRAY_NAME, pixels.nbytes, sha256=sha256)


def _config_for_arrays(config: Config, seed: int | None) -> Config:
    """Validated copy of a config without the keys that choose files; ConfigError for patches."""
    _check_complete(config)
    require_kind(config.source, "make_pair, as plan_image,", "srgb", "linear")
    if config.source.patch is not None:
        problem = (
            "make_pair returns complete frames; expected null; cut the arrays of the pair at even rows and columns"
        )
        raise refusal("source.patch", config.source.patch, problem)
    source = dataclasses.replace(config.source, root=None, list=None, limit=None, clips=False, include=("*",))
    config = dataclasses.replace(config, source=source, seed=config.seed if seed is None else seed)
    validate_config(config)
    return config


def _check_complete(config: Config) -> str:
    """Kind of the sources of a config.

    TypeError for another type, and ConfigError for ``Config()``, whose noise is in the option files.
    """
    if not isinstance(config, Config):
        raise TypeError(
            f"config={repr(config)[:60]}: is of type {type(config).__name__}; expected a Config; "
            "make it with unprocess_gen.load_config([…])"
        )
    if config.noise.units is None:
        raise ConfigError(
            "noise.units=null: Config() lacks the values of a noise profile; expected a complete config; "
            "make it with unprocess_gen.load_config(['camera=sony_a7r', 'noise=imx385_iso3200'])"
        )
    return config.source.kind


def _recorded(pixels: Srgb, downscale: int, layout: str) -> tuple[Srgb, tuple[Patch, ...]]:
    """Downscale an array, and list the one patch that its pair shows: all but an odd row or column of packed planes."""
    if min(pixels.shape[:2]) < downscale:
        problem = f"srgb is {list(pixels.shape)}; expected at least {downscale} x {downscale}"
        raise refusal("source.downscale", downscale, problem)
    recorded = pixels if downscale == 1 else downscaled(pixels, downscale)
    height, width = recorded.shape[:2]
    if layout == PACKED and min(height, width) < 2:
        raise ConfigError(f"output.layout=packed: srgb is {list(recorded.shape)}; expected at least 2 x 2 sites")
    return recorded, list_patches(None, 0, height, width, layout)
