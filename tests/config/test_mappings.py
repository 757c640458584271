"""`load_config` of a mapping, and the option files in an application of the user's own."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import pytest
import yaml
from helpers.commands import run_process
from helpers.photographs import pixels
from omegaconf import DictConfig, OmegaConf

import unprocess_gen as ug
from unprocess_gen.config.option_files import PACKAGE_DIRECTIVE, conf_dir
from unprocess_gen.config.schema import GROUPS
from unprocess_gen.config.serialization import dataset_yaml

OPTIONS = sorted(path for path in conf_dir().glob("*/*.yaml") if path.parent.name in GROUPS)
OF_ONE_GROUP = [path for path in OPTIONS if not path.read_text().startswith(PACKAGE_DIRECTIVE)]
NEEDED = {
    "camera=custom": {"camera": {"xyz2cam": [1, 0, 0, 0, 1, 0, 0, 0, 1]}},
    "noise=heteroscedastic": {"noise": {"a": 2, "b": 9}},
    "noise=imx385": {"noise": {"iso": 1600}},
    "body=imx385": {"noise": {"iso": 1600}},
    "sensor=source": {"source": {"kind": "raw", "root": "."}},
    "source=raw": {"source": {"root": "."}},
}
"""Values that an option lacks on purpose."""


def compose(folder: Path, defaults: list[Any], data: dict[str, Any]) -> DictConfig:
    """Compose an application whose key ``data`` has options of the package."""
    settings = {"hydra": {"searchpath": ["pkg://unprocess_gen.conf"]}, "lr": 3, "data": data}
    (folder / "app.yaml").write_text(yaml.safe_dump({"defaults": [*defaults, "_self_"], **settings}))
    with hydra.initialize_config_dir(str(folder), version_base="1.3"):
        return hydra.compose("app", [])


def as_overrides(data: dict[str, Any]) -> list[str]:
    return [f"{group}.{key}={value}" for group, keys in data.items() for key, value in keys.items()]


FIRST = {path.parent: path for path in reversed(OF_ONE_GROUP)}.values()


@pytest.mark.parametrize(
    "path",
    [path if path in FIRST else pytest.param(path, marks=pytest.mark.slow) for path in OF_ONE_GROUP],
    ids=lambda path: f"{path.parent.name}={path.stem}",
)
def test_an_option_composed_in_an_application_is_the_option(path: Path, tmp_path: Path) -> None:
    group, name = path.parent.name, path.stem
    added = NEEDED.get(f"{group}={name}", {})
    data = compose(tmp_path, [{f"/{group}@data.{group}": name}], added).data
    overrides = [f"{group}={name}", *as_overrides(added)]

    config = ug.load_config(data)
    assert dataset_yaml(config) == dataset_yaml(ug.load_config(overrides))
    assert config == ug.load_config(overrides)


@pytest.mark.parametrize("path", OPTIONS, ids=lambda path: f"{path.parent.name}={path.stem}")
def test_text_for_a_group_is_the_option(path: Path, tmp_path: Path) -> None:
    choice = f"{path.parent.name}={path.stem}"
    added = {f"{group}.{key}": value for group, keys in NEEDED.get(choice, {}).items() for key, value in keys.items()}
    expected = ug.load_config([choice, *(f"{key}={value}" for key, value in added.items())])
    assert ug.load_config({path.parent.name: path.stem, **added}) == expected


def test_keys_of_mappings_are_nested_or_dotted_and_recipes_are_texts() -> None:
    nested = {"experiment": "crvd_like", "source": {"root": Path(), "include": ["*.jpg", "été $"]}, "split": {"a": 1}}
    expected = ["+experiment=crvd_like", "source.root=.", "source.include=['*.jpg','été $']", "split={a: 1}"]
    assert ug.load_config(nested) == ug.load_config(expected)
    assert ug.load_config({"noise.a": 2, "body": None}) == ug.load_config(["noise.a=2"])


def test_a_profile_of_the_application_has_no_number_of_the_default(tmp_path: Path) -> None:
    (tmp_path / "noise").mkdir()
    branch = "branches: [{iso: [100, 6400], dn_per_e: 2, read_std_dn: 3}]\n"
    levels = "units: dn\nblack: subtracted\nbits: 12\nblack_level_dn: 240\nwhite_level_dn: 4095\n"
    (tmp_path / "noise/mine.yaml").write_text(f"name: mine\n{levels}{branch}")
    config = ug.load_config(compose(tmp_path, [{"/noise@data.noise": "mine"}], {}).data)
    assert config == ug.load_config(["noise=mine"], tmp_path)
    assert (config.noise.a, config.noise.branches[0].dn_per_e) == (None, 2)


def test_interpolations_are_those_of_the_application(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UG_PHOTOS", str(tmp_path))
    data = {"seed": "${lr}", "source": {"root": "${oc.env:UG_PHOTOS}"}, "out": r"\${x}", "n_jobs": "${.seed}"}
    config = ug.load_config(compose(tmp_path, [], data).data)
    assert (config.seed, config.source.root, config.out, config.n_jobs) == (3, str(tmp_path), "${x}", 3)


REFUSED = [
    ({"noize": {"a": 1}}, "noize={a:1}: no such key; .*; did you mean noise"),
    ({"noise": {"aa": 1}}, "noise.aa=1: no such key; noise has "),
    ({"noise": {"a": "x"}}, "noise.a=x: expected a finite number or a distribution"),
    ({"noise": None}, "noise=null: expected the name of an option"),
    ({"camera": "leica"}, "camera=leica: no such option"),
    ({"seed": "???"}, r"seed=\?\?\?: has no value; expected one; set it in the application"),
    ({"seed": "${lr}"}, "seed: Interpolation key 'lr' not found"),
    ({"source": {"root": "${oc.env:UG_NOT_SET}"}}, "source.root: Environment variable 'UG_NOT_SET' not found"),
    ({"noise": {3: 1}}, r"noise\.3: the key is no text; expected the name of a setting"),
    ({"seed": np.float64(1)}, "seed: .*expected 0 to"),
    ({"source": {"kind": "folder"}}, "source.kind=folder: is of the config.yaml of a dataset"),
    ({"sweep": "cameras"}, "the overrides describe a sweep"),
]


@pytest.mark.parametrize(("mapping", "sentence"), REFUSED, ids=[str(mapping) for mapping, _ in REFUSED])
def test_mistakes_in_mappings_are_explained_in_one_sentence(mapping: dict[Any, Any], sentence: str) -> None:
    for load in (ug.load_config, ug.LivePairs, ug.CameraNoise):
        with pytest.raises(ug.ConfigError, match=sentence) as caught:
            load(mapping)
        assert "\n" not in str(caught.value)


def test_live_pairs_and_camera_noise_take_mappings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "noise").mkdir()  # a key is no folder of a dataset
    data = OmegaConf.create({"noise": "imx385_iso1600", "source": {"limit": 1}})
    overrides = ["noise=imx385_iso1600", "source.limit=1"]
    np.testing.assert_array_equal(ug.LivePairs(data)[1, 0].noisy, ug.LivePairs(overrides)[1, 0].noisy)
    first, second = (ug.CameraNoise(given)(pixels(1, 24, 32), index=0)[1] for given in (data, overrides))
    np.testing.assert_array_equal(first, second)


APP = """import hydra, unprocess_gen as ug
@hydra.main(version_base="1.3", config_path=".", config_name="app")
def main(cfg):
    print(ug.load_config(cfg.data).camera.name, ug.load_config(cfg.data).noise.name)
main()
"""


def test_an_application_composes_options_without_a_warning(tmp_path: Path) -> None:
    compose(tmp_path, [{"/camera@data.camera": "sony_a7r"}], {})
    (tmp_path / "app.py").write_text(APP)
    done = run_process(sys.executable, "-W", "error", "app.py", "+data.noise=imx385_iso1600", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "sony_a7r imx385_iso1600\n", "")
