"""The door: ``gen-dataset``. Verbs, what they say, exit codes.

Verbs are dispatched before the settings are composed (`compose`), and ``--help`` is answered before it too (Hydra's own
takes half a second). Everything heavy is imported where it is first used.
"""

from __future__ import annotations

import gc
import io
import os
import re
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from unprocess_gen import __version__
from unprocess_gen.cli.hydra_app import complain, compose
from unprocess_gen.cli.messages import log_to_stderr
from unprocess_gen.config.option_files import conf_dir
from unprocess_gen.core.errors import ConfigError, DamageError, UnprocessGenError

if TYPE_CHECKING:
    from unprocess_gen.config.schema import AccuracyConfig, Config
    from unprocess_gen.pipeline.generate import Summary

HELP = """\
gen-dataset: pairs of clean and noisy raw images from ordinary photographs

  gen-dataset camera=convex noise=imx385_iso3200 source.root=photos out=ds     one dataset
  gen-dataset                                  the same from the built-in scenes, into ds
  gen-dataset -m camera=sony_a7r,nexus_6p noise=imx385_iso1600,imx385_iso3200 out=sweep
                                               a sweep: one dataset folder each, and sweep/sweep.csv
  gen-dataset plan [overrides] [--all]         what would be made; writes nothing
  gen-dataset accuracy [overrides] out=…       what accuracy costs in time, measured here: a report
  gen-dataset figures [overrides] out=…        the article's figures, on the first photograph
  gen-dataset verify DIR [--regenerate N]      check every byte, and make N pairs again
  gen-dataset verify DIR --repair              … and make again what is damaged, to the same bytes
  gen-dataset verify DIR --noise [--to PNG]    … and fit the noise in its arrays against its rows
  gen-dataset report DIR [--to FILE] [--source ROOT]
                                               a page of the dataset: DIR/report.html
  gen-dataset replay MANIFEST [--rows A:B] [--keys K,…] [--to FOLDER] [source.root=…]
                                               make rows again and compare, or write their arrays
  gen-dataset preview DIR [--keys K,…] --to FOLDER [--source ROOT] [--stages]
                                               contact sheets: PNGs of pairs, and of each step
  gen-dataset dng DIR --keys K,… [--noisy|--clean] --to FOLDER
                                               frames as DNG files, for raw converters
  gen-dataset again DIR [source.root=…] out=…  make a dataset again from its config.yaml

Settings are key=value, in any order. Groups (group=option; their keys are group.key=value):
  source   root, include, recursive, limit, max_pixels, max_failed, icc, clips, video,
           downscale, dequantize, patch
  camera   convex choice sony_a7r olympus_em10 sony_rx100 nexus_6p identity custom
  gains    brooks2019 fixed paper_min paper_max paper_literal fig6_top fig6_bottom unity
  isp      smoothstep_gamma22 gamma22 srgb linear
  sensor   imx385_12bit generic_10bit generic_12bit generic_14bit generic_16bit
  noise    imx385_iso1600 … imx385_iso25600 imx385_iso3200_rvdd brooks2019 heteroscedastic none
           physical, for the ISO of the scene or of noise.iso: imx385 sony_a7s2 nikon_d850
           canon_5d4 canon_70d canon_700d oppo_reno10x
           several frames of one clean frame: noise.levels, noise.draws
  scene    daylight indoor low_light night video_night long_exposure
  effects  all (auto, on, off), tolerance, and each effect by name
  clean    includes_fixed_pattern
  accuracy exact reference fast or a budget: clean_dn, clean_changed_share, normal_error,
           law_distance, readable
  output   webdataset   dtype (uint16, float32), layout (mosaic, packed), pairs_per_shard
  experiment ipol_demo brooks2019_training crvd_like eld_low_light
           recipes, whose settings others change; added with a plus: +experiment=ipol_demo
and at the top: seed (0), out (ds), n_jobs (-1: all cores), self_test (stop; go_on),
check_disk (true).

  --cfg job           print the settings and stop
  --config-dir DIR    add a folder of your own options
  -m, --multirun      sweep over comma-separated values
  -sc install=bash    tab completion: eval "$(gen-dataset -sc install=bash)"; zsh and fish too
  --version, --help, --hydra-help

Exit codes: 0 done · 1 a bug · 2 usage or settings · 3 finished with failed images · 4 damage found
            5 the machine failed (disk full) · 11 another run holds the output
            130, 143 stopped by a signal
"""


