"""Make the pages and figures of the experiments from their results.

    python docs/experiments/page.py

Reads the JSON files next to this script, and writes a page for each of them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
from matplotlib import pyplot as plt

HERE = Path(__file__).parent
NAMES = {
    "real": "real",
    "noisy": "noisy, not denoised",
    "awgn": "AWGN",
    "two_numbers": "two numbers",
    "physical": "physical",
    "dark_frames": "dark frames",
    "camera_noise": "`CameraNoise`",
    "by_exposure": "by exposure",
    "fixed_gains": "fixed gains",
    "other_phone": "other phone",
    "camera_fit": "`CameraNoise.fit`",
    "noise_flow": "Noise Flow",
    "GAN": "GAN",
    "white_oracle": "white, oracle",
    "awgn_1.6": "AWGN × 1.6",
    "awgn_2.5": "AWGN × 2.5",
    "best_awgn": "best AWGN",
    "bilinear": "`CameraNoise`, bilinear",
    "malvar": "`CameraNoise`, default",
    "fitted": "`CameraNoise`, fitted",
    "fitted_isp": "`CameraNoise`, fitted with ISP",
}


def number(value: float) -> str:
    """Format a number with three digits."""
    return f"{value:.3g}" if 0.0001 <= abs(value) < 1000 or not value else f"{value:.4f}"


def with_interval(values: Sequence[float]) -> str:
    """Format a value with its interval."""
    return f"{number(values[0])} ({number(values[1])} to {number(values[2])})"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def met(condition: bool) -> str:
    """State whether a goal was met."""
    return "met" if condition else "not met"


def ladder(results: dict[str, Any]) -> str:
    """Return the page of experiment 1, and draw its figure."""
    models = ("awgn", "two_numbers", "physical")
    figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
    flats = [level for level in results["levels"] if level["kind"] == "flat"]
    for model in models:
        left.plot(
            [level["mean_dn"] for level in flats],
            [level[model]["divergence"] for level in flats],
            "o",
            label=NAMES[model],
        )
    left.set(yscale="log", xlabel="mean signal, DN", ylabel="divergence from real")
    for model in ("real", *models):
        right.plot(np.arange(1, 9) / 16, results["row_power_dn2"][model], ".-", label=NAMES[model])
    right.set(yscale="log", xlabel="frequency, cycles per row", ylabel="power of row means, DN²")
    left.legend(fontsize="small"), right.legend(fontsize="small", loc="lower left")
    figure.savefig(HERE / "ladder.png", dpi=80)
    ratios, divergences = results["simulated_to_real"], results["divergence"]
    ratio, rows = results["two_numbers_to_awgn"], ratios["row_mean_std_dn"]
    physical, two = rows["physical"][0], rows["two_numbers"][0]
    darks = [level for level in results["levels"] if level["kind"] == "dark"]
    flat = {model: number(float(np.median([level[model]["divergence"] for level in flats]))) for model in models}
    left_out = ", ".join(results["saturated_levels"])
    saturated = f" Levels that saturate are left out: those of {left_out}." if left_out else ""
    name = "row_mean_std_dn"
    dark = {
        model: number(float(np.median([one[model][name] / one["real"][name] for one in darks]))) for model in models
    }
    cells = [
        [
            NAMES[model],
            with_interval(divergences[model]),
            *(with_interval(ratios[name][model]) for name in ("std_dn", "row_mean_std_dn", "column_mean_std_dn")),
            number(results["next_in_row"][model]),
            number(results["next_in_column"][model]),
        ]
        for model in models
    ]
    return f"""# The ladder on raw frames

A sensor was calibrated on frames of {results["calibrating_levels"]} levels and judged on other frames, of
{results["judged_levels"]} levels.{saturated} Values are medians over levels with 95 % intervals. Pixels, row means and
column means are ratios of simulated to real standard deviations. Real neighbours correlate by
{number(results["next_in_row"]["real"])} in a row and by {number(results["next_in_column"]["real"])} in a column.

{table(["model", "divergence", "pixels", "row means", "column means", "next in row", "next in column"], cells)}

- Divergence of two numbers to that of AWGN: {with_interval(ratio)}. Goal, at most 0.05: {met(ratio[0] <= 0.05)}.
- Row means of physical, 0.95 to 1.05 of the real ones: {met(0.95 <= physical <= 1.05)} ({number(physical)}).
- Row means of two numbers, less than a third of the real ones: {met(two < 1 / 3)} ({number(two)}).

The protocol does not separate darks and flats. On darks alone, the ratio of row means is {dark["two_numbers"]} for two
numbers and {dark["physical"]} for physical. On flats alone, the median divergence is {flat["two_numbers"]} for two
numbers and {flat["physical"]} for physical. All simulated frames are of one body.

