"""Run the verbs that generate a dataset: generate, manifest and again."""

from __future__ import annotations

from typing import TYPE_CHECKING

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.exit_codes import DONE, TOO_MANY_FAILED
from unprocess_gen.cli.hydra_app import compose
from unprocess_gen.cli.messages import print_results
from unprocess_gen.cli.places import dark_frames_of, dataset_folder, given_root
from unprocess_gen.config.option_files import group_options
from unprocess_gen.core.paths import any_path

if TYPE_CHECKING:
    from unprocess_gen.config.schema import Config, ExecutorConfig
    from unprocess_gen.pipeline.generate import Summary


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
    changes |= {"output.frames": True} if "output.frames" in call.values else {}
    changes |= {"source.max_failed": call.values["source.max_failed"]} if "source.max_failed" in call.values else {}
    changes |= {"noise.dark_frames": dark_frames_of(folder / "manifest.csv", call)}
    config = recorded_config(folder, given_root(call), changes)
    check_sources(folder, config)
    code, _, lines = generate_dataset(config)
    print_results(*lines)
    print_results(compare(folder, any_path(config.out)))
    return code


def _executor(call: Call) -> ExecutorConfig:
    """Return the settings of the executor that a call names, by default of ``executor=local``."""
    from dataclasses import replace

    from unprocess_gen.config.serialization import read_option
    from unprocess_gen.config.values import one_of

    name = call.values.get("executor", "local")
    one_of("executor", name, tuple(group_options("executor")))
    executor: ExecutorConfig = read_option("executor", name)
    return replace(executor, address=call.values.get("executor.address"))
