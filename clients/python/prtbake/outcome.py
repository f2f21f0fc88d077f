"""What an answer means for the caller; without I/O."""

import httpx

from prtbake.errors import error_class
from prtbake_storage.contract.jobs import Estimate, Job, Problem
from prtbake_storage.contract.resources import Resource


def parsed(resource: Resource) -> Resource:
    """Return a resource that can be used, or raise why it cannot."""
    if resource.state != "refused":
        return resource
    told = resource.problem or {}
    problem = Problem(
        title="Refused",
        status=400,
        detail=str(told.get("detail", "the file could not be used")),
        code=str(told.get("code", "refused")),
        pointer=told.get("pointer"),
    )
    raise error_class(problem.status)(problem)


def estimate_of(job: Job) -> Estimate:
    """Return the estimate that a quick job came to."""
    return Estimate.model_validate(job.result)


def job_of_estimate(response: httpx.Response) -> str:
    """Return the id of the quick job that works on an estimate (the answer was a 202)."""
    return Job.model_validate_json(response.content).id
