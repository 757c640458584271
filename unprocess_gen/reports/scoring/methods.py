"""Load restoration methods: those of ``manifests/methods.py`` by name, and functions in modules and files of users."""

from __future__ import annotations

import functools
import importlib
import inspect
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.libraries import require
from unprocess_gen.core.suggestions import did_you_mean
from unprocess_gen.reports.builds import manifests_dir

METHODS = ("noisy", "gaussian", "non_local_means")
"""Methods that have a name."""


@functools.cache
def load_method(name: str, folder: str) -> Callable[[Any, Any], Any]:
    """Find one of `METHODS`, ``module:function`` or ``path/file.py:function``, from a folder; else ConfigError."""
    if name == "non_local_means":
        require("skimage", f"score: --method {name}: needs scikit-image", "photos")
    place, _, function = f"{manifests_dir() / 'methods.py'}:{name}".rpartition(":")
    if name not in METHODS:
        place, _, function = name.rpartition(":")
    problem, expected = "no such method", f"{', '.join(METHODS)}, module:function or FILE.py:function"
    try:
        if place:
            expected, file = f"a function {function}(noisy, row) in {place}", Path(folder, place).expanduser()
            sys.path.insert(0, str(file.parent))  # a module may be in the folder, and a file imports its neighbours
            is_file = file.suffix == ".py"
            method = (runpy.run_path(str(file)) if is_file else vars(importlib.import_module(place)))[function]
            inspect.signature(method).bind(None, None)
            return method  # type: ignore[no-any-return]
    except (Exception, SystemExit) as error:
        problem = f"{type(error).__name__}: {error_in_one_line(error)}"
    raise ConfigError(f"score: --method {name}: {problem}; expected {expected}{did_you_mean(name, METHODS)}")