class Terminated(BaseException):
    """SIGTERM arrived."""


OPENCV_LIMITS = ("PIXELS", "WIDTH", "HEIGHT")
"""OpenCV refuses pictures above these limits where the environment sets them; ours is `source.max_pixels`."""


OBJECTS_BETWEEN_COLLECTIONS = 50_000
"""Imports make half a million objects that stay: looking for garbage among them takes a tenth of the start."""


def main() -> int:
    """Run ``gen-dataset`` with the arguments of this process; return the exit code."""
    for limit in OPENCV_LIMITS:
        os.environ.pop(f"OPENCV_IO_MAX_IMAGE_{limit}", None)  # before OpenCV is loaded, and workers inherit it
    if sys.stderr is None:  # closed by the caller; what codecs say is read from there
        sys.stderr = os.fdopen(os.dup2(os.open(os.devnull, os.O_WRONLY), 2), "w")
    gc.set_threshold(OBJECTS_BETWEEN_COLLECTIONS)
    signal.signal(signal.SIGTERM, _terminate)
    unraisable, sys.unraisablehook = sys.unraisablehook, _send_again
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal that cannot show a sign is no reason to stop
    log_to_stderr()
    try:
        return run(sys.argv[1:])
    except UnprocessGenError as error:
        return complain(error)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # nobody reads on: no second complaint at exit
        return 141
    except KeyboardInterrupt:
        return 130
    except Terminated:
        return 143
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)  # all is said: a late signal ends us at once, without a traceback
        sys.unraisablehook = unraisable


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated


SENT_AGAIN_S = 0.05


def _send_again(unraisable: sys.UnraisableHookArgs) -> None:
    """Send a signal anew whose exception C dropped: it came while LLVM called back, which takes far less than that."""
    number = {KeyboardInterrupt: signal.SIGINT, Terminated: signal.SIGTERM}.get(unraisable.exc_type)
    if number is None:
        sys.__unraisablehook__(unraisable)
        return
    timer = threading.Timer(SENT_AGAIN_S, os.kill, (os.getpid(), number))
    timer.daemon = True
    timer.start()


def run(arguments: Sequence[str]) -> int:
    """Dispatch the verb; return the exit code or raise what `main` knows."""
    if {"-h", "--help"} & set(arguments):
        print(HELP, end="")
        return 0
    if "--version" in arguments:
        print(f"unprocess_gen {__version__}")
        return 0
    if arguments and re.fullmatch("[a-z]+", arguments[0]):
        if arguments[0] not in VERBS:
            raise ConfigError(f"{arguments[0]}: no such verb; expected {', '.join(VERBS)} or settings key=value")
        return VERBS[arguments[0]](list(arguments[1:]))
    return generate(list(arguments))


# ----------------------------------------------------------------------------------------------------------- verbs


def generate(arguments: list[str]) -> int:
    """``gen-dataset [overrides]``: make a dataset, or with ``-m`` one for every combination."""
    steps = [partial(import_module, name) for name in ("numpy", "cv2", "numba", "unprocess_gen.pipeline.generate")]
    return compose(arguments, _generate, sweep_csv=True, meanwhile=steps)


def _generate(config: Config) -> tuple[int, Summary]:
    from unprocess_gen.pipeline import generate as runner

    summary = runner.generate(config)
    print(_sentence(summary))
    if summary.made and summary.sites["all"]:
        print(_limits(summary.sites))
    too_many = sum(summary.failed.values()) > config.source.max_failed
    return 3 if too_many else 0, summary


