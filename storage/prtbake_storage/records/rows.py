"""From rows to wire models."""

from collections.abc import Sequence

from prtbake_storage.contract.jobs import Artefact, Event, Job, JobError, JobState, Progress
from prtbake_storage.records.models import ArtefactRow, EventRow, JobRow


def to_artefact(row: ArtefactRow) -> Artefact:
    """Show an artefact."""
    return Artefact(name=row.name, size=row.size, media_type=row.media_type, sha256=row.digest)


def to_event(row: EventRow) -> Event:
    """Show an event."""
    return Event.model_validate(
        {
            "id": row.id,
            "job": row.job_id,
            "type": row.type,
            "data": row.data,
            "created": row.created,
        }
    )


def to_job(row: JobRow, artefacts: Sequence[ArtefactRow] = ()) -> Job:
    """Show a job; what it was given besides its request stays inside."""
    return Job(
        id=row.id,
        kind=row.kind,
        state=JobState(row.state),
        request=row.request,
        label=row.label,
        created=row.created,
        started=row.started,
        finished=row.finished,
        progress=Progress.model_validate(row.progress),
        # a running job that is being stopped has its error noted already: it is not yet the answer
        error=JobError.model_validate(row.error) if row.error and row.finished else None,
        retry_of=row.retry_of,
        result=row.result,
        artefacts=[to_artefact(artefact) for artefact in artefacts],
    )
