"""Compare bursts of the public generator, and those of this package, with exact light.

    python docs/experiments/bursts.py [--to RESULTS.json]

Needs scikit-image (extra photos). The generator is implemented from its description (NTIRE 2021).
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
import skimage
from common import write
from matplotlib import pyplot as plt

import unprocess_gen as ug
from unprocess_gen.simulation.pair import linear_rgb
from unprocess_gen.sources.synthetic import picture

mpl.use("Agg")
HERE = Path(__file__).parent
FRAMES, SHIFT, DEGREES, SCALE, SIDE = 14, 24, 1, 4, 384
PHOTOGRAPHS = {"astronaut": "astronaut.png", "motorcycle": "motorcycle_left.png", "stars": "hubble_deep_field.jpg"}
BUILT_IN = ("dead_leaves-0", "colour_chart-0", "highlights-0")
NAMES = (*PHOTOGRAPHS, *BUILT_IN, "dark dead_leaves-0")
DRAWS = 4
SPAN = {12: 3855, 14: 15359}
"""White minus black of imx385_12bit and generic_14bit, in DN."""


def read(name: str) -> Any:
    """Return a picture of scikit-image or of this package, uint8 [H, W, 3]."""
    if name in BUILT_IN:
        return picture(name)
    return np.ascontiguousarray(cv2.imread(str(Path(skimage.data_dir, PHOTOGRAPHS[name])))[..., ::-1])


def lights(name: str) -> Iterator[Any]:
    """Yield the unprocessed light of a picture, float64 [H, W, 3], for several draws of camera and gains."""
    config = ug.load_config(["gains.highlight=gray_mean", "noise=none", "output.dtype=float32"])
    pixels, divisor = read(name.removeprefix("dark ")), 10 if name.startswith("dark ") else 1
    for draw in range(DRAWS):
        yield linear_rgb(pixels, ug.plan_image(pixels, config, key=f"{name} {draw}")).astype(np.float64) / divisor


def sample(light: Any, y: Any, x: Any) -> Any:
    """Interpolate light bilinearly at positions, in float64; outside is black."""
    padded = np.pad(light, ((1, 1), (1, 1), (0, 0)))
    y, x = (np.clip(at + 1, 0, size - 1.001) for at, size in zip((y, x), padded.shape, strict=False))
    i, j = y.astype(int), x.astype(int)
    v, u = (y - i)[..., None], (x - j)[..., None]
    top, low = (padded[i + k, j] * (1 - u) + padded[i + k, j + 1] * u for k in (0, 1))
    return top * (1 - v) + low * v


def mosaic(rgb: Any) -> Any:
    """Keep the colour of each site, RGGB."""
    rows, columns = np.indices(rgb.shape[:2]) % 2
    return np.take_along_axis(rgb, (rows + columns)[..., None], axis=2)[..., 0]


def public_frame(light: Any, k: int, draws: Any) -> tuple[Any, Any, Any]:
    """Return frame k of the public generator, with 8 bits and exactly, and the positions that its pixels show."""
    side = light.shape[0]
    turn, (y, x) = (draws.uniform(-DEGREES, DEGREES), draws.uniform(-SHIFT, SHIFT, 2)) if k else (0, (1.5, 1.5))
    matrix = np.vstack((cv2.getRotationMatrix2D((side / 2, side / 2), turn, 1), (0, 0, 1)))
    matrix = matrix @ ((1, 0, x), (0, 1, y), (0, 0, 1))
    codes = (light * 255).astype(np.uint8)
    codes = cv2.warpAffine(codes, matrix[:2], (side, side), flags=cv2.INTER_LINEAR)[SHIFT:-SHIFT, SHIFT:-SHIFT]
    codes = cv2.resize(codes, None, fx=1 / SCALE, fy=1 / SCALE, interpolation=cv2.INTER_LINEAR)
    inverse, pixels = np.linalg.inv(matrix), np.indices((side, side))[:, SHIFT:-SHIFT, SHIFT:-SHIFT][::-1]
    x, y = (inverse[axis, 0] * pixels[0] + inverse[axis, 1] * pixels[1] + inverse[axis, 2] for axis in (0, 1))
    exact = middle(sample(light, y, x))
    return codes / 255, exact, middle(np.stack((y, x), axis=-1))


def blocks(pixels: Any) -> Any:
    """Return [H, W, n] as [H / 4, 4, W / 4, 4, n]."""
    height, width, count = pixels.shape
    return pixels.reshape(height // SCALE, SCALE, width // SCALE, SCALE, count)


def middle(pixels: Any) -> Any:
    """Reduce [H, W, n] as bilinear interpolation between pixel centres does: from 4 of the 16 pixels of a block."""
    return blocks(pixels)[:, 1:3, :, 1:3].mean(axis=(1, 3))


def package_clips(pictures: list[Any], folder: Path, patches: int = 1, dtype: str = "uint16") -> Iterator[Any]:
    """Yield bursts of this package without noise, in the order of pictures of light, float64 [H, W, 3]."""
    (folder / "light").mkdir(parents=True)
    for number, light in enumerate(pictures):
        np.save(folder / "light" / f"{number:03}.npy", light.astype(np.float32))
    burst = f"{{frames: {FRAMES}, shift: {SHIFT}, rotation_deg: {DEGREES}, downscale: {SCALE}}}"
    settings = ["source.kind=linear", "source.primaries=camera", "noise=none", "sensor=generic_14bit", "n_jobs=1"]
    settings += [f"source.burst={burst}", f"source.patch=[random,{SIDE},{patches}]", f"output.dtype={dtype}"]
    ug.generate(ug.load_config([*settings, f"source.root={folder / 'light'}", f"out={folder / 'ds'}"]))
    yield from ug.RawClips(folder / "ds")


def package_exact(light: Any, row: Any) -> Any:
    """Return the light of a frame of this package, from the picture and the frame's row."""
    p, q = np.indices((SIDE, SIDE))
    y, x = (
        row["patch_" + to] * SCALE + row[f"motion_{to}y"] * p + row[f"motion_{to}x"] * q + row[f"motion_{to}"]
        for to in "yx"
    )
    return blocks(sample(light, y, x)).mean(axis=(1, 3))


