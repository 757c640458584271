"""The door: ``gen-dataset``. Verbs, composing and checking the settings, exit codes. The only room that names Hydra.

Verbs are dispatched before Hydra, and ``--help`` is answered before it too (its own takes half a second). Hydra prints
several lines for a mistake and always ends with 1; so it is told to raise, and every mistake becomes one line here. An
exception that leaves a Hydra task costs a second line, so tasks hand over their outcome instead. Of a sweep Hydra only
parses the values; each job is then composed for itself. Everything heavy is imported where it is first used.
"""

from __future__ import annotations

import io
import itertools
import os
import re
import shlex
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from unprocess_gen import __version__
from unprocess_gen.errors import ConfigError, DamageError, UnprocessGenError
from unprocess_gen.sweep import Job, folder_name, overrides_text, worst, write_table

if TYPE_CHECKING:
    from unprocess_gen.config import AccuracyConfig, Config
    from unprocess_gen.runner import Summary

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
and at the top: seed (0), out (ds), n_jobs (-1: all cores), self_test (stop; go_on).

  --cfg job           print the settings and stop
  --config-dir DIR    add a folder of your own options
  -m, --multirun      sweep over comma-separated values
  -sc install=bash    tab completion: eval "$(gen-dataset -sc install=bash)"; zsh and fish too
  --version, --help, --hydra-help

Exit codes: 0 done · 1 a bug · 2 usage or settings · 3 finished with failed images · 4 damage found
            5 the machine failed (disk full) · 11 another run holds the output
            130, 143 stopped by a signal
"""

ANY = ("…",)
HYDRA_FLAGS: dict[tuple[str, ...], tuple[str, ...]] = {
    ("--hydra-help",): (),
    ("--resolve",): (),
    ("--run", "-r"): (),
    ("--multirun", "-m"): (),
    ("--shell-completion", "-sc"): (),
    ("--cfg", "-c"): ("job", "hydra", "all"),
    ("--info", "-i"): ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath"),
    ("--package", "-p"): ANY,
    ("--config-path", "-cp"): ANY,
    ("--config-name", "-cn"): ANY,
    ("--config-dir", "-cd"): ANY,
}
"""Hydra's flags (each in its spellings) and the values they take; its own parser answers mistakes with a page."""

SWEEP_FLAGS = ("-m", "--multirun")


class Terminated(BaseException):
    """SIGTERM arrived."""


OPENCV_LIMITS = ("PIXELS", "WIDTH", "HEIGHT")
"""OpenCV refuses pictures above these limits where the environment sets them; ours is `source.max_pixels`."""


def main() -> int:
    """Run ``gen-dataset`` with the arguments of this process; return the exit code."""
    for limit in OPENCV_LIMITS:
        os.environ.pop(f"OPENCV_IO_MAX_IMAGE_{limit}", None)  # before OpenCV is loaded, and workers inherit it
    if sys.stderr is None:  # closed by the caller; what codecs say is read from there
        sys.stderr = os.fdopen(os.dup2(os.open(os.devnull, os.O_WRONLY), 2), "w")
    signal.signal(signal.SIGTERM, _terminate)
    unraisable, sys.unraisablehook = sys.unraisablehook, _send_again
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal that cannot show a sign is no reason to stop
    try:
        return run(sys.argv[1:])
    except UnprocessGenError as error:
        return _report(error)
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


def _report(error: BaseException, job: str = "") -> int:
    """Say what went wrong (in which ``job`` of a sweep), in one line where it is not a bug; return the exit code."""
    if isinstance(error, UnprocessGenError):
        print(f"gen-dataset: {job}{error}", file=sys.stderr)
        return error.exit_code
    traceback.print_exception(error)
    return 1


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
    return compose(arguments, _generate, sweep_csv=True)


def _generate(config: Config) -> tuple[int, Summary]:
    from unprocess_gen import runner

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
    from unprocess_gen import forecast, runner

    told = forecast.forecast(config, runner.effective_jobs(config.n_jobs, 10**6), read_all, _tiers())
    print(f"out       {config.out}")
    print(forecast.text(config, told))
    return 0, None


def accuracy(arguments: list[str]) -> int:
    """``gen-dataset accuracy [overrides]``: measure error and time of every method and tier, and report in ``out``.

    Which is ``accuracy`` unless it is said: a report is no dataset.
    """
    if not any(argument.startswith("out=") for argument in arguments):
        arguments = [*arguments, "out=accuracy"]
    return compose(arguments, lambda config: _accuracy(config, shlex.join(["gen-dataset", "accuracy", *arguments])))


