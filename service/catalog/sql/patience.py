"""How long a caller waits for the database and the blob store; nothing in the catalog waits without a limit."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class Patience:
    """Limits of one caller, in seconds."""

    connect_s: float  #: for a server to take a connection
    lock_s: float  #: for another writer, or for a connection of the pool
    statement_s: (
        float  #: for the answer to one statement that reads; PostgreSQL alone, SQLite works in the caller
    )
    write_s: float  #: and to one in a transaction that writes: a large map takes a while to delete
    blob_s: float  #: for the answer of the blob store, and then for each further piece of it
    blob_request_s: float  #: for one whole request to the blob store, but for a blob that is streamed
    blob_retry_s: float  #: after which a request to the blob store that failed is not tried again


#: Of the API: a client is told soon, and can come again.
REQUESTS = Patience(
    connect_s=3, lock_s=5, statement_s=10, write_s=60, blob_s=8, blob_request_s=12, blob_retry_s=6
)
#: Of the workers, where coming again costs a step.
JOBS = Patience(
    connect_s=10, lock_s=30, statement_s=300, write_s=300, blob_s=30, blob_request_s=300, blob_retry_s=60
)
#: Of those who watch over workers: while they wait for the database they watch over nobody.
SUPERVISION = Patience(
    connect_s=3, lock_s=4, statement_s=5, write_s=5, blob_s=8, blob_request_s=12, blob_retry_s=6
)
#: Of migrations, which may rewrite a large table, or wait for who does.
MIGRATIONS = Patience(
    connect_s=10, lock_s=600, statement_s=3600, write_s=3600, blob_s=30, blob_request_s=300, blob_retry_s=60
)
