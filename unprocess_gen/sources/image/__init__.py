"""Read the headers and pixels of image files."""
