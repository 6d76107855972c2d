"""Readers and writers of PLY and PCD."""
