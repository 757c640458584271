"""Typed dataclasses of the configuration: one for each folder of ``conf/``, and `Config` for all of them.

OmegaConf checks keys and types against these dataclasses; `validation` checks ranges and combinations. The dataclasses
are not frozen, because Hydra cannot override frozen ones. No code changes a configuration once it has been validated.

A parameter that is drawn for every image is a number or a distribution, written as a list: ``[uniform, 1.9, 2.4]``. An
override replaces a list completely. A mapping would be merged with the default's mapping, into a mixture of both.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Optional

from unprocess_gen.core.types import MOSAIC, UINT16


@dataclass
class SourceConfig:
    """Select and prepare the source images.

    Attributes
    ----------
    root : str or None
        Folder or single picture; None selects the built-in synthetic scenes.
    include : list of str
        Glob patterns of images. Without a slash they match the base name; case does not matter.
    recursive : bool
        Whether to descend into folders.
    limit : int or None
        Number of sources to use, in the order of their names; None uses all.
    max_pixels : int
        Images with more pixels fail with reason ``too_large``.
    max_failed : int
        Number of failed sources above which a run exits with code 3.
    icc : str
        ``ignore`` colour profiles, or ``refuse`` images whose profile is not sRGB.
    clips : bool
        Whether folders, and files that match ``video``, are clips.
    video : list of str
        Glob patterns of video files; used with ``clips`` only.
    downscale : int
        Side of the block of pixels whose mean becomes one pixel.
    dequantize : str
        ``off`` or ``dither``; see `interpretation.dequantize_method`.
    patch : Any
        Patches to cut; see `interpretation.patch_rule`.
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
    """Choose the colour matrix of the camera.

    Attributes
    ----------
    name : str
        Name of the camera, recorded in each row.
    law : str
        One of `validation.CAMERA_LAWS`: how the matrix is chosen for an image.
    xyz2cam : list of float or None
        Nine numbers, row by row, from XYZ (D65) to the camera; for ``law=custom`` only.
    """

    name: str = "convex"
    law: str = "convex"
    xyz2cam: Optional[list[float]] = None


@dataclass
class GainsConfig:
    """Define white balance, brightening and the treatment of highlights.

    Attributes
    ----------
    red, blue : Any
        Forward white-balance gains: numbers or distributions.
    inverse_rgb : Any
        Inverse of the brightening gain: a number or a distribution. The image is multiplied by it.
    highlight : str
        ``per_channel`` (the article), ``gray_mean`` (the code of Brooks et al.) or ``none``.
    threshold : float
        Linear signal above which highlights are preserved, at least 0 and below 1.
    """

    red: Any = None
    blue: Any = None
    inverse_rgb: Any = None
    highlight: str = "per_channel"
    threshold: float = 0.9


@dataclass
class IspConfig:
    """Define the curves that the camera applied after the colour matrix.

    Attributes
    ----------
    tone : str
        ``smoothstep`` or ``none``.
    gamma : Any
        Exponent from 0.1 to 10, or ``srgb`` for the piecewise curve of IEC 61966-2-1.
    """

    tone: str = "smoothstep"
    gamma: Any = 2.2


