"""What a receiver of webhooks gets, and how it has to answer: the `webhooks` of the OpenAPI document."""

from __future__ import annotations

from typing import Any

from service.cloud_events import MEDIA_TYPE
from service.webhooks.sending import LIMIT_S

DESCRIPTION = f"""\
Each event is sent as a signed POST (Standard Webhooks 1.0.0), one after the other and in the order of publication, at \
least once: the same event has the same `webhook-id`, by which you leave a second one out.

To check a request, before you read it as JSON:

1. Take the `secret` of the webhook without `whsec_`, and decode it from base64: that is the key.
2. Join `webhook-id`, a point, `webhook-timestamp`, a point, and the body as it came, byte for byte.
3. Compute the HMAC-SHA256 of that, write it in base64, and put `v1,` before it.
4. `webhook-signature` has one signature or, for a day after the secret was changed, two with a space between. Accept \
the request where one of them is yours; compare in constant time.
5. Refuse a `webhook-timestamp` that is more than five minutes off your clock.

The libraries of standardwebhooks.com do this in most languages.

Any answer of 2xx within {LIMIT_S:g} s counts as received; its body is not read, and redirects are not followed. Else the \
event is sent again after 5 s, 5 min, 30 min, 2 h, 5 h, 10 h and 10 h, and those behind it wait. A webhook is disabled \
when it answers 410, or when eight attempts at one event failed; `reason` says why, and `PATCH /webhooks/{{webhook_id}}` \
with `"status": "active"` has it go on where it was.
"""


def described() -> dict[str, Any]:
    """Return the `webhooks` of an OpenAPI 3.1 document, whose schemas are `service.api.following.event_documents`'."""
    operation = {
        "operationId": "receive_event",
        "tags": ["webhooks"],
        "summary": "An event is sent to your address",
        "description": DESCRIPTION,
        "parameters": [
            _header("webhook-id", "of the event, the same each time it is sent", "event-6b1f0c"),
            _header("webhook-timestamp", "seconds since 1970, when this attempt was made", "1772712000"),
            _header(
                "webhook-signature",
                "`v1,` and base64, more than one with spaces between",
                "v1,K5oZfzN95Z9UVu1E=",
            ),
        ],
        "requestBody": {
            "required": True,
            "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/WebhookEvent"}}},
        },
        "responses": {
            "2XX": {"description": "Received; the next event follows"},
            "410": {"description": "Nobody wants these events any more: the webhook is disabled"},
            "default": {"description": "Not received; the event is sent again later"},
        },
        "security": [],
    }
    return {"event": {"post": operation}}


def _header(name: str, description: str, example: str) -> dict[str, Any]:
    schema = {"type": "string", "examples": [example]}
    return {"in": "header", "name": name, "required": True, "description": description, "schema": schema}
