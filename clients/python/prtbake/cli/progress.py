"""Progress of jobs and transfers: bars on a terminal, plain lines elsewhere."""

from collections.abc import Iterable
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TransferSpeedColumn,
)

from prtbake.cli.output import human_seconds, messages
from prtbake_storage.contract.jobs import Job

STEP = 0.1
"""Without a terminal a line is printed at each new stage and each tenth of the way."""


def show(jobs: Iterable[Job], *, quiet: bool = False) -> Job:
    """Show a job while it changes; return it as it was last."""
    last: Job | None = None
    with JobProgress(quiet=quiet) as progress:
        for job in jobs:
            progress.update(job)
            last = job
    if last is None:
        raise ValueError("a job that is followed shows at least once")
    return last


class JobProgress:
    """The progress of one job on standard error."""

    def __init__(self, console: Console | None = None, *, quiet: bool = False) -> None:
        self._console = console or messages()
        self._quiet = quiet
        self._told: tuple[str, str, int] | None = None
        self._bar: Progress | None = None
        if self._console.is_terminal and not quiet:
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.percentage:>4.0f} %"),
                TimeElapsedColumn(),
                TextColumn("{task.fields[rest]}"),
                console=self._console,
            )
            self._task = self._bar.add_task("waiting for a worker", total=1.0, rest="")

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def update(self, job: Job) -> None:
        """Show where the job stands."""
        if self._quiet:
            return
        now = job.progress
        stage = now.stage or ("waiting for a worker" if job.state == "queued" else job.state)
        if self._bar is not None:
            done = f"{now.done:g}/{now.total:g} {now.unit}" if now.total else ""
            left = f"about {human_seconds(now.eta_s)} left" if now.eta_s else ""
            self._bar.update(
                self._task,
                description=f"{stage} ({now.stage_index + 1}/{now.stage_count})"
                if now.stage_count
                else stage,
                completed=now.fraction,
                rest="  ".join(part for part in (done, left) if part),
            )
            return
        key = (job.state, stage, int(now.fraction / STEP))
        if key != self._told:
            self._told = key
            self._console.print(f"{escape(job.id)} {job.state} {now.fraction:4.0%} {escape(stage)}")


class TransferProgress:
    """The progress of an upload or a download on standard error; nothing off a terminal."""

    def __init__(self, name: str, total: int, *, quiet: bool = False) -> None:
        console = messages()
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            DownloadColumn(binary_units=True),
            TransferSpeedColumn(),
            console=console,
            disable=quiet or not console.is_terminal,
        )
        self._task = self._bar.add_task(escape(name), total=total)

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bar.stop()

    def advance(self, count: int) -> None:
        """Count bytes."""
        self._bar.advance(self._task, count)
