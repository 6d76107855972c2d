"""The pairs of scans that the building of a map has registered, kept so that one that was killed goes on from them."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Iterable, Iterator
from uuid import uuid4

from service.catalog.files import blob_keys
from service.catalog.files.blobs import Blobs
from worker.pipeline.registration.scan_to_scan import PairResult

_INTERVAL_S = 2.0  #: between two writes, and so about the most work that is lost


log = logging.getLogger(__name__)


class StoredPairCache:
    """A `worker.pipeline.mapping.pair_registration.PairCache` among the files of a map, which go when it is saved.

    Each write is a blob of its own, under a name that nobody else takes: it is seen whole or not at all, and a worker
    that was thought dead and still writes does no harm.
    """

    def __init__(self, blobs: Blobs, job_id: str, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._blobs, self._job_id, self._clock = blobs, job_id, clock
        self._waiting: list[PairResult] = []
        self._written = clock()

    def load(self) -> Iterator[PairResult]:
        """Return every pair that earlier attempts registered; what another release wrote otherwise is done again."""
        for key in self._blobs.under(blob_keys.map_work(self._job_id)):
            try:
                results = [PairResult.of_document(pair) for pair in json.loads(self._blobs.get_bytes(key))]
            except (KeyError, TypeError, ValueError) as error:
                log.warning("pairs in %s cannot be read and are registered again: %s", key, error)
                continue
            yield from results

    def save(self, results: Iterable[PairResult]) -> None:
        """Remember more pairs; they are written at once if the last write is two seconds ago, else with later ones."""
        self._waiting += results
        if self._clock() - self._written >= _INTERVAL_S:
            self.flush()

    def flush(self) -> None:
        """Write what waits."""
        if self._waiting:
            text = json.dumps([pair.document() for pair in self._waiting])
            self._blobs.put_bytes(blob_keys.map_pairs(self._job_id, uuid4().hex), text.encode())
        self._waiting, self._written = [], self._clock()
