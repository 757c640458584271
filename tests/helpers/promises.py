"""List the project's promises and the tests that prove them: the source of docs/evidence.md.

A test reports the number that it measured with the fixture ``figure`` (`promise_report`). The page and the table that
``pytest -m slow`` prints have one entry for each promise.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
RECORDED = ROOT / "docs" / "evidence_figures.json"
"""Figures of earlier runs by promise and test, which ``pytest --record-figures`` updates."""


class Promise(NamedTuple):
    """Hold one promise: its identifier, the sentence, the files of its tests, and the commands that show more."""

    id: str
    sentence: str
    files: tuple[str, ...]
    commands: tuple[str, ...] = ()


PROMISES = (
    Promise(
        "clean-frame",
        "Every clean DN follows from the manifest row and the source, by an independent float64 Algorithm 1.",
        ("tests/simulation/test_algorithm1.py",),
        ("PHOTOS=folder pytest -m slow tests/simulation/test_algorithm1.py",),
    ),
    Promise(
        "kernels",
        "The kernels give the reference's DN for every pixel, also by tile and by single pixel.",
        ("tests/simulation/test_pair.py",),
    ),
    Promise(
        "noise-moments",
        "Mean and variance of the noise are within bounds that follow from the sample size, at 64 levels, for every "
        "two-parameter profile.",
        ("tests/simulation/test_flat_fields.py",),
    ),
    Promise(
        "workers",
        "The bytes do not depend on `n_jobs`, file order, working directory, time zone, umask or locale.",
        ("tests/pipeline/test_generate.py",),
    ),
    Promise(
        "machines",
        "The bytes do not depend on the processor, the library versions, or the code that libraries select for a "
        "processor; 64-bit Arm was emulated.",
        ("tests/project/test_everywhere.py", "tests/helpers/everywhere.py"),
        ("pytest -m slow tests/project/test_everywhere.py",),
    ),
    Promise(
        "resume",
        "A run that was killed and rerun ends with the bytes of an uninterrupted run.",
        ("tests/pipeline/test_resume.py", "tests/pipeline/test_faults.py"),
        ("pytest -m slow tests/pipeline/test_faults.py",),
    ),
    Promise(
        "parts",
        "Parts made in any order, twice, or after any number of kills end with the bytes of one run.",
        ("tests/pipeline/test_parts.py",),
        ("pytest -m slow tests/pipeline/test_parts.py",),
    ),
    Promise(
        "dask",
        "A run on a Dask cluster ends with the bytes of a local run, whichever process dies, freezes or is slow.",
        ("tests/pipeline/test_dask.py",),
        ("pytest -m slow tests/pipeline/test_dask.py",),
    ),
    Promise(
        "disk-full",
        "A full disk ends the run with exit code 5; the next run completes the dataset to the same bytes.",
        ("tests/pipeline/test_faults.py",),
    ),
    Promise(
        "dead-worker",
        "The death of a worker is noticed within five seconds, and its shard is regenerated.",
        ("tests/pipeline/test_faults.py",),
    ),
    Promise(
        "independence",
        "Adding a photograph changes no parameter and no noise of another.",
        ("tests/pipeline/test_generate.py",),
    ),
    Promise(
        "photon-transfer",
        "The noise in the arrays is what the rows state, for every kind of noise, where its standard deviation is "
        "above 1 DN.",
        ("tests/reports/test_photon_transfer.py",),
        ("gen-dataset verify DIR --noise",),
    ),
    Promise(
        "noise-check",
        "A dataset with right noise raises no alarm, and faults of the noise are found in at least 95 % of runs.",
        ("tests/reports/test_noise_check.py",),
        ("gen-dataset verify DIR --noise",),
    ),
    Promise(
        "levels",
        "Noise levels, draws and frames of a clip share the clean frame, and each has its own noise.",
        ("tests/simulation/test_levels.py",),
    ),
    Promise(
        "video",
        "Colours of videos are within half a code of the formula. A frame depends neither on the order of reading nor "
        "on SIMD.",
        ("tests/sources/video/test_colours.py", "tests/sources/video/test_decode.py"),
    ),
    Promise(
        "patches",
        "A patch is the crop of its full frame's pair; random patches do not depend on other images.",
        ("tests/sources/test_patches.py",),
    ),
    Promise(
        "effects",
        "Each physical effect follows its distribution, and none changes the values of another.",
        (
            "tests/simulation/test_effects.py",
            "tests/simulation/test_read_noise.py",
            "tests/simulation/test_effect_independence.py",
        ),
    ),
    Promise(
        "poisson",
        "Poisson counts follow their distribution to 2^-32, at any rate up to 1e9.",
        ("tests/simulation/kernels/test_poisson.py",),
    ),
    Promise(
        "normal",
        "Normal deviates are within their stated error of the true quantile, for every random word.",
        ("tests/simulation/kernels/test_normal.py", "tests/core/test_lookup_tables.py"),
    ),
    Promise(
        "float-output",
        "Frames in float32 are the frames in DN before rounding, with the same bytes in every tier.",
        ("tests/simulation/test_float_output.py",),
    ),
    Promise(
        "experiments",
        "The shipped experiments contain the numbers of their sources.",
        ("tests/config/test_experiments.py",),
    ),
    Promise(
        "curves",
        "All 256 and 65,536 entries of the curves are correctly rounded.",
        ("tests/core/test_lookup_tables.py",),
    ),
    Promise(
        "verify",
        "`verify` finds and names any flipped bit, truncation, and swapped, foreign or missing shard.",
        ("tests/pipeline/test_verify.py",),
        ("pytest -m slow tests/pipeline/test_verify.py",),
    ),
    Promise(
        "repair",
        "`verify --repair` restores damaged files to the same bytes and touches nothing else.",
        ("tests/pipeline/test_repair.py",),
    ),
    Promise(
        "colours",
        "Every colour that no clip touches returns to its own 8-bit code, for four cameras and extreme gains; white "
        "stays white.",
        ("tests/simulation/reference/test_isp.py",),
        ("pytest -m slow tests/simulation/reference/test_isp.py",),
    ),
    Promise(
        "developing",
        "A developed raw frame has the codes of its photograph in flat areas; demosaicing restores linear ramps except "
        "at the border, for all four patterns.",
        ("tests/simulation/reference/test_isp.py",),
    ),
    Promise(
        "preview",
        "A contact sheet shows what the dataset contains, panel by panel.",
        ("tests/reports/test_sheets.py",),
    ),
    Promise(
        "tiers",
        "The error of each method and tier stays within its stated bound.",
        ("tests/reports/test_benchmark.py", "tests/simulation/test_pair.py"),
        ("gen-dataset accuracy source.root=folder",),
    ),
    Promise(
        "report",
        "A dataset's page agrees with its manifest, escapes every name, and fits a window and a phone in a browser.",
        ("tests/reports/test_dataset_page.py",),
    ),
    Promise(
        "paper-figures",
        "Saturated sites in the article's figures are those that Algorithm 1 counts, in both readings of Figure 6.",
        ("tests/reports/test_paper.py",),
        ("gen-dataset figures",),
    ),
    Promise(
        "self-test",
        "A machine that computes differently is detected before its first pair.",
        ("tests/simulation/test_self_test.py",),
    ),
    Promise(
        "replay",
        "Any pair can be regenerated from its row and its source.",
        ("tests/pipeline/test_verify.py",),
        ("gen-dataset replay MANIFEST",),
    ),
    Promise(
        "dng",
        "LibRaw reads a DNG's array bit for bit, and develops it to the photograph's linear light within rounding.",
        ("tests/dataset/test_dng.py",),
        ("PHOTOS=folder pytest -m slow tests/dataset/test_dng.py",),
    ),
    Promise(
        "mistakes",
        "A wrong setting gives one line and exit code 2, and writes nothing.",
        ("tests/config/test_validation.py", "tests/cli/test_main.py"),
    ),
    Promise(
        "start",
        "A run imports no large library that it does not need, and reuses machine code until a kernel changes.",
        ("tests/project/test_start.py", "tests/core/test_jit.py"),
    ),
    Promise(
        "damaged-pictures",
        "No truncated JPEG or PNG is decoded, and no picture whose codec reports damage; every file has a row.",
        ("tests/sources/image/test_decode.py", "tests/sources/test_listing.py"),
    ),
    Promise(
        "hostile-files",
        "Broken, oversized and unusual pictures of other projects cause no crash and no hang: at most 10 s and 1.5 GB "
        "each.",
        ("tests/sources/test_hostile_files.py",),
        ("pytest -m slow tests/sources/test_hostile_files.py",),
    ),
    Promise(
        "hostile-names",
        "Names of any bytes are restored exactly; nothing is written outside `out`; no cell starts a formula.",
        ("tests/sources/test_hostile_names.py",),
    ),
    Promise(
        "pinned-builds",
        "The pinned builds of `manifests/` are reproduced.",
        ("tests/project/test_pinned.py",),
    ),
    Promise(
        "site",
        "Every link and picture of the documentation's site resolves; it loads nothing from servers; its pages fit a "
        "window and a phone.",
        ("tests/project/test_site.py",),
    ),
)
"""Every promise, in the order of the page."""

BY_ID = {promise.id: promise for promise in PROMISES}

_REPORTED = re.compile(r'\bfigure\(\s*"([a-z0-9-]+)"')

_NUMBER = re.compile(r"(?<![\w^.])\d+(?:,\d{3})*(?:\.\d+)?(?:e[-+]?\d+)?(?![\w^])")
"""A number of a figure, but no part of a name and no power such as 2^32."""

Figures = dict[str, dict[str, dict[str, int]]]
"""Number of cases with each figure, by promise, test function (``file::function``) and figure."""


def reporting_files() -> dict[str, set[str]]:
    """Return for each promise the test files that contain a call of ``figure`` for it."""
    found: dict[str, set[str]] = {promise.id: set() for promise in PROMISES}
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        for name in _REPORTED.findall(path.read_text(encoding="utf-8")):
            found.setdefault(name, set()).add(path.relative_to(ROOT).as_posix())
    return found


def recorded_figures() -> Figures:
    """Return the recorded figures of tests that exist."""
    if not RECORDED.exists():
        return {}
    figures: Figures = json.loads(RECORDED.read_text(encoding="utf-8"))
    return {
        promise: {test: cases for test, cases in tests.items() if _exists(test)}
        for promise, tests in figures.items()
        if promise in BY_ID
    }


def _exists(test: str) -> bool:
    """Return whether a test function is in its file."""
    path, _, function = test.partition("::")
    return (ROOT / path).exists() and f"def {function}(" in (ROOT / path).read_text(encoding="utf-8")


def one_line(figures: dict[str, dict[str, int]]) -> str:
    """Return the figures of a promise's tests in one line.

    Figures that differ only in their numbers become one, with sums or ranges of the numbers and the number of cases.
    """
    alike: dict[tuple[str, ...], Counter[str]] = {}
    for texts in figures.values():
        for text, cases in texts.items():
            alike.setdefault(tuple(_NUMBER.split(text)), Counter())[text] += cases
    return "; ".join(_combined(words, texts) for words, texts in alike.items())


def _combined(words: tuple[str, ...], texts: Counter[str]) -> str:
    """Return one figure for all ``texts``, which have the same words between their numbers.

    The counts of "3 of 4" are added over all cases; other numbers become a range.
    """
    numbers = {text: [float(number.replace(",", "")) for number in _NUMBER.findall(text)] for text in texts}
    counts = [number for number, word in enumerate(words) if 0 < number < len(words) - 1 and word == " of "]
    shown = words[0]
    for place, word in enumerate(words[1:]):
        if place + 1 in counts or place in counts:
            total = sum(values[place] * texts[text] for text, values in numbers.items())
            shown += f"{total:,.0f}{word}"
            continue
        spelt = [_NUMBER.findall(text)[place] for text in texts]
        low, high = (choose(spelt, key=lambda text: float(text.replace(",", ""))) for choose in (min, max))
        shown += (low if low == high else f"{low} to {high}") + word
    cases = texts.total()
    return shown if cases == 1 else f"{shown} ({cases} cases)"


def evidence_table() -> str:
    """Return the Markdown table of docs/evidence.md."""
    figures = recorded_figures()
    lines = ["| promise | figure | tests and commands |", "|---|---|---|"]
    for promise in PROMISES:
        proofs = [f"`{proof}`" for proof in promise.files + promise.commands]
        shown = one_line(figures.get(promise.id, {})).replace("|", "\\|")
        lines.append(f"| {promise.sentence} | {shown} | {'<br>'.join(proofs)} |")
    return "\n".join(lines)