def _sentence(summary: Summary) -> str:
    failed = ", ".join(f"{count} {reason}" for reason, count in summary.failed.items())
    facts = f"{summary.pairs} pairs in {summary.shards} shards, {summary.bytes / 1e6:,.1f} MB, " + (
        f"{sum(summary.failed.values())} failed ({failed}; see {summary.out}/manifest.csv)" if failed else "0 failed"
    )
    if not summary.made:
        return f"{summary.out} is complete: {facts}; nothing to do"
    return f"{summary.out}: {facts}; {summary.made} of {summary.rows} made now, {summary.seconds:.1f} s"


def _limits(sites: dict[str, int]) -> str:
    """Say which share of the sites met a limit, so that nobody trains on clipped data unawares."""
    share = {name: f"{count / sites['all']:.3%}" for name, count in sites.items()}
    return (
        f"of {sites['all']:,} sites, clean: {share['clean_clipped_low']} were clipped at black, "
        f"{share['clean_clipped_high']} at white, {share['saturated']} are saturated; "
        f"noisy: {share['noisy_clipped_low']} were clipped low, {share['noisy_clipped_high']} high; "
        f"{share['zero_variance']} have no noise variance"
    )


def plan(arguments: list[str]) -> int:
    """``gen-dataset plan [overrides] [--all]``: tell what would be made."""
    read_all = "--all" in arguments
    return compose([argument for argument in arguments if argument != "--all"], lambda config: _plan(config, read_all))


def _plan(config: Config, read_all: bool) -> tuple[int, None]:
    from unprocess_gen.pipeline.executors.local import effective_jobs
    from unprocess_gen.reports import estimate as forecast

    told = forecast.estimate_run(config, effective_jobs(config.n_jobs, 10**6), read_all, _tiers())
    print(f"out       {config.out}")
    print(forecast.format_estimate(config, told))
    return 0, None


def accuracy(arguments: list[str]) -> int:
    """``gen-dataset accuracy [overrides]``: measure error and time of every method and tier, and report in ``out``.

    Which is ``accuracy`` unless it is said: a report is no dataset.
    """
    arguments = _with_out(arguments, "accuracy")
    return compose(arguments, lambda config: _accuracy(config, shlex.join(["gen-dataset", "accuracy", *arguments])))


def _accuracy(config: Config, command: str) -> tuple[int, None]:
    from unprocess_gen.config.schema import NoiseConfig, SensorConfig
    from unprocess_gen.config.serialization import read_option
    from unprocess_gen.reports import report_files
    from unprocess_gen.reports.benchmark import measure as room
    from unprocess_gen.reports.benchmark import report

    out = Path(config.out)
    report_files.check_report_folder(out, "accuracy")
    noise, sensor = conf_dir() / "noise", conf_dir() / "sensor"
    beside = room.BenchmarkProfiles(
        _tiers(),
        read_option(noise / "imx385_iso3200.yaml", NoiseConfig),
        read_option(noise / "sony_a7s2.yaml", NoiseConfig),
        read_option(sensor / "generic_14bit.yaml", SensorConfig),
    )
    found = room.measure_accuracy(config, beside, command=command)
    report.write_benchmark(found, out)
    print(report.text_table(found.rows))
    print(f"{out}: {', '.join(report.FILES)}")
    return 0, None


def _tiers() -> dict[str, AccuracyConfig]:
    """Return every tier of ``conf/accuracy``, the reference first."""
    from unprocess_gen.config.schema import AccuracyConfig
    from unprocess_gen.config.serialization import read_option

    files = sorted((conf_dir() / "accuracy").glob("*.yaml"), key=lambda path: (path.stem != "reference", path.stem))
    return {path.stem: read_option(path, AccuracyConfig) for path in files}


FIGURE_KEYS = ("source", "camera", "sensor", "seed", "out")
"""What can be chosen about the article's figures; it sets the rest itself."""