![divergence by level, and power of row means by frequency, real and simulated](ladder.png)
"""


def classifier(results: dict[str, Any]) -> str:
    """Return the page of experiment 2."""
    cells, goals = [], []
    for kind in ("dark", "flat"):
        found = results[kind]
        cells += [
            [
                f"{kind}s",
                NAMES[model],
                with_interval([100 * share for share in one["accuracy"]]),
                str(one["judged_frames"]),
            ]
            for model, one in found.items()
        ]
        best = min((one["accuracy"][0], model) for model, one in found.items())
        two = found["two_numbers"]["accuracy"][0]
        goals.append(
            f"- Best model on {kind}s: {NAMES[best[1]]}, {number(100 * best[0])} %."
            f" Goal, at most 55 %: {met(best[0] <= 0.55)}."
            f" Two numbers exceed 55 %: {met(two > 0.55)}."
        )
    return f"""# A classifier as judge

A network of {results["parameters"]} parameters was trained to distinguish real from simulated tiles of
{results["tile"]} x {results["tile"]} sites. It was judged on frames that neither calibrated the sensor nor trained it.
Accuracy is the mean of three seeds with 95 % intervals over frames; chance is 50 %.

{table(["frames", "model", "accuracy, %", "judged frames"], cells)}

{chr(10).join(goals)}

An independent measurement on 214 other flats of this CCD, at other levels, is not part of this experiment. It gave
66.5 % for AWGN, 68.8 % for two numbers, and 56.5 % (55.1 to 57.8) for physical.
"""


COLOUR = {
    "red_green": "R–G",
    "green_blue": "G–B",
    "chroma_to_luma": "chroma / luma",
    "lag_1": "lag 1 of R, G, B",
    "lag_1_y": "lag 1 of Y",
    "lag_1_cb": "lag 1 of Cb",
}
"""Statistics of colour noise."""


def against_real(one: dict[str, Any]) -> str:
    """Format a median with the real one, and the difference or ratio of the two with its interval."""
    compared = with_interval(one["difference"]) if "difference" in one else f"ratio {with_interval(one['to_real'])}"
    model, real = (f"{round(one[name], 2) + 0:.2f}" for name in ("model", "real"))
    return f"{model}, real {real}: {compared}"


def learned_noise(results: dict[str, Any]) -> str:
    """Return the page of experiment 3."""
    models = results["models"]
    head = ["noise", "patches", "groups", "divergence", "patches above 0.02", "deviation to real"]
    cells = [
        [
            NAMES[model],
            *(str(one[name]) for name in ("patches", "groups")),
            with_interval(one["divergence"]),
            str(one["above_goal"]),
            with_interval(one["std_to_real"]),
        ]
        for model, one in models.items()
    ]
    names = list(COLOUR)
    colour, neighbours = (
        table(
            ["noise", *(COLOUR[name] for name in part)],
            [[NAMES[model], *(against_real(one[name]) for name in part)] for model, one in models.items()],
        )
        for part in (names[:3], names[3:])
    )
    camera = models["camera_noise"]
    goals = [
        ("Divergence", camera["divergence"], 0.02),
        ("R–G correlation, difference", camera["red_green"]["difference"], 0.1),
        ("Lag 1 of Y, difference", camera["lag_1_y"]["difference"], 0.08),
    ]
    lines = [
        f"- {name}: {with_interval(value)}. Goal, at most {goal}: {met(value[0] <= goal)}."
        for name, value, goal in goals
    ]
    return f"""# Against learned noise

{results["judged"]} of {results["patches"]} patches of SIDD were judged, in {camera["groups"]} groups of one scene,
phone and ISO. `CameraNoise` was fitted on other patches of the same phone and ISO. Values are medians over groups with
95 % intervals.

{table(head, cells)}

- By exposure: noise is scaled as by digital brightening.
- Fixed gains: all lights have the same gains.
- Other phone: the noise was fitted on the other phone and scaled by ISO.
- White, oracle: the standard deviation at each level is that of the judged patch.
- At the median level, the variance of `CameraNoise` differs from the real variance by
  {100 * camera["variance_by_level_error"][0]:.0f} %.
- Noise Flow is compared with the real noise of its own pipeline, whose colours differ.

Goals of `CameraNoise`:

{chr(10).join(lines)}

## Colours

Correlations between channels, with their absolute differences from real after the colon. The last column is the
variance of chroma divided by that of luma, with its ratio to real.

{colour}

## Neighbours

Correlations with the next pixel in a row, with their absolute differences from real after the colon.

