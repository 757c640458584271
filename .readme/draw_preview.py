"""Draw preview.png, an overview of two pairs: python .readme/draw_preview.py. Its dataset is temporary."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import cv2

from unprocess_gen.reports.sheets import contact_sheet

KEYS = "1,2"


def main() -> None:
    """Generate the dataset and write preview.png."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "unprocess_gen", f"out={folder}/ds", "noise=imx385_iso12800"]
        subprocess.run(command, check=True)
        picture = contact_sheet(Path(folder) / "ds", KEYS)
    cv2.imwrite(str(Path(__file__).with_name("preview.png")), picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
