"""Run the verb explore: a page in the browser that shows what settings do."""

from __future__ import annotations

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.hydra_app import check_overrides, option_folders
from unprocess_gen.cli.messages import print_results
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.libraries import require
from unprocess_gen.core.paths import any_path

CHOOSING = {"--config-dir", "--config-name", "--config-path"}
"""Flags of Hydra that choose where options are; the others make no sense for a page."""


def explore(call: Call) -> int:
    """Serve a page on this machine until it is interrupted."""
    for library in ("bokeh", "jinja2"):
        require(library, f"explore: the page needs {library}", "explore")
    if refused := sorted(call.hydra.keys() - CHOOSING):
        raise ConfigError(f"explore: {refused[0]}: a page shows one config; expected settings; leave it out")
    check_overrides(call.overrides)
    from unprocess_gen.reports.explorer import server
    from unprocess_gen.reports.explorer.opening import open_place

    place = call.path
    if place is not None and not any_path(place).is_listed():
        raise ConfigError(f"explore: {place}: no such file or folder; expected a photograph, a folder or a dataset")
    if place is not None and place.is_dir() and (place / "sweep.csv").is_file():
        raise ConfigError(f"explore: {place}: is the folder of a sweep; expected one of its datasets")
    folders = option_folders(call.hydra)
    choices = open_place(place, call.values.get("keys"), call.overrides, call.hydra_arguments, folders)
    server.serve(choices, call.values.get("port", 0), "no_browser" not in call.values, _print_address)
    return 0


def _print_address(address: str) -> None:
    print_results(f"{address} shows the page on this machine; stop with Ctrl-C")
