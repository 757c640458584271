"""Name the targets: arrays for a training, next to the frames of a pair. Imports nothing: ``--help`` needs it."""

FRAME_TARGETS = ("variance", "noise_std")
"""Targets that belong to a noisy frame, in its layout."""

TARGETS = ("linear_rgb", "srgb", *FRAME_TARGETS)
"""All targets; the first two, [H, W, 3], belong to the clean frame."""
