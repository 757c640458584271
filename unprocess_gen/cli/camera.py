"""Run the verb camera: a camera option, and a sensor option, from one raw file."""

from __future__ import annotations

import shlex
from pathlib import Path

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.messages import print_result, print_results
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.files import machine_errors
from unprocess_gen.core.paths import LocalPath, local_path


def camera(call: Call) -> int:
    """Write the options, and print what was read from which tag."""
    from unprocess_gen.sources.raw.options import camera_options, check_options

    assert call.path is not None
    file = local_path(call.path, f"camera: {call.path} is in an object store; expected a local file")
    if not file.is_file():
        raise ConfigError(f"camera {file}: no such file; expected a raw file")
    to, sensor = Path(call.values["to"]), Path(call.values["sensor"]) if "sensor" in call.values else None
    check_options(to, sensor)
    options, chosen = camera_options(file, to.stem), ""
    for path, group, text in ((to, "camera", options.camera), (sensor, "sensor", options.sensor)):
        if path is not None:
            with machine_errors(path):
                LocalPath(path).write(text.encode(), str(path.parent))
            chosen += f" {group}={path.stem}"
    print_results(options.sources)
    where = f"--config-dir {shlex.quote(str(to.parent.parent))}"
    if to.absolute().parent.name != "camera":
        where = "the file in a folder camera of --config-dir, and"
    print_result(f"{to}: use it with {where}{chosen}")
    return 0