def judge(frames: Any, exact: Any) -> dict[str, float]:
    """Compare clean frames with exact light, 0 at black and 1 at white; levels are those of the first frame."""
    error = frames - exact
    return {
        "levels": len(np.unique(frames[0])),
        "burst_levels": len(np.unique(frames)),
        **{f"exact_levels_{bits}": len(np.unique(np.rint(exact[0] * span))) for bits, span in SPAN.items()},
        **{f"bias_{bits}": float(error[0].mean() * span) for bits, span in SPAN.items()},
        "db": float(-10 * np.log10(np.mean(error[0] ** 2))),
        "black": float(np.mean((frames[0] == 0) & (exact[0] > 0))),
    }


def public_burst(light: Any, place: tuple[int, int], draws: Any) -> list[tuple[Any, Any, Any]]:
    """Return the frames of a burst of the public generator, whose target begins at a place of a picture."""
    top, left = place[0] - SHIFT, place[1] - SHIFT
    square = light[top : top + SIDE + 2 * SHIFT, left : left + SIDE + 2 * SHIFT]
    return [public_frame(square, k, draws) for k in range(FRAMES)]


def align(frame: Any, flow: Any) -> Any:
    """Sample a frame [H, W] at each pixel plus its flow (y, x)."""
    y, x = np.indices(frame.shape) + flow
    return sample(frame[..., None], y, x)[..., 0]