def figures(arguments: list[str]) -> int:
    """``gen-dataset figures [overrides]``: draw the article's figures on a photograph, in ``out`` (``figures``)."""
    for argument in arguments:
        if "=" in argument and not argument.startswith("-") and re.split(r"[.=]", argument)[0] not in FIGURE_KEYS:
            raise ConfigError(f"figures: {argument}: the article sets it; expected {', '.join(FIGURE_KEYS)}")
    arguments = _with_out(arguments, "figures")
    return compose(arguments, lambda config: _figures(config, shlex.join(["gen-dataset", "figures", *arguments])))


def _figures(config: Config, command: str) -> tuple[int, None]:
    from unprocess_gen.config.schema import GainsConfig, NoiseConfig
    from unprocess_gen.config.serialization import read_option
    from unprocess_gen.reports import paper_figures as room
    from unprocess_gen.reports import report_files

    out = Path(config.out)
    report_files.check_report_folder(out, "figures")
    gains = {name: read_option(conf_dir() / "gains" / f"{name}.yaml", GainsConfig) for name in room.GAINS}
    authors = read_option(conf_dir() / "noise" / f"{room.AUTHORS_NOISE}.yaml", NoiseConfig)
    drawn = room.draw_figures(config, room.PaperOptions(gains, authors))
    print(f"{out}: {', '.join(room.write_figures(drawn, out, command))}")
    return 0, None


AGAIN_KEYS = {"source.root": str, "out": str, "n_jobs": int, "source.max_failed": int}
VERIFY_KEYS = {"source.root": str, "--regenerate": int, "--to": str}
REPORT_KEYS = {"--to": Path, "--source": Path}
REPLAY_KEYS = {"source.root": str, "--rows": str, "--keys": str, "--to": str}
PREVIEW_KEYS = {"--keys": str, "--to": str, "--source": str}
DNG_KEYS = {"--keys": str, "--to": str}


def again(arguments: list[str]) -> int:
    """``gen-dataset again DIR source.root=… out=…``: make a dataset again from its ``config.yaml``."""
    from unprocess_gen.config.serialization import read_dataset_yaml
    from unprocess_gen.config.validation import validate_config

    if not arguments or "=" in arguments[0]:
        raise ConfigError("again: expected the folder of a dataset, then source.root=… and out=…")
    folder, chosen = Path(arguments[0]), _values("again", AGAIN_KEYS, arguments[1:])
    config, kind = read_dataset_yaml(folder / "config.yaml")
    if "out" not in chosen:
        raise ConfigError("again: out=… is missing: the folder to make it in")
    if (kind == "folder") != ("source.root" in chosen):
        wanted = "give source.root=…" if kind == "folder" else "leave source.root out"
        raise ConfigError(f"again: {folder} was made from a source of kind {kind}: {wanted}")
    config.out, config.source.root = chosen["out"], chosen.get("source.root")
    config.n_jobs = chosen.get("n_jobs", config.n_jobs)
    config.source.max_failed = chosen.get("source.max_failed", config.source.max_failed)
    validate_config(config)
    code, _ = _generate(config)
    old, new = folder / "manifest.csv", Path(config.out) / "manifest.csv"
    if not old.exists():
        print(f"{folder} has no manifest.csv to compare with")
    elif old.read_bytes() != new.read_bytes():
        raise DamageError(f"{new}: differs from that of {folder}: were these the same sources?")
    else:
        print(f"the same as {folder}, bit for bit")
    return code


def _first(verb: str, arguments: Sequence[str], expected: str = "the folder of a dataset") -> Path:
    """Return the path that a verb's first argument is; ConfigError where it is none."""
    if not arguments or arguments[0].startswith("-") or "=" in arguments[0]:
        raise ConfigError(f"{verb}: expected {expected}")
    return Path(arguments[0])


