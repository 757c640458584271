"""Draw page.png, sweep.jpg, figure6.png and dng.png for the documentation: python .readme/draw_pages.py.

They show the report of a dataset, that of a sweep, a figure of the article and DNG files, of synthetic pictures, in
a temporary folder; the page of the sweep is written too. Requires the extras figures and dng, rawpy, and Chromium.
"""

from __future__ import annotations

import re
import shutil
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


def screenshot(page: Path, width: int, height: int, scale: float) -> np.ndarray:
    """Return the top of a page, RGB, scaled."""
    to = page.with_suffix(".png")
    shot = (f"--window-size={width},{height}", f"--screenshot={to}", f"--user-data-dir={page.parent}/profile")
    subprocess.run([*BROWSER, *shot, page.as_uri()], check=True, capture_output=True)
    whole = cv2.imread(str(to), cv2.IMREAD_COLOR_RGB)
    return cv2.resize(whole, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def draw_sweep() -> None:
    """Generate a sweep of synthetic pictures, and write its page, without links to datasets, and a picture of it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "camera_by_iso"
        gen_dataset("+sweep=camera_by_iso", f"out={folder}", "source.limit=1", "source.downscale=2", "n_jobs=1")
        gen_dataset("report", str(folder))
        page = folder / "report.html"
        text = page.read_text(encoding="utf-8")
        page.write_text(re.sub(r'<a href="[^"]*">page of the dataset</a>\n?', "", text), encoding="utf-8")
        picture = screenshot(page, 1220, 980, 0.75)
        shutil.copyfile(page, HERE.parent / "docs" / "_static" / "camera_by_iso.html")
    cv2.imwrite(str(HERE / "sweep.jpg"), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])


def main() -> None:
    """Generate a dataset, its report, DNG files and figures; write the three pictures."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        gen_dataset(f"out={folder}/ds", "noise=imx385_iso12800", "gains=fixed")
        gen_dataset("report", f"{folder}/ds")
        gen_dataset("dng", f"{folder}/ds", "--keys", CHART, "--to", f"{folder}/dng")
        figures = HERE.parent / "docs" / "figures" / "draw.py"
        subprocess.run([sys.executable, str(figures), f"out={folder}/figures", "source.limit=1"], check=True)
        save(screenshot(folder / "ds" / "report.html", 1220, 2100, 0.5), "page.png")
        frames = [developed(folder / "dng" / f"{CHART}.{frame}.dng") for frame in ("clean", "noisy")]
        save(cv2.resize(np.hstack(frames), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), "dng.png")
        (HERE / "figure6.png").write_bytes((folder / "figures" / "fig6.png").read_bytes())


if __name__ == "__main__":
    main()
    draw_sweep()
