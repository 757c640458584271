"""Name the targets: arrays for a training, next to the frames of a pair. Imports nothing: ``--help`` needs it."""

LINEAR_RGB = "linear_rgb"
"""The target that datasets can store."""

TARGETS = (LINEAR_RGB, "srgb", "variance", "noise_std")
"""Targets of live pairs."""
