"""SDK and command line of prtbake."""

from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
    from prtbake.asset import Asset

__all__ = [
    "ApiError",
    "Asset",
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


def __getattr__(name: str) -> Any:
    # numpy and h5py take longer to import than most commands take to run
    if name == "Asset":
        from prtbake.asset import Asset

        return Asset
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
