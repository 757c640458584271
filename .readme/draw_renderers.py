"""Draw the picture of the guide on linear sources: ``python .readme/draw_renderers.py`` writes ``renderers.png``."""

from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

import unprocess_gen as ug
from unprocess_gen.reports.sheets import write_sheets

HERE = Path(__file__).parent
SETTINGS = "source.kind=linear", "source.limit=3", "scene.ev=-2.6", "body=sony_a7s2", "scene=indoor"
ROWS, COLOURS = ((75, 340), (582, 846)), 160  # of the sheet: three pictures each

with TemporaryDirectory() as folder:
    ug.generate(ug.load_config([*SETTINGS, f"out={folder}/hdr", "n_jobs=1"]))
    list(write_sheets(Path(folder, "hdr"), Path(folder, "sheets"), "2"))
    sheet = Image.open(Path(folder, "sheets", "00000002.png")).convert("RGB")
    drawn = Image.new("RGB", (sheet.width, sum(end - start for start, end in ROWS)))
    for number, (start, end) in enumerate(ROWS):
        drawn.paste(sheet.crop((0, start, sheet.width, end)), (0, number * (ROWS[0][1] - ROWS[0][0])))
    drawn.quantize(COLOURS, dither=Image.Dither.NONE).save(HERE / "renderers.png", optimize=True)
