"""The names of blobs: every key that is written or read is spelled here and nowhere else."""

from __future__ import annotations

import re

_UNSAFE = re.compile(r"[^A-Za-z0-9._-]+")


def safe_name(filename: str) -> str:
    """The last part of a client's file name, with nothing left in it that a path or a shell would read.

    Never empty, never hidden, at most 100 characters; the suffix is kept when the name is cut.
    """
    name = _UNSAFE.sub("_", filename.replace("\\", "/").rsplit("/", 1)[-1]).lstrip(".")
    return name[-100:].lstrip(".") or "scan"


def scan_file(scan_id: str, token: str, filename: str) -> str:
    """The uploaded bytes, as they came; `token` is of this upload alone, for the same bytes may come again meanwhile."""
    return f"scans/{scan_id}-{token}/{safe_name(filename)}"


def folder_of(key: str) -> str:
    """The prefix of a key and of what lies beside it."""
    return key.rsplit("/", 1)[0] + "/"


def probe(token: str) -> str:
    """What a look at the store writes and removes; two looks at once have a token each."""
    return f"health/{token}"


def map_folder(job_id: str) -> str:
    """The prefix of everything kept for a version of a map.

    `job_id` is that of the job that builds it, and not the map's own id, which a client may give again once the map is
    deleted: a step of the old job that comes late must not write among the files of the new map.
    """
    return f"maps/{job_id}/"


def map_cloud(job_id: str) -> str:
    """The fused reference map, PLY."""
    return map_folder(job_id) + "cloud.ply"


def map_reference(job_id: str) -> str:
    """What surveys are registered to and compared with: points, normals and grid of the reference map."""
    return map_folder(job_id) + "reference.npz"


def map_tiles(job_id: str) -> str:
    """What release 0.1 kept the map's grid in, with the points of its tiles; later ones have no such file."""
    return map_folder(job_id) + "tiles.npz"


def map_embedding(job_id: str, model: str, sha256: str | None) -> str:
    """What one model computed of the reference alone; `model` is `name/version`, the digest that of its weights.

    Other weights under the same name find no embedding, rather than one that is not theirs.
    """
    made_by = f"{model.replace('/', '-')}-{(sha256 or 'none')[:12]}"
    return f"{map_folder(job_id)}description-{safe_name(made_by)}.npz"


def map_manifest(job_id: str) -> str:
    """The tile manifest (paper, Table A1), JSON."""
    return map_folder(job_id) + "manifest.json"


def map_scan(job_id: str, scan_id: str) -> str:
    """The points, pose and sensor origin of one accepted scan of the map."""
    return f"{map_folder(job_id)}scans/{scan_id}.npz"


def map_work(job_id: str) -> str:
    """The prefix of what the building of a map remembers of itself while it lasts."""
    return map_folder(job_id) + "work/"


def map_pairs(job_id: str, token: str) -> str:
    """Pairs of scans that were registered, JSON; every write has a token of its own."""
    return f"{map_work(job_id)}pairs-{token}.json"


def model_folder(job_id: str) -> str:
    """The prefix of everything kept for a site's own model; `job_id` is that of the job that trains it."""
    return f"models/{job_id}/"


def model_weights(job_id: str) -> str:
    """The weights that the model's card vouches for."""
    return model_folder(job_id) + "weights.safetensors"


def model_log(job_id: str) -> str:
    """The log of the training, CSV, a row an epoch."""
    return model_folder(job_id) + "epochs.csv"


def model_work(job_id: str) -> str:
    """The prefix of what a training remembers of itself while it lasts."""
    return model_folder(job_id) + "work/"


def model_tiles(job_id: str) -> str:
    """The training set."""
    return model_work(job_id) + "tiles.npz"


def model_checkpoint(job_id: str, name: str) -> str:
    """One of the files that a training goes on from."""
    return model_work(job_id) + name


def survey_folder(survey_id: str) -> str:
    """The prefix of everything kept for a survey."""
    return f"surveys/{survey_id}/"


def survey_current(survey_id: str) -> str:
    """The survey's scans fused in the map frame."""
    return survey_folder(survey_id) + "current.npz"


def survey_scores(survey_id: str) -> str:
    """The class probabilities of every tile, and of voxels where the detector has them."""
    return survey_folder(survey_id) + "scores.npz"


def survey_cloud(survey_id: str) -> str:
    """The current map coloured by result, PLY."""
    return survey_folder(survey_id) + "cloud.ply"


def survey_picture(survey_id: str) -> str:
    """The top view with tiles by state, PNG."""
    return survey_folder(survey_id) + "picture.png"


def survey_scan(survey_id: str, scan_id: str) -> str:
    """The points, pose and sensor origin of one accepted scan of the survey."""
    return f"{survey_folder(survey_id)}scans/{scan_id}.npz"
