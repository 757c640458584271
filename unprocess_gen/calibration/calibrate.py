"""Calibrate a camera: read its captures, check and measure them ISO by ISO, and write a noise profile."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from unprocess_gen.calibration.body import measure_body
from unprocess_gen.calibration.captures import CaptureSet, common, read_captures
from unprocess_gen.calibration.gain import Estimate
from unprocess_gen.calibration.measure import Watch, measure_iso
from unprocess_gen.calibration.profile import (
    MARK,
    Calibration,
    unknown_numbers,
)
from unprocess_gen.config.limits import NAME
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.files import machine_errors
from unprocess_gen.core.libraries import require
from unprocess_gen.core.output_paths import check_output_file


def check_outputs(to: Path) -> None:
    """Refuse, before any work, names to which a profile cannot be written."""
    if to.suffix != ".yaml" or not NAME.allows(to.stem):
        raise ConfigError(f"--to {to}: is no name of a profile; expected {NAME}, and .yaml")
    check_output_file(to, f"--to {to}", "an earlier profile of this verb", MARK.lower().encode())
    to_json = to.with_suffix(".json")
    check_output_file(to_json, f"--to {to}: {to_json.name}", "an earlier list of estimates", b'{"name": "')
    require("scipy", "calibrate: fits need scipy", "calibrate")


def calibrate(folder: Path, watch: Watch = lambda frames: frames) -> Calibration:
    """Measure the captures of a folder; ``watch`` shows progress.

    Raises ConfigError or MachineError.
    """
    return measure_all(read_captures(folder), watch)


def measure_all(captures: CaptureSet, watch: Watch, gains: Mapping[float, Estimate] | None = None) -> Calibration:
    """Measure each ISO, and what all ISOs show together; of ISOs whose gain is given, darks alone are measured."""
    results = [measure_iso(captures, iso, watch, (gains or {}).get(iso)) for iso in captures.isos]
    body = measure_body(results, captures.sensor)
    darks = {capture.path: capture for capture in captures.captures if capture.kind == "dark"}
    notes = [*captures.notes, *(note for result in results for note in result.notes), *unknown_numbers(body)]
    return Calibration(captures, results, body, common(darks, "temperature_c"), notes)


def write_files(to: Path, profile: str, listed: str) -> None:
    """Write the text of a profile, and of a list of estimates next to it."""
    for path, text in {to: profile, to.with_suffix(".json"): listed}.items():
        with machine_errors(path):
            path.write_text(text, encoding="utf-8")
