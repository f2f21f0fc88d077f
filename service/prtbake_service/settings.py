"""Settings of the service process."""

from datetime import timedelta
from pathlib import Path
from typing import Annotated

from pydantic import Field, SecretStr
from pydantic_settings import BaseSettings, SettingsConfigDict

DEFAULT_PORT = 8420
MIN_KEY_LENGTH = 16
"""Characters: keys are stored under a fast hash, so a guessable one is no key."""


class ServiceSettings(BaseSettings):
    """Read once at start from ``PRTBAKE_*``; passed down from there.

    Attributes
    ----------
    host, port
        Where to listen; anything but the loopback is the operator's decision.
    fd
        A bound socket inherited from the parent process, in place of ``host`` and ``port``.
    data_dir
        Home of the embedded default: its database, its blobs and its API key.
    database_url, blob_url
        The two URLs that make an embedded service a distributed one.
    api_key
        A key to accept, given by the operator in place of the one given at an earlier start;
        without one the first start generates one.
    max_upload_bytes, max_request_bytes
        Limits of an upload and of any other request body.
    parse_wait
        How long a request waits for its quick job before it answers 202.
    long_poll_max, poll_every, heartbeat_every
        Longest ``?wait=``; how often a waiting request looks; silence between events.
    reconcile_every
        How often submissions and engine are brought into line.
    worker_dead_after
        Silence after which a worker is not counted as alive any more.
    """

    model_config = SettingsConfigDict(env_prefix="PRTBAKE_", extra="ignore", frozen=True)

    host: str = "127.0.0.1"
    port: int = DEFAULT_PORT
    fd: int | None = None
    data_dir: Path = Path("prtbake-data")
    database_url: str | None = None
    blob_url: str | None = None
    api_key: Annotated[SecretStr, Field(min_length=MIN_KEY_LENGTH)] | None = None
    max_upload_bytes: int = 2 << 30  # 2 GiB
    max_request_bytes: int = 1 << 20  # 1 MiB
    parse_wait: timedelta = timedelta(seconds=5)
    long_poll_max: timedelta = timedelta(seconds=60)
    poll_every: timedelta = timedelta(milliseconds=250)
    heartbeat_every: timedelta = timedelta(seconds=15)
    reconcile_every: timedelta = timedelta(seconds=10)
    worker_dead_after: timedelta = timedelta(seconds=30)

    @property
    def database(self) -> str:
        """The database's URL."""
        return self.database_url or f"sqlite:///{self.data_dir.absolute() / 'prtbake.sqlite'}"

    @property
    def blobs(self) -> str:
        """The blob store's URL."""
        return self.blob_url or (self.data_dir.absolute() / "blobs").as_uri()
