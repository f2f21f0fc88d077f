"""When to send a request again, and after how long; without I/O."""

import time
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import httpx

from prtbake.calls import Call
from prtbake.errors import PrtbakeError, ServiceUnreachable, error_from

FIRST_PAUSE_S = 0.2
BUSY = frozenset({429, 503})
LONG_POLL_S = 20.0
"""One long poll; proxies commonly cut idle connections after 30 to 60 s."""
REGISTER_S = 900.0
"""The service parses for 600 s at most; the rest is waiting for a worker."""
AWAY_S = 60.0
"""How long whoever waits for a job puts up with a service that is away: it may be restarting."""
LONGEST_PAUSE_S = 5.0
STREAM_SILENCE_S = 60.0
"""Four heartbeats of the service without a byte mean a dead connection."""
_LOOPBACK = frozenset({"127.0.0.1", "::1", "localhost"})


def client_options(url: str, key: str | None, timeout_s: float) -> dict[str, Any]:
    """Return what both httpx clients are built with."""
    headers = {"Authorization": f"Bearer {key}"} if key else {}
    # a proxy named in the environment cannot reach this machine's loopback
    trust_env = urlsplit(url).hostname not in _LOOPBACK
    return {"base_url": url, "headers": headers, "timeout": timeout_s, "trust_env": trust_env}


def request_options(call: Call[Any], timeout_s: float) -> dict[str, Any]:
    """Return the arguments of ``httpx.Client.request`` for a call."""
    options: dict[str, Any] = {
        "method": call.method,
        "url": call.path,
        "params": dict(call.params),
        "headers": dict(call.headers),
        "timeout": timeout_s,
    }
    if call.body is not None:
        options["json"] = call.body
    return options


def pauses(retries: int) -> Iterator[float | None]:
    """Yield the pause after each try in seconds, None after the last."""
    for attempt in range(retries):
        yield FIRST_PAUSE_S * 3.0**attempt
    yield None


class Patience:
    """Growing pauses while a service is away, until it has been away for too long.

    Parameters
    ----------
    until
        End of all waiting in seconds of `time.monotonic`, in place of a minute without an answer.
    """

    def __init__(self, until: float | None = None) -> None:
        self._given = until
        self.answered()

    def answered(self) -> None:
        """Begin anew: the service is there."""
        self._until = self._given
        self._pause_s = FIRST_PAUSE_S

    def pause(self) -> float | None:
        """Return how long to wait before asking again, or None if it has been too long."""
        now = time.monotonic()
        if self._until is None:
            self._until = now + AWAY_S
        if now >= self._until:
            return None
        pause = min(self._pause_s, self._until - now)
        self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)
        return pause


def pause_after(response: httpx.Response, call: Call[Any], pause: float | None) -> float | None:
    """Return how long to wait before asking again, or None to take the response as it is."""
    if response.status_code not in BUSY or pause is None or not call.repeatable:
        return None
    told = response.headers.get("retry-after", "")
    return max(pause, min(float(told), 30.0)) if told.isdigit() else pause


def check(response: httpx.Response) -> None:
    """Raise the error that a response stands for, if it is one."""
    if response.is_error:
        raise error_from(response)


def unreachable(url: str, error: httpx.TransportError) -> PrtbakeError:
    """Say that the service did not answer."""
    return ServiceUnreachable(f"no answer from {url}: {str(error) or type(error).__name__}")
