"""What surrounds every request: its id, its log line, its metrics, its size limit."""

import logging
import re
import time
from contextvars import ContextVar
from uuid import uuid4

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from prtbake_service.errors_http import internal_problem, problem_response
from prtbake_service.health.metrics import Metrics

log = logging.getLogger(__name__)
REQUEST_ID: ContextVar[str | None] = ContextVar("request_id", default=None)
_SAFE_ID = re.compile(r"[A-Za-z0-9_.-]{1,64}")
# anything else is made up by the caller, and each name would be a series of its own
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
_SECURITY = {"X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer"}


class RequestContext:
    """Pure ASGI middleware: streams pass through it untouched.

    Parameters
    ----------
    app
        What answers the request.
    metrics
        Where requests are counted.
    max_request_bytes
        Limit of a body; uploads have their own and stand under ``/v1/uploads/sha256:``.
    """

    def __init__(self, app: ASGIApp, *, metrics: Metrics, max_request_bytes: int) -> None:
        self.app = app
        self.metrics = metrics
        self.max_request_bytes = max_request_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        given = Headers(scope=scope).get("x-request-id", "")
        request_id = given if _SAFE_ID.fullmatch(given) else uuid4().hex
        token = REQUEST_ID.set(request_id)
        start = time.perf_counter()
        status = 0

        async def send_with_headers(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers["X-Request-ID"] = request_id
                for name, value in _SECURITY.items():
                    headers.setdefault(name, value)
            await send(message)

        try:
            await self.app(scope, self._limited(scope, receive), send_with_headers)
        except Exception:
            log.exception("request.failed")
            if status:
                raise  # half an answer is out: only cutting the connection says that it is wrong
            response = problem_response(internal_problem())
            await response(scope, receive, send_with_headers)
        finally:
            seconds = time.perf_counter() - start
            route = getattr(scope.get("route"), "path", "unmatched")
            method = scope["method"] if scope["method"] in _METHODS else "other"
            self.metrics.observe(method, route, status, seconds)
            log.info(
                "request.done",
                extra={
                    "method": scope["method"],
                    "path": scope["path"],
                    "status": status,
                    "seconds_s": round(seconds, 4),
                },
            )
            REQUEST_ID.reset(token)

    def _limited(self, scope: Scope, receive: Receive) -> Receive:
        if scope["path"].startswith("/v1/uploads/sha256:"):
            return receive
        limit = self.max_request_bytes
        received = 0

        async def receive_limited() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > limit:
                raise HTTPException(413, f"a request body may have {limit} bytes at most")
            return message

        return receive_limited
