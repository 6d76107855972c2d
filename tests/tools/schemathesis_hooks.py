"""What schemathesis sends as files: scans by their first bytes, for the API reads no further."""

from __future__ import annotations

import schemathesis
from hypothesis import strategies as st

_SCANS = st.integers(0, 10**6).map(
    lambda number: f"ply\nformat ascii 1.0\ncomment {number}\nend_header\n".encode()
)

schemathesis.openapi.format("binary", _SCANS)
schemathesis.openapi.media_type("application/octet-stream", _SCANS)
schemathesis.openapi.media_type("application/offset+octet-stream", _SCANS)  # a piece of an upload (tus 1.0.0)
