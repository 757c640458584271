"""Experiment 1: compare simulated with real noise of a sensor, on frames that did not calibrate it.

    python docs/experiments/ladder.py CAPTURES [--to RESULTS.json]

CAPTURES is a folder that ``gen-dataset calibrate`` reads. Protocol: protocol.md.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from common import (
    Level,
    Sensor,
    arguments,
    correlation,
    divergence,
    halves,
    interval,
    ratio_of_medians,
    run,
    smooth,
    write,
)

import unprocess_gen as ug

MODELS = ("awgn", "two_numbers", "physical")
PAIRS = 4
BANDS = 8


def statistics(difference: Any) -> dict[str, float]:
    """Return deviations of row and column means, correlations, and the power of row means by frequency."""
    noise = difference / np.sqrt(2)
    rows, columns = noise.mean(axis=1), noise.mean(axis=0)
    power = np.abs(np.fft.rfft(rows - rows.mean()))[1:] ** 2 / len(rows)
    return {
        "std_dn": float(noise.std()),
        "row_mean_std_dn": float(rows.std(ddof=1)),
        "column_mean_std_dn": float(columns.std(ddof=1)),
        "next_in_row": correlation(noise[:, :-1], noise[:, 1:]),
        "next_in_column": correlation(noise[:-1], noise[1:]),
        "row_power_dn2": [float(band.mean()) for band in np.array_split(power, BANDS)],
    }


def judge(sensor: Sensor, level: Level, number: int) -> dict[str, Any]:
    """Compare the models with one level."""
    real = np.subtract(*map(np.float64, level.frames[:2]))
    found: dict[str, Any] = {"kind": level.kind, "mean_dn": level.mean_dn, "real": statistics(real)}
    clean = smooth(level)
    for model in MODELS:
        differences = []
        for pair in range(PAIRS):
            keys = (1000 * number + 2 * pair + side for side in (0, 1))
            differences.append(np.subtract(*(sensor.simulate(model, clean, key).astype(float) for key in keys)))
        each = [statistics(difference) for difference in differences]
        found[model] = {name: np.mean([one[name] for one in each], axis=0) for name in each[0]}
        found[model]["divergence"] = divergence(real, np.array(differences))
    return found


def main() -> None:
    """Run the experiment."""
    options = arguments(__doc__, "ladder", "captures of a sensor: EMVA data, captures.csv, or raw darks and flats")
    calibrating, judged = halves(options.data)
    sensor = Sensor(calibrating)
    saturated = [level.captures[0].path.name for level in judged if sensor.fills(level)]
    judged = [level for level in judged if not sensor.fills(level)]
    if not judged:
        raise ug.ConfigError(f"{options.data}: no level is left to judge; expected levels that do not saturate")
    levels = [judge(sensor, level, number) for number, level in enumerate(judged)]
    divergences = {model: [level[model]["divergence"] for level in levels] for model in MODELS}
    ratios = {
        name: {model: interval([level[model][name] / level["real"][name] for level in levels]) for model in MODELS}
        for name in ("std_dn", "row_mean_std_dn", "column_mean_std_dn")
    }
    write(
        {
            "calibrating_levels": len(calibrating),
            "judged_levels": len(judged),
            "saturated_levels": saturated,
            "divergence": {model: interval(values) for model, values in divergences.items()},
            "two_numbers_to_awgn": interval(
                np.column_stack((divergences["two_numbers"], divergences["awgn"])), ratio_of_medians
            ),
            "simulated_to_real": ratios,
            "next_in_row": {
                m: float(np.median([level[m]["next_in_row"] for level in levels])) for m in ("real", *MODELS)
            },
            "next_in_column": {
                m: float(np.median([level[m]["next_in_column"] for level in levels])) for m in ("real", *MODELS)
            },
            "row_power_dn2": {
                m: np.median([level[m]["row_power_dn2"] for level in levels], axis=0) for m in ("real", *MODELS)
            },
            "levels": levels,
        },
        options.to,
    )


if __name__ == "__main__":
    run(main)
