"""Write a camera option, and a sensor option, from what one raw file states."""

from __future__ import annotations

from pathlib import Path

from unprocess_gen.config.limits import CAMERA_LAWS, NAME
from unprocess_gen.config.schema import RawConfig
from unprocess_gen.core.errors import ConfigError, refused_files
from unprocess_gen.core.files import file_sha256, machine_errors
from unprocess_gen.core.output_paths import check_output_file
from unprocess_gen.core.raw_files import RAW_FILES
from unprocess_gen.simulation.reference import colour
from unprocess_gen.sources.raw.colour import temperature
from unprocess_gen.sources.raw.decode import decode_raw
from unprocess_gen.sources.raw.frames import camera_colours, file_sensor
from unprocess_gen.sources.raw.tags import RawMetadata, tags_of

MARK = "Written by gen-dataset camera"
"""Text in the first line of each file, by which an earlier one is known."""


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


def camera_options(file: Path, name: str) -> tuple[dict[str, str], tuple[str, ...]]:
    """Text of the option of each group, and the source of each fact; raises ConfigError or MachineError.

    ``name`` names the camera.
    """
    if file.suffix.lower() not in RAW_FILES:
        raise ConfigError(f"camera {file}: is no raw file; expected a file as {', '.join(RAW_FILES)}")
    with machine_errors(file), refused_files(f"camera {file}:"):
        content = file.read_bytes()
        frame, tags = decode_raw(content, file.suffix), tags_of(content, check=False)
        matrix, gains = camera_colours(frame.metadata)
        sensor, black, _ = file_sensor(frame, RawConfig())
    if matrix is None:
        raise ConfigError(f"camera {file}: has no ColorMatrix, and LibRaw knows no matrix of its camera; expected one")
    levels = ", ".join(f"{level:g}" for level in dict.fromkeys(black))
    black_tag, white_tag = ("LibRaw" if fact is None else "tag" for fact in (tags.black_dn, tags.white_dn))
    facts = (
        f"matrix: {_matrix_source(tags)}",
        f"gains: {_gains_source(tags, gains)}",
        f"levels: black {levels} ({black_tag}), white {sensor.white_level_dn} ({white_tag}); mean of black",
        f"pattern: {sensor.pattern} at the corner of the visible part",
        *(f"note: the file {note}" for note in frame.metadata.notes),
    )
    model = " ".join((frame.metadata.model or "a camera without a name").split())
    head = f"# {model}. {MARK}.\n# {file.name}, SHA-256 {file_sha256(file)}.\n# " + "\n# ".join(facts)
    entries = ", ".join(f"{entry:.6g}" for entry in matrix)
    levels = f"black_level_dn: {sensor.black_level_dn}\nwhite_level_dn: {sensor.white_level_dn}"
    options = {
        "camera": f"{head}\nname: {name}\nlaw: custom\nxyz2cam: [{entries}]\n",
        "sensor": f"{head}\nbits: {sensor.bits}\n{levels}\npattern: {sensor.pattern}\nsaturated: auto\n",
    }
    return options, facts


def _matrix_source(tags: RawMetadata) -> str:
    if tags.colour is None:
        return "table of LibRaw, for D65"
    x, y = white = tags.colour.white()
    names = " and ".join(f"ColorMatrix{number}" for number, _ in enumerate(tags.colour.matrices, start=1))
    third = "; ColorMatrix3, for a third light, is not used" if tags.colour.has_third else ""
    return f"{names} at the white point x {x:.4f}, y {y:.4f} ({temperature(white):.0f} K){third}"


def _gains_source(tags: RawMetadata, gains: tuple[float, float] | None) -> str:
    if gains is None:
        return "not stated"
    source = "LibRaw" if tags.colour is None or tags.colour.gains() is None else "white point of the DNG"
    return f"gains=fixed gains.red={gains[0]:.6g} gains.blue={gains[1]:.6g} ({source})"
