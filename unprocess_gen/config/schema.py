"""Define the configuration as typed dataclasses: one for each folder of ``conf/``, and `Config` for all of them.

Each key is declared once, with its unit and allowed values (`settings.key`); the docstring of its group has its
meaning. OmegaConf checks keys and types against these dataclasses; `validation` checks values by the same declarations.
A config is immutable and hashable: lists become tuples. `replaced` returns a copy with other values.

A parameter that is drawn for every image is a number or a distribution, written as a list: ``[uniform, 1.9, 2.4]``. An
override replaces a list completely. A mapping would be merged with the default's mapping, into parts of both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Optional, TypeVar

from unprocess_gen.config import limits
from unprocess_gen.config.iso_forms import BLACK_ERROR, READ_SHAPE, IsoNumber
from unprocess_gen.config.settings import documented, groups_in, key, settings_of
from unprocess_gen.core.fields import Choice, Integers, Limit, NumberList, NumberOrWord, Numbers, is_number
from unprocess_gen.simulation.effects import EFFECTS, profile_keys
from unprocess_gen.simulation.effects.effect import Effect
from unprocess_gen.simulation.numbers import SHAPE, SITES, Number
from unprocess_gen.simulation.plan import EXACT, FIELDS
from unprocess_gen.simulation.reference.primaries import CAMERA, PRIMARIES, XYZ

GroupType = TypeVar("GroupType")


class FrozenMapping(dict[str, Any]):
    """A mapping inside a config, such as ``{a: 1, b: 2}`` of ``noise.levels``."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(tuple(self.items()))


def frozen(value: Any) -> Any:
    """Value of a config in a hashable form."""
    if isinstance(value, list | tuple):
        return tuple(map(frozen, value))
    return FrozenMapping({name: frozen(item) for name, item in value.items()}) if isinstance(value, dict) else value


YAML_SWITCHES = {"True": "on", "False": "off"}
"""Text of the booleans that YAML reads from on and off without quotes."""


class Group:
    """Base of the dataclasses of a config, whose lists become tuples, and whose switches have one spelling."""

    def __post_init__(self) -> None:
        """Freeze the values of the fields."""
        for name, value in vars(self).items():
            if isinstance(value, list | tuple | dict):
                object.__setattr__(self, name, frozen(value))
            elif value in YAML_SWITCHES and YAML_SWITCHES[value] in getattr(settings_of(self)[name].limit, "words", ()):
                object.__setattr__(self, name, YAML_SWITCHES[value])


@documented
@dataclass(frozen=True)
class RawConfig(Group):
    """State what files of raw sources do not state, or state wrongly.

    Attributes
    ----------
    pattern
        CFA pattern of mosaics in TIFF, PNG and NPY files
    black_dn
        black level of the files
    white_dn
        white level of the files
    a_dn
        noise of the files themselves: slope of the variance a_dn (x - black) + b_dn2
    b_dn2
        noise of the files themselves: variance at black
    """

    pattern: Optional[str] = key(None, FIELDS["raw_pattern"].limit, null="that of the file")
    black_dn: Optional[float] = key(None, Numbers(0, 65534), unit="DN", null="that of the file")
    white_dn: Optional[float] = key(None, Numbers(1, 65535), unit="DN", null="that of the file")
    a_dn: Optional[float] = key(None, Numbers(0, 65535), unit="DN", null="that of the tag NoiseProfile of a DNG")
    b_dn2: Optional[float] = key(None, Numbers(0, 65535**2), unit="DN²", null="that of the tag NoiseProfile of a DNG")


