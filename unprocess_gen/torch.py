"""Develop raw frames to sRGB in PyTorch, in batches and with gradients: for a loss in sRGB, as Brooks et al. train.

Import it by name (``from unprocess_gen.torch import develop``); nothing else imports PyTorch. The steps, formulas and
filters are those of `simulation.reference.isp`, whose `isp.develop` gives the values before rounding to codes. In
float64 both differ by less than 1e-9.

There is neither a convolution nor a matrix product: GPUs and autocast may compute these with 10 bits of precision.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from unprocess_gen.dataset.columns import Value
from unprocess_gen.dataset.development import FILTERS, SRGB, DevelopmentParameters, development_parameters
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference import isp
from unprocess_gen.simulation.reference.cfa import MONO, plane_sites, tile

__all__ = ["DevelopmentParameters", "develop", "development_parameters"]

LEAST_STEEPNESS = 0.1
"""Bound that keeps gradients finite where light is negative and the channel mean has no root of its own."""

LEAST_LIGHT = 1e-8
"""Light below which the gradient of a power curve is 0; its slope is infinite at 0. The value of Brooks et al."""


def develop(
    frames: Tensor, rows: DevelopmentParameters | Mapping[str, Value] | Plan | Sequence[Mapping[str, Value] | Plan]
) -> Tensor:
    """Render raw frames as sRGB, without rounding to codes.

    Parameters
    ----------
    frames : Tensor
        Mosaics [N, H, W] or [N, 1, H, W], packed planes [N, 4, H / 2, W / 2], or camera RGB [N, 3, H, W], which is not
        demosaicked. Integers are DN; floats are light, 0 at black and 1 at white, not clipped.
    rows : DevelopmentParameters, mapping, Plan, or sequence of mapping and Plan
        Parameters of all frames, stacked; or one row or plan for each frame, or for all.

    Returns
    -------
    Tensor, [N, 3, H, W]
        Display-referred values in [0, 1], R, G, B, on the device of the frames: in their dtype if that is float64,
        otherwise in float32; integers give the default dtype. They differ from those of `unprocess_gen.develop` before
        rounding by at most 1e-9 in float64 and 1e-5 in float32. Power curves without a tone curve are computed in
        float64 for that; Apple's GPUs have no float64, so there the limit is 1e-3 for dark colours.

    Raises
    ------
    DamageError
        If a row is not the row of a pair.
    ValueError
        If frames have another shape, or a side under 2 sites, or there are not as many rows as frames.

    Notes
    -----
    Gradients with respect to the frames are exact, also through highlights, which are solved by iteration. They are 0
    where a channel is below 0 or above 1 after the colour matrix, because it is clipped there, and where a power curve
    receives less than 1e-8. A channel of exactly 1 has the gradient of the side below. All are finite.
    """
    if frames.ndim == 3:
        frames = frames[:, None]
    if frames.ndim != 4 or frames.shape[1] not in (1, 3, 4):
        raise ValueError(f"frames={list(frames.shape)}: expected [N, H, W], or [N, C, H, W] with C of 1, 3 or 4")
    if min(frames.shape[2:]) < (2 if frames.shape[1] == 1 else 1):
        raise ValueError(f"frames={list(frames.shape)}: channels are missing; expected at least 2 x 2 sites")
    is_dn = not frames.is_floating_point()
    own = torch.get_default_dtype() if is_dn else frames.dtype
    values = frames.to(torch.promote_types(own, torch.float32))
    kinds, (codes, numbers) = defaultdict(list), _stacked(rows, len(frames))
    for number, kind in enumerate(zip(*(code.tolist() for code in codes), strict=True)):
        kinds[_Kind(*kind)].append(number)
    scale = 2 if frames.shape[1] == 4 else 1
    image = values.new_empty((len(values), 3, scale * values.shape[2], scale * values.shape[3]))
    for kind, members in kinds.items():
        dtype = torch.float64 if kind.is_steep and values.device.type != "mps" else values.dtype
        levels, *others = (part[members].to(dtype).to(values.device) for part in numbers)
        light = values[members].to(dtype)
        if is_dn:
            black, white = levels.T[:, :, None, None, None]
            light = (light - black) / (white - black)
        image[members] = _develop(light, kind, *others).to(image.dtype)
    return image


class _Kind(NamedTuple):
    """Choices that frames developed together share: positions as in `DevelopmentParameters`, and gamma."""

    pattern: int
    highlight: int
    tone: int
    gamma: float

    @property
    def is_smooth(self) -> bool:
        return list(isp.TONES)[self.tone] == "smoothstep"

    @property
    def is_steep(self) -> bool:
        """True if the power curve of dark colours would magnify the rounding of float32 to 1e-3."""
        return not self.is_smooth and self.gamma not in (SRGB, 1.0)


def _stacked(rows: Any, count: int) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Parameters of all frames, those of `_Kind` first; ValueError unless there are as many as frames."""
    if isinstance(rows, Mapping | Plan):
        rows = development_parameters(rows)
    elif not isinstance(rows, DevelopmentParameters):
        rows = map(np.stack, zip(*map(development_parameters, rows), strict=True))
    tensors = [torch.as_tensor(value) for value in rows] or [torch.empty(0)] * len(DevelopmentParameters._fields)
    if tensors[0].ndim == 0:
        tensors = [value.expand(count, *value.shape) for value in tensors]
    if len(tensors[0]) != count:
        raise ValueError(f"rows={len(tensors[0])}: there are {count} frames; expected a row for each, or one for all")
    return tuple(tensors[:4]), tuple(tensors[4:])


