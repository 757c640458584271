"""Measure the noise of a camera from its raw frames, and write it as a noise profile."""
