"""Run the verbs that make options of a camera from its raw files: calibrate and camera."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

from unprocess_gen.cli.arguments import Call, Operand, flag, local, switch, verb
from unprocess_gen.cli.messages import print_results, report
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.reports.formatting import counted, short_number


@verb(
    Operand("CAPTURES", "the folder of the raw frames; of DNG files or of pairs of pictures with --from or --srgb"),
    flag("--to", "FILE", "write the profile to FILE.yaml, and estimates to FILE.json", local, required=True),
    flag("--report", "PAGE", "draw curves, histograms and maps in PAGE (HTML)", local),
    flag("--from", "noise_profile", "read tags of DNG files", dest="origin", choices=("noise_profile",)),
    switch(
        "--srgb", "fit CameraNoise to noisy and clean sRGB pictures: pairs.csv, or names as x_noisy.png, x_clean.png"
    ),
)
def calibrate(call: Call) -> int:
    """Measure the noise of a camera from raw frames or sRGB pairs, or read it from DNG files; write a noise profile."""
    from unprocess_gen.calibration.profile import check_outputs

    folder, to, page = call.local_place("folder"), call.to, call.report
    if bool(call.origin) + call.srgb + (page is not None) > 1:
        raise ConfigError("calibrate: --from, --srgb, --report: exclude each other; expected one of them, or none")
    check_outputs(to)
    if call.srgb:
        return _fit(folder, to)
    isos = _state(folder, to) if call.origin else _measure(folder, to, page)
    print_results(f"{to}: profile of {counted(len(isos), 'ISO')}; use it with {_usage(noise=to)} scene.iso={isos[0]:g}")
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


def _fit(folder: Path, to: Path) -> int:
    """Write the profile of pairs of pictures."""
    from unprocess_gen.calibration.picture_pairs import read_picture_pairs
    from unprocess_gen.calibration.profile import write_profile
    from unprocess_gen.camera_fit import fit_json, fit_yaml
    from unprocess_gen.camera_noise import CameraNoise

    pairs, count, sha256 = read_picture_pairs(folder)
    fit = CameraNoise.fit(pairs)
    source = f"{counted(count, 'pair')} of pictures, SHA-256 of the list of their SHA-256 {sha256}"
    write_profile(to, fit_yaml(fit, to.stem, source), fit_json(fit))
    print_results(fit, f"{to}: use it with {_usage(noise=to)} {fit.settings}; in CameraNoise with {fit.keywords} too")
    return 0


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


def _usage(**options: Path) -> str:
    """Settings with which a run uses the option files of groups; others may follow."""
    chosen = " ".join(f"{group}={path.stem}" for group, path in options.items())
    folders = {path.parent.parent if path.parent.name == group else None for group, path in options.items()}
    if len(folders) > 1 or None in folders:
        return f"{chosen}, in a folder {' and a folder '.join(options)} of --config-dir, and"
    return f"--config-dir {shlex.quote(str(folders.pop()))} {chosen}"


@verb(
    Operand("FILE", "the raw file: a DNG, or another one that LibRaw reads"),
    flag("--to", "CAMERA", "write the matrix of the camera to CAMERA.yaml", local, required=True),
    flag("--sensor", "SENSOR", "write pattern, bits and levels to SENSOR.yaml", local),
)
def camera(call: Call) -> int:
    """Write a camera option, and a sensor option, from one raw file."""
    from unprocess_gen.core.files import machine_errors
    from unprocess_gen.core.paths import LocalPath
    from unprocess_gen.sources.raw.options import camera_options, check_options

    file, to, sensor = call.local_place("file"), call.to, call.sensor
    if not file.is_file():
        raise ConfigError(f"camera {file}: no such file; expected a raw file")
    check_options(to, sensor)
    options, sources = camera_options(file, to.stem)
    paths = {"camera": to} | ({"sensor": sensor} if sensor else {})
    for group, path in paths.items():
        with machine_errors(path):
            LocalPath(path).write(options[group].encode(), str(path.parent))
    print_results(*sources, f"{to}: use it with {_usage(**paths).removesuffix(', and')}")
    return 0
