"""Compute the sums of the noise checks with NumPy, as their definitions state them."""

from __future__ import annotations

from typing import Any

import numpy as np

from unprocess_gen.core.types import Float
from unprocess_gen.reports.noise_check.expectation import LARGEST_Z
from unprocess_gen.reports.noise_check.site_sums import PARTNERS
from unprocess_gen.reports.noise_check.sums import LARGEST_DIFFERENCE, LEAST_DIFFERENCE_DN, TILE, Sums


def numpy_sums(sums: Sums, clean: Any, noisy: Any) -> dict[str, Float]:
    """Return the sums of a pair by the names of the attributes of `Sums`."""
    clean_dn = clean.astype(np.float64)
    z, weight = (np.zeros(clean.shape) for _ in range(2))
    found = {name: np.zeros_like(sums.z) for name in ("z", "cosine", "double")}
    for plane, site in enumerate(TILE):
        at = np.s_[site[0] :: 2, site[1] :: 2]
        x, table = clean_dn[at], sums.tables[plane]
        dn = np.rint(np.maximum(x, 0)).astype(int)
        of_site = 1 / np.maximum(table.std[dn], 1e-300)
        if sums.law.plan.clean_normalised:
            law = sums.law.of_site(plane)
            of_site = 1 / np.sqrt(law.variance(law.signal(x, site)))
        scale = np.where(sums.usable[plane][dn], of_site, 0)
        offset = sums.law.offset_dn[site[0], site[1] :: 2]
        of_plane = np.clip((noisy[at] - x - offset) * scale, -LARGEST_Z, LARGEST_Z)
        values = {"z": of_plane, "cosine": np.cos(of_plane), "double": np.cos(2 * of_plane)}
        if sums.law.plan.clean_normalised:
            for name in ("cosine", "double"):
                of, distance = getattr(table, name), x - dn
                values[name] = values[name] - distance * of.by_clean[dn] - distance**2 * of.by_square[dn]
        for name, some in values.items():
            np.add.at(found[name][plane], dn[scale > 0], some[scale > 0])
        mean = table.rounding_mean[dn] * np.where(scale > 0, 1 / np.maximum(table.std[dn], 1e-300), 0)
        z[at] = np.where(scale > 0, of_plane - mean - table.outlier_mean[dn], 0)
        weight[at] = scale
    found["neighbours"], found["partners"] = _neighbours(z, weight), _partners(sums, clean_dn, z, weight)
    return found | _lines(z, weight, sums.law.rows.variance)


def _residuals(z: Float, weight: Float) -> Float:
    """Return z without the weighted mean of each row."""
    information = np.maximum((weight * weight).sum(axis=1, keepdims=True), 1e-300)
    return z - weight * (z * weight).sum(axis=1, keepdims=True) / information


def _residual_variances(variance: Float, weight: Float) -> Float:
    """Return the variances of `_residuals` for independent z: the diagonal of P diag(variance) Pᵀ."""
    found = np.zeros_like(weight)
    for y, of_row in enumerate(weight):
        if of_row.any():
            projection = np.eye(len(of_row)) - np.outer(of_row, of_row) / (of_row @ of_row)
            found[y] = (projection**2) @ variance[y]
    return found


def _lines(z: Float, weight: Float, row_dn2: float) -> dict[str, Float]:
    rows, columns = ([n * length // 8 // 2 * 2 for n in range(8)] for length in reversed(z.shape))
    square, own = weight**2, 1 - row_dn2 * weight**2
    of_rows = np.stack([z * weight, square, own * square])
    of_columns = np.stack([_residuals(z, weight) * weight, square, _residual_variances(own, weight) * square])
    return {
        "rows": np.add.reduceat(of_rows, rows, axis=2),
        "columns": np.add.reduceat(of_columns, columns, axis=1).transpose(0, 2, 1),
    }


def _neighbours(z: Float, weight: Float) -> Float:
    found = []
    horizontal, vertical = (np.s_[:, :-2], np.s_[:, 2:], z), (np.s_[:-2], np.s_[2:], _residuals(z, weight))
    for before, after, of in (horizontal, vertical):
        inverse = weight[before] * weight[after]
        sums = (of[before] * of[after]).sum(), (inverse > 0).sum(), inverse.sum()
        found.append([*sums, (inverse.sum(axis=1) ** 2).sum()])
    return np.array(found)


def _partners(sums: Sums, clean: Float, z: Float, weight: Float) -> Float:
    found = np.zeros((3, 5))
    is_rounded = not sums.law.plan.clean_normalised
    least = LEAST_DIFFERENCE_DN if is_rounded else 0.0
    for kind, planes in enumerate(PARTNERS):
        for pair in planes:
            some = [[frame[TILE[n][0] :: 2, TILE[n][1] :: 2] for n in pair] for frame in (clean, z, weight)]
            difference = some[0][1] - some[0][0]
            at = (some[2][0] > 0) & (some[2][1] > 0) & (np.abs(difference) >= least)
            first, second = (1 / values[at] for values in some[2])
            noise, std = some[1][0][at] * first - some[1][1][at] * second, np.hypot(first, second)
            step = difference[at] / std
            limited = np.clip(step, -LARGEST_DIFFERENCE, LARGEST_DIFFERENCE)
            products = limited / std * noise, limited**2, np.abs(limited / std) * is_rounded, 2 * limited * step
            found[kind] += [some.sum() for some in (*products, (limited / std) ** 2)]
    return found
