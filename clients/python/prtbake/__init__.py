"""SDK and command line of prtbake."""

from prtbake.async_client import AsyncClient
from prtbake.client import Client
from prtbake.errors import (
    ApiError,
    Conflict,
    DownloadError,
    InvalidRequest,
    JobNotSucceeded,
    LaunchError,
    NotFound,
    PrtbakeError,
    ServiceFailed,
    ServiceUnreachable,
    Unauthorised,
    WaitTimeout,
)

__all__ = [
    "ApiError",
    "AsyncClient",
    "Client",
    "Conflict",
    "DownloadError",
    "InvalidRequest",
    "JobNotSucceeded",
    "LaunchError",
    "NotFound",
    "PrtbakeError",
    "ServiceFailed",
    "ServiceUnreachable",
    "Unauthorised",
    "WaitTimeout",
]
