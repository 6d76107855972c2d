"""Placement: whether the pose of a scan is believed, and why one that is not found its place."""