def _develop(
    light: Tensor, kind: _Kind, exposure_ratio: Tensor, threshold: Tensor, inverse_gains: Tensor, cam2rgb: Tensor
) -> Tensor:
    """Develop frames of one kind, as `isp.develop` does."""
    light = light * exposure_ratio[:, None, None, None]
    pattern, highlight = FILTERS[kind.pattern], list(isp.HIGHLIGHTS)[kind.highlight]
    apply_gains, threshold, k = HIGHLIGHTS[highlight], threshold[:, None, None, None], inverse_gains[:, :, None, None]
    if light.shape[1] == 4:
        order = [plane_sites(pattern).index((y, x)) for y in (0, 1) for x in (0, 1)]
        light = torch.pixel_shuffle(light[:, order], 2)
    if light.shape[1] == 3:
        balanced = apply_gains(light, k, threshold)
    else:
        height, width = light.shape[2:]
        tiles = k[:, np.ravel(tile(pattern)), 0, 0].view(-1, 1, 2, 2)
        site_k = tiles.repeat(1, 1, (height + 1) // 2, (width + 1) // 2)[:, :, :height, :width]
        if highlight == "gray_mean":
            balanced = apply_gains(_demosaic(light / site_k, pattern) * k, k, threshold)
        else:
            balanced = _demosaic(apply_gains(light, site_k, threshold), pattern)
    columns = cam2rgb[:, :, :, None, None].unbind(2)
    linear = sum(column * balanced[:, [channel]] for channel, column in enumerate(columns))
    image = _compress_gamma(torch.clamp(linear, 0, 1), kind.gamma)
    return image * image * (3 - 2 * image) if kind.is_smooth else image


def _demosaic(values: Tensor, pattern: str) -> Tensor:
    """Interpolate the missing channels, [N, 1, H, W] to [N, 3, H, W], as `isp.demosaic` does."""
    height, width = values.shape[2:]
    if pattern == MONO:
        return values.expand(-1, 3, -1, -1)
    padded = values[:, 0, _mirrored(height)][:, :, _mirrored(width)]
    image, sites = values.new_empty((len(values), 3, height, width)), tile(pattern)
    for y in (0, 1):
        for x in (0, 1):
            own, right, below = sites[y][x], sites[y][1 - x], sites[1 - y][x]
            missing = {right: "row", below: "column"} if own == isp.GREEN else {isp.GREEN: "green", 2 - own: "diagonal"}
            image[:, own, y::2, x::2] = values[:, 0, y::2, x::2]
            for channel, name in missing.items():
                image[:, channel, y::2, x::2] = sum(
                    weight / 16 * padded[:, y + dy : height + dy : 2, x + dx : width + dx : 2]
                    for dy, row in enumerate(isp.KERNELS[name])
                    for dx, weight in enumerate(row)
                    if weight
                )
    return image


def _mirrored(count: int) -> list[int]:
    """Positions from -2 to count + 1, mirrored about the first and the last site."""
    period = 2 * (count - 1)
    return [min(position % period, -position % period) for position in range(-2, count + 2)]


def _compress_gamma(u: Tensor, gamma: float) -> Tensor:
    """Apply the gamma, as `isp.compress_gamma` does, with gradients that are finite at 0."""
    if gamma == SRGB:
        end = 0.04045 / 12.92
        return torch.where(u <= end, u * 12.92, 1.055 * u.clamp(min=end) ** (1 / 2.4) - 0.055)
    return torch.where(u < LEAST_LIGHT, u.detach() ** (1 / gamma), u.clamp(min=LEAST_LIGHT) ** (1 / gamma))


# -------------------------------------------------------------------------------------------------------- highlights


def _gains_per_channel(y: Tensor, k: Tensor, threshold: Tensor) -> Tensor:
    """Solve for each value, as `isp.apply_gains_per_channel` does."""
    y, k, threshold = torch.broadcast_tensors(y, k, threshold)
    i = y / k
    kept = (k < 1) & (i > threshold)
    return i.masked_scatter(kept, _solve_highlight(y[kept], k[kept], threshold[kept]))


def _solve_highlight(y: Tensor, k: Tensor, threshold: Tensor) -> Tensor:
    """Find the root as `isp._solve_highlight` does; its derivative is 1 / slope, by the implicit function theorem."""
    goal, width = y.detach(), 1 - threshold
    i = goal.clamp(min=1)
    for _ in range(isp.MAX_ITERATIONS):
        m = (i - threshold) / width
        slope = k + (1 - k) * m * (m + 2 * i / width)
        better = torch.maximum(i - (i * (k + (1 - k) * m * m) - goal) / slope, threshold)
        if (better >= i).all():
            break
        i = torch.minimum(better, i)
    return i + (y - goal) / slope


def _gains_gray_mean(y: Tensor, k: Tensor, threshold: Tensor) -> Tensor:
    """Divide by the gains of the channel mean, as `isp.apply_gains_gray_mean` does, [N, 3, H, W]."""
    y, k, threshold = (values.movedim(1, -1) for values in torch.broadcast_tensors(y, k, threshold))
    i = y / k
    kept = i.mean(-1) > threshold[..., 0]
    y, k, threshold = y[kept], k[kept], threshold[kept]
    solved = y / _gray_gains(_solve_gray_mean(y, k, threshold[:, :1]), k, threshold)
    return i.masked_scatter(kept[..., None], solved).movedim(-1, 1)


def _solve_gray_mean(y: Tensor, k: Tensor, threshold: Tensor) -> Tensor:
    """Find the channel mean s of values [M, 3], the root of F(s) = mean(y / g(s)) - s, by bisection.

    Its derivative is that of F by y divided by -F'(s), which is at least 1 unless light is negative.
    """
    goal = y.detach()
    low, high = threshold, (goal / k / k).mean(-1, keepdim=True)
    for _ in range(isp.MAX_ITERATIONS):
        middle = (low + high) / 2
        if ((middle <= low) | (middle >= high)).all():
            break
        above = middle > (goal / _gray_gains(middle, k, threshold)).mean(-1, keepdim=True)
        low, high = torch.where(above, low, middle), torch.where(above, middle, high)
    gains, m = _gray_gains(high, k, threshold), (high - threshold).clamp(min=0) / (1 - threshold)
    steepness = 1 + (goal / gains**2 * (1 - k).clamp(min=0) * 2 * m / (1 - threshold)).mean(-1, keepdim=True)
    return high + ((y - goal) / gains).mean(-1, keepdim=True) / steepness.clamp(min=LEAST_STEEPNESS)


def _gray_gains(gray: Tensor, k: Tensor, threshold: Tensor) -> Tensor:
    """Inverse gains for a channel mean, as `unprocess.gray_gains`."""
    m = (gray - threshold).clamp(min=0) / (1 - threshold)
    return k + m * m * (1 - k).clamp(min=0)


def _gains_none(y: Tensor, k: Tensor, threshold: Tensor) -> Tensor:
    """Divide by the inverse gains."""
    return y / k


HIGHLIGHTS: dict[str, Callable[[Tensor, Tensor, Tensor], Tensor]] = {
    "per_channel": _gains_per_channel,
    "gray_mean": _gains_gray_mean,
    "none": _gains_none,
}
