r"""Run ``gen-dataset`` and report the libraries and kernels that it used, for the tests in `test_everywhere`.

    python tests/helpers/everywhere.py FACTS.json [gen-dataset's arguments]    make a dataset, then write the facts
    python tests/helpers/everywhere.py FACTS.json --code                       compile the kernels and run none of them

The facts come from the process that did the work, so that a setting which a library ignores proves nothing.

**Another processor, emulated** (optional): QEMU's user mode computes in software according to IEEE 754. On a Debian
machine with another processor, in a folder with this package's wheel, photographs and this script, for 64-bit Arm:

    apt-get download qemu-user-static; dpkg -x qemu-user-static_*.deb host
    mkdir -p apt/lists/partial apt/archives/partial; touch apt/status
    for_arm() { apt-get -o APT::Architecture=arm64 -o APT::Architectures=arm64 -o Dir::State="$PWD/apt" \
                    -o Dir::State::status="$PWD/apt/status" -o Dir::Cache="$PWD/apt" "$@"; }
    for_arm update; for_arm -dy --no-install-recommends install python3-minimal libpython3-stdlib libstdc++6 libgomp1
    for package in apt/archives/*.deb; do dpkg -x "$package" arm; done
    pip install --target site --no-deps antlr4-python3-runtime==4.9.3
    pip install --target site --no-deps --only-binary :all: --python-version 3.11 --platform manylinux_2_28_aarch64 \
        --platform manylinux_2_27_aarch64 --platform manylinux2014_aarch64 unprocess_gen-*.whl hydra-core==1.3.* \
        omegaconf==2.3.* packaging pyyaml numpy numba llvmlite opencv-python-headless joblib cloudpickle tqdm xxhash
    host/usr/bin/qemu-aarch64-static -L arm -E PYTHONPATH="$PWD/site" -E NUMBA_CACHE_DIR="$PWD/kernels" \
        arm/usr/bin/python3.11 everywhere.py arm.json source.root=photos n_jobs=1 out=ds-arm

Shards, manifest.csv, config.yaml and ``doubles`` in the facts must equal those of this machine. With eleven small
photographs this took 85 seconds, most of them for compiling (20 with ``NUMBA_DISABLE_JIT=1``). To emulate an old x86-64
for all libraries: ``host/usr/bin/qemu-x86_64-static -cpu Nehalem .venv/bin/python everywhere.py …`` (70 seconds).
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
import numpy as np
from numba.core.typing.templates import builtin_registry

from unprocess_gen.cli import main as cli
from unprocess_gen.simulation import self_test as selftest
from unprocess_gen.simulation.kernels import render, site_patterns
from unprocess_gen.simulation.kernels.strips import STRIP, allocate_scratch
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.plan import Plan

KERNELS = {
    f"{module_name}.{name}": value
    for module_name, module in sorted(sys.modules.items())
    if module_name.startswith("unprocess_gen.")
    for name, value in vars(module).items()
    if hasattr(value, "targetoptions") and value.__module__ == module_name
}
"""All compiled functions of the package."""

FUSED = re.compile(r"\b(?:v?fn?m(?:add|sub|acc|sac|la|ls|ad|sb)|x[sv]n?m(?:add|sub))\w*")
"""Instructions that multiply and add with one rounding: x86, Arm, RISC-V, Power."""

GUESSED = re.compile(r"\b(?:v?r(?:sqrt|cp)|fr(?:sqrt|ecp)|xv?r(?:sqrt)?e|vfr(?:sqrt7|ec7))\w*")
"""Instructions that give a reciprocal or a square root to a few digits."""

TARGETS = {
    "Arm": ("aarch64-unknown-linux-gnu", "neoverse-v1"),
    "RISC-V": ("riscv64-unknown-linux-gnu", "sifive-p670"),
}
"""Processors that can fuse, as LLVM names them."""


# Facts about the process ----------------------------------------------------------------------------------------------


def facts() -> dict[str, Any]:
    import cv2  # imported late: it reads its settings at import, and the run decides when

    from unprocess_gen.pipeline import generate as runner

    features = np._core._multiarray_umath.__cpu_features__
    return {
        "package": str(Path(cli.__file__).parent),
        "versions": {name: version(name) for name in runner.PACKAGES},
        "optimize": sys.flags.optimize,
        "numpy": [name for name in np._core._multiarray_umath.__cpu_dispatch__ if features[name]],
        "opencv": opencv_features(),
        "ipp": cv2.ipp.useIPP(),
        "product": product(),
        "libm": digest(repr([function(k / 999) for k in range(1, 999) for function in LIBM]).encode()),
        "kernels": kernels(),
    }


def opencv_features() -> list[str]:
    """Return the optional instruction sets that OpenCV uses."""
    import cv2

    return [one[1:] for one in cv2.getCPUFeaturesLine().split() if one[0] == "*" and one[-1] != "?"]


def hash_kernel_values() -> Any:
    """Hash all arguments of the outer kernel after each of its later calls: a change of one bit shows.

    Frames would show such a change once in 10^12 sites. The scratch memory holds the unrounded values of all stages for
    the last strip, including counts and deviates; it is hashed for complete strips, since its padding is undefined.
    """
    kernel, values = render._render, hashlib.sha256()

    def call_and_hash(*arguments: Any) -> None:
        kernel(*arguments)
        has_padding = arguments[0].shape[1] % STRIP
        for one in members((*arguments[:-4], *arguments[-3:], () if has_padding else arguments[-4])):
            values.update(np.asarray(one).tobytes())

    render._render, render.scratch_of_thread = call_and_hash, allocate_scratch
    return values


def members(value: Any) -> Iterator[Any]:
    """Yield the arrays and numbers of a tuple, also those of tuples inside."""
    if isinstance(value, tuple):
        for one in value:
            yield from members(one)
    else:
        yield value


LIBM: tuple[Callable[[float], float], ...] = (math.sin, math.asin, math.exp, math.log, lambda x: x**2.2)


def digest(data: Any) -> str:
    return hashlib.sha256(data).hexdigest()


def product() -> str:
    """Return the digest of a matrix product, which differs between libraries for linear algebra."""
    matrix = np.random.default_rng(0).random((50, 50))
    return digest(matrix @ matrix)


def kernels() -> dict[str, Any]:
    """Return how many kernels were loaded and compiled, and the digest of their machine code if none was loaded."""
    loaded = sum(sum(one.stats.cache_hits.values()) for one in KERNELS.values())
    code = "" if loaded else "".join(asm for one in KERNELS.values() for asm in one.inspect_asm().values())
    return {
        "loaded": loaded,
        "compiled": sum(len(one.overloads) for one in KERNELS.values()) - loaded,
        "code": digest(code.encode()) if code else None,
        "ymm": "ymm" in code,
    }


def make_pairs_of_all_kernels() -> None:
    """Make a pair of each of `plans`, in which every code of a photograph occurs."""
    n = np.arange(2 * STRIP)
    codes = (np.stack([n, n * 7, n * 13], axis=-1) % 256).astype(np.uint8).reshape(2, STRIP, 3)
    for plan in plans():
        make_pair(codes / np.float32(64) if plan.source.is_linear else codes, plan, origin=(5, 7))


def plans() -> list[Plan]:
    """Return plans that need all kernels."""
    golden = [plan for plan in selftest.GOLDEN_PLANS.values() if plan.accuracy != "reference"]
    full = selftest.GOLDEN_PLANS["physical"]
    averaged = full.replace(physics=selftest.GOLDEN_PHYSICS.replace(fixed_pattern_in_clean=True))
    dark = selftest.GOLDEN_PLAN.replace(a_dn=0.01, b_dn2=-1.0)
    few = selftest.GOLDEN_PLAN.replace(noise_law="poisson", a_dn=900.0)
    float32 = selftest.GOLDEN_PLANS["float32"].replace(highlight="gray_mean")
    pinned = full.replace(saturated_as="white", exposure_ratio=9.0)
    return [*golden, averaged, averaged.replace(dtype="float32"), dark, few, float32, pinned]


# Machine code ---------------------------------------------------------------------------------------------------------


def code() -> dict[str, Any]:
    """Return facts about the kernels' code, compiled by Numba for this target and by LLVM for others.

    Each entry is paired with that of a loop compiled with fast-math, which proves that the target can fuse operations
    and that this is detected. Nothing is executed, so that targets can be other processors.
    """
    free = numba.njit(fastmath=True)(multiply_and_add)
    free.compile((numba.float64[::1],) * 3)
    compile_kernels()
    chosen = kernels_chosen_by_class()
    kernels = [one for one in (*KERNELS.values(), *chosen) if one.signatures]
    compiled = {one.py_func for one in kernels}
    asm, free_asm = ("".join(code for one in of for code in one.inspect_asm().values()) for of in (kernels, [free]))
    ir, free_ir = ([code for one in of for code in one.inspect_llvm().values()] for of in (kernels, [free]))
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    return {
        "not compiled": [name for name, one in KERNELS.items() if one.py_func not in compiled],
        "instructions": {
            "Numba's own": [instructions(asm), instructions(free_asm)],
            **{
                name: [instructions(assembly(one, *target)) for one in (ir, free_ir)]
                for name, target in TARGETS.items()
            },
        },
        "fast-math flags": [fast_math_flags("".join(one)) for one in (ir, free_ir)],
        "called": sorted(set(re.findall(r"call [^@\n]*double>? @([\w.]+)", "".join(ir)))),
    }


def compile_kernels() -> None:
    """Compile the outer kernels, and with them all others, for the arguments of their calls; execute none."""
    for module, name in ((render, "_render"), (site_patterns, "_fill_normals"), (site_patterns, "_fill_defects")):
        setattr(module, name, compiler(getattr(module, name)))
    for dtype in (np.uint8, np.uint16):
        for plan in plans():
            make_pair(np.zeros((2, 2, 3), np.float32 if plan.source.is_linear else dtype), plan)
    selftest._product_and_sum.compile((numba.float64[::1],) * 3)


def kernels_chosen_by_class() -> list[Any]:
    """Return the kernels that Numba has compiled for functions of `jit.by_class`: it compiles them separately."""
    return [
        entry[0]
        for function, kind in builtin_registry.globals
        if getattr(function, "__qualname__", "") == "by_class.<locals>.call"
        for template in kind.templates
        for entry in template._impl_cache.values()
        if entry is not None
    ]


def compiler(kernel: Any) -> Callable[..., None]:
    """Return a function that compiles a kernel for its arguments without executing it."""
    return lambda *arguments: kernel.compile(tuple(map(numba.typeof, arguments))) and None


def multiply_and_add(x: Any, y: Any, out: Any) -> None:
    for i in range(out.size):
        out[i] += math.sqrt(x[i]) * y[i]


def assembly(modules: list[str], triple: str, cpu: str) -> str | None:
    """Return LLVM's code for another processor; None if this LLVM was built without it."""
    try:
        machine = llvm.Target.from_triple(triple).create_target_machine(cpu=cpu, opt=3)
    except RuntimeError:
        return None
    ir = "\f".join(modules)
    ir = re.sub(r"target triple = .*", f'target triple = "{triple}"', ir)
    ir = re.sub(r"target datalayout = .*", f'target datalayout = "{machine.target_data}"', ir)
    ir = re.sub(r"(?:tail )?call i8 @llvm\.x86\.atomic.*", "add i8 0, 0", ir)  # a counter of references
    return "".join(machine.emit_assembly(llvm.parse_assembly(one)) for one in ir.split("\f"))


def instructions(asm: str | None) -> dict[str, list[str]] | None:
    if asm is None:
        return None
    return {"fused": sorted(set(FUSED.findall(asm))), "guessed": sorted(set(GUESSED.findall(asm)))}


def fast_math_flags(ir: str) -> list[str]:
    """Return the flags on arithmetic that allow other results than those of IEEE 754."""
    operations = re.findall(r"= (?:\w+ )?(?:f(?:add|sub|mul|div|neg|rem)|call) (.*)", ir)
    return sorted({word for rest in operations for word in rest.split(" ")[:9] if word in FAST_MATH_FLAGS})


FAST_MATH_FLAGS = {"fast", "nnan", "ninf", "nsz", "arcp", "contract", "afn", "reassoc"}


def main(facts_path: str, *arguments: str) -> int:
    report: dict[str, Any]
    if arguments == ("--code",):
        exit_code, report = 0, code()
    else:
        sys.argv[1:] = arguments
        values = hash_kernel_values()
        exit_code = cli.main()
        make_pairs_of_all_kernels()
        report = {**facts(), "doubles": values.hexdigest()}
    Path(facts_path).write_text(json.dumps(report), encoding="utf-8")
    return exit_code


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
