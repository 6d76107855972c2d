"""Upload by tuspy: URL FILE [UPLOAD STOP_AT]. Prints the address of the upload; with UPLOAD it goes on with that one.

STOP_AT: bytes after which it ends, 0 for all; UPLOAD `-` begins one.
"""

from __future__ import annotations

import sys

from tusclient.client import TusClient

url, file, upload, stop_at = sys.argv[1:5]
client = TusClient(f"{url}/uploads")
uploader = client.uploader(
    file,
    url=None if upload == "-" else upload,
    chunk_size=100_000,
    metadata={"filename": "hall.ply", "device_id": "robot-7"},
    upload_checksum=True,
    retries=2,
)
uploader.upload(stop_at=int(stop_at) or None)
print(uploader.url)
