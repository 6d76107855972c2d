"""What the demo can end in."""

from __future__ import annotations


class DemoFailed(Exception):
    """The service did not do its job; `str()` is one sentence."""