def rms(frames: Any, base: Any) -> float:
    """Return the root mean square difference of frames from the first one, without their borders."""
    rim = (..., slice(SIDE // 32, -SIDE // 32), slice(SIDE // 32, -SIDE // 32))
    return float(np.sqrt(np.mean((np.array(frames) - base)[rim] ** 2)))


def aligned(frames: Any, flows: dict[str, Any]) -> dict[str, float]:
    """Return differences of moved frames from the first one, as they are and aligned by flows."""
    moved = {name: [align(*pair) for pair in zip(frames[1:], flow, strict=True)] for name, flow in flows.items()}
    return {name: rms(shown, frames[0]) for name, shown in {"not aligned": frames[1:], **moved}.items()}


def alignment(folder: Path) -> dict[str, dict[str, float]]:
    """Compare what flows do to a gray picture: its frames have one colour, so mosaics can be interpolated."""
    gray = np.repeat(cv2.GaussianBlur(next(lights("motorcycle")), (0, 0), 8)[..., 1:2], 3, axis=2)
    shown = [frame[1:] for frame in public_burst(gray, (SHIFT, SHIFT), np.random.default_rng(0))]
    places = np.array([place for _, place in shown]) / SCALE
    flow = np.moveaxis(places - places[0], -1, 1)[1:]
    axis = np.moveaxis(places - places[..., 1:], -1, 1)[1:]  # y and x less x, of the same frame
    public = aligned([frame[..., 0] for frame, _ in shown], {"documented": flow, "reversed": -flow, "other axis": axis})
    clip = next(package_clips([gray], folder, dtype="float32"))
    flow = np.array([ug.flow(clip.rows, k) for k in range(1, FRAMES)])
    return {"public": public, "package": aligned(clip.clean, {"documented": flow, "reversed": -flow})}


def borders(folder: Path, bursts: int = 60) -> dict[str, list[int]]:
    """Count moved frames of white light in which a site is not white."""
    draws, white = np.random.default_rng(0), np.ones((600, 600, 3))
    public = [frame[0].min() < 1 for _ in range(bursts) for frame in public_burst(white, (SHIFT, SHIFT), draws)[1:]]
    package = [frame.min() < 16383 for clip in package_clips([white], folder, bursts) for frame in clip.clean[1:]]
    return {name: [int(sum(each)), len(each)] for name, each in (("public", public), ("package", package))}


def draw(frames: dict[str, Any]) -> None:
    """Draw first frames [H, W], brightened, without noise: a pixel for each 2 x 2 sites."""
    figure, axes = plt.subplots(1, len(frames), figsize=(8, 4), layout="constrained")
    for axis, (name, frame) in zip(axes, frames.items(), strict=True):
        rgb = np.stack((frame[::2, ::2], (frame[::2, 1::2] + frame[1::2, ::2]) / 2, frame[1::2, 1::2]), axis=-1)
        white = np.quantile(frames["this package"], 0.99)
        axis.imshow(np.clip(rgb / white, 0, 1) ** (1 / 2.2))
        axis.set(title=name, xticks=[], yticks=[])
    figure.savefig(HERE / "bursts.png", dpi=80)


def main() -> None:
    """Measure and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--to", type=Path, default=HERE / "bursts.json", help="file of the results")
    to, draws, found = parser.parse_args().to, np.random.default_rng(0), []
    with tempfile.TemporaryDirectory() as folder:
        pictures = [(name, light) for name in NAMES for light in lights(name)]
        clips = package_clips([light for _, light in pictures], Path(folder, "all"))
        for (name, light), clip in zip(pictures, clips, strict=True):
            shown = public_burst(light, (clip.rows[0]["patch_y"] * SCALE, clip.rows[0]["patch_x"] * SCALE), draws)
            codes, exact = (np.array([mosaic(frame[side]) for frame in shown]) for side in (0, 1))
            own, own_exact = (clip.clean - 1024.0) / SPAN[14], [mosaic(package_exact(light, row)) for row in clip.rows]
            found.append({"picture": name, "public": judge(codes, exact), "package": judge(own, np.array(own_exact))})
        draw({"public generator": codes[0], "this package": own[0]})
        results = {"crops": found, "borders": borders(Path(folder, "white"))}
        write(results | {"alignment": alignment(Path(folder, "gray"))}, to)


if __name__ == "__main__":
    main()