{neighbours}
"""


SETS = {
    "SIDD_patches": "Patches of SIDD: phones, rendered from raw without denoising or compression",
    "PolyU": "PolyU: pictures of cameras, saved again as JPEG of quality 75 with 4:2:0",
}
GOALS = {"SIDD_patches": {"malvar - awgn": 1.0, "malvar - best_awgn": 0.5}, "PolyU": {"malvar - awgn": 0.0}}
"""Least differences of PSNR, in dB; from 1 dB on, the interval is to be above 0 too."""


def decibels(values: Sequence[float]) -> str:
    """Format a value in dB with its interval."""
    return "{:.2f} ({:.2f} to {:.2f})".format(*values)


def real_pictures(name: str, results: dict[str, Any], steps: int) -> str:
    """Return the section of a set of real pairs."""

    def difference(pair: str) -> str:
        return " − ".join(NAMES[model] for model in pair.split(" - "))

    cells = []
    for model, psnr in results["psnr"].items():
        noise = results["noise"]["judged" if model == "noisy" else model]
        facts = [f"{noise['luma_codes']:.1f}", f"{noise['red_green']:.2f}"]
        cells.append([NAMES[model], decibels(psnr), with_interval(results["ssim"][model]), *facts])
    differences = [
        [difference(pair), decibels(psnr), with_interval(results["ssim_difference"][pair])]
        for pair, psnr in results["psnr_difference"].items()
    ]
    longer = results["psnr_of_longer_training"]
    seed_0 = {model: results["psnr_by_seed"][model][0] for model in longer}
    more = [[NAMES[model], f"{seed_0[model]:.2f}", f"{psnr:.2f}"] for model, psnr in longer.items()]
    lines = []
    for pair, least in GOALS.get(name, {}).items():
        value, low, _ = results["psnr_difference"][pair]
        bound = f"at least {least:g} dB{' and an interval above 0' if least >= 1 else ''}"
        is_met = met(value >= least and (least < 1 or low > 0))
        lines.append(f"- {difference(pair)}, goal {bound}: {is_met} ({value:.2f} dB).")
    if longer:
        kept = sorted(seed_0, key=seed_0.__getitem__) == sorted(longer, key=longer.__getitem__)
        word = "keep" if kept else "change"
        lines.append(f"- Twice the steps {word} the order of the {len(longer)} models in the last table.")
    not_run = [NAMES[model] for model in results["not_run"] if model != "real"]
    if not_run:
        lines.append(f"- Not run: {', '.join(not_run)}.")
    head = ["PSNR, dB, with seed 0", f"{steps:,} steps", f"{2 * steps:,} steps"]
    longer_training = f"\n{table(head, more)}\n" if more else ""
    return f"""
### {SETS.get(name, name)}

{results["pairs"]} pairs of {results["groups"]} groups.

{table(["training noise", "PSNR, dB", "SSIM", "luma, codes", "R–G"], cells)}

{table(["difference", "PSNR, dB", "SSIM"], differences)}

{chr(10).join(lines)}
{longer_training}"""


def training(results: dict[str, Any]) -> str:
    """Return the page of experiment 4."""
    sections = ""
    for part in (results, results.get("more_photographs")):
        if part is not None:
            sets = sorted(part["sets"].items(), key=lambda item: (item[0] not in GOALS, item[0] != "SIDD_patches"))
            sections += f"\n## Trained on {part['photographs']} photographs\n"
            sections += "".join(real_pictures(name, found, results["steps"]) for name, found in sets)
    page = f"""# Does it train better

A network of {results["parameters"]:,} parameters was trained with each kind of noise: {results["steps"]:,} steps,
{results["seeds"]} seeds (one for real pairs). It was judged on real sRGB pairs. The [protocol](protocol.md) describes
the models; [Experiments](index.md) summarises the results.

- PSNR and SSIM are means over groups, with 95 % intervals over groups. An interval of a difference that contains 0
  shows no difference.
- Luma and R–G are medians for the noise of training patches: standard deviation, and correlation of R and G. The first
  row describes the judged pictures instead.
- The best AWGN is chosen on the judged pictures.
{sections}"""
    if "raw" not in results:
        return page
    raw = results["raw"]
    cells = [[NAMES[model], with_interval(values)] for model, values in raw["error_to_noise"].items()]
    ratios = [
        [" / ".join(NAMES[name] for name in pair.split(" / ")), with_interval(values)]
        for pair, values in raw["error_ratio"].items()
    ]
    return f"""{page}
## On raw frames

Remaining squared error divided by the noise variance, measured on pairs of exposures without clean frames. Values are
medians over {raw["judged_levels"]} judged levels of the sensor:

{table(["training noise", "error / noise"], cells)}

{table(["ratio of errors", "median over levels"], ratios)}
"""


PAGES: dict[str, Callable[[dict[str, Any]], str]] = {
    "ladder": ladder,
    "classifier": classifier,
    "learned_noise": learned_noise,
    "training": training,
}


def main() -> None:
    """Make the pages of all results that exist."""
    for name, page in PAGES.items():
        results = HERE / f"{name}.json"
        if results.exists():
            (HERE / f"{name}.md").write_text(page(json.loads(results.read_text(encoding="utf-8"))), encoding="utf-8")


if __name__ == "__main__":
    main()
