"""Make raw pairs from Python: run this file, or open its cells in a notebook (``# %%``).

It writes below a temporary folder and needs only unprocess_gen.
"""

# %% A photograph, here a smooth one: any uint8 or uint16 array [H, W, 3] in R, G, B order
import tempfile
from pathlib import Path

import numpy as np

import unprocess_gen as ug

y, x = np.mgrid[0:120, 0:160]
srgb = np.stack([x + 40, y + 60, 200 - (x + y) // 2], axis=-1).astype(np.uint8)

# %% A config: the overrides of the command line
config = ug.load_config(["camera=sony_a7r", "noise=imx385_iso3200", "seed=7"])

# %% One pair: uint16 mosaics [H, W] in DN, and the manifest row with every drawn parameter
pair = ug.make_pair(srgb, config)
print(pair.clean.shape, pair.clean.dtype, "white balance:", pair.row["red_gain"], pair.row["blue_gain"])

# %% Noise: its variance is a·u + b + 1/6, u above black, if neither frame is clipped (both are rounded)
noise = pair.noisy.astype(float) - pair.clean
signal = pair.clean.astype(float) - pair.row["black_level_dn"]
predicted = pair.row["a_dn"] * signal.mean() + pair.row["b_dn2"] + 1 / 6
print(f"variance {noise.var():.0f} DN², predicted {predicted:.0f} DN²")

# %% Another seed gives other parameters; a plan keeps them for other pixels
plan = ug.plan_image(srgb, config, seed=8)
darker = ug.make_pair(srgb // 2, plan)

# %% A frame back to sRGB, uint8 [H, W, 3]
photograph = ug.develop(pair.clean, pair.row)
print("largest difference from the photograph:", np.abs(photograph.astype(int) - srgb).max(), "codes")

# %% A dataset of files: three built-in scenes here; source.root=FOLDER for your photographs
folder = Path(tempfile.mkdtemp()) / "ds"
summary = ug.generate(ug.load_config(["source.limit=3", "n_jobs=1", f"out={folder}"]))
print(summary.pairs, "pairs in", summary.shards, "shard")

# %% Read it: map-style, for PyTorch's DataLoader
pairs = ug.RawPairs(folder)
clean, noisy, row = pairs[0]
print(len(pairs), [sample.row["source"] for sample in pairs[1:]])

# %% Check every byte, and regenerate pairs from their rows
assert ug.verify(folder) == []
assert not any(one.complaint for one in ug.replay(folder, keys=[0, "1-2"]))

# %% Errors carry the sentence of the command line
try:
    ug.load_config(["camera=leica"])
except ug.ConfigError as error:
    print(error)
