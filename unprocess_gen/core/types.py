"""The frozen records that travel between rooms; what each field means is said once, here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Srgb = NDArray[np.uint8] | NDArray[np.uint16]
Raw = NDArray[np.uint16]
Normalised = NDArray[np.float32]
Frame = Raw | Normalised
"""What a dataset holds: DN, or their share of the way from black, 0, to white, 1; mosaic or packed planes."""
Float = NDArray[np.float64]


NO_CLIP = "none"
"""The clip of a photograph that is part of none."""


@dataclass(frozen=True, slots=True)
class Source:
    """One photograph, or one frame of a video, as the listing found it.

    ``name`` is the manifest's spelling (``/``-joined, percent-encoded where needed); ``path`` the file's path relative
    to the source folder as the operating system spells it (undecodable bytes as surrogate escapes), or the name of a
    synthetic scene. ``size_bytes`` is None where there is no file to read (``reason`` then says why), and 0
    for a scene. Files that share a size were hashed beforehand (``sha256``) and identical ones numbered
    (``occurrence``). Where folders are clips, ``clip`` is the folder's name as ``name`` spells it, ``frame`` the number
    of the frame in it, and ``clip_sha256`` with ``clip_occurrence`` stands for the whole clip: the digest of its first
    frame, and the number of clips before it that begin with the same; ``frames`` is how many frames it has. All frames
    of a video have its name, which is its clip's too, and its digest.
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

    @property
    def is_video(self) -> bool:
        """Whether it is a frame of a video file: no folder of photographs has the name of one of them."""
        return self.clip == self.name != NO_CLIP

    def stream_identity(self, sha256: str) -> tuple[str, int]:
        """Return the digest and the number that the streams are keyed by: the clip's, or those of the photograph."""
        if self.clip_sha256 is not None:
            return self.clip_sha256, self.clip_occurrence
        return sha256, self.occurrence


@dataclass(frozen=True, slots=True)
class Photograph:
    """Decoded pixels: ``srgb`` uint8 or uint16 ``[H, W, 3]`` in R, G, B order, upright (``orientation`` applied)."""

    srgb: Srgb
    orientation: int


@dataclass(frozen=True, slots=True)
class PatchRule:
    """Which patches are cut out of each image, squares of ``side`` pixels.

    ``kind`` is ``grid``, whose corners are ``stride`` pixels apart, or ``random``, ``count`` of them; the number that
    the other kind has is 0.
    """

    kind: str
    side: int
    stride: int = 0
    count: int = 0


@dataclass(frozen=True, slots=True)
class Patch:
    """A cut-out of a full frame: its number in the image, the row and column of its corner, its size in pixels.

    A whole image is patch 0 at row 0, column 0.
    """

    number: int
    y: int
    x: int
    height: int
    width: int

    @property
    def origin(self) -> tuple[int, int]:
        """Row and column of its corner in the full frame."""
        return self.y, self.x


@dataclass(frozen=True, slots=True)
class Facts:
    """What a plan may know of the pixels: whole numbers, the same on every machine.

    ``dark_code`` and ``bright_code`` are the lowest and the highest code (of ``codes`` possible ones) in any channel;
    ``frames`` is how many frames the clip has, 1 for a photograph.
    """

    width: int
    height: int
    codes: int
    dark_code: int
    bright_code: int
    frames: int = 1


