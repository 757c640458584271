"""Run the verb explore: a page in the browser that shows what settings do."""

from __future__ import annotations

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.jobs import option_folders
from unprocess_gen.cli.messages import print_results
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.libraries import require


def explore(call: Call) -> int:
    """Serve a page on this machine until it is interrupted."""
    for library in ("bokeh", "jinja2"):
        require(library, f"explore: the page needs {library}", "explore")
    if call.multirun or call.cfg or call.resolve:
        name = "--multirun" if call.multirun else "--cfg" if call.cfg else "--resolve"
        raise ConfigError(f"explore: {name}: a page shows one config; expected settings; leave it out")
    from unprocess_gen.core.paths import any_path
    from unprocess_gen.reports.explorer import server
    from unprocess_gen.reports.explorer.exploration import open_place

    place = call.place
    if place is not None and not any_path(place).is_listed():
        raise ConfigError(f"explore: {place}: no such file or folder; expected a photograph, a folder or a dataset")
    if place is not None and place.is_dir() and (place / "sweep.csv").is_file():
        raise ConfigError(f"explore: {place}: is the folder of a sweep; expected one of its datasets")
    given = {"--config-dir": call.config_dir, "--config-name": call.config_name, "--config-path": call.config_path}
    flags = [word for name, value in given.items() if value is not None for word in (name, str(value))]
    choices = open_place(place, call.keys, call.overrides, flags, option_folders(call))
    server.serve(choices, call.port, not call.no_browser, _print_address)
    return 0


def _print_address(address: str) -> None:
    print_results(f"{address} shows the page on this machine; stop with Ctrl-C")
