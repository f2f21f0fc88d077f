"""Every error as RFC 9457 problem details.

422 stands for malformed requests only; what is well formed but cannot be done says 400, 404 or 409.
"""

import logging
import re
from collections.abc import Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from sqlalchemy.exc import InterfaceError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, Response

from prtbake_service.validation import validation_entries, wanted_of
from prtbake_storage.contract.jobs import Problem
from prtbake_storage.errors import PrtError, Unauthorised

PROBLEM_JSON = "application/problem+json"
RETRY_AFTER_S = "5"
RETRIED = frozenset({429, 503})
log = logging.getLogger(__name__)

CODES = {
    400: "bad-request",
    401: "unauthorised",
    404: "not-found",
    405: "method-not-allowed",
    406: "not-acceptable",
    413: "too-large",
    415: "unsupported-media-type",
    416: "range-not-satisfiable",
    422: "malformed-request",
}


class ProblemError(PrtError):
    """A problem that knows its own status: a job's or a parser's refusal, passed on."""

    def __init__(self, status: int, code: str, detail: str, *, pointer: str | None = None) -> None:
        super().__init__(detail, pointer=pointer)
        self.status = status
        self.problem_code = code


class MalformedRequest(PrtError, ValueError):
    """A request that the models refuse."""

    code = "malformed-request"
    kind = "input"
    http_status = 422

    def __init__(self, errors: Sequence[dict[str, Any]]) -> None:
        first = errors[0]
        super().__init__(str(first["detail"]), pointer=first["pointer"])
        self.errors = list(errors)


def problem_response(problem: Problem, headers: dict[str, str] | None = None) -> Response:
    """Render a problem; what may be otherwise soon says when to ask again."""
    soon = {"Retry-After": RETRY_AFTER_S} if problem.status in RETRIED else {}
    return JSONResponse(
        problem.model_dump(mode="json", exclude_none=True),
        status_code=problem.status,
        headers=soon | (headers or {}),
        media_type=PROBLEM_JSON,
    )


def title_of(status: int) -> str:
    """Return the standard phrase of a status."""
    try:
        return HTTPStatus(status).phrase
    except ValueError:
        return "Error"


def on_prt_error(request: Request, error: Exception) -> Response:
    """Render an error of ours."""
    if not isinstance(error, PrtError):
        raise TypeError("registered for PrtError only") from error
    status, code = error.http_status, error.code
    if isinstance(error, ProblemError):
        status, code = error.status, error.problem_code
    if status >= 500:
        log.error("request.error", exc_info=error)
    headers = {}
    if isinstance(error, Unauthorised):
        headers["WWW-Authenticate"] = 'Bearer realm="prtbake"'
    problem = Problem(
        title=title_of(status),
        status=status,
        detail=error.detail,
        code=code,
        pointer=error.pointer,
        errors=error.errors if isinstance(error, MalformedRequest) else [],
    )
    return problem_response(problem, headers)


def on_validation_error(request: Request, error: Exception) -> Response:
    """Render what the models refuse."""
    if not isinstance(error, RequestValidationError):
        raise TypeError("registered for RequestValidationError only") from error
    if isinstance(error.body, bytes):
        # the framework reads JSON only where the header says so
        return on_prt_error(request, not_called_json(request.headers.get("content-type")))
    field = getattr(request.scope.get("route"), "body_field", None)
    wanted = "" if field is None else wanted_of(field.field_info)
    entries = validation_entries(error.errors(), error.body, wanted=wanted)
    return on_prt_error(request, MalformedRequest(entries))


def not_called_json(content_type: str | None) -> ProblemError:
    """Return the refusal of a body whose header does not say that it is JSON."""
    given = "has no Content-Type" if content_type is None else f"says Content-Type: {content_type}"
    return ProblemError(
        415,
        CODES[415],
        f"the body must be JSON and the request must say so, but it {given}:"
        " send the header Content-Type: application/json",
    )


def on_http_exception(request: Request, error: Exception) -> Response:
    """Render what the framework refuses: no such path or method, a body too large."""
    if not isinstance(error, HTTPException):
        raise TypeError("registered for HTTPException only") from error
    status = error.status_code
    detail = error.detail
    if status == 404:
        detail = f"there is nothing at {request.url.path}"
    elif status == 405:
        detail = f"{request.method} is not possible at {request.url.path}"
    problem = Problem(
        title=title_of(status), status=status, detail=detail, code=CODES.get(status, "error")
    )
    headers = dict(error.headers or {})
    if status == 405:
        headers["Allow"] = ", ".join(allowed_methods(request, headers.get("Allow", "")))
    return problem_response(problem, headers)


def allowed_methods(request: Request, known: str) -> list[str]:
    """Return every method of a path; the router knows those of the first route that fits only."""
    methods = {method for method in known.split(", ") if method}
    for template, operations in request.app.openapi()["paths"].items():
        # a parameter fits what stands between two slashes
        pattern = re.sub(r"\\{[^}]*\\}", "[^/]+", re.escape(template))
        if re.fullmatch(pattern, request.url.path):
            methods |= {method.upper() for method in operations}
    return sorted(methods)


def on_database_error(request: Request, error: Exception) -> Response:
    """Render that the database is away or too busy."""
    log.error("database.away", exc_info=error)
    problem = Problem(
        title=title_of(503),
        status=503,
        detail="the database does not answer at the moment: ask again soon",
        code="database-away",
    )
    return problem_response(problem)


def internal_problem() -> Problem:
    """Return what a caller learns of a fault of ours: nothing but that it is logged."""
    return Problem(
        title=title_of(500),
        status=500,
        detail="an internal error; the log has it under this response's X-Request-ID",
        code="internal",
    )


def install(app: FastAPI) -> None:
    """Register the handlers."""
    app.add_exception_handler(PrtError, on_prt_error)
    app.add_exception_handler(RequestValidationError, on_validation_error)
    app.add_exception_handler(HTTPException, on_http_exception)
    for away in (OperationalError, InterfaceError, PoolTimeout):
        app.add_exception_handler(away, on_database_error)