def _accuracy(config: Config, command: str) -> tuple[int, None]:
    from unprocess_gen import accuracy as room
    from unprocess_gen import report
    from unprocess_gen.config import NoiseConfig, SensorConfig, read_option

    out = Path(config.out)
    report.check_out(out, "accuracy")
    noise, sensor = conf_dir() / "noise", conf_dir() / "sensor"
    beside = room.Beside(
        _tiers(),
        read_option(noise / "imx385_iso3200.yaml", NoiseConfig),
        read_option(noise / "sony_a7s2.yaml", NoiseConfig),
        read_option(sensor / "generic_14bit.yaml", SensorConfig),
    )
    found = room.measure(config, beside, command=command)
    report.write(found, out)
    print(report.table(found.rows))
    print(f"{out}: {', '.join(report.FILES)}")
    return 0, None


def _tiers() -> dict[str, AccuracyConfig]:
    """Return every tier of ``conf/accuracy``, the reference first."""
    from unprocess_gen.config import AccuracyConfig, read_option

    files = sorted((conf_dir() / "accuracy").glob("*.yaml"), key=lambda path: (path.stem != "reference", path.stem))
    return {path.stem: read_option(path, AccuracyConfig) for path in files}


FIGURE_KEYS = ("source", "camera", "sensor", "seed", "out")
"""What can be chosen about the article's figures; it sets the rest itself."""


def figures(arguments: list[str]) -> int:
    """``gen-dataset figures [overrides]``: draw the article's figures on a photograph, in ``out`` (``figures``)."""
    for argument in arguments:
        if "=" in argument and not argument.startswith("-") and re.split(r"[.=]", argument)[0] not in FIGURE_KEYS:
            raise ConfigError(f"figures: {argument}: the article sets it; expected {', '.join(FIGURE_KEYS)}")
    if not any(argument.startswith("out=") for argument in arguments):
        arguments = [*arguments, "out=figures"]
    return compose(arguments, lambda config: _figures(config, shlex.join(["gen-dataset", "figures", *arguments])))


def _figures(config: Config, command: str) -> tuple[int, None]:
    from unprocess_gen import figures as room
    from unprocess_gen import report
    from unprocess_gen.config import GainsConfig, NoiseConfig, read_option

    out = Path(config.out)
    report.check_out(out, "figures")
    gains = {name: read_option(conf_dir() / "gains" / f"{name}.yaml", GainsConfig) for name in room.GAINS}
    authors = read_option(conf_dir() / "noise" / f"{room.AUTHORS_NOISE}.yaml", NoiseConfig)
    drawn = room.draw(config, room.Recipes(gains, authors))
    print(f"{out}: {', '.join(room.write(drawn, out, command))}")
    return 0, None


AGAIN_KEYS = {"source.root": str, "out": str, "n_jobs": int, "source.max_failed": int}
VERIFY_KEYS = {"source.root": str, "--regenerate": int, "--to": str}
REPORT_KEYS = {"--to": Path, "--source": Path}
REPLAY_KEYS = {"source.root": str, "--rows": str, "--keys": str, "--to": str}
PREVIEW_KEYS = {"--keys": str, "--to": str, "--source": str}
DNG_KEYS = {"--keys": str, "--to": str}


