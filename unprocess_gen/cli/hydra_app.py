"""How settings are composed: overrides to a checked `Config`, by Hydra, for one run or for each job of a sweep.

The only room that names Hydra. Hydra prints several lines for a mistake and always ends with 1; so it is told to raise,
and every mistake becomes one line here. An exception that leaves a Hydra task costs a second line, so tasks hand over
their outcome instead. Of a sweep Hydra only parses the values; each job is then composed for itself.
"""

from __future__ import annotations

import itertools
import os
import pickle
import re
import select
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NoReturn

from unprocess_gen.cli.sweep import Job, folder_name, overrides_text, worst, write_table
from unprocess_gen.config.option_files import conf_dir
from unprocess_gen.core.errors import ConfigError, UnprocessGenError

if TYPE_CHECKING:
    from unprocess_gen.config.schema import Config
    from unprocess_gen.pipeline.generate import Summary

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

Task = Callable[["Config"], tuple[int, "Summary | None"]]
"""What is run on the settings: returns the exit code, and what was made."""


def compose(
    arguments: list[str], task: Task, sweep_csv: bool = False, meanwhile: Sequence[Callable[[], object]] = ()
) -> int:
    """Compose the settings and run ``task`` on them, with ``-m`` on every combination; return the exit code.

    ``sweep_csv`` says whether a sweep leaves its table in ``out``; ``meanwhile``, what a single run can do, step by
    step, while Hydra is busy, where there is a core for that (`compose_beside`). Raises ConfigError for settings that
    Hydra or `config.check` refuse, and whatever the task of a single run raises.
    """
    flags, overrides = _sort_arguments(arguments)
    swept = any(flag in SWEEP_FLAGS for flag in flags)
    flags = [flag for flag in flags if flag not in SWEEP_FLAGS]
    if not swept:
        config = None if flags or not meanwhile else compose_beside(overrides, meanwhile)
        return compose_one(flags, overrides, task) if config is None else task(config)[0]
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

    from unprocess_gen.config.schema import Config
    from unprocess_gen.config.validation import validate_config

    ConfigStore.instance().store(name="gen_dataset_schema", node=Config)
    outcomes: list[int | BaseException] = []

    def on_config(node: DictConfig) -> None:
        try:
            for key in _unknown_keys(node, Config()):
                raise ConfigError(f"{_assignment(key, overrides)}: no such key; {_allowed(key)}")
            config = OmegaConf.to_object(node)
            assert isinstance(config, Config)
            validate_config(config)
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


def compose_beside(overrides: list[str], meanwhile: Sequence[Callable[[], object]]) -> Config | None:
    """Return the settings as a child of this process composed and checked them, while the steps of ``meanwhile`` ran.

    To import Hydra and compose takes as long as to import what makes pairs: 0.4 s. On two cores that is done at once,
    and this process never holds what Hydra brings along. Raises ConfigError for settings that are refused, before the
    next step. None where there is no second core, where a fork is not safe or gains nothing, and where the child could
    not tell: then they are to be composed here, where everything that can go wrong is told.
    """
    if not _may_fork():
        return None
    reading, writing = os.pipe()
    try:
        child = os.fork()
    except OSError:
        os.close(reading)
        os.close(writing)
        return None
    told = b""
    if child == 0:
        os.close(reading)
        with os.fdopen(writing, "wb") as answer:
            _tell_settings(overrides, answer)
    try:
        os.close(writing)
        with os.fdopen(reading, "rb") as answer:
            for step in meanwhile:
                if not told and select.select([answer], [], [], 0)[0]:
                    told = answer.read()
                    _settings_in(told)
                step()
            told = told or answer.read()
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    return _settings_in(told)


def _settings_in(told: bytes) -> Config | None:
    """Return the settings that a child told, None where it did not; raise what it refused them with."""
    found: Config | ConfigError | None = None
    with suppress(Exception):  # nothing was told, or not all of it
        found = pickle.loads(told)
    if isinstance(found, ConfigError):
        raise found
    return found


def _may_fork() -> bool:
    """Whether nothing is running or loaded yet that a fork would break or make useless, and a core is idle.

    Where SIGCHLD is ignored, a child that ended is gone, and its number may be another's: then it cannot be ended.
    """
    single = threading.active_count() == 1 and not {"hydra", "numba", "cv2"} & set(sys.modules)
    return (
        single
        and signal.getsignal(signal.SIGCHLD) == signal.SIG_DFL
        and sys.platform == "linux"
        and len(os.sched_getaffinity(0)) > 1
    )


def _tell_settings(overrides: list[str], answer: BinaryIO) -> NoReturn:
    """Compose and check settings, write them or what is wrong with them, and end this process."""

    def tell(config: Config) -> tuple[int, None]:
        answer.write(pickle.dumps(config))
        return 0, None

    with suppress(BaseException):
        try:
            compose_one([], overrides, tell)
        except ConfigError as error:
            answer.write(pickle.dumps(error))
        answer.flush()
    os._exit(0)


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


def complain(error: BaseException, job: str = "") -> int:
    """Say what went wrong (in which ``job`` of a sweep), in one line where it is not a bug; return the exit code."""
    if isinstance(error, UnprocessGenError):
        print(f"gen-dataset: {job}{error}", file=sys.stderr)
        return error.exit_code
    traceback.print_exception(error)
    return 1


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
        code = complain(error, f"{folder}: ")
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

    from unprocess_gen.config.values import error_in_one_line

    chain: list[BaseException] = []
    link: BaseException | None = error
    while link is not None and link not in chain:
        chain.append(link)
        link = link.__cause__ or link.__context__
    text = " ".join(error_in_one_line(link) for link in chain)
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
    return error_in_one_line(error)


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
    from unprocess_gen.config.schema import Config

    node: Any = Config()
    path = key.split(".")[:-1]
    for name in path:
        node = getattr(node, name, None)
    if not is_dataclass(node):
        node, path = Config(), []
    names = ", ".join(field.name for field in fields(node))
    return f"{'.'.join(path)} has {names}" if path else f"expected one of {names}"
