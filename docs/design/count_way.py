"""Count the functions and files of the package on the way of one photograph, from ``main`` to a DN.

    python docs/design/count_way.py PHOTOGRAPH [overrides]

The way is the union of the call stacks at three moments: the file's bytes are decoded, a function returns the plan or a
part of it, and a function prepares or calls compiled code. Generated code, comprehensions and properties are left out.
A first run compiles kernels and fills caches; the second one is counted.
"""

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import unprocess_gen
from unprocess_gen.cli import main as command

PACKAGE = Path(unprocess_gen.__file__).parent
SETTINGS = ["body=sony_a7s2", "source.patch=[random,512,1]", "n_jobs=1"]
Function = tuple[str, str]
"""File below the package, and qualified name."""


def main(photograph: str, overrides: list[str]) -> None:
    """Print the number of functions and files of the way, and its functions by file."""
    way: set[Function] = set()

    def profile(frame: FrameType, event: str, value: Any) -> None:
        decodes = event == "c_call" and getattr(value, "__name__", "") == "imdecode"
        plans = event == "return" and is_own(frame.f_code) and type(value).__module__ == "unprocess_gen.simulation.plan"
        computes = event == "call" and is_own(frame.f_code) and "/simulation/kernels/" in frame.f_code.co_filename
        if decodes or plans or computes:
            way.update(functions_of(frame))

    with tempfile.TemporaryDirectory() as folder:
        arguments = ["gen-dataset", *SETTINGS, f"source.root={photograph}", *overrides]
        for number in range(2):
            sys.argv = [*arguments, f"out={folder}/{number}"]
            sys.setprofile(profile if number else None)
            try:
                code = command.main()
            finally:
                sys.setprofile(None)
            assert code == 0
    for file, name in sorted(way):
        print(f"{file:40} {name}")
    print(f"{len(way)} functions in {len({file for file, _ in way})} files")


def functions_of(frame: FrameType | None) -> Iterator[Function]:
    """Yield the functions of the package on a call stack, properties left out."""
    while frame is not None:
        if is_own(frame.f_code) and not is_property(frame):
            path = Path(frame.f_code.co_filename).relative_to(PACKAGE)
            yield path.as_posix(), frame.f_code.co_qualname
        frame = frame.f_back


def is_own(code: CodeType) -> bool:
    """Check whether code is a function in a file of the package."""
    return Path(code.co_filename).is_relative_to(PACKAGE) and not code.co_name.startswith("<")


def is_property(frame: FrameType) -> bool:
    """Check whether a frame executes the property of a class at the top level of its module."""
    kind, _, name = frame.f_code.co_qualname.rpartition(".")
    owner = frame.f_globals.get(kind) if kind else None
    return isinstance(vars(owner).get(name), property) if isinstance(owner, type) else False


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