def again(arguments: list[str]) -> int:
    """``gen-dataset again DIR source.root=… out=…``: make a dataset again from its ``config.yaml``."""
    from unprocess_gen import config as settings

    if not arguments or "=" in arguments[0]:
        raise ConfigError("again: expected the folder of a dataset, then source.root=… and out=…")
    folder, chosen = Path(arguments[0]), _values("again", AGAIN_KEYS, arguments[1:])
    config, kind = settings.read_dataset_yaml(folder / "config.yaml")
    if "out" not in chosen:
        raise ConfigError("again: out=… is missing: the folder to make it in")
    if (kind == "folder") != ("source.root" in chosen):
        wanted = "give source.root=…" if kind == "folder" else "leave source.root out"
        raise ConfigError(f"again: {folder} was made from a source of kind {kind}: {wanted}")
    config.out, config.source.root = chosen["out"], chosen.get("source.root")
    config.n_jobs = chosen.get("n_jobs", config.n_jobs)
    config.source.max_failed = chosen.get("source.max_failed", config.source.max_failed)
    settings.check(config)
    code, _ = _generate(config)
    old, new = folder / "manifest.csv", Path(config.out) / "manifest.csv"
    if not old.exists():
        print(f"{folder} has no manifest.csv to compare with")
    elif old.read_bytes() != new.read_bytes():
        raise DamageError(f"{new}: differs from that of {folder}: were these the same sources?")
    else:
        print(f"the same as {folder}, bit for bit")
    return code


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
    from unprocess_gen import repair
    from unprocess_gen import verify as room

    mend, noise = "--repair" in arguments, "--noise" in arguments
    arguments = [argument for argument in arguments if argument not in ("--repair", "--noise")]

    if not arguments or arguments[0].startswith("-") or "=" in arguments[0]:
        raise ConfigError("verify: expected the folder of a dataset")
    folder, chosen = Path(arguments[0]), _values("verify", VERIFY_KEYS, arguments[1:])
    damages = _told(folder, room.verify(folder))
    if damages and mend:
        for step in repair.repair(folder, room.source_root(folder / "manifest.csv", chosen.get("source.root"))):
            print(step, file=sys.stdout if step.mended else sys.stderr)
        damages = _told(folder, room.verify(folder))
    manifest, count, again = folder / "manifest.csv", chosen.get("--regenerate", 0), 0
    if count and not damages:
        root = room.source_root(manifest, chosen.get("source.root"))
        replayed = list(room.replay(room.spread(manifest, count), root))
        again = len(replayed)
        damages += _told(folder, (f"{one.key} ({one.source}): {one.complaint}" for one in replayed if one.complaint))
    if noise and not damages:
        damages += _check_noise(folder, chosen.get("--to"))
    if damages:
        return 4
    print(f"{folder} is whole" + (f"; {again} pairs were made again, bit for bit" if again else ""))
    return 0


def _check_noise(folder: Path, to: str | None) -> list[str]:
    """Compare the noise in the arrays with the manifest's numbers; return what does not fit."""
    from unprocess_gen import transfer

    looked = transfer.look(folder)
    if looked.worst is None:
        print(f"{folder}: no pair has sites enough to fit its noise")
        return []
    print(f"noise of {looked.count} pairs fitted (a, b with 95 % intervals); the farthest from its row: {looked.worst}")
    if to is not None:
        transfer.draw(looked.first, Path(to))
        print(f"drawn in {to}")
    return _told(folder, (f"noise of {one}" for one in looked.wrong))


def _told(folder: Path, damages: Iterable[object]) -> list[str]:
    told = [str(damage) for damage in damages]
    for damage in told:
        print(f"gen-dataset: {folder}: {damage}", file=sys.stderr)
    return told


def replay(arguments: list[str]) -> int:
    """``gen-dataset replay MANIFEST [--rows A:B] [--keys K,…] [--to FOLDER] [source.root=…]``: make rows again."""
    from unprocess_gen import verify as room

    if not arguments or arguments[0].startswith("-") or "=" in arguments[0]:
        raise ConfigError("replay: expected a manifest.csv, or the folder of a dataset")
    manifest, chosen = Path(arguments[0]), _values("replay", REPLAY_KEYS, arguments[1:])
    manifest = manifest / "manifest.csv" if manifest.is_dir() else manifest
    to = Path(chosen["--to"]) if "--to" in chosen else None
    rows = room.choose(manifest, chosen.get("--rows"), chosen.get("--keys"))
    same = different = 0
    for one in room.replay(rows, room.source_root(manifest, chosen.get("source.root")), to):
        same, different = same + (not one.complaint), different + bool(one.complaint)
        if one.complaint:
            print(f"gen-dataset: {one.key} ({one.source}): {one.complaint}", file=sys.stderr)
    print(f"{same} pairs are the same, bit for bit; {different} are not" + (f"; arrays in {to}" if to else ""))
    return 4 if different else 0


def report(arguments: list[str]) -> int:
    """``gen-dataset report DIR [--to FILE] [--source ROOT]``: write the page of a dataset, else ``DIR/report.html``."""
    from unprocess_gen import page

    if not arguments or arguments[0].startswith("-") or "=" in arguments[0]:
        raise ConfigError("report: expected the folder of a dataset")
    chosen = _values("report", REPORT_KEYS, arguments[1:])
    print(page.write(Path(arguments[0]), chosen.get("--to"), chosen.get("--source")))
    return 0


