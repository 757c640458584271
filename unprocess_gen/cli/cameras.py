"""Run the verbs that make options of a camera from its raw files: calibrate and camera."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.messages import print_results, report
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.reports.formatting import counted, short_number


def calibrate(call: Call) -> int:
    """Write a noise profile and the list of its estimates, from captures or from what DNG files state."""
    from unprocess_gen.calibration.profile import check_outputs
    from unprocess_gen.core.paths import local_path

    assert call.place is not None
    folder = local_path(call.place, f"calibrate: {call.place} is in an object store; expected a local folder")
    to, page = call.to, call.report
    if call.origin and page is not None:
        raise ConfigError(f"calibrate: --report {page}: draws measured frames, not tags; leave it out")
    check_outputs(to)
    isos = _state(folder, to) if call.origin else _measure(folder, to, page)
    print_results(f"{to}: profile of {counted(len(isos), 'ISO')}; use it with {_usage(to)} scene.iso={isos[0]:g}")
    return 0


def _state(folder: Path, to: Path) -> Sequence[float]:
    """Write the profile that NoiseProfile tags state; return its ISOs."""
    from unprocess_gen.calibration.profile import write_profile
    from unprocess_gen.calibration.stated_noise import read_stated_noise, stated_json, stated_yaml

    stated = read_stated_noise(folder)
    _report_notes(stated.notes)
    write_profile(to, stated_yaml(stated, to.stem), stated_json(stated))
    for iso, a, b, *_ in stated.isos:
        print_results(f"ISO {iso:g}: a {short_number(a[1], 4)} DN, b {short_number(b[1], 4)} DN² (stated)")
    return [result.iso for result in stated.isos]


def _measure(folder: Path, to: Path, page: Path | None) -> Sequence[float]:
    """Write the profile of flats and darks, and a page about them; return its ISOs."""
    from unprocess_gen.calibration.calibrate import calibrate
    from unprocess_gen.calibration.captures import read_captures
    from unprocess_gen.calibration.profile import AGAINST_ISO, estimates, estimates_json, measured_yaml, write_profile
    from unprocess_gen.pipeline.progress import with_bar

    if page is not None:
        from unprocess_gen.reports.calibration_page import check_page, write_page

        check_page(page)
    calibration = calibrate(read_captures(folder), partial(with_bar, unit="frame"))
    _report_notes(calibration.captures.notes)
    write_profile(to, measured_yaml(calibration, to.stem), estimates_json(estimates(calibration)))
    for result in calibration.isos:
        gain, read, row = (result[name] for name in AGAINST_ISO)
        print_results(
            f"ISO {result.iso:g}: {short_number(gain.value, 4)} DN per electron "
            f"({short_number(gain.low, 4)} to {short_number(gain.high, 4)}), "
            f"read noise {short_number(read.value, 4)} DN, row noise {short_number(row.value, 3)} DN"
        )
    if page is not None:
        write_page(calibration, to.stem, f"gen-dataset calibrate {folder} --to {to}", page)
        print_results(f"drawn in {page}")
    return calibration.captures.isos


def _report_notes(notes: Iterable[str]) -> None:
    for note in notes:
        report(f"calibrate: {note.removeprefix('calibrate: ')}")


def _usage(to: Path) -> str:
    """Return the settings with which a run uses the profile."""
    if to.parent.name != "noise":
        return f"noise={to.stem}, in a folder noise of --config-dir, and"
    return f"--config-dir {shlex.quote(str(to.parent.parent))} noise={to.stem}"


def camera(call: Call) -> int:
    """Write the options, and print what was read from which tag."""
    from unprocess_gen.core.files import machine_errors
    from unprocess_gen.core.paths import LocalPath, local_path
    from unprocess_gen.sources.raw.options import camera_options, check_options

    assert call.place is not None
    file = local_path(call.place, f"camera: {call.place} is in an object store; expected a local file")
    if not file.is_file():
        raise ConfigError(f"camera {file}: no such file; expected a raw file")
    to, sensor = call.to, call.sensor
    check_options(to, sensor)
    options, sources = camera_options(file, to.stem)
    paths = {"camera": to} | ({"sensor": sensor} if sensor else {})
    for group, path in paths.items():
        with machine_errors(path):
            LocalPath(path).write(options[group].encode(), str(path.parent))
    chosen = " ".join(f"{group}={path.stem}" for group, path in paths.items())
    print_results(*sources)
    folder = to.parent.parent
    if all(path.parent == folder / group for group, path in paths.items()):
        usage = f"--config-dir {shlex.quote(str(folder))} {chosen}"
    else:
        usage = f"{chosen}, in a folder {' and a folder '.join(paths)} of --config-dir"
    print_results(f"{to}: use it with {usage}")
    return 0
