"""What can go wrong on the service's side, and the stable code of each. HTTP statuses are in api/http/problems.py.

ServiceError
├── NotFound             not_found            no such scan, map, survey, job, tile or model
├── NotReady             not_ready            the map is still building, the survey still running
├── Conflict             conflict             the id is taken, the scan is in use
├── BadRequest           bad_request          a value that the schema admits and the service does not
├── ScanUnreadable       scan_unreadable      an uploaded file that is neither PLY nor PCD
├── TooLarge             too_large            a body over the limit
├── TooSlow              too_slow             a body that takes too long
├── WrongMediaType       wrong_media_type     neither a scan nor JSON
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


class ServiceError(Exception):
    """Base of every error that a client can see; `str()` says what is wrong and what to do."""

    code = "service_error"


class NotFound(ServiceError):
    code = "not_found"


class NotReady(ServiceError):
    code = "not_ready"


class Conflict(ServiceError):
    code = "conflict"


class BadRequest(ServiceError):
    code = "bad_request"


class ScanUnreadable(ServiceError):
    code = "scan_unreadable"


class TooLarge(ServiceError):
    code = "too_large"


class TooSlow(ServiceError):
    code = "too_slow"


class WrongMediaType(ServiceError):
    code = "wrong_media_type"


class DiskFull(ServiceError):
    code = "disk_full"


class QueueFull(ServiceError):
    code = "queue_full"


class Unauthorized(ServiceError):
    code = "unauthorized"


class Forbidden(ServiceError):
    code = "forbidden"


class Unavailable(ServiceError):
    code = "unavailable"


class QueueUnavailable(Unavailable):
    code = "queue_unavailable"


class DatabaseUnavailable(Unavailable):
    code = "database_unavailable"


class BlobsUnavailable(Unavailable):
    code = "blobs_unavailable"


def is_disk_full(error: BaseException | None) -> bool:
    """Tell whether an error, or one that it comes from, says that no space is left."""
    while error is not None:
        if isinstance(error, DiskFull) or getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT):
            return True
        error = error.__cause__ or error.__context__
    return False
