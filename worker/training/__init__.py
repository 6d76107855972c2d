"""Annotation-free training; torch and numpy only, so that it runs on any GPU machine."""
