"""Scores of recorded pairs: exact on synthetic pairs, and on PolyU those of the experiments."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers import dng_files
from helpers.commands import RunMain

from unprocess_gen.reports.scoring.real_pairs import collect

RANDOM = np.random.default_rng(0)
CODES = RANDOM.integers(20, 230, (24, 32, 3), np.uint16)
SIGNAL, ERROR = RANDOM.integers(0, 300, (24, 32), np.uint16), RANDOM.integers(0, 10, (24, 32), np.uint16)


def write(folder: Path, lines: str, **files: Any) -> Path:
    """Write files, whose names have _ in place of a point, and their pairs.csv."""
    for name, content in files.items():
        path = folder / name.replace("_", ".")
        path.write_bytes(cv2.imencode(".png", content)[1].tobytes() if path.suffix == ".png" else content)
    (folder / "pairs.csv").write_text(lines)
    return folder


def scored(run_main: RunMain, folder: Path) -> Any:
    assert not run_main("score", "--real", folder, "--method", "noisy", "--to", folder / "scores").code
    return json.loads((folder / "scores" / "score.json").read_text())


def psnr(peak: float, error: Any) -> Any:
    return pytest.approx(10 * np.log10(peak**2 / np.mean(np.float64(error) ** 2)), abs=1e-6)


def dng(dn: Any, black: int, iso: int, seconds: float) -> bytes:
    tags = {50713: (3, (2, 2)), 50714: (4, (black, 260, 270, 265)), 34855: (3, (iso,)), 33434: (5, (seconds,))}
    return dng_files.dng(dng_files.image(dn + np.tile([[black, 260], [270, 265]], (12, 16)), tags))


@pytest.mark.parametrize(("factor", "dtype"), [(1, np.uint8), (256, np.uint16)])
def test_srgb_pairs_have_the_psnr_of_their_codes(factor: int, dtype: type, run_main: RunMain, tmp_path: Path) -> None:
    pictures = {"a_png": CODES + ERROR[..., None], "b_png": CODES + 1, "c_png": CODES}
    lines = "noisy;clean;group;iso\na.png;c.png;one;1,5\nb.png;c.png;two;\n"
    write(tmp_path, lines, **{name: (factor * codes).astype(dtype) for name, codes in pictures.items()})
    found, peak = scored(run_main, tmp_path), np.iinfo(dtype).max
    assert [pair["srgb_psnr"] for pair in found["pairs"]] == [psnr(peak, factor * ERROR), psnr(peak, factor)]
    assert (found["all"]["srgb_psnr"]["sources"], "raw_psnr" in found["all"]) == (1, False)
    assert {*found["by_group"], *found["by_iso"]} == {"one", "two", "1.5"}


def test_raw_pairs_are_compared_at_the_exposure_of_the_clean_frame(run_main: RunMain, tmp_path: Path) -> None:
    """Black levels differ by site and file: PSNR is that of 8 times the error above them, below and above white."""
    files = {"a_dng": dng(SIGNAL + ERROR, 250, 800, 0.01), "b_dng": dng(8 * SIGNAL, 290, 200, 0.32)}
    files |= {"c_png": 100 + SIGNAL + ERROR, "d_png": 100 + 4 * SIGNAL}
    lines = "noisy,clean,group,pattern,black_dn,white_dn,ratio\na.dng,b.dng,x\nc.png,d.png,y,GBRG,100,1023,4\n"
    of_files, of_line = scored(run_main, write(tmp_path, lines, **files))["pairs"]
    assert (of_files["raw_psnr"], of_files["exposure_ratio"]) == (psnr(dng_files.WHITE - 261, 8 * ERROR), 8)
    assert of_line["raw_psnr_unsaturated"] == psnr(923, 4 * ERROR[100 + 4 * SIGNAL < 1023])
    assert ("srgb_psnr" in of_files, "srgb_psnr" in of_line) == (True, False)
    facts = {"black_level_dn": 261, "white_level_dn": 4095, "pattern": "RGGB", "iso": 800, "exposure_s": 0.01}
    assert facts.items() <= next(iter(collect(tmp_path).items)).rows[0].items()


@pytest.mark.parametrize(
    ("name", "method", "problem"),
    [
        ("a.png", "gaussian", "takes no sRGB pictures; use noisy, or"),
        ("c.png", "non_local_means", "lack; use gaussian"),
    ],
)
def test_methods_say_what_real_pairs_they_do_not_take(
    name: str, method: str, problem: str, run_main: RunMain, tmp_path: Path
) -> None:
    pytest.importorskip("skimage")
    lines = f"noisy,clean,group,pattern,black_dn,white_dn\n{name},{name},x"
    write(tmp_path, lines + ",RGGB,0,1023" * (name == "c.png"), a_png=CODES.astype(np.uint8), c_png=SIGNAL)
    done = run_main("score", "--real", tmp_path, "--method", method)
    assert (done.code, problem in done.err, done.err.count("\n")) == (3, True, 1), done.err


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("a.png,no.png,x", "line 2: no.png: no such file below"),
        ("/etc/hosts,b.png,x", "line 2: /etc/hosts: no such file below"),
        ("\na.png,b.png,x\na.png,c.png,x", "line 4: noisy=a.png: also in"),
        ("a.png,c.png,x", "line 2: noisy is uint16 [24, 32, 3] sRGB 65535, clean uint16 [23, 32, 3] sRGB 65535"),
        ("a.png,e.png,x", "line 2: e.png has 16 bits but no colours"),
        ("a.png,d.npy,x", "line 2: d.npy a NPY file states no levels and no pattern; give pattern, black_dn and"),
        ("a.png,b.png,x,RGGB,0,255", "line 2: a.png has colours; expected a gray picture"),
        ("e.png,e.png,x,RGBG,0,255", "line 2: pattern=RGBG: expected"),
        ("f.png,a.png,x", "f.png: the file of 32 x 24 pixels lacks its IEND chunk"),
        ("", "pairs.csv: no such file; expected a table"),
    ],
)
def test_lines_that_are_no_pair_are_refused(line: str, problem: str, run_main: RunMain, tmp_path: Path) -> None:
    files = {"a_png": CODES, "b_png": CODES, "c_png": CODES[1:], "d_npy": b"", "e_png": SIGNAL, "f_png": CODES}
    folder = write(tmp_path, f"noisy,clean,group,pattern,black_dn,white_dn\n{line}", **files)
    (folder / "f.png").write_bytes((folder / "f.png").read_bytes()[:-40])
    done = run_main("score", "--real", folder if line else folder / "no", "--method", "noisy")
    assert (done.code, problem in done.err, done.err.count("\n")) == (2, True, 1), done.err


REAL = next((found for up in Path(__file__).parents if (found := up / "shared/data/real_pairs_srgb").is_dir()), Path())


@pytest.mark.slow
@pytest.mark.skipif(not REAL.name, reason="needs pairs of PolyU, which are not distributed")
def test_noisy_pictures_of_polyu_have_the_psnr_of_the_experiments(run_main: RunMain, tmp_path: Path) -> None:
    """Means over scenes, of the centres of 256 x 256, as in docs/experiments."""
    for file in (REAL / "polyu").iterdir():
        cv2.imwrite(str(tmp_path / f"{file.stem}.png"), cv2.imread(str(file))[128:384, 128:384])
    names = [file.name for file in tmp_path.glob("*_real.png")]
    lines = [f"{name},{name.replace('_real', '_mean')},{name.rsplit('_', 2)[0]}\n" for name in sorted(names)]
    scenes = scored(run_main, write(tmp_path, "noisy,clean,group\n" + "".join(lines)))["by_group"].values()
    recorded = json.loads((Path(__file__).parents[2] / "docs/experiments/training.json").read_text())
    wanted = pytest.approx(recorded["sets"]["PolyU"]["psnr"]["noisy"][0], abs=5e-3)
    assert np.mean([scene["srgb_psnr"]["mean"] for scene in scenes]) == wanted