def _with_out(arguments: list[str], out: str) -> list[str]:
    """Add the verb's own ``out`` where none is said."""
    return arguments if any(argument.startswith("out=") for argument in arguments) else [*arguments, f"out={out}"]


def _values(verb: str, known: Mapping[str, Callable[[str], Any]], arguments: Sequence[str]) -> dict[str, Any]:
    """Read ``key=value`` and ``--flag value`` (or ``--flag=value``); ConfigError for anything else."""
    values: dict[str, Any] = {}
    waiting = iter(arguments)
    for argument in waiting:
        key, equals, value = argument.partition("=")
        if key not in known:
            raise ConfigError(f"{verb}: {argument}: expected {', '.join(known)}")
        if not equals and (not key.startswith("--") or (value := next(waiting, "")) == ""):
            raise ConfigError(f"{verb}: {argument}: a value is missing")
        try:
            values[key] = known[key](os.path.expanduser(value))
        except ValueError:
            raise ConfigError(f"{verb}: {key}={value}: expected a whole number") from None
    return values


def verify(arguments: list[str]) -> int:
    """``gen-dataset verify DIR [--regenerate N] [--repair] [--noise] …``: check every byte, mend, fit the noise."""
    from unprocess_gen.cli.sweep import worst
    from unprocess_gen.pipeline import repair, replay
    from unprocess_gen.pipeline import verify as room

    mend, noise = "--repair" in arguments, "--noise" in arguments
    arguments = [argument for argument in arguments if argument not in ("--repair", "--noise")]
    folder, chosen = _first("verify", arguments), _values("verify", VERIFY_KEYS, arguments[1:])
    damages = _told(folder, room.verify(folder))
    codes: list[int] = []
    if damages and mend:
        for step in repair.repair(folder, replay.source_root(folder / "manifest.csv", chosen.get("source.root"))):
            print(step, file=sys.stdout if step.repaired else sys.stderr)
            codes.append(step.exit_code)
        damages = _told(folder, room.verify(folder))
    manifest, count, again = folder / "manifest.csv", chosen.get("--regenerate", 0), 0
    if count and not damages:
        root = replay.source_root(manifest, chosen.get("source.root"))
        replayed = list(replay.replay(replay.evenly_spaced_rows(manifest, count), root))
        codes = [result.exit_code for result in replayed]
        again = len(replayed)
        damages += _told(folder, (f"{one.key} ({one.source}): {one.complaint}" for one in replayed if one.complaint))
    if noise and not damages:
        damages += _check_noise(folder, chosen.get("--to"))
    if damages:
        return worst(codes) or 4
    print(f"{folder} is whole" + (f"; {again} pairs were made again, bit for bit" if again else ""))
    return 0


def _check_noise(folder: Path, to: str | None) -> list[str]:
    """Compare the noise in the arrays with the manifest's numbers; return what does not fit."""
    from unprocess_gen.reports import photon_transfer as transfer

    looked = transfer.fit_dataset(folder)
    if looked.worst is None:
        print(f"{folder}: no pair has sites enough to fit its noise")
        return []
    print(f"noise of {looked.count} pairs fitted (a, b with 95 % intervals); the farthest from its row: {looked.worst}")
    if to is not None:
        transfer.draw_fits(looked.first, Path(to))
        print(f"drawn in {to}")
    return _told(folder, (f"noise of {one}" for one in looked.wrong))


def _told(folder: Path, damages: Iterable[object]) -> list[str]:
    told = [str(damage) for damage in damages]
    for damage in told:
        print(f"gen-dataset: {folder}: {damage}", file=sys.stderr)
    return told


