"""The self-test detects a process that computes differently, and datasets record its result."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.photographs import fill
from helpers.promise_report import Figure

from unprocess_gen.config.schema import NoiseConfig
from unprocess_gen.config.settings import settings_of
from unprocess_gen.core import random_streams as streams
from unprocess_gen.core.errors import MachineError
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.simulation import lookup_tables, tone_curves
from unprocess_gen.simulation import self_test as selftest
from unprocess_gen.simulation.kernels import clean, gaussian, normal, philox, readout, render, strips
from unprocess_gen.simulation.pair import make_pair, reference_pair
from unprocess_gen.simulation.plan import NUMBERS


@pytest.fixture(autouse=True)
def _fresh() -> Iterator[None]:
    selftest.failures.cache_clear()
    yield
    selftest.failures.cache_clear()


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the override that selects two small photographs as the source."""
    return f"source.root={fill(tmp_path_factory.mktemp('self_test') / 'photographs', 2)}"


@pytest.mark.parametrize("kernels", selftest.kernels([*selftest.GOLDEN_PLANS.values()]))
def test_this_machine_passes_the_self_test(kernels: str) -> None:
    assert selftest.failures(kernels) == ()


def test_kernels_are_compiled_once_they_were_tested(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(selftest, "kernel_cache_folder", lambda: tmp_path)
    selftest.failures("gaussian")
    assert [*map(selftest.are_compiled, ("gaussian", "electrons", "reference"))] == [True, False, True]


@pytest.mark.parametrize("name", selftest.GOLDEN)
def test_golden_pairs_equal_the_reference_after_other_pairs(name: str) -> None:
    """Only ``float32`` states errors; a larger picture before leaves other numbers in the scratch memory."""
    plan = selftest.GOLDEN_PLANS[name]
    image = selftest.golden_image(plan)
    make_pair(np.full((3, 700, 3), image.max(), image.dtype), plan)
    for make in (make_pair, reference_pair) if "float32" not in name else (make_pair,):
        pair = make(image, plan, (1, 57))
        assert (array_xxh3(pair.clean), array_xxh3(pair.noisy)) == selftest.GOLDEN[name]


def test_the_float32_golden_pair_differs_from_float64() -> None:
    """Equal pairs could not show that the float32 kernels are tested."""
    plan = selftest.GOLDEN_PLANS["float32"].replace(accuracy="exact")

    assert array_xxh3(make_pair(selftest.golden_image(), plan, (1, 57)).noisy) != selftest.GOLDEN["float32"][1]


@pytest.mark.parametrize(
    ("kernels", "settings"),
    [
        ("gaussian", ["noise=imx385_iso3200"]),
        ("float32", ["noise=imx385_iso3200", "accuracy=fast"]),
        ("reference", ["noise=imx385_iso3200", "accuracy=reference"]),
        ("electrons", ["noise=sony_a7s2", "scene=daylight"]),
        pytest.param("electrons", ["noise=sony_a7s2", "scene=daylight", "effects.all=on"], marks=pytest.mark.slow),
        pytest.param("electrons", ["noise=imx385_iso3200", "noise.law=poisson"], marks=pytest.mark.slow),
        ("normalised_gaussian", ["noise=imx385_iso3200", "output.dtype=float32"]),
        pytest.param(
            "normalised_gaussian",
            ["noise=imx385_iso3200", "output.dtype=float32", "accuracy=fast"],
            marks=pytest.mark.slow,
        ),
        ("normalised_electrons", ["noise=sony_a7s2", "scene=daylight", "output.dtype=float32"]),
    ],
)
def test_only_the_kernels_of_the_plans_are_tested(
    kernels: str, settings: list[str], two: str, run_main: RunMain, monkeypatch: pytest.MonkeyPatch
) -> None:
    proved: list[str] = []
    monkeypatch.setattr(selftest, "failures", lambda kernels: proved.append(kernels) or ())

    assert run_main("n_jobs=1", two, *settings).code == 0
    assert set(proved) == {kernels}


def test_kernels_are_tested_when_a_plan_first_needs_them(
    two: str, run_main: RunMain, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The plans of all noise levels of an image count."""
    proved: list[str] = []
    monkeypatch.setattr(selftest, "failures", lambda kernels: proved.append(kernels) or ())
    monkeypatch.setattr(selftest, "kernels", lambda plans, _=(): [f"draw {plan.place.draw}" for plan in plans])

    assert run_main("n_jobs=1", two, "noise.draws=2").code == 0
    assert list(dict.fromkeys(proved)) == ["draw 0", "draw 1"]


def test_every_law_of_the_noise_has_a_golden_pair() -> None:
    plans = selftest.GOLDEN_PLANS.values()

    assert {plan.noise.noise_law for plan in plans} == set(settings_of(NoiseConfig)["law"].limit.words)
    assert {plan.physics.read_law for plan in plans if plan.physics} == set(NUMBERS["read_law"].limit.words)


def test_the_golden_image_reaches_every_limit() -> None:
    """Limits: clipped low and high, saturated, both kinds of highlights, every 8-bit code."""
    picture = selftest.golden_image()
    counts = reference_pair(picture, selftest.GOLDEN_PLAN, (1, 57)).counts

    assert set(np.unique(picture)) == set(range(256))
    assert min(counts.noisy_clipped_low, counts.noisy_clipped_high, counts.saturated) > 0


def last_bit(table: np.ndarray) -> np.ndarray:
    """Return the table with one central entry one unit in the last place larger."""
    changed = table.copy()
    changed.flat[changed.size // 2 + 1] = np.nextafter(changed.flat[changed.size // 2 + 1], np.inf)
    return changed


@pytest.mark.parametrize(("module", "build"), [(tone_curves, "compute_curve"), (lookup_tables, "_normal_row")])
def test_a_table_one_unit_off_is_detected(module: ModuleType, build: str, monkeypatch: pytest.MonkeyPatch) -> None:
    true: Callable[..., object] = getattr(module, build)
    monkeypatch.setattr(module, build, lambda *given: last_bit(np.array(true(*given)) * (1 + 2**-20)))
    tone_curves.linear_table.cache_clear()
    lookup_tables.normal_table.cache_clear()
    try:
        with pytest.raises(
            MachineError, match=r"the self-test failed: results differ \(a table has SHA-256 [0-9a-f]{64}; expected"
        ):
            selftest.check([selftest.GOLDEN_PLAN])
    finally:
        tone_curves.linear_table.cache_clear()
        lookup_tables.normal_table.cache_clear()


def test_a_wrong_philox_constant_is_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "ROUNDS", 9)

    assert "Philox of 00000000 differs from Random123" in selftest.failures("gaussian")


KERNEL_MODULES = (philox, strips, clean, normal, readout, gaussian, render)

KERNELS = {
    "_fill_signal": "", "_fill_gray_mean_signal": "", "_fill_linear": "clean", "_recompute_bright": "clean",
    "fill_word_blocks": "", "fill_values_by_lines": "", "approximate_gaussian": "noise_dn", "_round_and_list": "noisy",
    "exact_gaussian_site": "", "_replace": "noisy",
}  # fmt: skip
"""Kernels of the set ``gaussian``, and the member of the buffers that each fills; "" for its last argument or its
return value."""


def implementations(function: object) -> dict[type, Callable[..., object]]:
    """Return the kernels among which a function of `jit.by_class` chooses; none for another function."""
    if getattr(function, "__qualname__", "") != "by_class.<locals>.call":
        return {}
    found: dict[type, Callable[..., object]] = inspect.getclosurevars(function).nonlocals["implementations"]  # type: ignore[arg-type]
    return found


@pytest.fixture
def uncompiled(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Replace the kernels by plain Python functions."""
    for module in KERNEL_MODULES:
        for name, value in list(vars(module).items()):
            if hasattr(value, "py_func"):
                monkeypatch.setattr(module, name, value.py_func)
            for kind, one in implementations(value).items():
                monkeypatch.setitem(implementations(value), kind, getattr(one, "py_func", one))
    with np.errstate(over="ignore", invalid="ignore"):  # words wrap around; a nudge goes beyond a frame's numbers
        yield


@pytest.mark.usefixtures("uncompiled")
def test_uncompiled_kernels_pass_the_self_test() -> None:
    assert selftest.failures("gaussian") == ()


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("kernel", KERNELS)
def test_a_wrong_kernel_is_detected(kernel: str, monkeypatch: pytest.MonkeyPatch, figure: Figure) -> None:
    holders = [module for module in KERNEL_MODULES if hasattr(module, kernel)]
    right = getattr(holders[0], kernel)
    other = nudged(right, KERNELS[kernel])
    for module in holders:
        monkeypatch.setattr(module, kernel, other)
    for module in KERNEL_MODULES:
        for value in vars(module).values():
            for kind, one in implementations(value).items():
                if one is right:
                    monkeypatch.setitem(implementations(value), kind, other)

    assert any("the golden" in one for one in selftest.failures("gaussian"))
    figure("self-test", "an error in a kernel is detected")


def test_a_fused_multiply_add_is_detected(monkeypatch: pytest.MonkeyPatch, figure: Figure) -> None:
    def fused_at_once(x: np.ndarray, y: np.ndarray, out: np.ndarray) -> None:
        out[:] = [float(Fraction(a) ** 2 + Fraction(b)) for a, b in zip(x, y, strict=True)]

    monkeypatch.setattr(selftest, "_product_and_sum", fused_at_once)

    assert "a kernel uses a fused multiply-add" in selftest.failures("gaussian")
    figure("self-test", f"a fused multiply-add: {len(selftest.failures('gaussian'))} failure")


def nudged(kernel: Callable[..., object], member: str) -> Callable[..., object]:
    """Return the kernel with slightly larger outputs: one bit of the words, half a DN of signal or noise."""

    def other(*given: object) -> object:
        found = kernel(*given)
        if isinstance(found, float):
            return found + 0.5
        output = getattr(given[-1], member) if member else given[-1]
        assert isinstance(output, np.ndarray)
        output[: strips.STRIP] += {"uint32": 2**28, "uint16": 1, "float32": 0.5, "float64": 0.5}[output.dtype.name]
        return found

    return other


GOLDEN = {**selftest.GOLDEN, "per_channel": ("0" * 32, "0" * 32)}


def test_a_failed_self_test_stops_before_the_first_pair(
    two: str, run_main: RunMain, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(selftest, "GOLDEN", GOLDEN)

    done = run_main("n_jobs=1", two)

    assert done.code == 5
    assert done.err.startswith(
        "gen-dataset: the self-test failed: results differ (the golden clean frame (per_channel) is 443ea2ae"
    )
    assert done.err.endswith("or set self_test=go_on\n")
    assert len(done.err.splitlines()) == 1
    assert list((tmp_path / "ds" / "shards").iterdir()) == []
    assert not (tmp_path / "ds" / "dataset.json").exists()


def test_go_on_continues_and_records_the_failure(
    two: str, run_main: RunMain, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(selftest, "GOLDEN", GOLDEN)

    done = run_main("n_jobs=1", two, "output.pairs_per_shard=1", "self_test=go_on")

    facts = json.loads((tmp_path / "ds" / "dataset.json").read_text())
    assert done.code == 0
    assert done.err.count("the self-test failed: the golden clean frame") == 1
    assert facts["self_test"] == "failed"
    assert all("the golden clean frame" in entry["self_test"] for entry in facts["shards"])


def test_only_shards_of_the_failing_process_are_recorded(
    two: str, run_main: RunMain, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    arguments = ("n_jobs=1", two, "output.pairs_per_shard=1", "self_test=go_on")
    with monkeypatch.context() as patched:
        patched.setattr("unprocess_gen.pipeline.generate._finish", interrupted)
        assert run_main(*arguments).code == 130
    (tmp_path / "ds" / ".work" / "rows" / "00001.json").unlink()
    (tmp_path / "ds" / "shards" / "shard-00001.tar").unlink()
    monkeypatch.setattr(selftest, "GOLDEN", GOLDEN)
    selftest.failures.cache_clear()

    assert run_main(*arguments).code == 0

    shards = json.loads((tmp_path / "ds" / "dataset.json").read_text())["shards"]
    assert [("self_test" in entry) for entry in shards] == [False, True]


def interrupted(*_: object) -> None:
    raise KeyboardInterrupt


def test_replay_is_refused_after_a_failed_self_test(
    dataset: Path, run_main: RunMain, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(selftest, "GOLDEN", GOLDEN)

    assert run_main("replay", dataset / "manifest.csv").code == 5
