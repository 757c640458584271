"""Define the immutable records that packages exchange: sources, plans, pairs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.random_streams import frame_word

if TYPE_CHECKING:
    from unprocess_gen.simulation.effects import Physics

Srgb = NDArray[np.uint8] | NDArray[np.uint16]
Raw = NDArray[np.uint16]
Normalised = NDArray[np.float32]
Frame = Raw | Normalised
"""Frame of a dataset: DN (uint16), or normalised to 0 at black and 1 at white (float32); mosaic or packed planes."""
Array = Frame | Srgb
"""Frame or target of a pair."""
Float = NDArray[np.float64]


NO_CLIP = ""
"""Clip name of a photograph that does not belong to a clip."""


@dataclass(frozen=True, slots=True)
class Source:
    """Photograph, or frame of a clip, as listed.

    Attributes
    ----------
    index : int
        Place in the listing, from 0.
    name : str
        Path below ``source.root`` as in the manifest: joined by ``/``, percent-encoded if necessary.
    path : str
        Path below ``source.root`` as the operating system spells it (undecodable bytes as surrogate escapes), or the
        name of a synthetic picture.
    size_bytes : int or None
        Size of the file; 0 for a scene, None if there is no readable file.
    reason : str or None
        Reason why the source cannot be used, one of `errors.REASONS`.
    occurrence : int
        Number of identical files before this one.
    sha256 : str or None
        SHA-256 of the file if the listing hashed it, which it does for files that share a size.
    clip : str
        Name of the clip (its folder), or `NO_CLIP`.
    frame : int
        Number of the frame in its clip, from 0.
    clip_sha256 : str or None
        SHA-256 of the clip's first frame, or None without a clip.
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
    """Decoded pixels: ``srgb`` (uint8 or uint16 [H, W, 3], R, G, B), after applying the EXIF ``orientation``.

    Of a raw source, ``srgb`` has the codes of its camera RGB, and ``raw`` what the file states. ``note`` is a
    warning about the file.
    """

    srgb: Srgb
    orientation: int
    raw: RawParts | None = None
    note: str = ""


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


