"""The names of blobs: every key that is written or read is spelled here and nowhere else."""

from __future__ import annotations

import re
from collections.abc import Callable

ROOTS = (
    "scans",
    "maps",
    "models",
    "surveys",
)  #: in each a folder for each row that keeps files; what lies beside is of no account

_UNSAFE = re.compile(r"[^A-Za-z0-9._-]+")


def safe_name(filename: str) -> str:
    """Name the last part of a client's file name, with nothing left in it that a path or a shell would read.

    Never empty, never hidden, at most 100 characters; the suffix is kept when the name is cut.
    """
    name = _UNSAFE.sub("_", filename.replace("\\", "/").rsplit("/", 1)[-1]).lstrip(".")
    return name[-100:].lstrip(".") or "scan"


def scan_file(scan_id: str, token: str, filename: str) -> str:
    """Name the uploaded bytes, as they came.

    `token` is of this upload alone, for the same bytes may come again meanwhile.
    """
    return f"scans/{scan_id}-{token}/{safe_name(filename)}"


def folder_of(key: str) -> str:
    """Name the prefix of a key and of what lies beside it."""
    return key.rsplit("/", 1)[0] + "/"


def owner_of(key: str) -> str:
    """Name the folder of the id that a blob belongs to, such as `surveys/survey-91c4/`."""
    return "/".join(key.split("/")[:2]) + "/"


def probe(token: str) -> str:
    """Name what a look at the store writes and removes; two looks at once have a token each."""
    return f"health/{token}"


def _within(folder: Callable[[str], str], name: str) -> Callable[[str], str]:
    """Return what names a file, or a folder, in the folder of an id."""
    return lambda owner: folder(owner) + name


def map_folder(job_id: str) -> str:
    """Name the prefix of everything kept for a version of a map.

    `job_id` is that of the job that builds it, and not the map's own id, which a client may give again once the map is
    deleted: a step of the old job that comes late must not write among the files of the new map.
    """
    return f"maps/{job_id}/"


map_cloud = _within(map_folder, "cloud.ply")  #: the fused reference map
map_laz = _within(map_folder, "cloud.laz")  #: the same, packed; an earlier release kept no such file
map_reference = _within(
    map_folder, "reference.npz"
)  #: points, normals and grid, which surveys are compared with
map_seen = _within(map_folder, "seen.npz")  #: what the map's scans saw; release 0.1 kept no such file
map_tiles = _within(map_folder, "tiles.npz")  #: where release 0.1 kept the grid; later ones have no such file
map_manifest = _within(map_folder, "manifest.json")  #: the tile manifest (paper, Table A1)
map_tileset = _within(map_folder, "tileset.json")  #: the document of the cloud's tileset
map_tileset_contents = _within(map_folder, "tileset.bin")  #: all of its contents, one after the other
map_work = _within(map_folder, "work/")  #: what the building of a map remembers of itself while it lasts


def map_embedding(job_id: str, model: str, fingerprint: str) -> str:
    """Name the reference embedding of one model; `model` is `name/version`, `fingerprint` the one of its card.

    Other weights or settings under the same name find no embedding, rather than one that is not theirs. The key says
    `description`, as earlier builds wrote it.
    """
    made_by = f"{model.replace('/', '-')}-{fingerprint[:12]}"
    return f"{map_folder(job_id)}description-{safe_name(made_by)}.npz"


def map_alarms(job_id: str, model: str, fingerprint: str) -> str:
    """Name what one model found on the map's own scans, where nothing had changed; named as an embedding is."""
    made_by = f"{model.replace('/', '-')}-{fingerprint[:12]}"
    return f"{map_folder(job_id)}alarms-{safe_name(made_by)}.npz"


def map_scan(job_id: str, scan_id: str) -> str:
    """Name the points, pose and sensor origin of one accepted scan of the map."""
    return f"{map_folder(job_id)}scans/{scan_id}.npz"


def map_pairs(job_id: str, token: str) -> str:
    """Name pairs of scans that were registered, JSON; every write has a token of its own."""
    return f"{map_work(job_id)}pairs-{token}.json"


def model_folder(job_id: str) -> str:
    """Name the prefix of everything kept for a site's own model; `job_id` is that of the job that trains it."""
    return f"models/{job_id}/"


model_weights = _within(model_folder, "weights.safetensors")  #: the card has their digest
model_log = _within(model_folder, "epochs.csv")  #: of the training, a row an epoch
model_work = _within(model_folder, "work/")  #: what a training remembers of itself while it lasts
model_tiles = _within(model_work, "tiles.npz")  #: the training set


def model_checkpoint(job_id: str, name: str) -> str:
    """Name one of the files that a training goes on from."""
    return model_work(job_id) + name


def survey_folder(survey_id: str) -> str:
    """Name the prefix of everything kept for a survey."""
    return f"surveys/{survey_id}/"


survey_current = _within(survey_folder, "current.npz")  #: the survey's scans fused in the map frame
survey_seen = _within(survey_folder, "seen.npz")  #: what the survey's scans saw
survey_scores = _within(
    survey_folder, "scores.npz"
)  #: probabilities of tiles, and of voxels where there are such
survey_cloud = _within(survey_folder, "cloud.ply")  #: the current map coloured by result
survey_tileset = _within(
    survey_folder, "tileset.json"
)  #: the document of the cloud's tileset, where it is large
survey_tileset_contents = _within(survey_folder, "tileset.bin")  #: all of its contents
survey_laz = _within(survey_folder, "cloud.laz")  #: the same, packed; an earlier release kept no such file
survey_picture = _within(survey_folder, "picture.png")  #: the top view with tiles by state


def survey_scan(survey_id: str, scan_id: str) -> str:
    """Name the points, pose and sensor origin of one accepted scan of the survey."""
    return f"{survey_folder(survey_id)}scans/{scan_id}.npz"
