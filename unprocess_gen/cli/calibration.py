"""Run the verb calibrate: a noise profile from raw frames of a camera."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.messages import print_result, report
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.paths import local_path
from unprocess_gen.reports.formatting import counted, short_number

STATED, DARKS = "noise_profile", "darks"
"""What a profile is made from, if not from flats and darks."""
NOT_FOR = {
    "noise_profile": ("report", "quick", "keep_darks", "two_parameter", "gain", "dn_per_e"),
    "darks": ("report", "quick"),
    None: ("gain", "dn_per_e"),
}
"""Arguments that a form does not take."""


def calibrate(call: Call) -> int:
    """Write a noise profile and the list of its estimates, from captures or from what DNG files state."""
    from unprocess_gen.calibration.calibrate import check_outputs

    assert call.path is not None
    if call.words:
        raise ConfigError(f"calibrate: {call.words[0]}: unexpected; expected one folder of captures")
    folder = local_path(call.path, f"calibrate: {call.path} is in an object store; expected a local folder")
    form = call.values.get("from")
    for name in NOT_FOR[form]:
        if name in call.values:
            of = f"--from {form}" if form else "captures with flats; they show the gain"
            raise ConfigError(f"calibrate: --{name.replace('_', '-')}: not for {of}; remove it")
    to = Path(call.values["to"])
    check_outputs(to, Path(call.values["keep_darks"]) if "keep_darks" in call.values else None)
    if form == STATED:
        return _stated(folder, to)
    return _measured(folder, to, call)


def _stated(folder: Path, to: Path) -> int:
    """Write the profile that NoiseProfile tags state."""
    from unprocess_gen.calibration.calibrate import write_files
    from unprocess_gen.calibration.stated_noise import read_stated_noise, stated_json, stated_yaml

    stated = read_stated_noise(folder)
    _report_notes(stated.notes)
    write_files(to, stated_yaml(stated, to.stem), stated_json(stated))
    for iso, a, b, *_ in stated.isos:
        print_result(f"ISO {iso:g}: a {short_number(a[1], 4)} DN, b {short_number(b[1], 4)} DN² (stated)")
    _report_profile(to, [result.iso for result in stated.isos])
    return 0


def _measured(folder: Path, to: Path, call: Call) -> int:
    """Write the profile of flats and darks, or of darks alone."""
    from unprocess_gen.calibration import calibrate as measure
    from unprocess_gen.pipeline.progress import with_bar

    page = Path(call.values["report"]) if "report" in call.values else None
    if page is not None:
        from unprocess_gen.reports.calibration_page import check_page, write_page

        check_page(page)
    watch = partial(with_bar, unit="frame")
    if call.values.get("from") == DARKS:
        calibration = measure.calibrate_darks(folder, call.values.get("gain"), call.values.get("dn_per_e"), watch)
    else:
        calibration = measure.calibrate(folder, "quick" in call.values, watch)
    _report_notes(calibration.notes)
    measure.write_profile(calibration, to, "two_parameter" in call.values)
    for result in calibration.isos:
        gain, read, row = (result[name] for name in ("dn_per_e", "read_std_dn", "row_std_dn"))
        interval = f"{short_number(gain.low, 4)} to {short_number(gain.high, 4)}"
        print_result(
            f"ISO {result.iso:g}: {short_number(gain.value, 4)} DN per electron "
            f"({calibration.known.source if calibration.known else interval}), "
            f"read noise {short_number(read.value, 4)} DN, row noise {short_number(row.value, 3)} DN"
        )
    if page is not None:
        write_page(calibration, to.stem, f"gen-dataset calibrate {folder} --to {to}", page)
        print_result(f"drawn in {page}")
    if "keep_darks" in call.values:
        kept = ", ".join(map(str, measure.keep_darks(calibration, Path(call.values["keep_darks"]))))
        print_result(f"darks kept for noise.dark_frames: {kept}")
    _report_profile(to, [result.iso for result in calibration.isos])
    return 0


def _report_notes(notes: Iterable[str]) -> None:
    for note in notes:
        report(f"calibrate: {note.removeprefix('calibrate: ')}")


def _report_profile(to: Path, isos: Sequence[float]) -> None:
    """Report the profile, and the settings with which a run uses it."""
    print_result(f"{to}: profile of {counted(len(isos), 'ISO')}; use it with {_usage(to)} scene.iso={isos[0]:g}")


def _usage(to: Path) -> str:
    """Return the settings with which a run uses the profile."""
    if to.absolute().parent.name != "noise":
        return f"noise={to.stem}, in a folder noise of --config-dir, and"
    return f"--config-dir {shlex.quote(str(to.parent.parent))} noise={to.stem}"
