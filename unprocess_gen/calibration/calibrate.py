"""Calibrate a camera: read its captures, check and measure them ISO by ISO, and write a noise profile."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from unprocess_gen.calibration.body import measure_body, without_dark_current
from unprocess_gen.calibration.captures import CaptureSet, read_captures
from unprocess_gen.calibration.gain import Estimate
from unprocess_gen.calibration.known_gain import known_gain
from unprocess_gen.calibration.measure import Watch, measure_iso
from unprocess_gen.calibration.profile import (
    MARK,
    Calibration,
    KnownGain,
    estimates,
    estimates_json,
    measured_yaml,
    unknown_numbers,
)
from unprocess_gen.config.limits import NAME
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.files import machine_errors
from unprocess_gen.core.libraries import require
from unprocess_gen.core.output_paths import check_output_file, check_output_folder


def check_outputs(to: Path, keep_darks: Path | None = None) -> None:
    """Refuse, before any work, names to which a profile cannot be written."""
    if to.suffix != ".yaml" or not NAME.allows(to.stem):
        raise ConfigError(f"--to {to}: is no name of a profile; expected {NAME}, and .yaml")
    check_output_file(to, f"--to {to}", "an earlier profile of this verb", MARK.lower().encode())
    to_json = to.with_suffix(".json")
    check_output_file(to_json, f"--to {to}: {to_json.name}", "an earlier list of estimates", b'{"name": "')
    if keep_darks is not None:
        check_output_folder(keep_darks, f"--keep-darks {keep_darks}")
    require("scipy", "calibrate: fits need scipy", "calibrate")


def calibrate(folder: Path, quick: bool = False, watch: Watch = lambda frames: frames) -> Calibration:
    """Measure the captures of a folder; ``watch`` shows progress.

    Raises ConfigError or MachineError.
    """
    return measure_all(read_captures(folder), quick, watch, None)


def calibrate_darks(
    folder: Path, profile: str | None, stated: str | None, watch: Watch = lambda frames: frames
) -> Calibration:
    """Measure the darks of a folder; the gain is stated, or taken from a profile or from NoiseProfile tags.

    Raises ConfigError or MachineError.
    """
    captures = read_captures(folder, "dark")
    darks = [capture for capture in captures.captures if capture.kind == "dark"]
    if flats := len(captures.captures) - len(darks):
        captures.notes.append(f"{folder}: --from darks leaves out {flats} flats")
    captures = captures._replace(captures=darks)
    return measure_all(captures, False, watch, known_gain(captures, profile, stated))


def measure_all(captures: CaptureSet, quick: bool, watch: Watch, known: KnownGain | None) -> Calibration:
    """Measure each ISO, and what all ISOs show together; ISOs with a known gain are measured by darks alone."""
    gains = dict(known.by_iso) if known else {}
    for iso, gain in gains.items():
        if not gain.low > 0:  # not known: as if exact, in electrons
            gains[iso] = Estimate(gain.value, gain.value, gain.value)
    results = [measure_iso(captures, iso, quick, watch, gains.get(iso)) for iso in captures.isos]
    body = measure_body(results, captures.sensor)
    results = [without_dark_current(result, body) for result in results]
    calibration = Calibration(captures, results, body, [], known)
    notes = [*captures.notes, *(note for result in results for note in result.notes), *unknown_numbers(calibration)]
    return replace(calibration, notes=_merged(notes))


def _merged(notes: Iterable[str]) -> list[str]:
    """Return notes once each, without the names of places that differ only in the frames."""
    seen: dict[str, tuple[str, int]] = {}
    for note in notes:
        kind = re.sub(r"[0-9.]+", "#", note.rpartition("): ")[2])
        first, count = seen.get(kind, (note, 0))
        seen[kind] = first, count + 1
    return [note + (f" (and {count - 1} more like it)" if count > 1 else "") for note, count in seen.values()]


def write_profile(calibration: Calibration, to: Path, two_parameter: bool = False) -> None:
    """Write the profile and, with the suffix .json, the list of all estimates."""
    write_files(to, measured_yaml(calibration, to.stem, two_parameter), estimates_json(estimates(calibration)))


def write_files(to: Path, profile: str, listed: str) -> None:
    """Write the text of a profile, and of a list of estimates next to it."""
    for path, text in {to: profile, to.with_suffix(".json"): listed}.items():
        with machine_errors(path):
            path.write_text(text, encoding="utf-8")


def keep_darks(calibration: Calibration, folder: Path) -> list[Path]:
    """Write the darks from which read noise was measured as NPY, a folder for each ISO, for ``noise.dark_frames``."""
    folders = []
    for result in calibration.isos:
        place = folder / f"iso{result.iso:g}"
        with machine_errors(place):
            place.mkdir(parents=True, exist_ok=True)
            for number, frame in enumerate(result.dark.frames):
                np.save(place / f"{number:03d}_{frame.path.stem}.npy", frame.pixels())
        folders.append(place)
    return folders
