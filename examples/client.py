"""Use the service from Python: build a map of one scan, compare a later scan with it, print what changed.

spicd up &
python examples/client.py monday.pcd tuesday.pcd
"""

from __future__ import annotations

import sys
from pathlib import Path

from service.client import Client


def main(client: Client, before: Path, after: Path) -> None:
    """Have two scans compared by the service."""
    earlier, later = (client.upload_scan(path)["scan_id"] for path in (before, after))
    building = client.create_map([earlier])
    client.wait(building["job_id"], lambda job: print(job["progress"], job["message"]))
    survey = client.submit_survey(building["map_id"], [later])
    client.wait(survey["job_id"], lambda job: print(job["progress"], job["message"]))
    for feature in client.changes(building["map_id"])["features"]:
        tile = feature["properties"]
        print(f"{tile['tile_id']} at {tile['center']} m: {tile['score']:.2f}")


if __name__ == "__main__":
    with Client() as opened:
        main(opened, Path(sys.argv[1]), Path(sys.argv[2]))
