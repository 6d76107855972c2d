"""Settings of the whole service, from the environment (`SPICD_*`)."""

from __future__ import annotations

import ipaddress
import re
from pathlib import Path
from typing import Literal

from pydantic import Field, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict


def _model_store() -> Path:
    """Return the folder beside this package in a checkout, wherever the process was started."""
    beside = Path(__file__).resolve().parents[1] / "model_store"
    return beside if beside.is_dir() else Path("model_store")


_ORIGIN = re.compile(r"https?://[a-z0-9.\[\]:_-]+")
_ROOT_PATH = re.compile(r"(/[A-Za-z0-9._~-]+)+")


class Settings(BaseSettings):
    """Read once where a process starts and passed on; nothing else reads the environment."""

    model_config = SettingsConfigDict(env_prefix="SPICD_", env_ignore_empty=True, extra="ignore")

    host: str = Field("127.0.0.1", description="address that the API listens on")
    port: int = Field(8000, ge=0, le=65535, description="port of the API; 0 takes a free one")
    root_path: str | None = Field(
        None,
        description="path under which something in front has the API, as `/spicd`; links bear it, and requests may come "
        "with it or without",
    )
    auth: Literal["auto", "required", "none"] = Field(
        "auto",
        description="whether requests need an API key; `auto`: unless the API listens on loopback, "
        "`none`: never, for something in front asks who it is",
    )
    allowed_hosts: str | None = Field(
        None,
        description="names that `Host` may bear beside addresses, with commas between; unset: localhost, the machine's "
        "and that listened on, and any where a key is needed",
    )
    allowed_origins: str | None = Field(
        None,
        description="origins of dashboards on other sites, with commas between: `https://dash.example.org`",
    )
    data_dir: Path = Field(Path("data"), description="everything that the embedded parts keep")
    redis_url: str | None = Field(
        None, description="Redis or Valkey; unset: an embedded server in the data folder"
    )
    database_url: str | None = Field(None, description="SQLAlchemy URL; unset: SQLite in the data folder")
    blob_url: str | None = Field(
        None, description="`file:///...` or `s3://bucket/prefix`; unset: data folder"
    )
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="where the network runs")
    model_store: Path = Field(
        default_factory=_model_store,
        description="folder of the models and their cards; unset: the checkout's, without one `./model_store`",
    )
    model: str = Field("voxel-net/1", description="model used where a request names none")
    geometry_workers: int = Field(1, ge=0, description="worker processes of the geometry queue")
    inference_workers: int = Field(1, ge=0, description="worker processes of the inference queue")
    inference_concurrency: int | None = Field(
        None,
        ge=1,
        le=32,
        description="steps that an inference worker runs at a time, so that batches of the network have tiles of several "
        "surveys; unset: 1, with a GPU 4",
    )
    inference_batch_tiles: int = Field(
        64,
        ge=1,
        description="most tiles of a batch; halved while a batch does not fit into the GPU's memory",
    )
    inference_batch_wait_ms: float = Field(
        5.0,
        ge=0,
        le=1000,
        description="longest time that a batch which is not full waits for tiles of another survey that is under way",
    )
    inference_precision: Literal["auto", "float32", "bfloat16"] = Field(
        "auto",
        description="of the network's large products; `auto`: bfloat16 where the device has it and the model's card says "
        "that the scores hold",
    )
    inference_model_bytes: int = Field(
        1024**3,
        ge=0,
        description="bytes of models that an inference worker keeps open; above this the least recently used model is closed",
    )
    inference_gpu_share: float | None = Field(
        None,
        gt=0,
        le=1,
        description="share of the GPU's memory that an inference worker may take; unset: all, or with several "
        "`SPICD_INFERENCE_WORKERS` an equal part of nine tenths",
    )
    max_upload_bytes: int = Field(2 * 1024**3, gt=0, description="largest body of one request")
    upload_timeout_s: int = Field(14_400, gt=0, description="longest time of the body of one request")
    keep_uploads_hours: float = Field(
        24, gt=0, description="hours that a resumable upload (`/uploads`) waits for its next bytes"
    )
    shutdown_grace_s: int = Field(
        2, ge=0, description="that requests have to end, uploads above all, once the service is told to stop"
    )
    max_connections: int = Field(400, gt=0, description="open connections to the API at a time")
    max_listeners: int = Field(
        200,
        gt=0,
        description="of these, that may wait for events or a job (`GET /events`, `GET /jobs/{id}?wait=`) at a time",
    )
    max_scan_points: int = Field(50_000_000, gt=0, description="most points that one scan may declare")
    step_memory_bytes: int | None = Field(
        None,
        ge=0,
        description="most that each process of a geometry step, and an inference worker without a GPU, may allocate; "
        "0: no limit, unset: four fifths of the machine's or the container's memory",
    )
    min_free_bytes: int = Field(
        1024**3,
        ge=0,
        description="of the data folder's disk; uploads and jobs that would leave less are refused; 0: off",
    )
    map_memory_bytes: int = Field(
        256 * 1024**2,
        ge=16 * 1024**2,
        description="about what a step may take, beside a cloud itself, to fuse its scans or to write its tileset; "
        "what is more goes to the disk",
    )
    job_timeout_s: int = Field(3600, gt=0, description="longest time of one step of a job")
    max_waiting_jobs: int = Field(
        1000, gt=0, description="jobs that may wait; a request for one more is answered with 429"
    )
    max_waiting_jobs_per_device: int = Field(
        200, gt=0, description="of one device, so that none takes the room of the others"
    )
    training_minutes: float = Field(
        10.0, gt=0, description="of a model's training where a request names none"
    )
    max_training_minutes: float = Field(
        40.0,
        gt=0,
        description="most that a request may name; never more than four fifths of `SPICD_JOB_TIMEOUT_S`",
    )
    keep_scans_days: float = Field(
        0,
        ge=0,
        description="days that scans are kept of which no map and no kept survey is made; 0: for ever",
    )
    keep_surveys_days: float = Field(
        0, ge=0, description="days that surveys are kept which no version of a map took over; 0: for ever"
    )
    keep_idempotency_keys_hours: float = Field(
        24, ge=24, description="hours that an `Idempotency-Key` is kept with the answer to its request"
    )
    webhook_allowed_networks: str | None = Field(
        None,
        description="networks that webhooks may reach though they are private, there also without TLS, with commas "
        "between: `10.1.0.0/16`",
    )
    keep_events_days: float = Field(
        30,
        gt=0,
        description="days that events are kept; who follows them and was away for longer begins anew",
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field("info", description="of every process")
    log_format: Literal["text", "json"] = Field(
        "text", description="lines for people, or a JSON object a line"
    )

    @field_validator("root_path")
    @classmethod
    def _root_path_is_a_path(cls, value: str | None) -> str | None:
        trimmed = (value or "").rstrip("/")
        if trimmed and not _ROOT_PATH.fullmatch(trimmed):
            raise ValueError(f"{value!r} is no path to be under; give it as /name or /name/of/more")
        return trimmed or None

    @field_validator("allowed_origins")
    @classmethod
    def _origins_are_whole(cls, value: str | None) -> str | None:
        for origin in _names(value):
            if not _ORIGIN.fullmatch(origin):
                raise ValueError(
                    f"{origin!r} is no origin; name each as scheme://host[:port], `*` is not taken"
                )
        return value

    @field_validator("webhook_allowed_networks")
    @classmethod
    def _networks_are_cidr(cls, value: str | None) -> str | None:
        for network in _names(value):
            ipaddress.ip_network(network)
        return value

    def webhook_networks(self) -> tuple[ipaddress.IPv4Network | ipaddress.IPv6Network, ...]:
        """Return the networks that `webhook_allowed_networks` lists."""
        return tuple(ipaddress.ip_network(name) for name in _names(self.webhook_allowed_networks))

    def requires_key(self) -> bool:
        """Tell whether requests need an API key: as soon as another machine can reach the API, unless told."""
        return self.auth == "required" or (self.auth == "auto" and not _is_loopback(self.host))

    def hosts(self) -> tuple[str, ...] | None:
        """Return the names that `allowed_hosts` lists, in small letters; None where it is unset."""
        return None if self.allowed_hosts is None else _names(self.allowed_hosts)

    def origins(self) -> tuple[str, ...]:
        """Return the origins that `allowed_origins` lists, in small letters."""
        return _names(self.allowed_origins)

    def resolved_database_url(self) -> str:
        """Return the database that is used, embedded or not."""
        if self.database_url is not None:
            return self.database_url
        path = str((self.data_dir / "spicd.sqlite").absolute())
        return "sqlite:///" + path.replace("%", "%25").replace(
            "?", "%3F"
        )  # the two that a URL reads otherwise

    def resolved_blob_url(self) -> str:
        """Return the blob store that is used, embedded or not."""
        return self.blob_url or (self.data_dir / "blobs").absolute().as_uri()

    def most_training_minutes(self) -> float:
        """Return how long a training may be and still end well before its step is stopped."""
        return min(self.max_training_minutes, 0.8 * self.job_timeout_s / 60)

    def scratch_dir(self) -> Path:
        """Return where steps write aside: on the disk of embedded blobs, so that keeping a file is a rename."""
        return self.data_dir.absolute() / "scratch"


def _names(text: str | None) -> tuple[str, ...]:
    return tuple(name.strip().lower() for name in (text or "").split(",") if name.strip())


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"