def preview(arguments: list[str]) -> int:
    """``gen-dataset preview DIR [--keys K,…] --to FOLDER [--source ROOT] [--stages]``: draw contact sheets of pairs."""
    from unprocess_gen import preview as room

    with_stages = "--stages" in arguments
    arguments = [argument for argument in arguments if argument != "--stages"]
    if not arguments or arguments[0].startswith("-") or "=" in arguments[0]:
        raise ConfigError("preview: expected the folder of a dataset")
    folder, chosen = Path(arguments[0]), _values("preview", PREVIEW_KEYS, arguments[1:])
    if "--to" not in chosen:
        raise ConfigError("preview: --to is missing: the folder to draw the sheets in")
    to, source = Path(chosen["--to"]), Path(chosen["--source"]) if "--source" in chosen else None
    keys = chosen["--keys"].split(",") if "--keys" in chosen else []
    files = 0
    for drawn in room.preview(folder, to, keys, source, with_stages):
        files += len(drawn.files)
        if drawn.lacks:
            left_out = "the source's panel and the stages are" if with_stages else "the source's panel is"
            print(f"gen-dataset: {drawn.key} ({drawn.source}): {left_out} left out: {drawn.lacks}", file=sys.stderr)
    print(f"{files} pictures in {to}")
    return 0


def dng(arguments: list[str]) -> int:
    """``gen-dataset dng DIR --keys K,… [--noisy|--clean] --to FOLDER``: write frames as DNG files."""
    from unprocess_gen import dng as room

    if not arguments or arguments[0].startswith("-") or "=" in arguments[0]:
        raise ConfigError("dng: expected the folder of a dataset")
    flags = {f"--{frame}": frame for frame in room.FRAMES}
    chosen = _values("dng", DNG_KEYS, [argument for argument in arguments[1:] if argument not in flags])
    for key, wanted in (("--keys", "K,…: the rows to write"), ("--to", "FOLDER: where to write them")):
        if not chosen.get(key):
            raise ConfigError(f"dng: missing {key} {wanted}")
    frames = [frame for flag, frame in flags.items() if flag in arguments] or room.FRAMES
    done = room.export(Path(arguments[0]), chosen["--keys"], frames, Path(chosen["--to"]))
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

# ----------------------------------------------------------------------------------------------------------- Hydra

Task = Callable[["Config"], tuple[int, "Summary | None"]]


def conf_dir() -> Path:
    """Return the folder of the options: inside the installed package, or beside it in a source tree."""
    here = Path(__file__).resolve().parent
    for folder in (here / "conf", here.parent / "conf"):
        if (folder / "config.yaml").is_file():
            return folder
    raise ConfigError(f"no conf/config.yaml in or beside {here}: the installation is not whole")


def compose(arguments: list[str], task: Task, sweep_csv: bool = False) -> int:
    """Compose the settings and run ``task`` on them, with ``-m`` on every combination; return the exit code.

    ``sweep_csv`` says whether a sweep leaves its table in ``out``. Raises ConfigError for settings that Hydra or
    `config.check` refuse, and whatever the task of a single run raises.
    """
    flags, overrides = _sort_arguments(arguments)
    swept = any(flag in SWEEP_FLAGS for flag in flags)
    flags = [flag for flag in flags if flag not in SWEEP_FLAGS]
    if not swept:
        return compose_one(flags, overrides, task)
    jobs: list[Job] = []
    out: Path | None = None
    for job_overrides in expand(flags, overrides):
        job, composed_out = _sweep_job(flags, job_overrides, task)
        jobs.append(job)
        out = composed_out or out
        if sweep_csv and out is not None:
            write_table(out, jobs)
    return worst(job.exit for job in jobs)


