"""Define the records that decide a pair: with the pixels, a `Plan` determines both frames completely."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple, Self, get_args, get_type_hints

import msgspec
import numpy as np

from unprocess_gen.core.arrays import FLOAT32, MOSAIC, UINT16
from unprocess_gen.core.random_streams import frame_word
from unprocess_gen.simulation.numbers import DN, LARGEST, SHAPE, SITES, Number, number_in_dn, rate

TIERS = REFERENCE, EXACT, FAST = "reference", "exact", "fast"
"""Accuracy tiers: the NumPy reference, kernels with the same DN, and kernels in float32 where the noise allows it."""

Levels = tuple[float, ...]
"""A level in DN for each packed plane: R, G of the red rows, G of the blue rows, B."""

CODE_RANGE = 65535.0
"""Largest code of a raw source."""


class PlanRecord(msgspec.Struct, frozen=True):
    """Base of the records of a plan."""

    def replace(self, **values: Any) -> Self:
        """Return a copy with other values in fields of the record, and of the records in it.

        Parameters
        ----------
        **values : Any
            New values by the names of the fields.
        """
        own = {name: values.pop(name) for name in self.__struct_fields__ if name in values}
        for name in self.__struct_fields__ if values else ():
            part = getattr(self, name)
            if name not in own and isinstance(part, PlanRecord) and (inner := _known(part, values)):
                own[name] = part.replace(**inner)
                values = {other: value for other, value in values.items() if other not in inner}
        return msgspec.structs.replace(self, **own, **values)


def _known(record: PlanRecord, values: dict[str, Any]) -> dict[str, Any]:
    """Values whose names are fields of a record or of the records in it."""
    known = {name: values[name] for name in record.__struct_fields__ if name in values}
    for name in record.__struct_fields__:
        if isinstance(part := getattr(record, name), PlanRecord):
            known |= _known(part, values)
    return known


class Place(PlanRecord, frozen=True):
    """Numbers that select the random values of a frame of an image.

    Attributes
    ----------
    frame : int
        Number of the frame in its clip.
    level, draw : int
        Numbers of the noise level, and of the draw at this level.
    epoch : int
        Number of the epoch of live pairs; 0 in datasets.
    """

    frame: int = 0
    level: int = 0
    draw: int = 0
    epoch: int = 0

    @property
    def frame_word(self) -> int:
        """Word of the random counter that holds frame and epoch."""
        return frame_word(self.frame, self.epoch)


class CameraPlan(PlanRecord, frozen=True, kw_only=True):
    """Colours and gains of the camera.

    Attributes
    ----------
    camera : str
        Name of the camera option.
    weights : tuple of four floats
        Weights of the mixed cameras, in the order of `colour.CAMERAS`.
    rgb2cam : tuple of nine floats
        Matrix from linear sRGB to camera RGB, row by row; each row sums to 1.
    light, cct_k : str, float
        Light from which the gains follow, and its correlated colour temperature; empty and 0 without one.
    red_gain, blue_gain, inverse_rgb_gain : float
        White-balance gains of red and blue, and inverse of the brightness gain.
    """

    camera: str
    weights: tuple[float, float, float, float]
    rgb2cam: tuple[float, float, float, float, float, float, float, float, float]
    light: str = ""
    cct_k: float = 0.0
    red_gain: float
    blue_gain: float
    inverse_rgb_gain: float

    @property
    def inverse_gains(self) -> tuple[float, float, float]:
        """Factors of the red, green and blue channels (Brooks et al. 2019, random_gains())."""
        return self.inverse_rgb_gain / self.red_gain, self.inverse_rgb_gain, self.inverse_rgb_gain / self.blue_gain


class IspPlan(PlanRecord, frozen=True):
    """Processing that is inverted.

    Attributes
    ----------
    tone, gamma : str, float or str
        Tone curve and gamma (`tone_curves.linear_table`).
    highlight, highlight_threshold : str, float
        Method for highlights (`unprocess.INVERSE_HIGHLIGHTS`), and the intensity from which it acts, in [0, 1).
    """

    tone: str
    gamma: float | str
    highlight: str = "per_channel"
    highlight_threshold: float = 0.9


class SourcePlan(PlanRecord, frozen=True):
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


class SensorPlan(PlanRecord, frozen=True):
    """Digital output of the sensor.

    Attributes
    ----------
    pattern : str
        CFA pattern, one of `cfa.PATTERNS`.
    bits : int
        Bits per sample.
    black_level_dn, white_level_dn : int
        Levels, DN.
    sensor_clip : str
        Clipping of the noisy frame (`sensor.noisy_limits`).
    saturated_as : str
        Noisy value at sites where the clean frame is saturated: ``"noisy"``, or ``"white"``
        if the converter ends there; sites at a full well keep the noise behind it, and count as saturated.
    """

    pattern: str
    bits: int
    black_level_dn: int
    white_level_dn: int
    sensor_clip: str = "sensor"
    saturated_as: str = "noisy"

    @property
    def span_dn(self) -> int:
        """White level minus black level, DN."""
        return self.white_level_dn - self.black_level_dn


class ScenePlan(PlanRecord, frozen=True):
    """Light of the scene: its name, and the factor ``exposure_ratio`` by which the photograph is darkened."""

    scene: str
    exposure_ratio: float

    @property
    def exposure(self) -> float:
        """Factor applied to the light of the scene."""
        return 1 / self.exposure_ratio


class NoisePlan(PlanRecord, frozen=True):
    """Noise profile, its variance, and the effects that are simulated.

    Attributes
    ----------
    noise, noise_law : str
        Name of the noise profile, and for two-parameter profiles its distribution: ``"gaussian"`` or ``"poisson"``.
    a_dn, b_dn2 : float
        Slope (DN) and intercept (DN²) of the noise variance above black.
    effects, skipped : tuple of str
        Simulated effects, and the omitted ones with their reasons.
    assumed : tuple of str
        Assumed numbers of the noise profile that the simulated effects use.
    """

    noise: str
    noise_law: str
    a_dn: float
    b_dn2: float
    effects: tuple[str, ...]
    skipped: tuple[str, ...]
    assumed: tuple[str, ...] = ()

    @property
    def variance_line(self) -> tuple[float, float]:
        """Slope (DN) and intercept (DN²) of the noise variance above black, for the simulated effects."""
        if "heteroscedastic" in self.effects:
            return self.a_dn, self.b_dn2
        has_read_noise = "read" in self.effects or "dark_frame" in self.effects
        return self.a_dn if "shot" in self.effects else 0.0, self.b_dn2 if has_read_noise else 0.0


class Physics(PlanRecord, frozen=True, kw_only=True):
    """Numbers of a physical noise profile for one scene and sensor.

    The numbers of effects are in the order in which light meets the effects; a number without its effect has the
    default.

    Attributes
    ----------
    iso, exposure_s, temperature_c : float
        The scene: ISO, exposure time (s) and sensor temperature (°C).
    dark_offset : str
        ``"removed"`` if the camera subtracts the mean dark signal, else ``"kept"``.
    sensor_unit : str
        Name of the camera body.
    body_key : int
        Key of the body's fixed patterns (`random_streams.body_key`).
    fixed_pattern_in_clean : bool
        Whether the clean frame contains the fixed patterns too.
    frame_size : (int, int)
        Height and width of the full frame if its lens shading is known, else 0; pixels.
    """

    iso: float
    exposure_s: float
    temperature_c: float
    lens_shading: Annotated[
        tuple[float, float, float],
        Number(
            "relative illumination 1 + k1 r² + k2 r⁴ + k3 r⁶ as [k1, k2, k3]; r is the distance from the centre of the "
            "full frame, 1 in the corners",
            low=-10.0,
            high=10.0,
            count=3,
            columns={
                f"lens_shading_{power}": f"coefficient of r^{power} in the relative illumination" for power in (2, 4, 6)
            },
            lowest=-10.0,
            highest=10.0,
        ),
    ] = (0.0, 0.0, 0.0)
    prnu_std: Annotated[
        float,
        Number(
            "standard deviation of the photo response non-uniformity (PRNU), whose mean is 1", high=0.5, highest=1.0
        ),
    ] = 0.0
    dn_per_e: Annotated[
        float, Number("system gain K", "DN per electron", kind=DN, by_iso=True, required=True, highest=1e20)
    ] = 1.0
    dark_e: Annotated[
        float,
        rate(
            "mean dark current of the exposure",
            key="dark_e_per_s",
            key_meaning="mean dark current at dark_reference_c",
        ),
    ] = 0.0
    hot_pixel_share: Annotated[float, Number("fraction of hot pixels", high=1.0, highest=1.0)] = 0.0
    hot_pixel_e: Annotated[
        float,
        rate(
            "mean excess of a hot pixel in the exposure",
            key="hot_pixel_e_per_s",
            key_meaning="mean of the exponentially distributed current of hot pixels at dark_reference_c",
        ),
    ] = 0.0
    full_well_e: Annotated[float, Number("saturation capacity", "electrons", low=1.0, high=1e9, highest=1e9)] = 0.0
    gain_by_colour: Annotated[
        tuple[float, float, float],
        Number(
            "system gain of red, green and blue, relative to dn_per_e",
            low=0.1,
            high=10.0,
            count=3,
            columns={
                f"gain_{colour[0]}": f"system gain of {colour}, relative to dn_per_e"
                for colour in ("red", "green", "blue")
            },
            lowest=0.1,
            highest=10.0,
        ),
    ] = (1.0, 1.0, 1.0)
    read_law: Annotated[
        str,
        Number(
            "distribution of the read noise: gaussian, or tukey_lambda for Tukey's lambda with a shape from -0.45",
            words=("gaussian", "tukey_lambda"),
            key_default="gaussian",
        ),
    ] = "gaussian"
    read_shape: Annotated[
        float,
        Number(
            "shape of Tukey's lambda distribution",
            kind=SHAPE,
            by_iso=True,
            key_default=0.0,
            lowest=-0.5,
            highest=10.0,
        ),
    ] = 0.0
    read_std_dn: Annotated[
        float, number_in_dn("standard deviation of the read noise", by_iso=True, required=True, counter=1)
    ] = 0.0
    row_std_dn: Annotated[float, number_in_dn("standard deviation of row offsets", by_iso=True, counter=2)] = 0.0
    row_correlation: Annotated[
        float,
        Number(
            "correlation of the offsets of neighbouring rows, an autoregressive process of order 1; part of the "
            "effect row",
            low=-0.999,
            high=0.999,
            optional="independent rows",
            lowest=-0.999,
            highest=0.999,
        ),
    ] = 0.0
    column_std_dn: Annotated[float, number_in_dn("standard deviation of column offsets", by_iso=True, counter=3)] = 0.0
    column_temporal_std_dn: Annotated[
        float,
        number_in_dn(
            "standard deviation of the part of column offsets that is new in every frame", by_iso=True, counter=4
        ),
    ] = 0.0
    black_error_dn: Annotated[
        tuple[float, float, float, float],
        Number(
            "error of the black level",
            "DN",
            kind=SITES,
            by_iso=True,
            count=4,
            columns={
                f"black_error_dn_{i}{j}": f"black-level error of the 2x2 CFA pattern, row {i}, column {j}"
                for i in range(2)
                for j in range(2)
            },
            lowest=-LARGEST,
        ),
    ] = (0.0, 0.0, 0.0, 0.0)
    dsnu_std_e: Annotated[
        float,
        Number(
            "standard deviation of the dark-signal non-uniformity (DSNU), whose mean is 0",
            "electrons",
            high=1e6,
            highest=1e9,
        ),
    ] = 0.0
    dead_pixel_share: Annotated[float, Number("fraction of dead pixels", high=1.0, highest=1.0)] = 0.0
    dead_pixel_level: Annotated[
        float,
        Number(
            "value of dead pixels as a fraction of the black level; part of the effect dead_pixels",
            high=1.0,
            optional="0 DN",
            highest=1.0,
        ),
    ] = 0.0
    dark_offset: str
    sensor_unit: str
    body_key: int
    fixed_pattern_in_clean: bool
    frame_size: tuple[int, int] = (0, 0)


NUMBERS: dict[str, Number] = {
    name: kind.__metadata__[0]
    for name, kind in get_type_hints(Physics, include_extras=True).items()
    if get_args(kind) and isinstance(getattr(kind, "__metadata__", [None])[0], Number)
}
"""Numbers of all effects by the names of their fields."""


class DarkFramePlan(PlanRecord, frozen=True):
    """Dark frame whose noise replaces that of the read-out.

    Attributes
    ----------
    dark_frame : str
        SHA-256 of the frame.
    shift : (int, int)
        Even row and column of the dark frame at row 0, column 0 of the full frame.
    dark_black_dn, dark_scale : float
        Black level of the dark frame, DN of the dark frame, and DN of the sensor per DN of it.
    """

    dark_frame: str
    shift: tuple[int, int]
    dark_black_dn: float
    dark_scale: float


class OutputPlan(PlanRecord, frozen=True):
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
    stream_key, source, scene, camera, isp, output
        Parts of the plan.
    sensor : (str, int, int, int)
        Pattern, bits and levels.
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
    sensor: tuple[str, int, int, int]
    accuracy: str
    output: OutputPlan
    brightest: float
    lens: tuple[tuple[float, float, float], tuple[int, int]] | None
    patterns: tuple[Physics | None, tuple[str, ...], str] | None


class Plan(PlanRecord, frozen=True, kw_only=True):
    """All parameters of a pair; with the pixels it determines the pair completely.

    A plan is drawn once (`unprocess_gen.plan_image`) or read from a manifest row.

    Attributes
    ----------
    seed : int
        Seed of the dataset.
    stream_key : int
        Key of the image's random streams (`random_streams.stream_key`).
    split : str
        Part of the dataset that the image belongs to; empty without splits. It decides no pixel.
    place : Place
        Numbers of frame, level, draw and epoch.
    camera, isp, source, sensor, scene : CameraPlan, IspPlan, SourcePlan, SensorPlan, ScenePlan
        Colours and gains, processing, preparation of the pixels, levels, and light.
    noise : NoisePlan
        Noise profile and effects.
    accuracy : str
        Accuracy tier, one of `TIERS`.
    physics : Physics or None
        Numbers of a physical profile. None for two-parameter profiles, whose one effect is ``heteroscedastic``.
    dark : DarkFramePlan or None
        Dark frame whose noise replaces that of the read-out.
    output : OutputPlan
        Format of the frames.
    """

    seed: int
    stream_key: int
    split: str = ""
    place: Place = Place()
    camera: CameraPlan
    isp: IspPlan
    source: SourcePlan
    sensor: SensorPlan
    scene: ScenePlan
    noise: NoisePlan
    accuracy: str
    physics: Physics | None = None
    dark: DarkFramePlan | None = None
    output: OutputPlan = OutputPlan()

    @property
    def numbers(self) -> Physics:
        """Numbers of the physical profile, which the plan must have."""
        assert self.physics is not None
        return self.physics

    def __hash__(self) -> int:
        """Hash a few numbers: hashes of all fields take ten times as long, and patches look up their plan's records.

        Plans that are redrawn for an epoch differ in drawn numbers only.
        """
        drawn = self.camera.rgb2cam[0], self.camera.inverse_rgb_gain, self.scene.exposure_ratio
        return hash((self.stream_key, self.place, self.noise.a_dn, drawn))

    @property
    def counts_electrons(self) -> bool:
        """True if the noise contains Poisson counts, not only one normal deviate per site."""
        return self.physics is not None or (self.noise.noise_law == "poisson" and self.noise.variance_line[0] > 0)

    @property
    def averaged(self) -> bool:
        """True if the clean frame contains the fixed patterns, like the average of many frames."""
        return self.physics is not None and self.physics.fixed_pattern_in_clean

    @property
    def clean(self) -> CleanPlan:
        """All that decides the clean frame."""
        physics, effects, sensor = self.physics, self.noise.effects, self.sensor
        has_shading = physics is not None and "lens_shading" in effects
        return CleanPlan(
            self.stream_key, self.source, self.scene, self.camera, self.isp,
            (sensor.pattern, sensor.bits, sensor.black_level_dn, sensor.white_level_dn),
            self.clean_accuracy, self.output, self.brightest,
            (self.numbers.lens_shading, self.numbers.frame_size) if has_shading else None,
            (physics, effects, sensor.sensor_clip) if self.averaged else None,
        )  # fmt: skip

    @property
    def clean_accuracy(self) -> str:
        """Accuracy tier of the clean frame: ``exact`` in place of ``fast`` for float32 frames and Poisson counts.

        No drawn number decides it, so that all noise levels of an image have the same clean frame.
        """
        has_counts = self.physics is not None or self.noise.noise_law == "poisson"
        return EXACT if self.accuracy == FAST and (has_counts or self.output.clean_normalised) else self.accuracy

    @property
    def brightest(self) -> float:
        """Light at which the clean frame saturates: 1 (white), or less if the full well is reached below white."""
        physics = self.physics
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
        return self.sensor.saturated_as == "white" and self.brightest == 1

    @property
    def saturated_value(self) -> float:
        """Value of clean sites that count as saturated: white, or the full well below it with ``"white"``."""
        sensor = self.sensor
        value_dn = self.brightest_dn if sensor.saturated_as == "white" else float(sensor.white_level_dn)
        if not self.output.clean_normalised:
            return float(round(value_dn))
        return float(np.float32((value_dn - sensor.black_level_dn) / sensor.span_dn))
