"""Test whether the noise in a dataset follows the distribution that its manifest records."""