@dataclass(frozen=True, slots=True)
class DarkFrame:
    """Dark frame of a camera: SHA-256 of its file, and even height and width in pixels."""

    sha256: str
    height: int
    width: int


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
    """

    frames: tuple[DarkFrame, ...]
    sha256: str
    black_dn: float
    scale: float
    variance_dn2: float


@dataclass(frozen=True, slots=True)
class Facts:
    """Facts about an image's pixels that a plan may depend on: integers, identical on every machine.

    ``dark_code`` and ``bright_code`` are the lowest and highest code in any channel, of ``codes`` possible codes.
    ``frames`` is the number of frames in the clip, 1 for a photograph. ``raw`` is what the file of a raw source states.
    """

    width: int
    height: int
    codes: int
    dark_code: int
    bright_code: int
    frames: int = 1
    raw: RawParts | None = None


TIERS = REFERENCE, EXACT, FAST = "reference", "exact", "fast"
"""Accuracy tiers: the NumPy reference, kernels with the same DN, and kernels in float32 where the noise allows it."""

UINT16, FLOAT32 = "uint16", "float32"
"""Dtypes of frames."""
UINT8 = "uint8"
"""Dtype of most photographs."""
MOSAIC, PACKED = "mosaic", "packed"
"""Layouts of frames: ``[H, W]``, or ``[4, H / 2, W / 2]`` (`cfa.pack`)."""


Levels = tuple[float, ...]
"""A level in DN for each packed plane: R, G of the red rows, G of the blue rows, B."""

CODE_RANGE = 65535.0
"""Largest code of a raw source."""


@dataclass(frozen=True, slots=True)
class SourcePlan:
    """Preparation of the source's pixels.

    Attributes
    ----------
    downscale : int
        Side of the squares of source pixels that were averaged.
    dequantize : str
        ``"off"``, or how 8-bit codes are dithered.
    shrink : int
        Of a raw source, side of the cells whose sites of one colour were averaged, 1 for the mosaic itself; 0 for
        photographs.
    raw_pattern : str
        CFA pattern of the file of a raw source.
    raw_black_dn, raw_white_dn : Levels
        Levels of that file.
    mosaic_xxh3 : str
        XXH3-128 of its decoded mosaic.
    source_iso, source_exposure_s : float
        ISO and exposure time that it states; 0 if it does not.
    own_a_dn, own_b_dn2 : float
        Noise variance of the source itself in the clean frame, own_a_dn (x - black) + own_b_dn2; 0 if it is not stated.
    """

    downscale: int
    dequantize: str
    shrink: int = 0
    raw_pattern: str = ""
    raw_black_dn: Levels = ()
    raw_white_dn: Levels = ()
    mosaic_xxh3: str = ""
    source_iso: float = 0.0
    source_exposure_s: float = 0.0
    own_a_dn: float = 0.0
    own_b_dn2: float = 0.0

    @property
    def is_raw(self) -> bool:
        """True for raw sources."""
        return self.shrink > 0

    @property
    def code_levels(self) -> tuple[Levels, Levels]:
        """Codes of a raw source at black and at white, by plane: DN, or after averaging the finest binary steps of it.

        The steps are powers of two of a DN, so that means of 2, 4 and 8 sites of up to 12 bits are exact.
        """
        if self.shrink == 1:
            return self.raw_black_dn, self.raw_white_dn
        span = min(white - black for black, white in zip(self.raw_black_dn, self.raw_white_dn, strict=True))
        steps = 1.0
        while span * steps * 2 <= CODE_RANGE:
            steps *= 2
        while span * steps > CODE_RANGE:
            steps /= 2
        black = float(int((CODE_RANGE - span * steps) / 2))
        return (black,) * 4, (black + span * steps,) * 4


@dataclass(frozen=True, slots=True)
class ScenePlan:
    """Light of the scene: its name, and the factor ``exposure_ratio`` by which the photograph is darkened."""

    name: str
    exposure_ratio: float

    @property
    def exposure(self) -> float:
        """Factor applied to the light of the scene."""
        return 1 / self.exposure_ratio


@dataclass(frozen=True, slots=True)
class CameraPlan:
    """Colours and gains of the camera.

    Attributes
    ----------
    name : str
        Name of the camera option.
    weights : tuple of four floats
        Weights of the mixed cameras, in the order of `colour.CAMERAS`.
    rgb2cam : tuple of nine floats
        Matrix from linear sRGB to camera RGB, row by row; each row sums to 1.
    red_gain, blue_gain, inverse_rgb_gain : float
        White-balance gains of red and blue, and inverse of the brightness gain.
    highlight, highlight_threshold : str, float
        Method for highlights (`unprocess.INVERSE_HIGHLIGHTS`), and the intensity from which it acts, in [0, 1).
    light, cct_k : str, float
        Light from which the gains follow, and its correlated colour temperature; empty and 0 without one.
    """

    name: str
    weights: tuple[float, float, float, float]
    rgb2cam: tuple[float, float, float, float, float, float, float, float, float]
    red_gain: float
    blue_gain: float
    inverse_rgb_gain: float
    highlight: str
    highlight_threshold: float
    light: str = ""
    cct_k: float = 0.0

    @property
    def inverse_gains(self) -> tuple[float, float, float]:
        """Factors of the red, green and blue channels (Brooks et al. 2019, random_gains())."""
        return self.inverse_rgb_gain / self.red_gain, self.inverse_rgb_gain, self.inverse_rgb_gain / self.blue_gain


@dataclass(frozen=True, slots=True)
class IspPlan:
    """Tone curve and gamma that are inverted (`tone_curves.linear_table`)."""

    tone: str
    gamma: float | str


@dataclass(frozen=True, slots=True)
class SensorPlan:
    """CFA pattern (one of `cfa.PATTERNS`), bit depth, and levels in DN of the sensor."""

    pattern: str
    bits: int
    black_level_dn: int
    white_level_dn: int

    @property
    def span_dn(self) -> int:
        """White level minus black level, DN."""
        return self.white_level_dn - self.black_level_dn


class RawParts(NamedTuple):
    """Parts of a plan that the file of a raw source gives, and its own noise.

    Attributes
    ----------
    source : SourcePlan
        Levels of the file, digest of its mosaic, ISO and exposure time.
    camera, isp : CameraPlan, IspPlan
        Colours and curves with which pictures are drawn; frames do not depend on them.
    sensor : SensorPlan
        Pattern, bits and levels of the file.
    noise : (float, float) or None
        S and O of the variance S·x + O of the source, with x = 0 at black and 1 at white; None if it is not known.
    """

    source: SourcePlan
    camera: CameraPlan
    isp: IspPlan
    sensor: SensorPlan
    noise: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class DarkFramePlan:
    """Dark frame whose noise replaces that of the read-out; without one, every field has its default.

    Attributes
    ----------
    sha256 : str
        SHA-256 of the frame; empty without one.
    shift : (int, int)
        Even row and column of the dark frame at row 0, column 0 of the full frame.
    black_dn, scale : float
        Black level of the dark frame, DN of the dark frame, and DN of the sensor per DN of it.
    """

    sha256: str = ""
    shift: tuple[int, int] = (0, 0)
    black_dn: float = 0.0
    scale: float = 1.0


@dataclass(frozen=True, slots=True)
class NoisePlan:
    """Noise and limits of the noisy frame.

    Attributes
    ----------
    name, law : str
        Name of the noise profile, and for two-parameter profiles its distribution: ``"gaussian"`` or ``"poisson"``.
    a_dn, b_dn2 : float
        Slope (DN) and intercept (DN²) of the noise variance above black.
    effects, skipped : tuple of str
        Simulated effects, and the omitted ones with their reasons.
    sensor_clip : str
        Clipping of the noisy frame (`sensor.noisy_limits`).
    saturated : str
        Noisy value at sites where the clean frame is saturated: ``"noisy"``, or ``"white"``
        if the converter ends there; sites at a full well keep the noise behind it, and count as saturated.
    physics : Physics or None
        Numbers of a physical profile. None for two-parameter profiles, whose one effect is ``heteroscedastic``.
    level, draw, frame : int
        Numbers of the noise level, of the draw at this level, and of the frame in its clip. Each selects other random
        values.
    assumed : tuple of str
        Assumed numbers of the noise profile that the simulated effects use.
    dark : DarkFramePlan
        Dark frame whose noise replaces that of the read-out.
    epoch : int
        Number of the epoch of live pairs, each with other random values; 0 in datasets.
    """

    name: str
    law: str
    a_dn: float
    b_dn2: float
    effects: tuple[str, ...]
    skipped: tuple[str, ...]
    sensor_clip: str
    saturated: str
    physics: Physics | None = None
    level: int = 0
    draw: int = 0
    frame: int = 0
    assumed: tuple[str, ...] = ()
    dark: DarkFramePlan = DarkFramePlan()
    epoch: int = 0

    @property
    def frame_word(self) -> int:
        """Word of the random counter that holds frame and epoch."""
        return frame_word(self.frame, self.epoch)

    @property
    def counts_electrons(self) -> bool:
        """True if the noise contains Poisson counts, not only one normal deviate per site."""
        return self.physics is not None or (self.law == "poisson" and self.variance_line[0] > 0)

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


@dataclass(frozen=True, slots=True)
class OutputPlan:
    """Format of the frames: dtype and layout of both, and dtype of the clean frame if it differs, else empty."""

    dtype: str = UINT16
    layout: str = MOSAIC
    clean_dtype: str = ""

    @property
    def normalised(self) -> bool:
        """True if noisy frames are float32, 0 at black and 1 at white, without rounding to DN."""
        return self.dtype == FLOAT32

    @property
    def clean_normalised(self) -> bool:
        """True if the clean frame is float32, 0 at black and 1 at white, without rounding to DN."""
        return (self.clean_dtype or self.dtype) == FLOAT32


class CleanPlan(NamedTuple):
    """All that decides a clean frame; pairs with equal ones share it.

    Attributes
    ----------
    stream_key, source, scene, camera, isp, sensor, output
        Parts of the plan.
    accuracy : str
        `Plan.clean_accuracy`.
    brightest : float
        Light at which the frame saturates.
    lens : tuple or None
        Coefficients and frame size of the lens shading.
    patterns : tuple or None
        Numbers, effects and clipping of the noise if the frame contains its fixed patterns.
    """

    stream_key: int
    source: SourcePlan
    scene: ScenePlan
    camera: CameraPlan
    isp: IspPlan
    sensor: SensorPlan
    accuracy: str
    output: OutputPlan
    brightest: float
    lens: tuple[tuple[float, float, float], tuple[int, int]] | None
    patterns: tuple[Physics | None, tuple[str, ...], str] | None


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
    source, scene, camera, isp, sensor : SourcePlan, ScenePlan, CameraPlan, IspPlan, SensorPlan
        Preparation of the pixels, light, colours and gains, curves, and levels.
    noise : NoisePlan
        Noise and limits of the noisy frame.
    accuracy : str
        Accuracy tier, one of `TIERS`.
    output : OutputPlan
        Format of the frames.
    split : str
        Part of the dataset that the image belongs to; empty without splits. It decides no pixel.
    """

    seed: int
    stream_key: int
    source: SourcePlan
    scene: ScenePlan
    camera: CameraPlan
    isp: IspPlan
    sensor: SensorPlan
    noise: NoisePlan
    accuracy: str
    output: OutputPlan = OutputPlan()
    split: str = ""

    @property
    def physics(self) -> Physics:
        """Numbers of the physical profile, which the plan must have."""
        assert self.noise.physics is not None
        return self.noise.physics

    def __hash__(self) -> int:
        """Hash a few numbers: hashes of all fields take ten times as long, and patches look up their plan's records.

        Plans that are redrawn for an epoch differ in drawn numbers only.
        """
        noise, drawn = self.noise, (self.camera.rgb2cam[0], self.camera.inverse_rgb_gain, self.scene.exposure_ratio)
        return hash((self.stream_key, noise.level, noise.draw, noise.frame, noise.epoch, noise.a_dn, drawn))

    def replace(self, **values: Any) -> Plan:
        """Return a copy with other values in fields of the plan or of its parts.

        Parameters
        ----------
        **values : Any
            New values by the names of the fields. The field ``name``, which several parts have, cannot be given.
        """
        changes: dict[str, dict[str, Any]] = {}
        for name, value in values.items():
            changes.setdefault(_PART_OF[name], {})[name] = value
        own = changes.pop("", {})
        return replace(self, **own, **{part: replace(getattr(self, part), **new) for part, new in changes.items()})

    @property
    def clean(self) -> CleanPlan:
        """All that decides the clean frame."""
        noise, lens, patterns = self.noise, None, None
        if noise.physics is not None and "lens_shading" in noise.effects:
            lens = noise.physics.lens_shading, noise.physics.frame_size
        if noise.averaged:
            patterns = noise.physics, noise.effects, noise.sensor_clip
        return CleanPlan(
            self.stream_key, self.source, self.scene, self.camera, self.isp, self.sensor,
            self.clean_accuracy, self.output, self.brightest, lens, patterns,
        )  # fmt: skip

    @property
    def clean_accuracy(self) -> str:
        """Accuracy tier of the clean frame: ``exact`` in place of ``fast`` for float32 frames and Poisson counts.

        No drawn number decides it, so that all noise levels of an image have the same clean frame.
        """
        has_counts = self.noise.physics is not None or self.noise.law == "poisson"
        return EXACT if self.accuracy == FAST and (has_counts or self.output.clean_normalised) else self.accuracy

    @property
    def brightest(self) -> float:
        """Light at which the clean frame saturates: 1 (white), or less if the full well is reached below white."""
        physics = self.noise.physics
        if physics is None or "full_well" not in self.noise.effects:
            return 1.0
        return min(1.0, physics.full_well_e * physics.dn_per_e / self.sensor.span_dn)

    @property
    def brightest_dn(self) -> float:
        """Value of `brightest` in DN, unrounded."""
        return self.brightest * float(self.sensor.span_dn) + float(self.sensor.black_level_dn)

    @property
    def pins_saturated(self) -> bool:
        """True if noisy sites have the value of the clean frame where that saturates."""
        return self.noise.saturated == "white" and self.brightest == 1

    @property
    def saturated_value(self) -> float:
        """Value of clean sites that count as saturated: white, or the full well below it with ``"white"``."""
        value_dn = self.brightest_dn if self.noise.saturated == "white" else float(self.sensor.white_level_dn)
        if not self.output.clean_normalised:
            return float(round(value_dn))
        return float(np.float32((value_dn - self.sensor.black_level_dn) / self.sensor.span_dn))


PLAN_PARTS: dict[str, Any] = {
    "source": SourcePlan, "scene": ScenePlan, "camera": CameraPlan, "isp": IspPlan, "sensor": SensorPlan,
    "noise": NoisePlan, "output": OutputPlan,
}  # fmt: skip
"""Records of a plan by the names of their fields."""

_PART_OF = {field.name: part for part, record in PLAN_PARTS.items() for field in fields(record) if field.name != "name"}
_PART_OF |= {field.name: "" for field in fields(Plan)}
"""Part of a plan in which each field is; empty for the plan's own fields."""


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
    light_clipped_high : int or None
        Sites whose light is above white before the exposure ratio divides it; None without a ratio.
    """

    clean_clipped_low: int
    clean_clipped_high: int
    noisy_clipped_low: int
    noisy_clipped_high: int
    saturated: int
    zero_variance: int
    light_clipped_high: int | None = None


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


DESCRIPTIONS = {UINT8: "|u1", UINT16: "<u2", FLOAT32: "<f4"}
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
