"""`load_config`: overrides and option files to a validated config, inside other Hydra applications too."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import hydra
import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.version import getbase

from unprocess_gen.config import composition
from unprocess_gen.config.composition import compose_node, load_config, typed_config
from unprocess_gen.config.option_files import OptionFolders, conf_dir
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.raw_files import SUFFIXES

OWN_PROFILE = "name: own\nunits: normalized\nblack: subtracted\na: 1e-3\nb: 0\n"


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """Return a folder with one option of a user: ``noise=own``."""
    (tmp_path / "mine/noise").mkdir(parents=True)
    (tmp_path / "mine/noise/own.yaml").write_text(OWN_PROFILE)
    return tmp_path / "mine"


def test_overrides_and_option_files_of_the_user_decide_the_config(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = load_config(["camera=sony_a7r", "noise=imx385_iso1600", "seed=7"])
    assert (config.camera.name, config.noise.name, config.seed) == ("sony_a7r", "imx385_iso1600", 7)
    monkeypatch.chdir(own.parent)
    for folder in (own, str(own), "mine"):
        config = load_config(["noise=own", "noise.bits=null"], folder)
        assert (config.noise.name, config.noise.a) == ("own", 0.001)
    with pytest.raises(ConfigError, match="noise=own: no such option"):
        load_config(["noise=own"])


def test_hydra_composes_on_the_registered_schema() -> None:
    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        assert hydra.compose("config", ["seed=5"]).seed == 5


def test_a_running_hydra_application_keeps_its_state(tmp_path: Path) -> None:
    (tmp_path / "app.yaml").write_text("a: 1\n")
    with hydra.initialize_config_dir(str(tmp_path), version_base="1.2", job_name="app"):
        before, state = GlobalHydra.instance(), GlobalHydra.instance().hydra

        assert load_config(["seed=5"]).seed == 5
        with pytest.raises(ConfigError):
            load_config(["camera=nope"])

        assert GlobalHydra.instance() is before
        assert GlobalHydra.instance().hydra is state
        assert str(getbase()) == "1.2"
        node = hydra.compose("app", ["a=2"], return_hydra_config=True)
        assert (node.a, node.hydra.job.name) == (2, "app")


def test_threads_compose_at_the_same_time() -> None:
    seeds: list[int] = []
    threads = [threading.Thread(target=lambda i=i: seeds.append(load_config([f"seed={i}"]).seed)) for i in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(seeds) == list(range(6))


REFUSED = [
    ("camera=sony_a7", r"camera=sony_a7: no such option; expected one of canon_5d4, .*; did you mean sony_a7r\?"),
    ("source.rot=p", r"source.rot=p: no such key; source has root, kind, .*; did you mean root\?"),
    ("sed=1", r"sed=1: no such key; expected one of source, .*; did you mean seed\?"),
    ("seed=abc", r"seed=abc: expected 0 to 9223372036854775807$"),
    ("accuracy=quick", r"accuracy=quick: expected one of reference, exact, fast$"),
    ("source.include=null", r"source.include=null: expected a list of at least one pattern such as "),
    ("source.include={a: 1}", r"source.include=\{a: 1\}: expected a list of at least one pattern such as "),
    ("noise.branches=[1]", r"noise.branches\[0\]: expected a list of mappings with the keys of a branch$"),
    ("noise.provenance=[{sauce: x}]", r"noise.provenance: sauce: no such key; noise.provenance has .* mean source\?"),
    ("noise.branches=[{iso: x}]", r"noise.branches: iso: expected the lowest and the highest ISO, \[100, 6400\]$"),
    ("source.include=*.jpg", r"source.include=\*.jpg: expected a list, such as \[\*.jpg\]"),
    ("camera=sony_a7r,leica", "camera=sony_a7r,leica: several values; expected one; "),
    (
        "gains.red.x=1",
        "gains.red.x=1: no such key; expected a gain above 0, from 0.001 to 1000",
    ),
    ("seed=[1", r"seed=\[1: not a valid override"),
    ("~seed", r"~seed: a setting cannot be removed"),
    ("out=${no.such}", r"out=\$\{no.such\}: Interpolation key 'no.such' not found"),
    ("out=${oc.env:UG_NOT_SET}", r"out=\$\{oc.env:UG_NOT_SET\}: Environment variable 'UG_NOT_SET' not found$"),
    ("hydra.mode=MULTIRUN", r"describe a sweep; expected one config"),
    ("hydra.run.dir=here", r"hydra.run.dir=here: Hydra's own settings are fixed"),
    ("++sed=1", "sed=1: no such key; .*; did you mean seed"),
    ("body=sony", r"body=sony: no such option"),
    ("body=[imx385]", r"body=\[imx385\]: expected the name of an option"),
    (f"{'a' * 300}=1", "expected a setting key=value"),
    ("+sweep=cameras", "the overrides describe a sweep; expected one config"),
    ("source.include=" + "[" * 1000 + "]" * 1000, "nested too deeply"),
    ("source.include=" + "[" * 50_000 + "]" * 50_000, "nested too deeply"),
]


@pytest.mark.parametrize(("override", "sentence"), REFUSED, ids=[override[:40] for override, _ in REFUSED])
def test_mistakes_are_explained_in_one_sentence(override: str, sentence: str) -> None:
    started = time.process_time()
    with pytest.raises(ConfigError, match=sentence) as caught:
        load_config([override])
    assert "\n" not in str(caught.value)
    assert time.process_time() - started < 5


def test_options_that_a_built_in_option_hides_are_refused(own: Path) -> None:
    (own / "noise/none.yaml").write_text(OWN_PROFILE)
    with pytest.raises(ConfigError, match=r"noise=none: .*mine/noise/none.yaml has the name of a built-in file"):
        load_config(["noise=none"], own)


@pytest.mark.parametrize("place", ["typed_config", "validate_config", "check_overrides", "_check_own_files"])
def test_bugs_are_neither_hidden_nor_tried_twice(place: str, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def fail(*arguments: object) -> None:
        calls.append(arguments)
        raise AttributeError("a bug")

    monkeypatch.setattr(composition, place, fail)
    with pytest.raises(AttributeError, match="a bug"):
        load_config(["seed=3"])
    assert len(calls) == 1


WRONG_FILES = [
    ("noise/bad", ["noise=bad"], "", r"mine/noise/bad.yaml: noise.units=dnn: expected one of dn, normalized$"),
    ("noise/bad", ["noise=bad", "noise.units=dnm"], "", "^noise.units=dnm: expected one of"),
    (
        "noise/bad",
        ["noise=bad"],
        "noise",
        "noise=bad: no such option; .* for .*/mine/noise/bad.yaml, write --config-dir .*/mine$",
    ),
    (
        "experiment/bad",
        ["+experiment=bad"],
        "",
        r"\+experiment=bad: .*/bad.yaml: expected '# @package _global_' as its first",
    ),
]


@pytest.mark.parametrize(("name", "overrides", "folder", "sentence"), WRONG_FILES)
def test_refused_files_are_named_with_the_remedy(
    name: str, overrides: list[str], folder: str, sentence: str, own: Path
) -> None:
    (own / name).parent.mkdir(exist_ok=True)
    defaults = "defaults: [override /noise: none]\n" if "experiment" in name else ""
    (own / f"{name}.yaml").write_text(defaults + OWN_PROFILE.replace("normalized", "dnn"))
    with pytest.raises(ConfigError, match=sentence):
        load_config(overrides, own / folder)


def test_text_for_a_list_and_a_missing_folder_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"overrides='seed=1': one string; expected a list .*\['seed=1'\]"):
        load_config("seed=1")
    with pytest.raises(ConfigError, match=r"--config-dir nowhere: no such folder; expected"):
        load_config([], "nowhere")


def test_kind_of_the_source_chooses_patterns_and_sensor(own: Path) -> None:
    raw = ["source.kind=raw", f"source.root={own}"]
    config = load_config(raw)
    assert config.source.include == tuple(f"*{suffix}" for suffix in SUFFIXES)
    assert config.sensor.levels == "source"
    assert load_config([*raw, "body=sony_a7s2"]).sensor.bits == load_config(["sensor=sony_a7s2"]).sensor.bits
    assert load_config(["source.kind=srgb", "+experiment=raw_low_light"]).source.include == load_config().source.include
    (own / "experiment").mkdir()
    (own / "experiment/raw.yaml").write_text("# @package _global_\nsource:\n  kind: raw\n")
    with pytest.raises(ConfigError, match=r"source.kind=raw: .*expected source=raw, or '- override /source: raw'"):
        load_config(["+experiment=raw", f"source.root={own}"], own)


def test_interpolations_resolve_in_every_value(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UG_FOLDER", "here")
    config = load_config(["out=${oc.env:UG_FOLDER}/x", "seed=${output.pairs_per_shard}"])
    assert (config.out, config.seed) == ("here/x", 8)


@pytest.mark.parametrize("name", ["$HOME", "a$b", r"\${x}", "it's", "été", "a b", "[1]", "back\\slash", "=", "a,b"])
def test_folder_names_are_taken_as_they_are(name: str) -> None:
    place = os.path.expanduser("~/") + name.replace(r"\${", "${")
    assert load_config([f"+out=~/{name}"]).out == place
    assert typed_config(compose_node([f"noise.dark_frames=~/{name}"]), []).noise.dark_frames == place


BOMB = "".join(f"l{level}: &l{level} [{', '.join([f'*l{level - 1}' if level else '1'] * 9)}]\n" for level in range(12))


@pytest.mark.parametrize(("place", "overrides"), [("noise", ["noise=own"]), (".", [])])
def test_hostile_option_files_are_refused_in_one_line(place: str, overrides: list[str], tmp_path: Path) -> None:
    (tmp_path / place).mkdir(exist_ok=True)
    (tmp_path / place / "own.yaml").write_text(BOMB)
    folders = OptionFolders(name="own" if place == "." else "config", own=tmp_path)
    with pytest.raises(ConfigError, match=r"/own.yaml: line 5: more than 32 aliases$"):
        compose_node(overrides, folders)


def test_hostile_option_files_that_are_not_used_do_no_harm(own: Path) -> None:
    (own / "noise/empty.yaml").write_text("")
    assert load_config(["noise=own", "noise.bits=null"], own).noise.name == "own"
