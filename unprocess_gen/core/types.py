"""Define the immutable records that packages exchange: sources, plans, pairs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Srgb = NDArray[np.uint8] | NDArray[np.uint16]
Raw = NDArray[np.uint16]
Normalised = NDArray[np.float32]
Frame = Raw | Normalised
"""Frame of a dataset: DN (uint16), or normalised to 0 at black and 1 at white (float32); mosaic or packed planes."""
Float = NDArray[np.float64]


NO_CLIP = "none"
"""Clip name of a photograph that does not belong to a clip."""


@dataclass(frozen=True, slots=True)
class Source:
    """Photograph, or frame of a clip, as listed.

    Attributes
    ----------
    index : int
        Place in the listing, from 0.
    name : str
        Path below ``source.root`` as in the manifest: joined by ``/``, percent-encoded if necessary. All frames of a
        video have the name of the video.
    path : str
        Path below ``source.root`` as the operating system spells it (undecodable bytes as surrogate escapes), or the
        name of a synthetic scene.
    size_bytes : int or None
        Size of the file; 0 for a scene, None if there is no readable file.
    reason : str or None
        Reason why the source cannot be used, one of `errors.REASONS`.
    occurrence : int
        Number of identical files before this one.
    sha256 : str or None
        SHA-256 of the file if the listing hashed it, which it does for files that share a size.
    clip : str
        Name of the clip (its folder or video), or `NO_CLIP`.
    frame : int
        Number of the frame in its clip, from 0.
    clip_sha256 : str or None
        SHA-256 of the clip's first frame or of the video, or None without a clip.
    clip_occurrence : int
        Number of clips before this one with the same ``clip_sha256``.
    frames : int
        Number of frames in the clip; 1 for a photograph.
    etag : str or None
        ETag of the object in an object store, which identifies its content; None for files and scenes.
    """

    index: int
    name: str
    path: str
    size_bytes: int | None
    reason: str | None = None
    occurrence: int = 0
    sha256: str | None = None
    clip: str = NO_CLIP
    frame: int = 0
    clip_sha256: str | None = None
    clip_occurrence: int = 0
    frames: int = 1
    etag: str | None = None

    @property
    def is_video(self) -> bool:
        """True for a frame of a video file: only there the clip has the name of the source."""
        return self.clip == self.name != NO_CLIP

    def stream_identity(self, sha256: str) -> tuple[str, int]:
        """Return the digest and occurrence number that key the random streams.

        Parameters
        ----------
        sha256 : str
            SHA-256 of the source's file.

        Returns
        -------
        (str, int)
            Digest and occurrence of the clip if there is one, else of the file.
        """
        if self.clip_sha256 is not None:
            return self.clip_sha256, self.clip_occurrence
        return sha256, self.occurrence


@dataclass(frozen=True, slots=True)
class Photograph:
    """Decoded pixels: ``srgb`` (uint8 or uint16 [H, W, 3], R, G, B), after applying the EXIF ``orientation``."""

    srgb: Srgb
    orientation: int


@dataclass(frozen=True, slots=True)
class PatchRule:
    """Rule for cutting square patches of ``side`` pixels from each image.

    ``kind`` is ``grid`` (corners every ``stride`` pixels) or ``random`` (``count`` patches); the other number is 0.
    """

    kind: str
    side: int
    stride: int = 0
    count: int = 0


@dataclass(frozen=True, slots=True)
class Patch:
    """Rectangle of a full frame: number in the image, row and column of its first pixel, size in pixels.

    An uncut image is patch 0 at row 0, column 0.
    """

    number: int
    y: int
    x: int
    height: int
    width: int

    @property
    def origin(self) -> tuple[int, int]:
        """Row and column of the first pixel in the full frame."""
        return self.y, self.x


class DarkPixels(Protocol):
    """Give access to the pixels of dark frames."""

    def frame(self, sha256: str) -> Raw:
        """Return the mosaic of the dark frame whose file has this SHA-256, [H, W] with even sides."""

    def shading(self, sha256: str) -> NDArray[np.float32]:
        """Return the dark-shading map with this SHA-256, [H, W] with the sides of the dark frames."""


@dataclass(frozen=True, slots=True)
class DarkFrame:
    """Dark frame of a camera: SHA-256 of its file, and even height and width in pixels."""

    sha256: str
    height: int
    width: int


@dataclass(frozen=True, slots=True)
class DarkShading:
    """Dark-shading map that is subtracted from dark frames.

    Attributes
    ----------
    sha256 : str
        SHA-256 of its file, or of the set of dark frames whose mean it is.
    black_dn : float
        Value that is subtracted too, DN of the frames: their black level for a map above black, else 0.
    file : str
        Name of its file; empty for the mean of the frames.
    residual_dn : float
        Median of the frames after the subtraction, DN of the frames.
    """

    sha256: str
    black_dn: float = 0.0
    file: str = ""
    residual_dn: float = 0.0


@dataclass(frozen=True, slots=True)
class DarkFrames:
    """Dark frames from which a run samples noise.

    Attributes
    ----------
    frames : tuple of DarkFrame
        The frames, in the order of their SHA-256.
    sha256 : str
        SHA-256 of the list of all their SHA-256, which identifies the set.
    black_dn : float
        Black level of the frames, DN of the frames.
    scale : float
        DN of the sensor per DN of the frames.
    variance_dn2 : float
        Variance of their noise with dither, DN² of the sensor.
    shading : DarkShading or None
        Map that is subtracted at each site; None to subtract the black level alone.
    """

    frames: tuple[DarkFrame, ...]
    sha256: str
    black_dn: float
    scale: float
    variance_dn2: float
    shading: DarkShading | None = None


@dataclass(frozen=True, slots=True)
class Facts:
    """Facts about an image's pixels that a plan may depend on: integers, identical on every machine.

    ``dark_code`` and ``bright_code`` are the lowest and highest code in any channel, of ``codes`` possible codes.
    ``frames`` is the number of frames in the clip, 1 for a photograph.
    """

    width: int
    height: int
    codes: int
    dark_code: int
    bright_code: int
    frames: int = 1


@dataclass(frozen=True, slots=True)
class Physics:
    """Numbers of a physical noise profile for one scene and sensor; 0 if the profile does not have the number.

    Attributes
    ----------
    iso, exposure_s, temperature_c : float
        The scene: ISO, exposure time (s) and sensor temperature (°C).
    dn_per_e : float
        System gain K, DN per electron.
    prnu_std : float
        Standard deviation of the pixels' relative gain.
    dark_e : float
        Mean dark signal of the exposure, electrons.
    dark_offset : str
        ``"removed"`` if the camera subtracts the mean dark signal, else ``"kept"``.
    hot_pixel_share, hot_pixel_e : float
        Fraction of hot pixels, and the mean of their exponentially distributed excess, electrons per exposure.
    full_well_e : float
        Saturation capacity, electrons.
    read_law : str
        Distribution of the read noise: ``"gaussian"``, or Tukey's lambda with shape ``read_shape``, as
        ``"tukey_lambda"``, or as ``"tukey"`` (version 0.1; `lookup_tables.quantile_table`).
    read_std_dn : float
        Standard deviation of the read noise, DN.
    row_std_dn, column_std_dn : float
        Standard deviations of a row's offset per frame and of a column's offset per body, DN.
    black_error_dn : tuple of four floats
        Black-level errors of the sites (0, 0), (0, 1), (1, 0), (1, 1) of the 2x2 tile, DN.
    dead_pixel_share : float
        Fraction of pixels that read 0.
    sensor_unit : str
        Name of the camera body.
    body_key : int
        Key of the body's fixed patterns (`random_streams.body_key`).
    fixed_pattern_in_clean : bool
        Whether the clean frame contains the fixed patterns too.
    row_correlation : float
        Correlation of the offsets of neighbouring rows, between -1 and 1.
    column_temporal_std_dn : float
        Standard deviation of a column's offset that is new in every frame, DN.
    gain_by_colour : tuple of three floats
        System gain of red, green and blue, relative to ``dn_per_e``.
    lens_shading : tuple of three floats
        Coefficients of r², r⁴ and r⁶ in the relative illumination; r is 1 in the corners.
    frame_size : (int, int)
        Height and width of the full frame if its lens shading is known, else 0; pixels.
    """

    iso: float
    exposure_s: float
    temperature_c: float
    dn_per_e: float
    prnu_std: float
    dark_e: float
    dark_offset: str
    hot_pixel_share: float
    hot_pixel_e: float
    full_well_e: float
    read_law: str
    read_shape: float
    read_std_dn: float
    row_std_dn: float
    column_std_dn: float
    black_error_dn: tuple[float, float, float, float]
    dead_pixel_share: float
    sensor_unit: str
    body_key: int
    fixed_pattern_in_clean: bool
    row_correlation: float = 0.0
    column_temporal_std_dn: float = 0.0
    gain_by_colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    lens_shading: tuple[float, float, float] = (0.0, 0.0, 0.0)
    frame_size: tuple[int, int] = (0, 0)


REFERENCE_METHOD, FLOAT32_METHOD = "colour:numpy_float64", "colour:fused_float32"
"""Methods that select the NumPy reference and the float32 kernels; plans without them use the float64 kernels."""

UINT16, FLOAT32 = "uint16", "float32"
"""Dtypes of frames."""
MOSAIC, PACKED = "mosaic", "packed"
"""Layouts of frames: ``[H, W]``, or ``[4, H / 2, W / 2]`` (`cfa.pack`)."""


def inverse_gains(red_gain: float, blue_gain: float, inverse_rgb_gain: float) -> tuple[float, float, float]:
    """Return the factors of the red, green and blue channels (Brooks et al. 2019, random_gains()).

    Parameters
    ----------
    red_gain, blue_gain, inverse_rgb_gain : float
        White-balance gains, and inverse of the brightness gain.

    Returns
    -------
    tuple of float
        Factors of the linear channels.
    """
    return inverse_rgb_gain / red_gain, inverse_rgb_gain, inverse_rgb_gain / blue_gain


@dataclass(frozen=True, slots=True)
class Plan:
    """All parameters of a pair; with the pixels it determines the pair completely.

    A plan is drawn once (`unprocess_gen.plan_image`) or read from a manifest row.

    Attributes
    ----------
    seed : int
        Seed of the dataset.
    stream_key : int
        Key of the image's random streams (`random_streams.stream_key`).
    downscale : int
        Side of the squares of source pixels that were averaged.
    dequantize : str
        ``"off"``, or how 8-bit codes are dithered.
    scene : str
        Name of the scene.
    exposure_ratio : float
        Factor by which the scene is darkened.
    camera : str
        Name of the camera option.
    weights : tuple of four floats
        Weights of the mixed cameras, in the order of `colour.CAMERAS`.
    rgb2cam : tuple of nine floats
        Matrix from linear sRGB to camera RGB, row by row; each row sums to 1.
    red_gain, blue_gain, inverse_rgb_gain : float
        White-balance gains of red and blue, and inverse of the brightness gain.
    tone, gamma : str, float or str
        Tone curve and gamma that were inverted (`tone_curves.linear_table`).
    highlight, highlight_threshold : str, float
        Method for highlights (`unprocess.HIGHLIGHTS`), and the intensity from which it acts, in [0, 1).
    pattern : str
        CFA pattern, one of `cfa.PATTERNS`.
    bits, black_level_dn, white_level_dn : int
        Bit depth of the sensor, and its levels in DN.
    sensor_clip : str
        Clipping of the noisy frame (`sensor.noisy_limits`).
    saturated : str
        Noisy value at sites where the clean frame is saturated: ``"noisy"``, or ``"pinned"`` to white.
    noise, noise_law : str
        Name of the noise profile, and for two-parameter profiles its distribution: ``"gaussian"`` or ``"poisson"``.
    a_dn, b_dn2 : float
        Slope (DN) and intercept (DN²) of the noise variance above black.
    effects, skipped : tuple of str
        Simulated effects, and the omitted ones with their reasons.
    accuracy, methods, law_distance : str, tuple of str, float
        Name of the budget, method of each stage, and largest accepted CDF difference of shot plus read noise.
    physics : Physics or None
        Numbers of a physical profile. None for two-parameter profiles, whose one effect is ``heteroscedastic``.
    level, draw, frame : int
        Numbers of the noise level, of the draw at this level, and of the frame in its clip. Each selects other random
        values.
    dtype, layout : str
        Dtype and layout of both frames.
    clean_dtype : str
        Dtype of the clean frame if it differs from ``dtype``; empty if it does not.
    assumed : tuple of str
        Assumed numbers of the noise profile that the simulated effects use; empty with ``effects.assumed=off``.
    dark_frame : str
        SHA-256 of the dark frame whose noise replaces that of the read-out; empty without one.
    dark_shift : (int, int)
        Even row and column of the dark frame at row 0, column 0 of the full frame.
    dark_black_dn, dark_scale : float
        Value that is subtracted from the dark frame, DN of the dark frame, and DN of the sensor per DN of it.
    dark_shading : str
        SHA-256 of the dark-shading map that is subtracted too: of its file, or of the set of dark frames whose mean it
        is. Empty without a map.
    """

    seed: int
    stream_key: int
    downscale: int
    dequantize: str
    scene: str
    exposure_ratio: float
    camera: str
    weights: tuple[float, float, float, float]
    rgb2cam: tuple[float, float, float, float, float, float, float, float, float]
    red_gain: float
    blue_gain: float
    inverse_rgb_gain: float
    tone: str
    gamma: float | str
    highlight: str
    highlight_threshold: float
    pattern: str
    bits: int
    black_level_dn: int
    white_level_dn: int
    sensor_clip: str
    saturated: str
    noise: str
    noise_law: str
    a_dn: float
    b_dn2: float
    effects: tuple[str, ...]
    skipped: tuple[str, ...]
    accuracy: str
    methods: tuple[str, ...]
    law_distance: float = 0.0
    physics: Physics | None = None
    level: int = 0
    draw: int = 0
    frame: int = 0
    dtype: str = UINT16
    layout: str = MOSAIC
    assumed: tuple[str, ...] = ()
    clean_dtype: str = ""
    dark_frame: str = ""
    dark_shift: tuple[int, int] = (0, 0)
    dark_black_dn: float = 0.0
    dark_scale: float = 1.0
    dark_shading: str = ""

    @property
    def normalised(self) -> bool:
        """True if noisy frames are float32, 0 at black and 1 at white, without rounding to DN."""
        return self.dtype == FLOAT32

    @property
    def clean_normalised(self) -> bool:
        """True if the clean frame is float32, 0 at black and 1 at white, without rounding to DN."""
        return (self.clean_dtype or self.dtype) == FLOAT32

    @property
    def uses_reference(self) -> bool:
        """True if the NumPy reference is selected."""
        return REFERENCE_METHOD in self.methods

    @property
    def uses_float32(self) -> bool:
        """True if the float32 kernels are selected."""
        return FLOAT32_METHOD in self.methods

    @property
    def exposure(self) -> float:
        """Factor applied to the light of the scene."""
        return 1 / self.exposure_ratio

    @property
    def counts_electrons(self) -> bool:
        """True if the noise contains Poisson counts, not only one normal deviate per site."""
        return self.physics is not None or (self.noise_law == "poisson" and self.variance_line[0] > 0)

    @property
    def averaged(self) -> bool:
        """True if the clean frame contains the fixed patterns, like the average of many frames."""
        return self.physics is not None and self.physics.fixed_pattern_in_clean

    @property
    def variance_line(self) -> tuple[float, float]:
        """Slope (DN) and intercept (DN²) of the noise variance above black, for the simulated effects."""
        if "heteroscedastic" in self.effects:
            return self.a_dn, self.b_dn2
        has_read_noise = "read" in self.effects or "dark_frame" in self.effects
        return self.a_dn if "shot" in self.effects else 0.0, self.b_dn2 if has_read_noise else 0.0

    @property
    def brightest_dn(self) -> float:
        """Value of `brightest` in DN, unrounded."""
        return self.brightest * float(self.white_level_dn - self.black_level_dn) + float(self.black_level_dn)

    @property
    def brightest(self) -> float:
        """Light at which the clean frame saturates: 1 (white), or less if the full well is reached below white."""
        if self.physics is None or "full_well" not in self.effects:
            return 1.0
        span_dn = self.white_level_dn - self.black_level_dn
        return min(1.0, self.physics.full_well_e * self.physics.dn_per_e / span_dn)

    @property
    def inverse_gains(self) -> tuple[float, float, float]:
        """Factors of the red, green and blue channels (Brooks et al. 2019, random_gains())."""
        return inverse_gains(self.red_gain, self.blue_gain, self.inverse_rgb_gain)


@dataclass(frozen=True, slots=True)
class Counts:
    """Numbers of sites at a limit.

    Attributes
    ----------
    clean_clipped_low, clean_clipped_high : int
        Clean values below black and above white, before clipping.
    noisy_clipped_low, noisy_clipped_high : int
        Noisy values outside the sensor's range, after rounding (without rounding for float32 frames).
    saturated : int
        Sites of the clean frame at the white level.
    zero_variance : int
        Sites whose noise variance is 0, because a fitted b is negative or no noise is simulated.
    """

    clean_clipped_low: int
    clean_clipped_high: int
    noisy_clipped_low: int
    noisy_clipped_high: int
    saturated: int
    zero_variance: int


@dataclass(frozen=True, slots=True)
class Pair:
    """Clean and noisy frame of one image, and counts of clipped sites.

    Frames are uint16 mosaics [H, W] in DN, unless the plan has another dtype or layout.
    """

    clean: Frame
    noisy: Frame
    counts: Counts


@dataclass(frozen=True, slots=True)
class Distribution:
    """Distribution of a parameter: a kind of `config.distributions` and its numbers; ``constant`` has one number."""

    kind: str
    numbers: tuple[float, ...]


DESCRIPTIONS = {UINT16: "<u2", FLOAT32: "<f4"}
"""NumPy descriptions of the dtypes in files: little-endian."""


def gamma_text(gamma: float | str) -> str:
    """Return the text of a gamma in the manifest.

    Parameters
    ----------
    gamma : float or str
        Exponent, or ``"srgb"``.

    Returns
    -------
    str
        ``"srgb"``, or the shortest decimal number, such as ``"1"`` or ``"2.2"``.
    """
    if gamma == "srgb":
        return "srgb"
    number = float(gamma)
    return str(int(number)) if number.is_integer() else repr(number)


Value = str | int | float | None


Row = Mapping[str, Value]
