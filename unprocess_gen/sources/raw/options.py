"""Write a camera option, and a sensor option, from what one raw file states."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from unprocess_gen.config.limits import CAMERA_LAWS, NAME
from unprocess_gen.config.schema import RawConfig
from unprocess_gen.core.errors import ConfigError, SourceError
from unprocess_gen.core.files import file_sha256, machine_errors
from unprocess_gen.core.output_paths import check_output_file
from unprocess_gen.core.raw_files import RAW_FILES
from unprocess_gen.simulation.reference import colour
from unprocess_gen.sources.raw.colour import temperature
from unprocess_gen.sources.raw.decode import decode_raw
from unprocess_gen.sources.raw.frames import XTRANS, camera_colours, file_levels, file_pattern, file_sensor
from unprocess_gen.sources.raw.metadata import RawMetadata, tags_of

MARK = "Written by gen-dataset camera"
"""Text in the first line of each file, by which an earlier one is known."""

SENSOR_LINES = """\
clip: sensor            # noisy frames: sensor: at 0 and 2^bits - 1; black: at black instead of 0; none: float32 only
saturated: auto
dark_offset: removed    # mean of the dark current: removed (as with optical-black pixels) or kept
units: image            # camera bodies with their own fixed patterns: image (one per image), or a number of bodies
"""


@dataclass(frozen=True, slots=True)
class CameraOptions:
    """Texts of the options, and sentences that state what was read from which tag.

    Attributes
    ----------
    camera, sensor : str
        Contents of the files.
    sources : tuple of str
        A sentence for each fact.
    """

    camera: str
    sensor: str
    sources: tuple[str, ...]


def check_options(to: Path, sensor: Path | None) -> None:
    """Refuse, before any work, names to which options cannot be written."""
    for option, path in (("--to", to), ("--sensor", sensor)):
        if path is None:
            continue
        if path.suffix != ".yaml" or not NAME.allows(path.stem):
            raise ConfigError(f"{option} {path}: is no name of an option; expected {NAME}, and .yaml")
        check_output_file(path, f"{option} {path}", "an earlier option of this verb", MARK.lower().encode())
    if to.stem in (*colour.CAMERAS, *CAMERA_LAWS.words):
        raise ConfigError(f"--to {to}: is the name of a built-in camera; choose another name")
    if sensor is not None and sensor.resolve() == to.resolve():
        raise ConfigError(f"--sensor {sensor}: is --to too; choose another name")


def camera_options(file: Path, name: str) -> CameraOptions:
    """Read a raw file and describe its camera as options; ``name`` names the camera.

    Raises ConfigError or MachineError.
    """
    if file.suffix.lower() not in RAW_FILES:
        raise ConfigError(f"camera {file}: is no raw file; expected a file as {', '.join(RAW_FILES)}")
    with machine_errors(file):
        content = file.read_bytes()
    try:
        frame, tags = decode_raw(content), tags_of(content)
        matrix, gains = camera_colours(frame.metadata)
        pattern = file_pattern(frame, RawConfig())
        black, white = file_levels(frame.metadata, pattern, RawConfig())
    except SourceError as error:
        raise ConfigError(f"camera {file}: {error.text}") from error
    if matrix is None:
        raise ConfigError(f"camera {file}: has no ColorMatrix, and LibRaw knows no matrix of its camera; expected one")
    if pattern == XTRANS:
        raise ConfigError(f"camera {file}: has an X-Trans mosaic, which no sensor option has; expected a Bayer mosaic")
    model = " ".join((frame.metadata.model or "a camera without a name").split())
    matrix_source, gains_source = _matrix_source(tags), _gains_source(tags, gains)
    sensor = file_sensor(pattern, black, white)
    origin = f"# {file.name}, SHA-256 {file_sha256(file)}.\n"
    entries = [f"{entry:.6g}" for entry in matrix]
    rows = ",\n          ".join(", ".join(entries[row : row + 3]) for row in (0, 3, 6))
    levels = _levels_source(tags, black, sensor.white_level_dn)
    return CameraOptions(
        f"# {model}: the matrix from XYZ to the camera. {MARK}.\n# Source: {matrix_source}.\n{origin}"
        f"# Gains of the frame: {gains_source}.\nname: {name}\nlaw: custom\nxyz2cam: [{rows}]\n",
        f"# {model}, {sensor.bits} bits. {MARK}.\n# Source: {levels}.\n{origin}bits: {sensor.bits}\n"
        f"black_level_dn: {sensor.black_level_dn}\nwhite_level_dn: {sensor.white_level_dn}\npattern: {pattern}\n"
        f"{SENSOR_LINES}",
        (
            f"matrix: {matrix_source}",
            f"gains: {gains_source}",
            f"levels: {levels}; {sensor.bits} bits hold them",
            f"pattern: {pattern} at the corner of the visible part "
            f"({'CFAPattern and ActiveArea' if tags.colour else 'LibRaw'})",
        ),
    )


def _matrix_source(tags: RawMetadata) -> str:
    """Describe the source of the matrix."""
    if tags.colour is None:
        return "table of LibRaw, for D65"
    named = [
        f"ColorMatrix{number} ({kelvin:g} K)" if kelvin else f"ColorMatrix{number}"
        for number, kelvin in enumerate(tags.colour.lights_k, start=1)
    ]
    others = [
        f"CameraCalibration{number}" for number in (1, 2) if tags.colour.calibrations[number - 1] != colour.IDENTITY
    ]
    others += ["AnalogBalance"] if tags.colour.balance != (1.0, 1.0, 1.0) else []
    x, y = white = tags.colour.white()
    stated = "AsShotWhiteXY" if tags.colour.white_xy else "AsShotNeutral" if tags.colour.neutral else "no tag, so D50"
    where = f"the white point x {x:.4f}, y {y:.4f} ({temperature(white):.0f} K; {stated})"
    third = "; ColorMatrix3, for a third light, is not used" if tags.colour.has_third else ""
    return f"{', '.join([*named, *others])} at {where}{third}"


def _gains_source(tags: RawMetadata, gains: tuple[float, float] | None) -> str:
    """Describe the gains and their source."""
    if gains is None:
        return "not stated"
    stated = tags.colour is not None and tags.colour.gains() is not None
    tag = ("AsShotNeutral" if tags.colour and tags.colour.neutral else "AsShotWhiteXY") if stated else "LibRaw"
    red, blue = (f"{gain:.6g}" for gain in gains)
    return f"red {red}, blue {blue} ({tag}); gains=fixed gains.red={red} gains.blue={blue}"


def _levels_source(tags: RawMetadata, black: tuple[float, ...], white: int) -> str:
    """Describe the levels and their source."""
    levels = f"{black[0]:g}" if len(set(black)) == 1 else f"{', '.join(f'{level:g}' for level in black)} (mean)"
    black_tag = "black level (LibRaw)" if tags.black_dn is None else "BlackLevel"
    white_tag = "white level (LibRaw)" if tags.white_dn is None else "WhiteLevel"
    return f"{black_tag} {levels}, {white_tag} {white}"
