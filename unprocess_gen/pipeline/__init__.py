"""Generate, verify, replay and repair datasets."""