@dataclass(frozen=True, slots=True)
class Physics:
    """What a physical profile and a scene say of one frame, on the sensor in use; 0 where there is no such number.

    ``dn_per_e``: the system gain K. ``prnu_std``: relative, of the
    pixels' responses. ``dark_e``: mean dark current of the exposure, electrons. ``hot_pixel_share``, ``hot_pixel_e``:
    share of pixels that are hot, and the mean of their exponentially distributed excess, electrons in the exposure.
    ``full_well_e``: electrons a pixel holds. ``read_law``: ``gaussian`` or ``tukey``, of shape ``read_shape``;
    ``read_std_dn``: its standard deviation, whatever the law. ``row_std_dn``, ``column_std_dn``: of a row's offset in a
    frame, of a column's in a body. ``black_error_dn``: offset of the mean black in the four sites of the 2x2 pattern,
    in reading order. ``dead_pixel_share``: share of pixels that read 0. ``body_key``: key of the fixed patterns of the
    camera body ``sensor_unit``.
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


READABLE, IN_FLOAT32 = "colour:numpy_float64", "colour:fused_float32"
"""The methods that tell the forms of a whole pair (`methods.FORMS`) apart."""

UINT16, FLOAT32 = "uint16", "float32"
"""What the numbers of a frame can be."""
MOSAIC, PACKED = "mosaic", "packed"
"""How the sites of a frame can lie: ``[H, W]``, or ``[4, H / 2, W / 2]`` (`bayer.pack`)."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Everything that decides a pair besides its pixels: what a manifest row holds, as numbers.

    Drawn once (`plan.plan_image`) or read back from a row (`manifest.plan_from_row`). ``downscale`` is the side of the
    squares of source pixels that were averaged, ``dequantize`` says whether 8-bit codes are dithered,
    ``exposure_ratio`` what the scene is darkened by. ``weights`` are those of the mixed cameras in the order of
    `colour.CAMERAS`; ``rgb2cam`` is row-major and its rows sum to 1; ``red_gain`` and ``blue_gain`` are forward gains,
    ``inverse_rgb_gain`` an inverse one; ``a_dn`` (DN) and ``b_dn2`` (DN²) are slope and intercept of the noise variance
    above black; ``stream_key`` is the key of the image's random streams. ``noise_law`` says whether a two-parameter
    profile's noise is ``gaussian`` or ``poisson``; ``saturated`` says what the noisy frame is where the clean one is
    saturated: ``noisy``, or ``pinned`` to white. ``physics`` is None for the two-parameter profiles, whose one effect
    is ``heteroscedastic``. ``accuracy`` names the budget, ``methods`` how each stage is computed (`methods`), and
    ``law_distance`` is how far from its law counted noise may be drawn. ``level``, ``draw`` and ``frame`` number the
    noise levels of one clean frame, the draws at one level, and the frames of a clip: each has values of its own in
    every stream. ``dtype`` and ``layout`` say what the numbers of both frames are and how their sites lie.
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

    @property
    def normalised(self) -> bool:
        """Whether frames are float32, 0 at black and 1 at white, and not rounded to DN."""
        return self.dtype == FLOAT32

    @property
    def readable(self) -> bool:
        """Whether the readable forms are asked for."""
        return READABLE in self.methods

    @property
    def in_float32(self) -> bool:
        """Whether the form in single precision is asked for."""
        return IN_FLOAT32 in self.methods

    @property
    def exposure(self) -> float:
        """What the light of the scene is multiplied by."""
        return 1 / self.exposure_ratio

    @property
    def counts_electrons(self) -> bool:
        """Whether the noise is made of counts of electrons, not of one normal a site."""
        return self.physics is not None or self.noise_law == "poisson"

    @property
    def averaged(self) -> bool:
        """Whether the clean frame shares the body's fixed patterns, as an average of many frames does."""
        return self.physics is not None and self.physics.fixed_pattern_in_clean

    @property
    def variance_line(self) -> tuple[float, float]:
        """Slope (DN) and intercept (DN²) of the variance above black, of the effects that are simulated."""
        if "heteroscedastic" in self.effects:
            return self.a_dn, self.b_dn2
        return self.a_dn if "shot" in self.effects else 0.0, self.b_dn2 if "read" in self.effects else 0.0

    @property
    def brightest_dn(self) -> float:
        """`brightest` in DN, unrounded."""
        return self.brightest * float(self.white_level_dn - self.black_level_dn) + float(self.black_level_dn)

    @property
    def brightest(self) -> float:
        """The light at which the clean frame saturates: white, or the full well where that is reached before."""
        if self.physics is None or "full_well" not in self.effects:
            return 1.0
        span_dn = self.white_level_dn - self.black_level_dn
        return min(1.0, self.physics.full_well_e * self.physics.dn_per_e / span_dn)

    @property
    def inverse_gains(self) -> tuple[float, float, float]:
        """What the red, green and blue channel are multiplied by (Brooks et al. 2019, random_gains())."""
        return (
            self.inverse_rgb_gain / self.red_gain,
            self.inverse_rgb_gain,
            self.inverse_rgb_gain / self.blue_gain,
        )


@dataclass(frozen=True, slots=True)
class Counts:
    """How many sites met a limit.

    ``clean_clipped_*``: the value before clipping lay below black or above white; ``noisy_clipped_*``: the value,
    rounded where frames are, lay outside what the sensor can say and was clipped; ``saturated``: sites of the clean
    frame at the white level; ``zero_variance``: sites where the noise law gives no variance (a fitted b below zero, or
    no noise at all).
    """

    clean_clipped_low: int
    clean_clipped_high: int
    noisy_clipped_low: int
    noisy_clipped_high: int
    saturated: int
    zero_variance: int


@dataclass(frozen=True, slots=True)
class Pair:
    """The clean and the noisy frame of one photograph, in the plan's dtype and layout, and what was clipped.

    uint16 mosaics ``[H, W]`` in DN, unless the plan says otherwise.
    """

    clean: Frame
    noisy: Frame
    counts: Counts


@dataclass(frozen=True, slots=True)
class Distribution:
    """How a parameter is drawn: a kind (`draws.LAWS` says what each does) and its numbers; ``constant`` has one."""

    kind: str
    numbers: tuple[float, ...]


DESCRIPTIONS = {UINT16: "<u2", FLOAT32: "<f4"}
"""The dtypes of frames as NumPy spells them in a file: little-endian."""


def gamma_text(gamma: float | str) -> str:
    """Return gamma as the manifest spells it: ``srgb``, or the shortest number (``1``, ``2.2``)."""
    if gamma == "srgb":
        return "srgb"
    number = float(gamma)
    return str(int(number)) if number.is_integer() else repr(number)


Value = str | int | float | None


Row = Mapping[str, Value]
