"""Run the verb camera: a camera option, and a sensor option, from one raw file."""

from __future__ import annotations

import shlex

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.messages import print_results
from unprocess_gen.core.errors import ConfigError


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
