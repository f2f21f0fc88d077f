"""The operator's garbage collection: ``python -m prtbake_storage.queue.garbage_main --dry-run``.

Workers collect by themselves; this does it now, with the same ``PRTBAKE_*`` (`QueueSettings`), and
prints as JSON what went or, with ``--dry-run``, what would go.
"""

import argparse
import json
import sys
from dataclasses import asdict

from prtbake_storage.blobs.opening import open_store
from prtbake_storage.queue.garbage import Collector
from prtbake_storage.queue.logs import configure_logging
from prtbake_storage.queue.settings import REGISTRY, QueueSettings
from prtbake_storage.queue.worker_main import load_registry
from prtbake_storage.records.database import create_database


def main(arguments: list[str] | None = None) -> None:
    """Collect once."""
    parser = argparse.ArgumentParser(prog="prtbake-garbage", description=__doc__)
    parser.add_argument("--dry-run", action="store_true", help="count, remove nothing")
    parser.add_argument("--registry", default=REGISTRY, help="module:attribute of the job kinds")
    options = parser.parse_args(arguments)
    configure_logging(worker="garbage")
    settings = QueueSettings()
    database = create_database(settings.database_url)
    store, runner = open_store(settings.blob_url), load_registry(options.registry)
    report = Collector(database, store, runner, settings).collect(dry_run=options.dry_run)
    database.dispose()
    sys.stdout.write(json.dumps(asdict(report)) + "\n")


if __name__ == "__main__":
    main()
