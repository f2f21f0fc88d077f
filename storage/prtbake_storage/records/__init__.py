"""The service's own database records."""

from prtbake_storage.records.cost_rates import CostRates
from prtbake_storage.records.database import Database, create_database
from prtbake_storage.records.events import Events
from prtbake_storage.records.internal import InternalJobs
from prtbake_storage.records.jobs import Jobs, NewJob
from prtbake_storage.records.keys import Key, Keys
from prtbake_storage.records.references import referenced_blobs
from prtbake_storage.records.registrations import Begun, Registrations
from prtbake_storage.records.resources import Resources
from prtbake_storage.records.runs import NewArtefact, Run, Runs, Stop
from prtbake_storage.records.uploads import Uploads
from prtbake_storage.records.workers import Worker, Workers

__all__ = [
    "Begun",
    "CostRates",
    "Database",
    "Events",
    "InternalJobs",
    "Jobs",
    "Key",
    "Keys",
    "NewArtefact",
    "NewJob",
    "Registrations",
    "Resources",
    "Run",
    "Runs",
    "Stop",
    "Uploads",
    "Worker",
    "Workers",
    "create_database",
    "referenced_blobs",
]  # fmt: skip
