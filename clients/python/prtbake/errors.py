"""Errors of the SDK, one tree.

::

    PrtbakeError
    ├── ServiceUnreachable            no answer: refused connection, timeout, broken stream
    ├── ApiError                      the service answered with a problem (RFC 9457)
    │   ├── InvalidRequest (ValueError)   400, 413, 422: mend the request
    │   ├── Unauthorised                  401
    │   ├── NotFound (LookupError)        404
    │   ├── Conflict                      409
    │   └── ServiceFailed                 429 and 5xx: not the caller's fault
    ├── JobNotSucceeded               the job ended, but not well; carries it
    ├── WaitTimeout (TimeoutError)    the job goes on, the waiting does not
    ├── DownloadError                 bytes that do not match their digest
    └── LaunchError                   a local service could not be started
"""

from http import HTTPStatus

import httpx
from pydantic import ValidationError

from prtbake_storage.contract.jobs import Job, Problem
from prtbake_storage.contract.resources import Resource


class PrtbakeError(Exception):
    """Base of every error that the SDK raises on purpose."""


class ServiceUnreachable(PrtbakeError):
    """The service did not answer."""


class ApiError(PrtbakeError):
    """The service refused a request.

    Attributes
    ----------
    problem
        The problem details: status, stable ``code``, ``detail`` and JSON ``pointer``.
    request_id
        What to quote to the operator; the service's log carries it.
    """

    def __init__(self, problem: Problem, *, request_id: str | None = None) -> None:
        self.problem = problem
        self.request_id = request_id
        super().__init__(describe(problem))


class InvalidRequest(ApiError, ValueError):
    """The request or its data cannot be used."""


class Unauthorised(ApiError):
    """No API key, or not one that the service knows."""


class NotFound(ApiError, LookupError):
    """There is no such thing, or the caller may not see it."""


class Conflict(ApiError):
    """The request is legal but not in this state."""


class ServiceFailed(ApiError):
    """The service is at fault or overloaded."""


class JobNotSucceeded(PrtbakeError):
    """A job ended as failed, canceled or expired."""

    def __init__(self, job: Job) -> None:
        self.job = job
        why = f": {job.error.detail}" if job.error else ""
        where = f" (at {job.error.pointer})" if job.error and job.error.pointer else ""
        super().__init__(f"job {job.id} {job.state}{why}{where}")


class WaitTimeout(PrtbakeError, TimeoutError):
    """A job or a registration did not end within the time that the caller would wait."""

    def __init__(self, waited_for: Job | Resource, seconds: float) -> None:
        self.waited_for = waited_for
        super().__init__(f"{waited_for.id} is still {waited_for.state} after {seconds:g} s")


class DownloadError(PrtbakeError):
    """A downloaded file does not match its digest, or its name is not a plain file name."""


class LaunchError(PrtbakeError):
    """A local service could not be started or stopped early."""


def describe(problem: Problem) -> str:
    """Say what is wrong and where in one line, plus one line for each further error."""
    where = f" (at {problem.pointer})" if problem.pointer else ""
    lines = [f"{problem.detail}{where} [{problem.status} {problem.code}]"]
    # one entry repeats the headline
    if len(problem.errors) > 1:
        lines += [f"  {e.get('pointer', '')}: {e.get('detail', '')}" for e in problem.errors]
    return "\n".join(lines)


def error_class(status: int) -> type[ApiError]:
    """Return the class that stands for an HTTP status."""
    match status:
        case 401 | 403:
            return Unauthorised
        case 404:
            return NotFound
        case 409:
            return Conflict
        case _ if status == HTTPStatus.TOO_MANY_REQUESTS or status >= 500:
            return ServiceFailed
        case _:
            return InvalidRequest


def error_from(response: httpx.Response) -> ApiError:
    """Build the error for a response whose body has been read."""
    try:
        problem = Problem.model_validate_json(response.content)
    except ValidationError:
        # a proxy in between answers in its own words
        problem = Problem(
            title=response.reason_phrase or "error",
            status=response.status_code,
            detail=response.text[:300] or response.reason_phrase or "no detail given",
            code="unknown",
        )
    request_id = response.headers.get("x-request-id")
    return error_class(problem.status)(problem, request_id=request_id)
