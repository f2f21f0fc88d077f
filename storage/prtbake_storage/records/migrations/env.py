"""Run by Alembic inside `prtbake_storage.records.migrate.migrate`, which gives the connection."""

from alembic import context

from prtbake_storage.records.models import Base

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=Base.metadata,
    render_as_batch=True,
    version_table="prtbake_migrations",
)
with context.begin_transaction():
    context.run_migrations()
