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


class Server:
    """A cluster in a temporary folder, reached through a Unix socket; stopped when created.

    Attributes
    ----------
    url
        A database of it.
    """

    def __init__(self, folder: Path, programs: Path) -> None:
        self.url = f"postgresql://{_SERVER_ROLE}@/postgres?host={folder}"
        self._folder, self._programs = folder, programs
        # the server refuses to run as root; its packages come with a user for it
        self._as_user = ["runuser", "-u", _SERVER_ROLE, "--"] if os.geteuid() == 0 else []
        if self._as_user:
            os.chown(folder, pwd.getpwnam(_SERVER_ROLE).pw_uid, pwd.getpwnam(_SERVER_ROLE).pw_gid)
        initdb = ["initdb", "-U", _SERVER_ROLE, "-A", "trust", "-E", "UTF8", "--no-sync"]
        self._call(*initdb, "-D", str(folder / "data"))

    def start(self) -> None:
        """Start, and wait until it answers."""
        # the data dies with the test run, so nothing needs to reach the disk
        sockets = f"-k {self._folder} -c listen_addresses=''"
        options = f"{sockets} -c fsync=off -c max_connections=200"
        self._control("-l", str(self._folder / "log"), "-w", "-o", options, "start")

    def stop(self) -> None:
        """Stop as a crash would: every connection breaks, and the next start recovers."""
        self._control("-m", "immediate", "stop")

    def _control(self, *arguments: str) -> None:
        self._call("pg_ctl", "-D", str(self._folder / "data"), *arguments)

    def _call(self, program: str, *arguments: str) -> None:
        command = [*self._as_user, str(self._programs / program), *arguments]
        subprocess.run(command, check=True, capture_output=True, cwd=self._folder, text=True)


@contextmanager
def private_server() -> Iterator[Server]:
    """Run a server that the caller may stop and start; it must run again at the end."""
    programs = find_postgres()
    if programs is None:
        raise RuntimeError(f"no PostgreSQL is installed, and {URL_VARIABLE} is unset")
    folder = Path(tempfile.mkdtemp(prefix="prtbake-pg-"))
    try:
        server = Server(folder, programs)
        server.start()
        try:
            yield server
        finally:
            server.stop()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def postgres_server() -> Iterator[str]:
    """Run a server, or use the one that `URL_VARIABLE` names; gives the URL of a database of it."""
    if url := os.environ.get(URL_VARIABLE):
        yield url
        return
    with private_server() as server:
        yield server.url


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