def compose_one(flags: list[str], overrides: list[str], task: Task) -> int:
    """Let Hydra compose one set of settings and run ``task`` on it; 0 where a flag asked Hydra to print and stop.

    Without flags, by the function that only composes: as an application Hydra does so twice, which takes 0.3 s. With
    them Hydra is told to raise, and the task's outcome is handed out of it: what leaves a Hydra task costs a second
    line.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra's switch for: raise, do not print
    import hydra
    from hydra.core.config_store import ConfigStore
    from hydra.errors import HydraException
    from omegaconf import DictConfig, OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    from unprocess_gen.config import Config, check

    ConfigStore.instance().store(name="gen_dataset_schema", node=Config)
    outcomes: list[int | BaseException] = []

    def on_config(node: DictConfig) -> None:
        try:
            for key in _unknown_keys(node, Config()):
                raise ConfigError(f"{_assignment(key, overrides)}: no such key; {_allowed(key)}")
            config = OmegaConf.to_object(node)
            assert isinstance(config, Config)
            check(config)
            outcomes.append(task(config)[0])
        except BaseException as error:
            outcomes.append(error)

    try:
        if flags:
            sys.argv = ["gen-dataset", *flags, *overrides]
            hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="config")(on_config)()
        else:
            with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
                node = hydra.compose("config", overrides)
            on_config(node)
    except (HydraException, OmegaConfBaseException, YAMLError, ValueError) as error:
        raise ConfigError(_explain(error, overrides)) from error
    for outcome in outcomes:
        if isinstance(outcome, OmegaConfBaseException):
            raise ConfigError(_explain(outcome, overrides)) from outcome
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome
    return 0


def expand(flags: list[str], overrides: list[str]) -> list[list[str]]:
    """Return the overrides of every job of a sweep: the product of the swept values, the last changing fastest.

    Hydra's own sweeper checks all jobs first and lets one that cannot be composed stop all others; here each job
    stands for itself.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        parsed = OverridesParser.create(config_loader=_Options(flags)).parse_overrides(overrides)  # type: ignore[arg-type]
        choices = [
            [f"{one.get_key_element()}={value}" for value in one.sweep_string_iterator()]
            if one.is_sweep_override()
            else [f"{one.get_key_element()}={one.get_value_element_as_str()}"]
            for one in parsed
        ]
    except HydraException as error:
        raise ConfigError(_explain(error, overrides)) from error
    return [list(job) for job in itertools.product(*choices)]


class _Options:
    """What Hydra's parser asks for ``glob(…)``: the options of a group."""

    def __init__(self, flags: list[str]) -> None:
        named = [value for flag, value in itertools.pairwise(flags) if flag in ("--config-dir", "-cd")]
        self.folders = [conf_dir(), *map(Path, named)]

    def get_group_options(self, group_name: str, *_: Any, **__: Any) -> list[str]:
        """Return the names of a group's options, ours and those of ``--config-dir``."""
        return sorted({path.stem for folder in self.folders for path in (folder / group_name).glob("*.yaml")})


def _sweep_job(flags: list[str], overrides: list[str], task: Task) -> tuple[Job, Path | None]:
    """Run one job of a sweep in its own folder below ``out``; whatever goes wrong becomes its exit code.

    Returns the job and the sweep's ``out``, None where the settings could not even be composed.
    """
    text = overrides_text(overrides)
    folder = folder_name(text)
    outs: list[Path] = []
    summaries: list[Summary | None] = []

    def in_its_folder(config: Config) -> tuple[int, None]:
        outs.append(Path(config.out))
        config.out = str(outs[0] / folder)
        code, summary = task(config)
        summaries.append(summary)
        return code, None

    try:
        code = compose_one(flags, overrides, in_its_folder)
    except Exception as error:
        code = _report(error, f"{folder}: ")
    summary = summaries[0] if summaries else None
    failed = None if summary is None else sum(summary.failed.values())
    job = Job(folder, text, None if summary is None else summary.rows, failed, code)
    return job, outs[0] if outs else None


def _unknown_keys(node: Any, schema: Any, prefix: str = "") -> list[str]:
    """Return the keys that a ``+`` override slipped past the schema."""
    unknown = []
    for key in map(str, node):
        value = getattr(schema, key, None)
        if not hasattr(schema, key):
            unknown.append(prefix + key)
        elif is_dataclass(value):
            unknown += _unknown_keys(node[key], value, f"{prefix}{key}.")
    return unknown


PATH_KEYS = ("source.root", "out")


def _quoted_path(argument: str) -> str:
    """Return an override of a path so that Hydra's grammar takes it as it stands, with ``~`` expanded.

    Unquoted, a path with an umlaut, an apostrophe or a bracket in it is no word of that grammar.
    """
    key, _, path = argument.partition("=")
    if key not in PATH_KEYS or path in ("", "null") or path[0] in "'\"":
        return argument
    path = os.path.expanduser(path).replace("${", "\\${")
    path = re.sub(r"(\\*)'", r"\1\1\\'", path)
    path = re.sub(r"(\\+)$", r"\1\1", path)
    return f"{key}='{path}'"


