"""Measure how hard the benchmark builds are, and write their cards: PSNR and SSIM of noisy and of denoised frames.

``python manifests/measure.py DIR`` makes every build in DIR, or uses what is there, and rewrites ``scores.csv``, the
cards and the table of ``README.md``; names after DIR select builds. Needs scikit-image (``pip install '.[photos]'``).

With ``--pin``, builds whose NAME.sha256 is missing get their digests and rows; those of others are not changed.
"""

from __future__ import annotations

import argparse
import csv
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

import unprocess_gen as ug
from unprocess_gen.cli.main import run
from unprocess_gen.cli.runs import make_build
from unprocess_gen.core.files import file_sha256
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.manifest import csv_lines, read_columns, read_rows
from unprocess_gen.dataset.row import COLUMN_NAMES
from unprocess_gen.reports.builds import MANIFEST, Build, build_names, read_build
from unprocess_gen.reports.scoring.items import dataset_items
from unprocess_gen.reports.scoring.scoring import score_items

FOLDER = Path(__file__).resolve().parent
SCORES = FOLDER / "scores.csv"
UNRECORDED = {"dataset.json", "sweep.csv", "sweep.csv.lock"}
DIGITS = {"psnr": 2, "ssim": 3}
BEGIN, END = "<!-- scores: written by measure.py -->", "<!-- end of scores -->"
METHODS, DOMAINS = ("noisy", "non_local_means"), ("raw", "srgb")
COLUMNS = tuple(f"{frame}_{domain}_{kind}" for frame in ("noisy", "denoised") for domain in DOMAINS for kind in DIGITS)


def measure(dataset: Path) -> dict[str, float]:
    """Compute the mean scores of a dataset as ``gen-dataset score`` does: of noisy, then of denoised frames."""
    scored = [score_items(dataset_items(dataset), method)["all"] for method in METHODS]
    means = [scores[f"{domain}_{kind}"]["mean"] for scores in scored for domain in DOMAINS for kind in DIGITS]
    return dict(zip(COLUMNS, means, strict=True))


# --------------------------------------------------------------------------------------------------- digests and cards


def make(build: Build, folder: Path, pin: bool) -> None:
    """Make a build; with ``pin``, record its digests and rows if it has none."""
    rows, digests = FOLDER / f"{build.name}.csv", FOLDER / f"{build.name}.sha256"
    if build.digests or not pin:
        if code := run(["build", build.name, "--to", str(folder)]):
            raise SystemExit(code)
        return
    _write_rows(rows, [], COLUMN_NAMES)  # no photograph is compared
    if code := make_build(build, folder):
        raise SystemExit(code)
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name not in UNRECORDED)
    digests.write_text("".join(f"{file_sha256(path)}  {path.relative_to(folder).as_posix()}\n" for path in files))
    manifests = [path for path in files if path.name == MANIFEST]
    used = set().union(*map(read_columns, manifests))
    columns = [name for name in COLUMN_NAMES if name in used]
    _write_rows(rows, (row for path in manifests for row in read_rows(path)), columns)


def _write_rows(file: Path, rows: Iterable[Row], columns: Sequence[str]) -> None:
    """Write rows as CSV with their header."""
    file.write_bytes(f"{','.join(columns)}\n".encode() + csv_lines(rows, columns))


def scores_of(build: Build, folder: Path) -> list[dict[str, str]]:
    """Return the lines of a build in ``scores.csv``, one for each dataset."""
    lines = []
    for dataset in build.datasets:
        print(f"{build.name} {dataset}", flush=True)
        texts = {name: f"{value:.{DIGITS[name[-4:]]}f}" for name, value in measure(folder / dataset).items()}
        lines.append(
            {"build": build.name, "dataset": dataset, "pairs": str(len(ug.RawPairs(folder / dataset))), **texts}
        )
    return lines


def mean_line(lines: list[dict[str, str]]) -> dict[str, str]:
    """Return the means over the pairs of all datasets of a build."""
    pairs = [int(line["pairs"]) for line in lines]
    means = {name: np.average([float(line[name]) for line in lines], weights=pairs) for name in COLUMNS}
    return {"pairs": str(sum(pairs)), **{name: f"{value:.{DIGITS[name[-4:]]}f}" for name, value in means.items()}}


def table(first: str, lines: dict[str, dict[str, str]]) -> str:
    """Return a Markdown table of scores, whose rows have names in the first column."""
    titles = (f"{frame}, {domain}" for frame in ("noisy", "denoised") for domain in ("raw", "sRGB"))
    text = [f"| {first} | pairs | {' | '.join(titles)} |", f"|---|{'--:|' * 5}"]
    for name, line in lines.items():
        cells = [f"{line[COLUMNS[at]]} / {line[COLUMNS[at + 1]]}" for at in range(0, len(COLUMNS), 2)]
        text.append(f"| {name} | {line['pairs']} | {' | '.join(cells)} |")
    return "\n".join(text)


def card(build: Build, lines: list[dict[str, str]]) -> str:
    """Return the card of a build in Markdown."""
    recipe = build.recipe
    sources = ", ".join(recipe.photographs) or "built-in scenes"
    settings = shlex.join(["gen-dataset", *(["-m"] if recipe.sweep else []), *recipe.overrides, *recipe.sweep])
    named = {f"`{line['dataset']}`": line for line in lines} if recipe.sweep else {}
    return CARD.format(
        name=build.name,
        title=recipe.title[0].upper() + recipe.title[1:],
        purpose=recipe.purpose,
        sources=sources,
        settings=settings,
        table=table("dataset", {**named, "all": mean_line(lines)}),
    )


CARD = """\
<!-- written by measure.py -->
# {name}

{title}. {purpose}

    gen-dataset build {name} --to {name}

- Sources: {sources}
- Settings: `{settings}`
- Digests: [`{name}.sha256`](../{name}.sha256); rows: [`{name}.csv`](../{name}.csv)

PSNR in dB / SSIM, means over the pairs, computed by [`measure.py`](../measure.py); [definitions](../README.md#scores).

{table}
"""


def texts(lines: list[dict[str, str]]) -> dict[str, str]:
    """Return the files that follow from the scores: the cards, and ``README.md`` with its table."""
    files, rows = {}, {}
    for build in map(read_build, build_names()):
        if of_build := [line for line in lines if line["build"] == build.name]:
            files[f"cards/{build.name}.md"] = card(build, of_build)
            rows[f"[`{build.name}`](cards/{build.name}.md): {build.recipe.title}"] = mean_line(of_build)
    before, _, rest = (FOLDER / "README.md").read_text(encoding="utf-8").partition(BEGIN)
    return {**files, "README.md": f"{before}{BEGIN}\n{table('build', rows)}\n{END}{rest.partition(END)[2]}"}


def read_scores() -> list[dict[str, str]]:
    """Return the lines of ``scores.csv``."""
    with SCORES.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def main() -> None:
    """Make and measure the builds that the command line names, all by default."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder of the builds")
    parser.add_argument("names", nargs="*", default=build_names(), metavar="NAME", help="build, all by default")
    parser.add_argument("--pin", action="store_true", help="record the digests of builds that have none")
    arguments = parser.parse_args()
    for name in arguments.names:
        make(read_build(name), arguments.folder / name, arguments.pin)
        others = [line for line in read_scores() if line["build"] != name]
        lines = sorted(others + scores_of(read_build(name), arguments.folder / name), key=lambda line: line["build"])
        with SCORES.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.DictWriter(stream, lines[0], lineterminator="\n")
            writer.writeheader()
            writer.writerows(lines)
        for file, text in texts(lines).items():
            (FOLDER / file).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
