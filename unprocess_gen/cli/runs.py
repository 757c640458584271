"""Run the verbs that generate a dataset: generate, manifest, build and again."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.exit_codes import DONE, TOO_MANY_FAILED
from unprocess_gen.cli.hydra_app import compose
from unprocess_gen.cli.messages import print_result, print_results, report
from unprocess_gen.cli.places import dark_frames_of, dataset_folder, given_root
from unprocess_gen.config.option_files import build_names, group_options, manifests_dir
from unprocess_gen.core.errors import ConfigError, DamageError
from unprocess_gen.core.paths import any_path

if TYPE_CHECKING:
    from unprocess_gen.config.schema import Config, ExecutorConfig
    from unprocess_gen.pipeline.generate import Summary


SHOWN = 20
"""Differences of a build that are named."""


def generate(call: Call) -> int:
    """Generate a dataset, or one for each combination of a sweep."""
    return compose(call, generate_dataset, sweep_csv=True)


def manifest(call: Call) -> int:
    """Write the manifest of a dataset, or one for each combination of a sweep, without making frames."""
    return compose(call, _generate_manifest, sweep_csv=True)


def _generate_manifest(config: Config, label: str = "") -> tuple[int, Summary, list[str]]:
    from unprocess_gen.config.schema import replaced

    return generate_dataset(replaced(config, {"output.frames": False}), label)


def generate_dataset(config: Config, label: str = "") -> tuple[int, Summary, list[str]]:
    """Generate one dataset; return the exit code, what was generated, and the lines to print."""
    from unprocess_gen.pipeline.generate import generate
    from unprocess_gen.sources.listing import unmatched_sentence

    summary = generate(config, label)
    lines = [summary.sentence(config.source.max_failed)]
    if summary.unmatched:
        lines.append(unmatched_sentence(summary.unmatched))
    too_many = sum(summary.failed.values()) > config.source.max_failed
    return TOO_MANY_FAILED if too_many else DONE, summary, lines


def again(call: Call) -> int:
    """Generate a dataset again from its ``config.yaml``, and compare the manifests."""
    from unprocess_gen.pipeline.again import check_sources, compare, recorded_config

    folder = dataset_folder(call)
    changes = {"out": call.values["out"], "executor": _executor(call)}
    changes |= {"n_jobs": call.values["n_jobs"]} if "n_jobs" in call.values else {}
    changes |= {"output.frames": call.values["frames"] == "true"} if "frames" in call.values else {}
    changes |= {"source.max_failed": call.values["max_failed"]} if "max_failed" in call.values else {}
    given = {name for name in ("dark_frames", "dark_shading") if name in call.values}
    dark = dark_frames_of(folder / "manifest.csv", call)
    config = recorded_config(folder, given_root(call), dark, given, changes)
    check_sources(folder, config)
    code, _, lines = generate_dataset(config)
    print_results(lines)
    print_result(compare(folder, any_path(config.out)))
    return code


def build(call: Call) -> int:
    """Make a benchmark build and compare it, or list the builds."""
    from unprocess_gen.config.values import one_of
    from unprocess_gen.pipeline.builds import make_build, purpose

    names = build_names()
    if "list" in call.values:
        if call.words or "to" in call.values:
            raise ConfigError("build: --list: takes neither a name nor --to; remove it")
        print_results(f"{name:<26}{purpose(name)}" for name in names)
        return DONE
    if len(call.words) != 1 or "to" not in call.values:
        raise ConfigError(
            f"build: expected one of {', '.join(names)}, and --to FOLDER; gen-dataset build --list explains them"
        )
    one_of("build", call.words[0], tuple(names))
    name, to = call.words[0], call.values["to"]
    damages = make_build(name, to, call.values.get("n_jobs", -1))
    for damage in damages[:SHOWN]:
        report(f"{to}: {damage}", logging.ERROR)
    if damages:
        rest = f"; {len(damages) - SHOWN} more differences" if len(damages) > SHOWN else ""
        report(f"{to}: differs from the build {name}{rest}", logging.ERROR)
        return DamageError.exit_code
    print_result(f"{to} is the build {name}, bit for bit; card: {manifests_dir() / f'{name}.md'}")
    return DONE


def _executor(call: Call) -> ExecutorConfig:
    """Return the settings of the executor that a call names, those of ``executor=local`` without one."""
    from dataclasses import replace

    from unprocess_gen.config.serialization import read_option
    from unprocess_gen.config.values import one_of

    name = call.values.get("executor", "local")
    one_of("executor", name, tuple(group_options("executor")))
    executor: ExecutorConfig = read_option("executor", name)
    return replace(executor, address=call.values.get("address"))
