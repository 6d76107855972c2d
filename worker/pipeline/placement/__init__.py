"""Placement: whether a pose that registration found is believed, and what a scan that found none has come by."""