@documented
@dataclass(frozen=True)
class SourceConfig(Group):
    """Select and prepare the source images.

    Attributes
    ----------
    root
        folder of photographs, or one photograph; a path, or a URL s3://, gs:// or az://
    kind
        srgb: photographs; raw: clean frames of a camera, DNG and other raw files or 16-bit mosaics (extra raw), of
        which the light is used: camera, gains and isp are not applied; linear: white-balanced scene-linear pictures,
        OpenEXR (extra exr), Radiance HDR, float TIFF (extra raw) or NPY [H, W, 3]: isp is not applied
    list
        text file with the path of an image in each line, or CSV file with paths in the column file, else in the first
        one; relative paths are below root, without it below the folder of the list; include is not applied
    include
        glob patterns of images; one with a slash matches the path below root, others the file name, in any case;
        hidden files and folders are left out
    exclude
        glob patterns of images to leave out, as in include
    recursive
        descend into folders
    limit
        use only the first sources, in the order of their names
    max_pixels
        images with more pixels fail with reason too_large
    min_side
        shortest side of images, after downscaling; smaller images are left out: their rows have the status
        filtered, and max_failed does not count them
    max_failed
        number of failed sources up to which a run exits with code 0; with more it exits with code 3
    icc
        colour profiles of photographs: convert reads colours as the profile says; ignore reads pixels as sRGB; with
        refuse, images with another profile fail
    clips
        treat each folder as a clip: its frames share camera, gains, noise level and fixed patterns
    patch
        cut images into square patches, after downscaling
    burst
        make a burst of each patch or picture: frames of a moving camera at 1 / downscale of the resolution; the largest
        motion of a frame is shift, in pixels of the picture, and rotation_deg about the centre of the patch; exposure
        times are multiplied by 2^ev, where ev is a list that repeats; an ev above 0 saturates photographs; phase places
        the centres of pixels
    own_noise
        noise of raw sources themselves: subtract lowers the variance that a profile with two numbers adds by that of
        the source, down to 0; the column zero_variance counts the sites where the source has as much or more
    primaries
        primaries of linear sources; xyz is CIE XYZ with the white D65, camera is sensor RGB, to which neither matrix
        nor gains are applied
    """

    # fmt: off
    root: Optional[str] = key(
        None, Limit("a folder, a file, a URL, or null"), null="the built-in synthetic pictures", decides_data=False)
    kind: str = key("srgb", Choice("srgb", "raw", "linear"))
    list: Optional[str] = key(
        None, Limit("a text file or a CSV file"), null="all images of the folders", decides_data=False)
    include: tuple[str, ...] = key(
        ("*.jpg", "*.jpeg", "*.jpe", "*.jfif", "*.mpo", "*.png", "*.tif", "*.tiff", "*.webp", "*.bmp", "*.heic",
         "*.heif", "*.hif", "*.avif"),
        Limit("a list of at least one pattern such as '*.jpg'", limits.are_texts))
    exclude: tuple[str, ...] = key((), Limit("a list of patterns such as '*_thumb.jpg'", limits.are_texts))
    recursive: bool = key(True, limits.BOOLEAN)
    limit: Optional[int] = key(None, Integers(1, 10**9), null="all sources")
    max_pixels: int = key(2**26, Integers(1, 2**40), unit="pixels")
    min_side: Optional[int] = key(None, Integers(1, 2**20), unit="pixels", null="images of any size")
    max_failed: int = key(0, Integers(0, 10**9), decides_data=False)
    icc: str = key("convert", Choice("convert", "ignore", "refuse"))
    clips: bool = key(False, limits.BOOLEAN)
    downscale: int = key(1, of="downscale")
    dequantize: str = key("off", of="dequantize")
    patch: Any = key(None, limits.PATCH, unit="pixels", null="complete images")
    burst: Any = key(None, limits.BURST, null="one frame of each image")
    shrink: int = key(1, of="shrink", unit="sites")
    own_noise: str = key("keep", Choice("keep", "subtract"))
    primaries: Optional[str] = key(
        None, Choice(*PRIMARIES, XYZ, CAMERA), null="those that the file states, or srgb")
    raw: RawConfig = field(default_factory=RawConfig)
    # fmt: on

    @property
    def place(self) -> str | None:
        """Folder that names of sources are relative to; None for the synthetic pictures."""
        if self.root is not None or self.list is None:
            return self.root
        return str(Path(self.list).parent)


