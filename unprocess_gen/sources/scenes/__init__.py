"""Generate the built-in synthetic scenes."""
