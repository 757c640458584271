"""Words and docstrings: plain technical English, and numpydoc where one package calls another."""

from __future__ import annotations

import ast
import importlib
import io
import re
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from helpers.modules import MODULES, tree

ROOT = Path(__file__).parents[2]

BANNED = {
    r"rooms?": "module, buffers, space",
    r"the run_main|doorstep": "command line, argument check",
    r"the hall|the house": "package",
    r"desks?": "buffers",
    r"(made|make|makes|making|read|written|tried|drawn) again": "regenerate, recompute, retry",
    r"anew": "again, from scratch",
    r"(is|are|was|were) gone": "was deleted, does not exist",
    r"want of": "out of, missing",
    r"beside|besides": "next to, compared with, in addition to",
    r"nobody|as ever|beforehand|of old": "no one named; say who",
    r"stands?|stood": "is, contains, is defined",
    r"tells?|told": "reports, returns, identifies",
    r"says? (it|so|that)|said": "reports, states, is set to",
    r"but for": "except",
    r"whole": "complete, intact, entire; integer",
    r"machine failed us": "system error",
    r"(?-i:us|our|ours|we)": "no first person",
    r"(?-i:TODO|FIXME|XXX)": "unfinished work",
}
"""Words of the 0.1 dialect, as regular expressions that match complete words, and what to write instead."""

BAD_STARTS = re.compile(
    r"(As|Of|Do so|The same|By|Where|What|Whether|Which|How|That|Also|These|Those|It|Hold)\b"
    r"|(Return|Yield|Give) (what|by how|how much|that of|those of|the same)\b"
)
"""Openings that need the docstring before them, or say what names and types say."""

NUMPYDOC_CODES = {"PR01", "PR02", "PR03", "RT01", "GL06", "GL07", "SS03"}
"""Parameters documented, known and in order; returns documented; sections known and in order; summary with a period."""

WITH_SECTIONS = ("simulation.reference", "simulation.effects")
"""Packages that follow the article: functions that others import have sections, like the public API."""


def python_files() -> list[Path]:
    return [*MODULES, *sorted((ROOT / "tests").rglob("*.py"))]


def prose(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line number and text of comments, docstrings, messages and names of tests; of other files every line."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        yield from enumerate(text.splitlines(), start=1)
        return
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT or (token.type == tokenize.STRING and " " in token.string):
            for offset, line in enumerate(token.string.splitlines()):
                yield token.start[0] + offset, line
        elif token.type == tokenize.NAME and token.string.startswith("test_"):
            yield token.start[0], token.string.replace("_", " ")


PATTERN = re.compile(rf"(?<![\w.\-/`{{])({'|'.join(BANNED)})(?![\w`=])", re.IGNORECASE)


def banned_words(path: Path) -> list[str]:
    return [
        f"{path.relative_to(ROOT)}:{number}: {match[0]!r}; write {instead!r}"
        for number, line in prose(path)
        for match in PATTERN.finditer(line)
        for word, instead in BANNED.items()
        if re.fullmatch(word, match[0], re.IGNORECASE)
    ]


def docstrings(path: Path) -> Iterator[tuple[int, str, str]]:
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module):
            text = ast.get_docstring(node)
            if text:
                yield getattr(node, "lineno", 1), getattr(node, "name", path.stem), text


def bad_first_lines(path: Path) -> list[str]:
    return [
        f"{path.relative_to(ROOT)}:{line}: {name}: {text.splitlines()[0][:60]}"
        for line, name, text in docstrings(path)
        if BAD_STARTS.match(text)
    ]


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


@cache
def public_functions() -> tuple[str, ...]:
    """Return the functions of the public API, and those of `WITH_SECTIONS` that other packages import."""
    import unprocess_gen

    functions = {
        f"{module_of(path)}.{node.name}"
        for path in MODULES
        for node in tree(path).body
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_")
    }
    exported = {f"{getattr(getattr(unprocess_gen, name), '__module__', '')}.{name}" for name in unprocess_gen.__all__}
    packages = tuple(f"unprocess_gen.{package}" for package in WITH_SECTIONS)
    imported = set()
    for path in MODULES:
        own = module_of(path).split(".")[1:2]
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[1:2] != own:
                imported |= {f"{node.module}.{alias.name}" for alias in node.names}
    shared = {name for name in functions & imported if name.startswith(packages)}
    return tuple(sorted(shared | (functions & exported)))


def numpydoc_errors(name: str) -> list[str]:
    from numpydoc.validate import validate  # imports Sphinx, which takes 0.5 s

    module, _, function = name.rpartition(".")
    importlib.import_module(module)
    return [
        f"{name}: {code} {text}" for code, text in validate(f"{module}.{function}")["errors"] if code in NUMPYDOC_CODES
    ]


def texts() -> list[Path]:
    """Return the files of the documentation and of ``conf/``, which contain prose too."""
    return sorted([ROOT / "README.md", *ROOT.glob("docs/**/*.md"), *ROOT.glob("conf/**/*.yaml")])


def test_words_are_plain() -> None:
    files = [path for path in [*python_files(), *texts()] if path != Path(__file__)]
    found = [violation for path in files for violation in banned_words(path)]
    assert not found, "\n".join(found)


def test_docstrings_begin_with_their_subject() -> None:
    found = [violation for path in MODULES for violation in bad_first_lines(path)]
    assert not found, "\n".join(found)


def test_public_functions_follow_numpydoc() -> None:
    found = [error for name in public_functions() for error in numpydoc_errors(name)]
    assert not found, "\n".join(found)


def test_banned_words_are_found() -> None:
    assert banned_words(Path(__file__))
