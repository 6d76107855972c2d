"""Simulator, benchmark and figures."""
