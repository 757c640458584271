"""Run the verbs that generate a dataset: generate, manifest and again."""

from __future__ import annotations

from collections.abc import Mapping
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.exit_codes import DONE, TOO_MANY_FAILED
from unprocess_gen.cli.jobs import Job, composed_jobs
from unprocess_gen.cli.messages import print_results
from unprocess_gen.cli.places import dark_frames_of, dataset_folder, given_root
from unprocess_gen.cli.sweep import result_cells, worst, write_row
from unprocess_gen.core.errors import ConfigError

if TYPE_CHECKING:
    from unprocess_gen.config.schema import Config
    from unprocess_gen.pipeline.generate import Summary


def generate(call: Call, changes: Mapping[str, Any] | None = None) -> int:
    """Generate a dataset, or one for each combination of a sweep; ``changes`` are settings that differ."""
    from unprocess_gen.config.schema import replaced
    from unprocess_gen.pipeline import generate as pipeline

    jobs = composed_jobs(call)
    for job in jobs:
        with job:
            job.result = pipeline.generate(replaced(job.config, changes or {}), job.label)
        finish(job)
    return worst(job.code for job in jobs)


def manifest(call: Call) -> int:
    """Write the manifest of a dataset, or one for each combination of a sweep, without making frames."""
    return generate(call, {"output.frames": False})


def finish(job: Job, has_advice: bool = True) -> None:
    """Write what became of a job to ``sweep.csv``, then print it, so that an error of stdout loses no row."""
    lines: list[str] = []
    if job.result is not None:
        job.code, lines = outcome(job.config, job.result)
    if job.sweep is not None:
        cells = {"seconds": ""} if job.result is None else result_cells(job.result)
        write_row(job.sweep, {**job.row, **cells, "exit": str(job.code)})
    print_results(*(lines if has_advice else lines[:1]))


def outcome(config: Config, summary: Summary) -> tuple[int, list[str]]:
    """Exit code of a generated dataset, and the lines to print about it."""
    from unprocess_gen.sources.listing import unmatched_sentence

    lines = [summary.sentence(config.source.max_failed)]
    if summary.unmatched:
        lines.append(unmatched_sentence(summary.unmatched))
    too_many = sum(summary.failed.values()) > config.source.max_failed
    return TOO_MANY_FAILED if too_many else DONE, lines


def again(call: Call) -> int:
    """Generate a dataset again from its ``config.yaml``, and compare the manifests."""
    from unprocess_gen.config.composition import load_config
    from unprocess_gen.core.paths import any_path
    from unprocess_gen.pipeline.again import check_sources, compare, recorded_config
    from unprocess_gen.pipeline.generate import generate

    folder = dataset_folder(call)
    if "out" not in call.settings:
        raise ConfigError("again: out is missing; expected the folder of the new dataset; give out=FOLDER")
    if (frames := call.settings.get("output.frames", "true")) != "true":
        raise ConfigError(f"again: output.frames={frames}: expected true")
    places = {"source.root", "noise.dark_frames"}
    given = load_config([f"{key}={value}" for key, value in call.settings.items() if key not in places])
    changes = {key: attrgetter(key)(given) for key in {"executor", *call.settings} - places}
    changes["noise.dark_frames"] = dark_frames_of(folder / "manifest.csv", call)
    config = recorded_config(folder, given_root(call), changes)
    check_sources(folder, config)
    code, lines = outcome(config, generate(config))
    print_results(*lines)
    print_results(compare(folder, any_path(config.out)))
    return code
