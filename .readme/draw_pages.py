"""Draw page.png, sweep.jpg, figure6.png and dng.png for the documentation: python .readme/draw_pages.py.

They show the report of a dataset, a figure of the article and DNG files, made from built-in scenes in a temporary
folder. Requires the extras figures and dng, rawpy, and Chromium.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import rawpy

HERE = Path(__file__).parent
BROWSER = ("chromium", "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars")
CHART = "00000001"


def gen_dataset(*arguments: str) -> None:
    """Run gen-dataset."""
    subprocess.run([sys.executable, "-m", "unprocess_gen", *arguments], check=True)


def save(picture: np.ndarray, name: str) -> None:
    """Save RGB codes as PNG with the highest compression."""
    cv2.imwrite(str(HERE / name), picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])


def developed(path: Path) -> np.ndarray:
    """Return a DNG file developed by LibRaw with the white balance in the file, brightened by 2."""
    with rawpy.imread(str(path)) as raw:
        return raw.postprocess(use_camera_wb=True, no_auto_bright=True, bright=2.0, adjust_maximum_thr=0)


def screenshot(page: Path, height: int) -> np.ndarray:
    """Return the top of a page, RGB, at half size."""
    to = page.with_suffix(".png")
    shot = (f"--window-size=1220,{height}", f"--screenshot={to}", f"--user-data-dir={page.parent}/profile")
    subprocess.run([*BROWSER, *shot, page.as_uri()], check=True, capture_output=True)
    return cv2.resize(cv2.imread(str(to), cv2.IMREAD_COLOR_RGB), None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)


def draw_sweep() -> None:
    """Generate a sweep of built-in scenes, and write the picture of its page."""
    with tempfile.TemporaryDirectory() as name:
        gen_dataset("+sweep=camera_by_iso", f"out={name}/sweep", "source.limit=2", "n_jobs=1")
        gen_dataset("report", f"{name}/sweep")
        picture = screenshot(Path(name) / "sweep" / "report.html", 1130)
    cv2.imwrite(str(HERE / "sweep.jpg"), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])


def main() -> None:
    """Generate a dataset, its report, DNG files and figures; write the three pictures."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        gen_dataset(f"out={folder}/ds", "noise=imx385_iso12800", "gains=fixed")
        gen_dataset("report", f"{folder}/ds")
        gen_dataset("dng", f"{folder}/ds", "--keys", CHART, "--to", f"{folder}/dng")
        gen_dataset("figures", f"out={folder}/figures")
        address = f"file://{folder}/ds/report.html"
        shot = ("--window-size=1220,2100", f"--screenshot={folder}/page.png", f"--user-data-dir={folder}/profile")
        subprocess.run([*BROWSER, *shot, address], check=True, capture_output=True)
        page = cv2.imread(f"{folder}/page.png", cv2.IMREAD_COLOR_RGB)
        save(cv2.resize(page, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), "page.png")
        frames = [developed(folder / "dng" / f"{CHART}.{frame}.dng") for frame in ("clean", "noisy")]
        save(cv2.resize(np.hstack(frames), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), "dng.png")
        (HERE / "figure6.png").write_bytes((folder / "figures" / "fig6.png").read_bytes())


if __name__ == "__main__":
    main()
    draw_sweep()