def replay(arguments: list[str]) -> int:
    """``gen-dataset replay MANIFEST [--rows A:B] [--keys K,…] [--to FOLDER] [source.root=…]``: make rows again."""
    from unprocess_gen.cli.sweep import worst
    from unprocess_gen.dataset.selection import select_rows
    from unprocess_gen.pipeline import replay as room

    manifest = _first("replay", arguments, "a manifest.csv, or the folder of a dataset")
    chosen = _values("replay", REPLAY_KEYS, arguments[1:])
    manifest = manifest / "manifest.csv" if manifest.is_dir() else manifest
    to = Path(chosen["--to"]) if "--to" in chosen else None
    rows = select_rows(manifest, chosen.get("--rows"), chosen.get("--keys"))
    same = different = 0
    codes: list[int] = []
    for one in room.replay(rows, room.source_root(manifest, chosen.get("source.root")), to):
        same, different = same + (not one.complaint), different + bool(one.complaint)
        codes.append(one.exit_code)
        if one.complaint:
            print(f"gen-dataset: {one.key} ({one.source}): {one.complaint}", file=sys.stderr)
    print(f"{same} pairs are the same, bit for bit; {different} are not" + (f"; arrays in {to}" if to else ""))
    return worst(codes)


def report(arguments: list[str]) -> int:
    """``gen-dataset report DIR [--to FILE] [--source ROOT]``: write the page of a dataset, else ``DIR/report.html``."""
    from unprocess_gen.reports import dataset_report as page

    folder, chosen = _first("report", arguments), _values("report", REPORT_KEYS, arguments[1:])
    print(page.write_dataset_report(folder, chosen.get("--to"), chosen.get("--source")))
    return 0


def preview(arguments: list[str]) -> int:
    """``gen-dataset preview DIR [--keys K,…] --to FOLDER [--source ROOT] [--stages]``: draw contact sheets of pairs."""
    from unprocess_gen.reports import contact_sheet as room

    with_stages = "--stages" in arguments
    arguments = [argument for argument in arguments if argument != "--stages"]
    folder, chosen = _first("preview", arguments), _values("preview", PREVIEW_KEYS, arguments[1:])
    if "--to" not in chosen:
        raise ConfigError("preview: --to is missing: the folder to draw the sheets in")
    to, source = Path(chosen["--to"]), Path(chosen["--source"]) if "--source" in chosen else None
    keys = chosen["--keys"].split(",") if "--keys" in chosen else []
    files = 0
    for drawn in room.write_sheets(folder, to, keys, source, with_stages):
        files += len(drawn.files)
        if drawn.missing_source:
            left_out = "the source's panel and the stages are" if with_stages else "the source's panel is"
            print(
                f"gen-dataset: {drawn.key} ({drawn.source}): {left_out} left out: {drawn.missing_source}",
                file=sys.stderr,
            )
    print(f"{files} pictures in {to}")
    return 0


def dng(arguments: list[str]) -> int:
    """``gen-dataset dng DIR --keys K,… [--noisy|--clean] --to FOLDER``: write frames as DNG files."""
    from unprocess_gen.dataset import dng as room

    folder = _first("dng", arguments)
    flags = {f"--{frame}": frame for frame in room.FRAMES}
    chosen = _values("dng", DNG_KEYS, [argument for argument in arguments[1:] if argument not in flags])
    for key, wanted in (("--keys", "K,…: the rows to write"), ("--to", "FOLDER: where to write them")):
        if not chosen.get(key):
            raise ConfigError(f"dng: missing {key} {wanted}")
    frames = [frame for flag, frame in flags.items() if flag in arguments] or room.FRAMES
    done = room.export(folder, chosen["--keys"], frames, Path(chosen["--to"]))
    told = (
        (done.written, "DNG files written"),
        (done.present, "were there already, the same"),
        (done.without_profile, "noisy ones without NoiseProfile, which their noise law does not fit"),
    )
    print(f"{chosen['--to']}: " + "; ".join(f"{count} {what}" for count, what in told if count))
    return 0


VERBS: dict[str, Callable[[list[str]], int]] = {
    "plan": plan,
    "accuracy": accuracy,
    "figures": figures,
    "verify": verify,
    "replay": replay,
    "report": report,
    "preview": preview,
    "dng": dng,
    "again": again,
}
