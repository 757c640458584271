"""Run the verb calibrate: a noise profile from raw frames of a camera."""

from __future__ import annotations

import shlex
from functools import partial
from pathlib import Path

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.messages import print_result, report
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.paths import local_path
from unprocess_gen.reports.formatting import counted, short_number


def calibrate(call: Call) -> int:
    """Measure captures, and write a noise profile and the list of its estimates."""
    from unprocess_gen.calibration.calibrate import calibrate as measure
    from unprocess_gen.calibration.calibrate import check_outputs, keep_darks, write_profile
    from unprocess_gen.pipeline.progress import with_bar

    assert call.path is not None
    if call.words:
        raise ConfigError(f"calibrate: {call.words[0]}: unexpected; expected one folder of captures")
    folder = local_path(call.path, f"calibrate: {call.path} is in an object store; expected a local folder")
    to = Path(call.values["to"])
    darks = Path(call.values["keep_darks"]) if "keep_darks" in call.values else None
    check_outputs(to, darks)
    page = Path(call.values["report"]) if "report" in call.values else None
    if page is not None:
        from unprocess_gen.reports.calibration_page import check_page, write_page

        check_page(page)
    found = measure(folder, "quick" in call.values, partial(with_bar, unit="frame"))
    for note in found.notes:
        report(f"calibrate: {note.removeprefix('calibrate: ')}")
    write_profile(found, to, "two_parameter" in call.values)
    for result in found.isos:
        gain, read = result.gain.sensor, result.read
        print_result(
            f"ISO {result.iso:g}: {short_number(gain.value, 4)} DN per electron ({short_number(gain.low, 4)} to "
            f"{short_number(gain.high, 4)}), read noise {short_number(read.value, 4)} DN, row noise "
            f"{short_number(result.row.value, 3)} DN"
        )
    if page is not None:
        write_page(found, to.stem, f"gen-dataset calibrate {folder} --to {to}", page)
        print_result(f"drawn in {page}")
    if darks is not None:
        kept = ", ".join(map(str, keep_darks(found, darks)))
        print_result(f"darks kept for noise.dark_frames: {kept}")
    print_result(
        f"{to}: profile of {counted(len(found.isos), 'ISO')}; use it with {_usage(to)} scene.iso={found.isos[0].iso:g}"
    )
    return 0


def _usage(to: Path) -> str:
    """Return the settings with which a run uses the profile."""
    if to.absolute().parent.name != "noise":
        return f"noise={to.stem}, in a folder noise of --config-dir, and"
    return f"--config-dir {shlex.quote(str(to.parent.parent))} noise={to.stem}"
