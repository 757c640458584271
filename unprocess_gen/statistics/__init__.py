"""Score statistics of frames: what ``verify --noise``, ``verify --against`` and ``calibrate`` share."""
