"""Settings of the whole service, from the environment (`SPICD_*`)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict


def _model_store() -> Path:
    """Return the folder beside this package in a checkout, wherever the process was started."""
    beside = Path(__file__).resolve().parents[1] / "model_store"
    return beside if beside.is_dir() else Path("model_store")


class Settings(BaseSettings):
    """Read once where a process starts and passed on; nothing else reads the environment."""

    model_config = SettingsConfigDict(env_prefix="SPICD_", env_ignore_empty=True, extra="ignore")

    host: str = Field("127.0.0.1", description="address that the API listens on")
    port: int = Field(8000, ge=0, le=65535, description="port of the API; 0 takes a free one")
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
    max_upload_bytes: int = Field(2 * 1024**3, gt=0, description="largest body of one request")
    max_scan_points: int = Field(50_000_000, gt=0, description="most points that one scan may declare")
    min_free_bytes: int = Field(
        1024**3,
        ge=0,
        description="of the data folder's disk; uploads and jobs that would leave less are refused; 0: off",
    )
    job_timeout_s: int = Field(3600, gt=0, description="longest time of one step of a job")
    training_minutes: float = Field(
        10.0, gt=0, description="of a model's training where a request names none"
    )
    max_training_minutes: float = Field(
        40.0,
        gt=0,
        description="most that a request may name; never more than four fifths of `SPICD_JOB_TIMEOUT_S`",
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field("info", description="of every process")

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