@dataclass
class SensorConfig:
    """Define the digital output of the sensor.

    Attributes
    ----------
    bits : int
        Bits per sample, 1 to 16.
    black_level_dn, white_level_dn : int
        Levels without light and at saturation, DN.
    pattern : str
        CFA pattern: RGGB, BGGR, GRBG or GBRG.
    clip : str
        Lowest value of noisy frames: ``sensor`` (0 DN), ``black`` (the black level) or ``none`` (no clipping).
    saturated : str
        Noisy value at sites where the clean frame is saturated: ``noisy`` or ``pinned`` (white level).
    dark_offset : str
        Mean of the dark current: ``removed`` or ``kept``.
    units : Any
        ``image``: a new camera body for every image; an integer: number of bodies to draw from.
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
    """Hold the numbers of a physical noise profile that depend on ISO, for one range of ISO.

    A number may be written as a form, ``[form, number, …]``; see `planning.noise_profile.FORMS`.

    Attributes
    ----------
    iso : list of float
        Lowest and highest ISO of the range.
    dn_per_e : Any
        System gain K, DN per electron.
    read_law : str
        Distribution of the read noise: ``gaussian`` or ``tukey`` (Tukey-λ).
    read_shape : Any
        Shape λ of the Tukey-λ distribution, or a choice of shapes.
    read_std_dn, row_std_dn, column_std_dn : Any
        Standard deviations of read, row and column noise, DN of the profile.
    black_error_dn : Any
        Error of the black level: one number, four (the sites of the CFA pattern), or a table; DN of the profile.
    """

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
    """Define the noise: two numbers (variance a·x + b), or a physical profile with ``branches`` by ISO.

    Attributes
    ----------
    name : str
        Name of the profile, recorded in each row.
    units : str or None
        ``dn`` or ``normalized`` (0 at black, 1 at white).
    black : str or None
        Whether x has the black level ``subtracted`` or ``included``.
    bits, black_level_dn, white_level_dn : int or None
        Levels at which a profile in DN was calibrated.
    a, b : Any
        Slope and offset of the variance: numbers or distributions.
    negative_variance : str
        ``refuse`` profiles whose variance is negative at black, or ``clip`` it at 0.
    law : str
        Distribution of the noise of a profile with two numbers: ``gaussian`` or ``poisson``.
    iso : Any
        ISO at which to use a physical profile: a number or a distribution; None takes the ISO of the scene.
    levels : Any
        Noise levels for each clean frame: how many to draw, a list of ISOs, or a list of ``{a, b}``.
    draws : int
        Noisy frames at each level.
    branches : list of BranchConfig
        Numbers of a physical profile that depend on ISO; empty for a profile with two numbers.
    prnu_std : float or None
        Standard deviation of the photo response non-uniformity; the mean is 1.
    dark_e_per_s : float or None
        Mean dark current, electrons per second, at ``dark_reference_c``.
    dark_reference_c, dark_doubling_c : float
        Temperature of ``dark_e_per_s``, and the rise that doubles it, degrees Celsius.
    hot_pixel_share : float or None
        Fraction of hot pixels, 0 to 1.
    hot_pixel_e_per_s : float or None
        Mean of the exponentially distributed current of hot pixels, electrons per second, at ``dark_reference_c``.
    dead_pixel_share : float or None
        Fraction of dead pixels, 0 to 1.
    full_well_e : float or None
        Saturation capacity, electrons.
    assumed : list of str
        Keys whose numbers no source gives. Their effects are simulated only if switched on by name.
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
    """Describe the exposure of a scene; each value is a number or a distribution.

    Attributes
    ----------
    name : str
        Name of the scene, recorded in each row.
    iso : Any
        ISO of a physical noise profile.
    exposure_s : Any
        Exposure time, seconds.
    temperature_c : Any
        Temperature of the sensor, degrees Celsius.
    exposure_ratio : Any
        Divisor of the light in the photograph; 100 leaves a hundredth.
    """

    name: str = "daylight"
    iso: Any = 100
    exposure_s: Any = 0.001
    temperature_c: Any = 25
    exposure_ratio: Any = 1


@dataclass
class EffectsConfig:
    """Choose the sensor effects to simulate: ``auto``, ``on`` or ``off``.

    The switch of a named effect takes precedence over ``all``; None uses ``all``. ``tolerance`` limits what ``auto``
    omits, as a ratio to the masking noise (see `planning.effect_selection`).
    """

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
    """Choose what clean frames contain.

    ``includes_fixed_pattern``: whether they contain the fixed-pattern noise of the camera body.
    """

    includes_fixed_pattern: bool = False


@dataclass
class AccuracyConfig:
    """Limit the errors accepted for speed; the attributes are those of `accuracy.Budget`."""

    name: str = "exact"
    readable: bool = False
    clean_dn: float = 0.0
    clean_changed_share: float = 0.0
    normal_error: float = 1e-6
    law_distance: float = 0.0


@dataclass
class OutputConfig:
    """Define the format of the dataset.

    Attributes
    ----------
    dtype : str
        ``uint16`` (DN) or ``float32`` (0 at black, 1 at white, not rounded).
    layout : str
        ``mosaic``, [H, W], or ``packed``, [4, H/2, W/2].
    pairs_per_shard : int
        Sources per shard.
    """

    dtype: str = UINT16
    layout: str = MOSAIC
    pairs_per_shard: int = 8


@dataclass
class Config:
    """Hold the complete configuration of a run; the keys of `serialization.NOT_DATA` do not decide the data."""

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
