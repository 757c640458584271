"""Read the frames of video files."""
