"""What can go wrong on the service's side, and the stable code of each. HTTP statuses are in api/http/answering/problems.py.

ServiceError
├── NotFound             not_found            no such scan, map, survey, job, tile or model
│   ├── NoSuchProcess    no_such_process      no process of that id (OGC API - Processes)
│   └── NoSuchJob        no_such_job          no job of that id, asked for its results (OGC API - Processes)
├── ResultNotReady       result_not_ready     the job still waits or runs (OGC API - Processes)
├── NotReady             not_ready            the map is still building, the survey still running
│   └── Failed           failed               it was not made, and will not be by waiting
├── Conflict             conflict             the id is taken, the scan is in use
├── BadRequest           bad_request          a value that the schema admits and the service does not
├── ScanUnreadable       scan_unreadable      an uploaded file that is neither PLY, PCD, E57 nor LAS
├── KeyMalformed         idempotency_key_malformed   an Idempotency-Key that is none
├── KeyReused            idempotency_key_reused      it came with another request before
├── KeyInUse             idempotency_key_in_use      the request under it is being carried out
├── TooLarge             too_large            a body over the limit
├── TooSlow              too_slow             a body that takes too long
├── WrongMediaType       wrong_media_type     neither a scan nor JSON
├── NotAcceptable        not_acceptable       the request accepts no media type that there is
├── WrongEncoding        wrong_encoding       a body in a content coding other than gzip
├── WrongDigest          wrong_digest         a body that is not what its digest says
├── BrokenRequest        broken_request       headers or a coding that cannot be read, a part of a body
├── OffsetMismatch       offset_mismatch      a piece of an upload that begins where none is wanted
├── ChecksumMismatch     checksum_mismatch    a piece of an upload that is not what was sent
├── UploadBusy           upload_busy          another request writes to the upload
├── TooManyUploads       too_many_uploads     as many uploads are begun as may be
├── TusVersion           tus_version          a request of another version of the protocol
├── TusMalformed         tus_malformed        a header of the protocol that is missing or cannot be read
├── Gone                 gone                 a cursor behind which something is not kept any more
├── DiskFull             disk_full            less space than the reserve is left, or none
├── QueueFull            queue_full           as many jobs wait as may
├── Unauthorized         unauthorized         no API key, or one that is not known
├── Forbidden            forbidden            the key, the host or the origin of the request may not do this
└── Unavailable          unavailable          a part that is needed does not answer; try again
    ├── QueueUnavailable       queue_unavailable        Redis
    ├── DatabaseUnavailable    database_unavailable     the database, or its lock was not to be had in time
    └── BlobsUnavailable       blobs_unavailable        the blob store
"""

from __future__ import annotations

import errno
from collections.abc import Iterator

_NO_SPACE = (errno.ENOSPC, errno.EDQUOT)
_SQLITE_FULL = 13  #: sqlite.org, result codes
_SQLITE_NO_SHM = 4874  #: SQLITE_IOERR_SHMSIZE: no space for the index of its log
_POSTGRESQL_FULL = "53100"  #: PostgreSQL, Appendix A: disk_full
_SAYS_FULL = ("no space left on device", "disk quota exceeded", "os error 28", "os error 122")


class ServiceError(Exception):
    """Base of every error that a client can see; `str()` says what is wrong and what to do."""

    code = "service_error"


class NotFound(ServiceError):
    code = "not_found"


class NoSuchProcess(NotFound):
    code = "no_such_process"


class NoSuchJob(NotFound):
    code = "no_such_job"


class ResultNotReady(ServiceError):
    code = "result_not_ready"


class NotReady(ServiceError):
    code = "not_ready"


class Failed(NotReady):
    code = "failed"


class Conflict(ServiceError):
    code = "conflict"


class BadRequest(ServiceError):
    code = "bad_request"


class ScanUnreadable(ServiceError):
    code = "scan_unreadable"


class KeyMalformed(ServiceError):
    code = "idempotency_key_malformed"


class KeyReused(ServiceError):
    code = "idempotency_key_reused"


class KeyInUse(ServiceError):
    code = "idempotency_key_in_use"
    retry_after_s = 2  #: seconds that the API asks a client to wait


class TooLarge(ServiceError):
    code = "too_large"


class TooSlow(ServiceError):
    code = "too_slow"


class WrongMediaType(ServiceError):
    code = "wrong_media_type"


class NotAcceptable(ServiceError):
    code = "not_acceptable"


class WrongEncoding(ServiceError):
    code = "wrong_encoding"


class WrongDigest(ServiceError):
    code = "wrong_digest"


class BrokenRequest(ServiceError):
    code = "broken_request"


class OffsetMismatch(ServiceError):
    code = "offset_mismatch"


class ChecksumMismatch(ServiceError):
    code = "checksum_mismatch"


class UploadBusy(ServiceError):
    code = "upload_busy"
    retry_after_s = 2  #: seconds that the API asks a client to wait


class TooManyUploads(ServiceError):
    code = "too_many_uploads"
    retry_after_s = 60  #: seconds that the API asks a client to wait


class TusVersion(ServiceError):
    code = "tus_version"


class TusMalformed(ServiceError):
    code = "tus_malformed"


class Gone(ServiceError):
    code = "gone"


class DiskFull(ServiceError):
    code = "disk_full"


class QueueFull(ServiceError):
    code = "queue_full"
    retry_after_s = 30  #: seconds that the API asks a client to wait


class Unauthorized(ServiceError):
    code = "unauthorized"


class Forbidden(ServiceError):
    code = "forbidden"


class Unavailable(ServiceError):
    code = "unavailable"
    retry_after_s = 5  #: seconds that the API asks a client to wait


class QueueUnavailable(Unavailable):
    code = "queue_unavailable"


class DatabaseUnavailable(Unavailable):
    code = "database_unavailable"


class BlobsUnavailable(Unavailable):
    code = "blobs_unavailable"


def is_disk_full(error: BaseException) -> bool:
    """Tell whether an error, or one that it came of, says that a disk or a quota is full.

    Redis and obstore say it in words alone.
    """
    return any(_says_full(cause) for cause in _causes(error))


def _says_full(error: BaseException) -> bool:
    if isinstance(error, DiskFull) or (isinstance(error, OSError) and error.errno in _NO_SPACE):
        return True
    code = getattr(error, "sqlite_errorcode", None) or 0
    if code & 0xFF == _SQLITE_FULL or code == _SQLITE_NO_SHM:
        return True
    if getattr(error, "sqlstate", None) == _POSTGRESQL_FULL:
        return True
    return any(words in str(error).lower() for words in _SAYS_FULL)


def _causes(error: BaseException) -> Iterator[BaseException]:
    """Yield the error and, each once, what it came of: `raise ... from`, while another was handled, SQLAlchemy's `orig`."""
    waiting, seen = [error], set[int]()
    while waiting:
        cause = waiting.pop()
        if id(cause) in seen:
            continue
        seen.add(id(cause))
        yield cause
        hidden = cause.__cause__ is not None or cause.__suppress_context__
        of = (cause.__cause__, None if hidden else cause.__context__, getattr(cause, "orig", None))
        waiting += [other for other in of if isinstance(other, BaseException)]
