"""Readers of PLY, PCD, E57 and LAS, and writers of PLY, PCD and LAZ."""
