"""The API from Python, sync and async: what the command line, the demo and a robot's script use (docs/client.md).

Names that stand here are the client's public ones, and stay.
"""

from __future__ import annotations

from service.client.asynchronous.client import AsyncClient
from service.client.errors import ClientError, Document, JobFailed, RequestRefused, Unreachable, sentence
from service.client.feeds import ChangesPage, Delivery, Event, NewWebhook, Webhook
from service.client.requests import DEFAULT_URL, OnReceived, OnSent, Pose
from service.client.retries import Retries
from service.client.synchronous.client import Client, OnProgress

__all__ = [
    "DEFAULT_URL",
    "AsyncClient",
    "ChangesPage",
    "Client",
    "ClientError",
    "Delivery",
    "Document",
    "Event",
    "JobFailed",
    "NewWebhook",
    "OnProgress",
    "OnReceived",
    "OnSent",
    "Pose",
    "RequestRefused",
    "Retries",
    "Unreachable",
    "Webhook",
    "sentence",
]
