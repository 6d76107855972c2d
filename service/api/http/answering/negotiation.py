"""Which of several representations a client gets (RFC 9110, Section 12)."""

from __future__ import annotations

from collections.abc import Sequence

import mimeparse
from fastapi import Request

from service.errors import NotAcceptable


def preferred(request: Request, offers: Sequence[str]) -> str:
    """Return the media type of `offers` that a request's `Accept` weighs most; the first of several that weigh the same.

    Without that header, and where it cannot be read, that is the first (Section 12.5.1). Raises NotAcceptable.
    """
    accept = ",".join(request.headers.getlist("accept")).strip().lower()  # names are (Section 8.3.1)
    if not accept:
        return offers[0]
    try:
        chosen: str = mimeparse.best_match(list(reversed(offers)), accept)
    except mimeparse.MimeTypeParseException:
        return offers[0]
    if not chosen:
        raise NotAcceptable(f"there is {', '.join(offers)} to have, and the request accepts none of them")
    return chosen