def _sort_arguments(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return Hydra's flags with their values, and the overrides; ConfigError for what is neither.

    Hydra's own parser loses track where a flag stands between overrides.
    """
    flags: list[str] = []
    overrides: list[str] = []
    waiting = iter(arguments)
    for argument in waiting:
        if argument.startswith("-"):
            flags += _read_flag(argument, waiting)
        elif argument.startswith("~"):
            raise ConfigError(f"{argument}: a setting cannot be taken away; choose another value or option")
        elif "=" not in argument:
            raise ConfigError(f"{argument}: expected a setting key=value; see gen-dataset --help")
        elif argument.startswith("hydra") and not argument.startswith("hydra.searchpath="):
            raise ConfigError(f"{argument}: Hydra's own settings are fixed, but for hydra.searchpath")
        else:
            _check_recipe(argument)
            _check_group(*argument.lstrip("+").split("=", 1))
            overrides.append(_quoted_path(argument))
    return flags, overrides


def _read_flag(argument: str, waiting: Iterator[str]) -> list[str]:
    flag, equals, value = argument.partition("=")
    allowed = next((values for spellings, values in HYDRA_FLAGS.items() if flag in spellings), None)
    if allowed is None or (equals and not allowed):
        raise ConfigError(f"{argument}: no such flag; see gen-dataset --help")
    if not allowed:
        return [flag]
    value = value if equals else next(waiting, "")
    if not value or (allowed != ANY and value not in allowed):
        raise ConfigError(f"{flag} {value}: expected {'a value' if allowed == ANY else ', '.join(allowed)}")
    return [flag, value]


RECIPE = "experiment"
"""The group of recipes: no settings of its own, so it stands in no list of defaults, and is added."""


def _check_recipe(argument: str) -> None:
    if argument.startswith(f"{RECIPE}="):
        raise ConfigError(f"{argument}: a recipe is added to the settings; say +{argument}")


def _check_group(key: str, value: str) -> None:
    """Refuse a group's option that is no word: Hydra merges a list of them, and stumbles over a number."""
    folder = conf_dir() / key
    word = re.match(r"[A-Za-z_]", value) and value not in ("null", "true", "false")
    if key.isalpha() and folder.is_dir() and not word:
        options = ", ".join(sorted(path.stem for path in folder.glob("*.yaml")))
        raise ConfigError(f"{key}={value}: expected the name of an option: {options}")


# --------------------------------------------------------------------------------------- Hydra's errors, in one line


def _explain(error: BaseException, arguments: Sequence[str]) -> str:
    """Return one sentence with the key, the value and what is allowed."""
    from omegaconf.errors import OmegaConfBaseException

    from unprocess_gen.config import one_line

    chain: list[BaseException] = []
    link: BaseException | None = error
    while link is not None and link not in chain:
        chain.append(link)
        link = link.__cause__ or link.__context__
    text = " ".join(one_line(link) for link in chain)
    option = re.search(r"Could not find '([^']+)/([^'/]*)'\s+Available options in '[^']+':((?:\n\t\S+)+)", str(error))
    if option:
        return f"{option[1]}={option[2]}: no such option; expected one of {', '.join(option[3].split())}"
    unknown = re.search(r"Could not (?:override|append to config|delete from config)[^']*'([\w.@/]+)'", text)
    if unknown:
        return f"{_assignment(unknown[1], arguments)}: no such key; {_allowed(unknown[1])}"
    for link in chain:
        key = getattr(link, "full_key", None)
        if isinstance(link, OmegaConfBaseException) and key:
            return f"{_assignment(key, arguments)}: {_reason(link, key)}"
    return one_line(error)


def _reason(error: Any, key: str) -> str:
    message = str(error.msg or error).splitlines()[0]
    if re.search(r"Key '.*' not in", message):
        return f"no such key; {_allowed(key)}"
    return message


def _assignment(key: str, arguments: Sequence[str]) -> str:
    """Return ``key=value`` as the user wrote it, where the key stands on the command line."""
    return next((argument.lstrip("+~") for argument in arguments if argument.lstrip("+~").split("=")[0] == key), key)


def _allowed(key: str) -> str:
    """Return what stands where an unknown key was looked for."""
    from unprocess_gen.config import Config

    node: Any = Config()
    path = key.split(".")[:-1]
    for name in path:
        node = getattr(node, name, None)
    if not is_dataclass(node):
        node, path = Config(), []
    names = ", ".join(field.name for field in fields(node))
    return f"{'.'.join(path)} has {names}" if path else f"expected one of {names}"
