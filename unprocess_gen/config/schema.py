"""The settings: one dataclass for each folder of ``conf/``, their checks, and the ``config.yaml`` of a dataset.

Everything a user can get wrong is refused here, before the first image, in one sentence that names the key, the value
and what is allowed. Types and unknown keys are checked by OmegaConf against these dataclasses; ranges, and what must
fit together, by `check`. The classes are ordinary ones, because Hydra cannot override frozen ones; nothing changes them
after the door.

A parameter that is drawn for every image is written as a number, or as a law: ``[uniform, 1.9, 2.4]``. A list, because
an override then replaces the whole law; a mapping would be merged into a mixture of two.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Optional

from unprocess_gen.core.types import MOSAIC, UINT16


@dataclass
class SourceConfig:
    """Where the photographs come from; ``root`` null stands for the built-in scenes.

    ``clips``: folders are clips, and so are the files that ``video``'s globs match, which else nothing looks at.
    """

    root: Optional[str] = None
    include: list[str] = field(default_factory=list)
    recursive: bool = True
    limit: Optional[int] = None
    max_pixels: int = 2**26
    max_failed: int = 0
    icc: str = "ignore"
    clips: bool = False
    video: list[str] = field(default_factory=list)
    downscale: int = 1
    dequantize: str = "off"
    patch: Any = None


@dataclass
class CameraConfig:
    """Which camera saw the scene: ``law`` is one of `CAMERA_LAWS`; ``xyz2cam`` row by row, for ``custom`` alone."""

    name: str = "convex"
    law: str = "convex"
    xyz2cam: Optional[list[float]] = None


@dataclass
class GainsConfig:
    """Forward gains of red and blue, the inverse brightening gain (numbers or laws), and what highlights do."""

    red: Any = None
    blue: Any = None
    inverse_rgb: Any = None
    highlight: str = "per_channel"
    threshold: float = 0.9


@dataclass
class IspConfig:
    """The tone curve and gamma (a power, or srgb) that the camera's processing applied after the matrix."""

    tone: str = "smoothstep"
    gamma: Any = 2.2


@dataclass
class SensorConfig:
    """Bits, levels (DN), Bayer pattern, how noisy frames are clipped and saturated, and which camera bodies there are.

    ``units``: ``image``, a body of its own for every image, or a number of bodies to draw from.
    """

    bits: int = 12
    black_level_dn: int = 240
    white_level_dn: int = 4095
    pattern: str = "RGGB"
    clip: str = "sensor"
    saturated: str = "noisy"
    dark_offset: str = "removed"
    units: Any = "image"


@dataclass
class BranchConfig:
    """What a physical profile says in one range of ISO; see `FORMS` for what stands where a number depends on ISO."""

    iso: list[float] = field(default_factory=list)
    dn_per_e: Any = None
    read_law: str = "gaussian"
    read_shape: Any = 0.0
    read_std_dn: Any = None
    row_std_dn: Any = None
    column_std_dn: Any = None
    black_error_dn: Any = None


@dataclass
class NoiseConfig:
    """A noise profile, in ``units``, with the levels (DN) it was calibrated at.

    ``levels``: several noise levels of one clean frame, a list of ISOs or of ``{a, b}``, or how many to draw;
    ``draws``: how many noisy frames at each.

    Either variance a·x + b (numbers or laws), or a physical one: ``branches`` by ISO, and what does not depend on it.
    ``assumed`` names the numbers that no source gives; they stay off unless their effect is switched on by name.
    """

    name: str = "none"
    units: Optional[str] = None
    black: Optional[str] = None
    bits: Optional[int] = None
    black_level_dn: Optional[int] = None
    white_level_dn: Optional[int] = None
    a: Any = None
    b: Any = None
    negative_variance: str = "refuse"
    law: str = "gaussian"
    iso: Any = None
    levels: Any = None
    draws: int = 1
    branches: list[BranchConfig] = field(default_factory=list)
    prnu_std: Optional[float] = None
    dark_e_per_s: Optional[float] = None
    dark_reference_c: float = 25.0
    dark_doubling_c: float = 7.0
    hot_pixel_share: Optional[float] = None
    hot_pixel_e_per_s: Optional[float] = None
    dead_pixel_share: Optional[float] = None
    full_well_e: Optional[float] = None
    assumed: list[str] = field(default_factory=list)


@dataclass
class SceneConfig:
    """What a physical profile needs to know of the scene: numbers or laws; exposure_ratio darkens it."""

    name: str = "daylight"
    iso: Any = 100
    exposure_s: Any = 0.001
    temperature_c: Any = 25
    exposure_ratio: Any = 1


@dataclass
class EffectsConfig:
    """Which effects are simulated: auto, on or off; a named one wins over ``all``."""

    all: str = "auto"
    tolerance: float = 0.1
    heteroscedastic: Optional[str] = None
    prnu: Optional[str] = None
    shot: Optional[str] = None
    dark_current: Optional[str] = None
    hot_pixels: Optional[str] = None
    full_well: Optional[str] = None
    read: Optional[str] = None
    row: Optional[str] = None
    column: Optional[str] = None
    black_error: Optional[str] = None
    dead_pixels: Optional[str] = None
    quantise: Optional[str] = None


@dataclass
class CleanConfig:
    """What the clean frame shares with the noisy one beyond the rule."""

    includes_fixed_pattern: bool = False


@dataclass
class AccuracyConfig:
    """What may be given up for speed: the numbers of `methods.Budget`."""

    name: str = "exact"
    readable: bool = False
    clean_dn: float = 0.0
    clean_changed_share: float = 0.0
    normal_error: float = 1e-6
    law_distance: float = 0.0


@dataclass
class OutputConfig:
    """What the dataset is written as: what its numbers are, how the sites of a frame lie, how large shards are."""

    dtype: str = UINT16
    layout: str = MOSAIC
    pairs_per_shard: int = 8


@dataclass
class Config:
    """All settings of a run; those in `NOT_DATA` do not decide the data."""

    source: SourceConfig = field(default_factory=SourceConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    gains: GainsConfig = field(default_factory=GainsConfig)
    isp: IspConfig = field(default_factory=IspConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    scene: SceneConfig = field(default_factory=SceneConfig)
    effects: EffectsConfig = field(default_factory=EffectsConfig)
    clean: CleanConfig = field(default_factory=CleanConfig)
    accuracy: AccuracyConfig = field(default_factory=AccuracyConfig)
    output: OutputConfig = field(default_factory=OutputConfig)
    seed: int = 0
    out: str = "ds"
    n_jobs: int = -1
    self_test: str = "stop"
    check_disk: bool = True
