"""A private PostgreSQL server for tests, in a temporary folder, without TCP."""

import os
import pwd
import shutil
import subprocess
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import sqlalchemy as sa

URL_VARIABLE = "PRTBAKE_TEST_POSTGRES_URL"
"""A server to use instead: any of its databases, by a role that may create others."""

_SERVER_ROLE = "postgres"


def find_postgres() -> Path | None:
    """Find the folder of the newest installed server's programs; None if there is none."""
    found = sorted(
        Path("/usr/lib/postgresql").glob("*/bin/initdb"),
        key=lambda path: float(path.parts[-3]) if path.parts[-3].isdigit() else 0.0,
    )
    on_path = shutil.which("initdb")
    if found:
        return found[-1].parent
    return Path(on_path).resolve().parent if on_path else None


def available() -> bool:
    """Whether tests can have a PostgreSQL server at all."""
    return bool(os.environ.get(URL_VARIABLE)) or find_postgres() is not None


@contextmanager
def postgres_server() -> Iterator[str]:
    """Run a server, or use the one that `URL_VARIABLE` names; gives the URL of a database of it."""
    if url := os.environ.get(URL_VARIABLE):
        yield url
        return
    programs = find_postgres()
    if programs is None:
        raise RuntimeError(f"no PostgreSQL is installed, and {URL_VARIABLE} is unset")
    folder = Path(tempfile.mkdtemp(prefix="prtbake-pg-"))
    # the server refuses to run as root; its packages come with a user for it
    as_user = ["runuser", "-u", _SERVER_ROLE, "--"] if os.geteuid() == 0 else []
    if as_user:
        entry = pwd.getpwnam(_SERVER_ROLE)
        os.chown(folder, entry.pw_uid, entry.pw_gid)
    data, log = folder / "data", folder / "log"
    # the data dies with the test run, so nothing needs to reach the disk
    options = f"-k {folder} -c listen_addresses='' -c fsync=off -c max_connections=200"

    def call(program: str, *arguments: str) -> None:
        command = [*as_user, str(programs / program), *arguments]
        subprocess.run(command, check=True, capture_output=True, cwd=folder, text=True)

    try:
        call(
            "initdb", "-D", str(data), "-U", _SERVER_ROLE, "-A", "trust", "-E", "UTF8", "--no-sync"
        )
        call("pg_ctl", "-D", str(data), "-l", str(log), "-w", "-o", options, "start")
        try:
            yield f"postgresql://{_SERVER_ROLE}@/postgres?host={folder}"
        finally:
            call("pg_ctl", "-D", str(data), "-m", "immediate", "stop")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def fresh_database(server_url: str) -> Iterator[str]:
    """Create an empty database on a server, and drop it afterwards; gives its URL."""
    url = sa.make_url(server_url).set(drivername="postgresql+psycopg")
    name = f"prtbake_{uuid.uuid4().hex[:12]}"
    engine = sa.create_engine(url, isolation_level="AUTOCOMMIT")
    try:
        with engine.connect() as connection:
            connection.execute(sa.text(f"CREATE DATABASE {name}"))
        yield url.set(drivername="postgresql", database=name).render_as_string(hide_password=False)
        with engine.connect() as connection:
            connection.execute(sa.text(f"DROP DATABASE {name} WITH (FORCE)"))
    finally:
        engine.dispose()