@documented
@dataclass(frozen=True)
class CameraConfig(Group):
    """Choose the colour matrix of the camera.

    Attributes
    ----------
    name
        name of the camera, recorded in each row
    law
        choice of an image's matrix: fixed is the camera called name, convex a mix of four cameras, choice one
        of the four, identity linear sRGB, custom xyz2cam
    xyz2cam
        matrix from XYZ (D65) to the camera, row by row, for law=custom
    weights
        weights of nexus_6p, sony_a7r, olympus_em10 and sony_rx100 in the mix of law=convex, divided by their sum
    """

    # fmt: off
    name: str = key("convex", limits.NAME)
    law: str = key("convex", limits.CAMERA_LAWS)
    xyz2cam: Optional[tuple[float, ...]] = key(
        None, Limit("nine numbers of an invertible matrix"), null="a law other than custom")
    weights: Optional[tuple[float, ...]] = key(None, NumberList(4, Numbers(0)), null="drawn for each image")
    # fmt: on


@documented
@dataclass(frozen=True)
class GainsConfig(Group):
    """Define white balance, brightening and the treatment of highlights.

    Attributes
    ----------
    light
        light from which the gains of red and blue follow, by the matrix of the camera; scene is scene.light
    """

    red: Any = key(("uniform", 1.9, 2.4), limits.GAIN, of="red_gain", null="the gain that follows from light")
    blue: Any = key(("uniform", 1.5, 1.9), limits.GAIN, of="blue_gain", null="the gain that follows from light")
    inverse_rgb: Any = key(("truncated_normal", 0.8, 0.1, 0.5, 1.1), limits.INVERSE_GAIN, of="inverse_rgb_gain")
    highlight: str = key("per_channel", of="highlight")
    threshold: float = key(0.9, of="highlight_threshold")
    light: Optional[str] = key(None, limits.LIGHT, null="red and blue are the gains")


@documented
@dataclass(frozen=True)
class IspConfig(Group):
    """Define the curves that the camera applied after the colour matrix."""

    tone: str = key("smoothstep", of="tone")
    gamma: Any = key(2.2, of="gamma")


@documented
@dataclass(frozen=True)
class SensorConfig(Group):
    """Define the digital output of the sensor.

    Attributes
    ----------
    levels
        given: bits, levels and pattern are those below; source: they are those of each raw file (source.kind=raw)
    saturated
        noisy value at sites where the clean frame is saturated: noisy is the clipped value plus noise, as in
        the article; white is the white level where the
        converter ends, and sites at a full well keep the noise behind it; auto is white for physical profiles
        with a full well or a converter that ends, otherwise noisy
    units
        camera bodies, each with its own fixed patterns: image is a new body for each image; with a number, each
        image has one of that many bodies
    """

    bits: int = key(12, of="bits")
    black_level_dn: int = key(240, limits.BLACK_LEVEL, of="black_level_dn")
    white_level_dn: int = key(4095, limits.WHITE_LEVEL, of="white_level_dn")
    pattern: str = key("RGGB", of="pattern")
    clip: str = key("sensor", of="sensor_clip")
    saturated: str = key("auto", Choice("noisy", "white", "auto"))
    dark_offset: str = key("removed", of="dark_offset")
    units: Any = key("image", NumberOrWord("image", Integers(1, 10**6), "{word}, or a number of bodies, {numbers}"))
    levels: str = key("given", Choice("given", "source"))


CHOSEN, PROFILE = "Chosen for a run", "Every profile"
TWO_NUMBERS, PHYSICAL = "Two-parameter profiles", "Physical profiles"
"""Sections of the keys of `NoiseConfig`."""

Fields = Mapping[str, tuple[Any, Any]]
"""Type and default of each field."""


