"""Run the verb that scores restoration methods."""

from __future__ import annotations

import re
from pathlib import Path

from unprocess_gen.cli.arguments import KEYS, Call, Operand, flag, local, parse, verb
from unprocess_gen.cli.messages import print_results, report
from unprocess_gen.cli.places import dataset_folder
from unprocess_gen.cli.runs import build
from unprocess_gen.core.errors import ConfigError

METHOD = "noisy, gaussian, non_local_means, or a function of (noisy, row): module:function or FILE.py:function"


@verb(
    Operand("DIR", "the folder of a dataset or of a sweep, or the name of a benchmark build", optional=True),
    flag("--method", "NAME", METHOD, required=True),
    KEYS,
    flag("--split", "NAME", "only pairs of this split"),
    flag("--real", "FOLDER", "score the recorded pairs that FOLDER/pairs.csv lists, in place of DIR", local),
    flag("--to", "FOLDER", "write score.json and score.csv to FOLDER; default: scores/DIR-METHOD", local),
    flag("--against", "JSON", "compare with the score.json of another method, pair by pair", local),
    keys={"n_jobs=N": "number of worker processes, 1 by default; -1: all cores"},
)
def score(call: Call) -> int:
    """Score a restoration method on a dataset, with intervals."""
    from unprocess_gen.config.composition import load_config
    from unprocess_gen.core.output_paths import check_output_folder
    from unprocess_gen.core.paths import any_path
    from unprocess_gen.reports.builds import build_names
    from unprocess_gen.reports.scoring.items import dataset_items
    from unprocess_gen.reports.scoring.methods import load_method
    from unprocess_gen.reports.scoring.real_pairs import collect
    from unprocess_gen.reports.scoring.scoring import compare, read_scores, score_items, score_table, write_scores

    if [call.place, call.real].count(None) != 1 or (call.real and (call.keys or call.split)):
        raise ConfigError("score: expected either DIR, or --real FOLDER without --keys and --split")
    load_method(call.method, str(Path.cwd()))
    n_jobs = load_config([f"n_jobs={call.settings.get('n_jobs', '1')}"]).n_jobs
    name, made = str(call.place), Path("builds", str(call.place))
    if name in build_names() and not Path(name).exists():
        if code := build.run(parse(build, [name, "--to", str(made)])):
            return code
        call.place = any_path(made)
    elif name in build_names():
        report(f"score: {name}: is a folder and the name of a build; the folder is scored")
    items = collect(call.real) if call.real else dataset_items(dataset_folder(call, sweeps=True), call.keys, call.split)
    to = call.to or Path("scores", re.sub(r"[^\w.-]+", "_", f"{items.data['name']}-{call.method}"))
    check_output_folder(to, f"--to {to}")
    other = None if call.against is None else read_scores(call.against, items.data)
    scored = score_items(items, call.method, n_jobs)
    write_scores(scored, to)
    print_results(f"{call.method} on {items.data['name']}: means with 95 % intervals", *score_table(scored))
    if other is not None:
        scored["against"] = compare(scored, other)
        write_scores(scored, to)
        print_results(f"{call.method} minus {other['method']}", *score_table(scored["against"]))
    print_results(f"{scored['seconds_per_megapixel']:g} s per megapixel; {to}: score.json, score.csv")
    return 0
