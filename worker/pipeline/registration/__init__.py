"""One scan to a target: coarse alignment, ICP, verification."""
