"""Read raw files of cameras: what they state, their mosaics, and the colours that follow from their tags."""