def with_fields(added: Fields, before: str = "") -> Callable[[type[GroupType]], type[GroupType]]:
    """Add fields to the body of a dataclass, at its end or before one of its fields."""

    def add(group: type[GroupType]) -> type[GroupType]:
        types = list(group.__annotations__.items())
        place = list(group.__annotations__).index(before) if before else len(types)
        types[place:place] = [(name, kind) for name, (kind, _) in added.items()]
        group.__annotations__ = dict(types)
        for name, (_, default) in added.items():
            setattr(group, name, default)
        return group

    return add


class EffectGroup(Group):
    """Base of the groups whose fields follow from the declarations of the effects."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...


def _number_field(effect: Effect, number: Number) -> tuple[Any, Any]:
    """Type and default of the key of a number."""
    kind: Any
    null, kind, limit = "", float, _limit(number)
    if number.may_be_unknown:
        null = number.optional or f"not known, so the effect {effect.name} cannot be simulated"
        kind = Optional[float] if number.count == 1 else Optional[tuple[float, ...]]
    if number.in_branch:
        kind = str if isinstance(number.limit, Choice) else Any
    section, meaning = "" if number.in_branch else PHYSICAL, number.key_meaning or number.meaning
    unit = number.key_unit or ("DN of the profile" if number.unit == "DN" else number.unit)
    return kind, key(number.key_default, limit, section, meaning=meaning, unit=unit, null=null)


def _limit(number: Number) -> Limit:
    """Values that the key of a number allows."""
    if number.kind in (SHAPE, SITES):
        return READ_SHAPE if number.kind == SHAPE else BLACK_ERROR
    if isinstance(number.limit, Choice):
        return number.limit
    if number.in_branch:
        return IsoNumber()
    numbers = number.key_limit or number.limit
    return NumberList(number.count, numbers) if isinstance(numbers, Numbers) and number.count > 1 else numbers


def _number_fields(in_branch: bool) -> Fields:
    """Keys of the numbers of a branch, or of the profile."""
    declared = profile_keys().items()
    return {name: _number_field(*number) for name, number in declared if number[1].in_branch == in_branch}


PHYSICAL_NUMBERS = tuple(
    name for name, (_, number) in profile_keys().items() if number.count == 1 and not number.in_branch
)
"""Keys of the numbers of a physical profile that do not depend on ISO."""

ASSUMABLE = (
    *PHYSICAL_NUMBERS,
    *(name for name, (_, number) in profile_keys().items() if number.in_branch and number.may_be_unknown),
)
"""Keys that ``noise.assumed`` may name: numbers of a physical profile, and those of a branch that may be unknown."""

BRANCH_FIELDS = _number_fields(in_branch=True)
SOURCED = (
    *("black_level_dn", "white_level_dn"),
    *(name for name in BRANCH_FIELDS if name != "read_law"),
    *PHYSICAL_NUMBERS,
)
"""Keys whose source a profile may state."""
SWITCH_FIELDS: Fields = {
    effect.name: (
        Optional[str],
        key(None, limits.SWITCH, meaning=effect.meaning, null="the value of all"),
    )
    for effect in EFFECTS
    if effect.has_switch
}


@documented
@dataclass(frozen=True)
@with_fields(BRANCH_FIELDS)
class BranchConfig(EffectGroup):
    """Numbers of a physical noise profile that depend on ISO, for one range of ISO.

    A number may be written as a form of `iso_forms.ISO_FORMS`.

    Attributes
    ----------
    iso
        lowest and highest ISO of the branch
    """

    iso: tuple[float, ...] = key((), limits.ISO_RANGE)


@documented
@dataclass(frozen=True)
class ProvenanceConfig(Group):
    """State the source and the uncertainty of numbers of a physical noise profile.

    Attributes
    ----------
    numbers
        keys of a branch or of the profile
    iso
        lowest and highest ISO the statement holds for; empty: all
    source
        where the numbers come from
    uncertainty
        how far the numbers may be off, or how far sources differ
    """

    numbers: tuple[str, ...] = key((), limits.Names("a list of keys whose values are numbers", SOURCED, least=1))
    iso: tuple[float, ...] = key((), limits.ISO_RANGE_OR_ALL)
    source: str = key("", limits.text("a text"))
    uncertainty: str = key("", limits.text("a text"))


@documented
@dataclass(frozen=True)
@with_fields(_number_fields(in_branch=False), before="assumed")
class NoiseConfig(EffectGroup):
    """Define the noise: two numbers (variance a·x + b), or a physical profile with ``branches`` by ISO.

    Attributes
    ----------
    name
        name of the profile, recorded in each row; it ends with * if a number of the profile is overridden
    units
        units of a and b: dn, or normalized (0 at black, 1 at white)
    black
        whether the signal x of the variance a * x + b has the black level subtracted or included
    bits
        bits of the sensor that a profile in DN was calibrated with
    black_level_dn
        black level of the calibration
    white_level_dn
        white level of the calibration
    a
        slope of the variance a * x + b
    b
        offset of the variance a * x + b
    negative_variance
        profiles whose variance at black is negative: refuse them, or clip the variance at 0
    iso
        ISO at which a physical profile is used, in place of scene.iso
    scatter
        how the scatter of a physical profile's lines and its read_shape are drawn: unit once for each camera
        body, off is no scatter and the median shape
    levels
        noise levels of each clean frame
    draws
        noisy frames at each level
    dark_frames
        folder of dark frames of the camera at one ISO and exposure; the noise of the read-out is sampled from
        them
    dark_frames_sha256
        SHA-256 of the set of dark frames, which a run records; frames of another set are refused
    dark_frames_black_dn
        black level of the dark frames
    branches
        numbers that depend on ISO, for one or more ranges of ISO; a profile without branches has two parameters
    assumed
        keys whose numbers no source gives for this camera
    unsourced
        assumed keys whose numbers no source gives for any camera; their effects are simulated only if they are
        switched on
    provenance
        source and uncertainty of the numbers, which plan --numbers prints
    """

    # fmt: off
    name: str = key("none", limits.PROFILE_NAME, PROFILE)
    units: Optional[str] = key(None, Choice("dn", "normalized"), PROFILE)
    black: Optional[str] = key(None, Choice("subtracted", "included"), PROFILE)
    bits: Optional[int] = key(None, Integers(1, 32), PROFILE, null="with units=normalized")
    black_level_dn: Optional[int] = key(
        None, limits.BLACK_LEVEL, PROFILE, unit="DN of the profile", null="with units=normalized")
    white_level_dn: Optional[int] = key(
        None, limits.WHITE_LEVEL, PROFILE, unit="DN of the profile", null="with units=normalized")
    a: Any = key(
        None, limits.VARIANCE_SLOPE, TWO_NUMBERS, unit="DN, or 1 with units=normalized", null="a physical profile")
    b: Any = key(
        None, limits.VARIANCE_OFFSET, TWO_NUMBERS, unit="DN², or 1 with units=normalized", null="a physical profile")
    negative_variance: str = key("refuse", Choice("refuse", "clip"), TWO_NUMBERS)
    law: str = key("gaussian", section=CHOSEN, of="noise_law")
    iso: Any = key(None, limits.ISO, CHOSEN, null="the ISO of the scene")
    scatter: str = key("off", Choice("off", "unit"), CHOSEN)
    levels: Any = key(None, limits.LEVELS, CHOSEN, null="one level, as the profile has it")
    draws: int = key(1, Integers(1, limits.MAX_LEVELS), CHOSEN)
    dark_frames: Optional[str] = key(
        None, Limit("a folder of mosaics: NPY, 16-bit PNG or TIFF, or raw files (extra raw)"), CHOSEN,
        null="the noise of the profile", decides_data=False)
    dark_frames_sha256: Optional[str] = key(None, limits.DIGEST, CHOSEN, null="any frames")
    dark_frames_black_dn: Optional[float] = key(
        None, Numbers(0, 65535), CHOSEN, unit="DN of the profile",
        null="the black level in the raw files, else the mean of the pixels without 0.01 % at each end")
    branches: tuple[BranchConfig, ...] = key((), Limit("a list of mappings with the keys of a branch"), PHYSICAL)
    assumed: tuple[str, ...] = key(
        (), limits.Names("a list of keys of this section or of a branch", ASSUMABLE), PHYSICAL)
    unsourced: tuple[str, ...] = key((), limits.Names("a list of keys of assumed", ASSUMABLE), PHYSICAL)
    provenance: tuple[ProvenanceConfig, ...] = key(
        (), Limit("a list of mappings with the keys numbers, iso, source and uncertainty"), PHYSICAL,
        decides_data=False)
    # fmt: on


@documented
@dataclass(frozen=True)
class SceneConfig(Group):
    """Describe the exposure of a scene; each value is a number or a distribution.

    Attributes
    ----------
    name
        name of the scene, recorded in each row
    light
        light of the scene, used by gains.light=scene
    """

    name: str = key("daylight", limits.NAME)
    iso: Any = key(100, limits.ISO, of="iso")
    exposure_s: Any = key(0.001, limits.EXPOSURE_S, of="exposure_s")
    temperature_c: Any = key(25, limits.TEMPERATURE_C, of="temperature_c")
    exposure_ratio: Any = key(1, limits.EXPOSURE_RATIO, of="exposure_ratio")
    ev: Any = key(0, limits.EV, of="ev")
    light: Any = key("daylight", limits.SCENE_LIGHT, null="not stated")


@documented
@dataclass(frozen=True)
@with_fields(SWITCH_FIELDS)
class EffectsConfig(EffectGroup):
    """Choose the sensor effects to simulate.

    Attributes
    ----------
    all
        auto omits effects that together stay within tolerance, for each image, and fixed patterns for each body
        and scene; on simulates all effects, off none; the switch of a named effect takes precedence
    tolerance
        largest ratio of the omitted effects to the masking noise, in each statistic
    """

    all: str = key("auto", limits.SWITCH)
    tolerance: float = key(0.1, Numbers(0, 10, open_low=True))


@documented
@dataclass(frozen=True)
class CleanConfig(Group):
    """Choose what clean frames contain.

    Attributes
    ----------
    includes_fixed_pattern
        whether clean frames contain the fixed-pattern noise of the camera body, like an average of many frames;
        they are then clipped like noisy frames
    """

    includes_fixed_pattern: bool = key(False, limits.BOOLEAN)


@documented
@dataclass(frozen=True)
class OutputConfig(Group):
    """Define the format of the dataset.

    Attributes
    ----------
    clean_dtype
        type of clean frames: float32 stores the unrounded mean, 0 at black and 1 at white, next to noisy frames
        in uint16
    pairs_per_shard
        sources per shard, the unit of work and of a retry
    targets
        more arrays for a training: linear_rgb is the scene before the mosaic
    frames
        store frames; false writes a manifest only, as the verb manifest does: ug.LivePairs makes the pairs of it
    """

    dtype: str = key("uint16", of="dtype")
    clean_dtype: Optional[str] = key(None, FIELDS["dtype"].limit, null="the type of dtype")
    layout: str = key("mosaic", of="layout")
    pairs_per_shard: int = key(8, Integers(1, 10**6))
    targets: tuple[str, ...] = key((), limits.TARGET_NAMES)
    frames: bool = key(True, limits.BOOLEAN)


@documented
@dataclass(frozen=True)
class ExecutorConfig(Group):
    """Choose what runs the workers; no byte of a dataset depends on it.

    Attributes
    ----------
    kind
        what runs the workers: local is processes of this machine, dask a Dask cluster (extra dask)
    address
        address of a running Dask scheduler, such as tcp://10.0.0.1:8786, used if kind is dask
    no_workers_s
        time without any Dask worker after which the run ends with exit code 5
    """

    # fmt: off
    kind: str = key("local", Choice("local", "dask"), decides_data=False)
    address: Optional[str] = key(
        None, limits.text("the address of a Dask scheduler"),
        null="start a scheduler and n_jobs workers on this machine", decides_data=False)
    no_workers_s: float = key(300.0, Numbers(0, 86400, open_low=True), unit="seconds", decides_data=False)
    # fmt: on


@documented
@dataclass(frozen=True)
class BodyConfig(Group):
    """Name the real camera whose options of camera, sensor and noise a run uses.

    Attributes
    ----------
    name
        name of the body
    missing
        groups for which no numbers of the body are published
    """

    name: Optional[str] = key(None, limits.NAME, null="no body", decides_data=False)
    missing: tuple[str, ...] = key((), limits.BODY_GROUPS, decides_data=False)


@documented
@dataclass(frozen=True)
class Config(Group):
    """The complete configuration of a run: a dataclass for each group, and the keys at the top level.

    Attributes
    ----------
    split
        shares of named parts of the dataset, such as {train: 0.8, val: 0.1, test: 0.1}; the column split names the
        part of each image, which depends on seed and file only: patches, noise levels and frames of a clip stay
        together
    out
        folder of the dataset, or its URL s3://, gs:// or az://; in a sweep, the local folder that contains the
        datasets
    n_jobs
        number of worker processes
    self_test
        what happens if this machine computes other values than the reference: stop ends the run, go_on
        continues and records the differences in dataset.json
    check_disk
        refuse to start if the free disk space is smaller than the estimated size of the dataset
    """

    source: SourceConfig = field(default_factory=SourceConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    gains: GainsConfig = field(default_factory=GainsConfig)
    isp: IspConfig = field(default_factory=IspConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    scene: SceneConfig = field(default_factory=SceneConfig)
    effects: EffectsConfig = field(default_factory=EffectsConfig)
    clean: CleanConfig = field(default_factory=CleanConfig)
    output: OutputConfig = field(default_factory=OutputConfig)
    executor: ExecutorConfig = field(default_factory=ExecutorConfig)
    body: BodyConfig = field(default_factory=BodyConfig)
    seed: int = key(0, of="seed")
    accuracy: str = key(EXACT, of="accuracy")
    split: Any = key(None, limits.SPLIT, null="no splits")
    out: str = key("ds", limits.OUTPUT_PLACE, decides_data=False)
    n_jobs: int = key(-1, Integers(1, 1024, other=-1, remark=" or -1 for one per core"), decides_data=False)
    self_test: str = key("stop", Choice("stop", "go_on"), decides_data=False)
    check_disk: bool = key(True, limits.BOOLEAN, decides_data=False)

    def __post_init__(self) -> None:
        """Write the names of splits as text and their shares as floats, because users may write 1 or 1.0."""
        super().__post_init__()
        if isinstance(self.split, dict):
            shares = {str(name): float(share) if is_number(share) else share for name, share in self.split.items()}
            object.__setattr__(self, "split", FrozenMapping(shares))

    def __repr__(self) -> str:
        names = {name: getattr(self, name).name for name in ("body", "camera", "noise", "scene")}
        settings = names | {"seed": self.seed, "source.root": self.source.root, "out": self.out}
        return f"Config({', '.join(f'{name}={value}' for name, value in settings.items() if value is not None)})"


GROUPS = groups_in(Config)
"""Dataclass of each config group, in the order of the config."""


def replaced(config: Config, changes: Mapping[str, Any]) -> Config:
    """Copy of a config with other values: ``{"source.root": "photos", "seed": 3}``."""
    for setting, value in changes.items():
        group, _, name = setting.rpartition(".")
        if group:
            name, value = group, replace(getattr(config, group), **{name: value})
        config = replace(config, **{name: value})
    return config
