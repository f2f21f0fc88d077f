"""The model of a job: stages of tasks.

A job kind is a list of `Stage`; a stage is a list of `Task` that may run at once on any worker, and
the next stage's tasks are a pure function of the results so far.  A task is a pure function of its
arguments, named by the digest of both and of the code, and its result is remembered under that
name: it is never run again, whichever worker, retry or recovery asks.

A stage may repeat: its tasks come in rounds, each a pure function of the rounds before.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, Protocol

from prtbake_storage.blobs.base import json_digest
from prtbake_storage.contract.rates import NewRates
from prtbake_storage.queue.code import code_version


@dataclass(frozen=True)
class Task:
    """A unit of work, run in a child process of its own.

    Attributes
    ----------
    function
        ``module:name`` of ``f(args, context) -> dict``, in the package of the `JobRunner`.
    args
        JSON; with ``function``, ``threads`` and the code all that the result depends on.
    label
        For people, in logs.
    threads
        BLAS and OpenMP threads.  They are part of the name, because one thread or two changes the
        last bits of a matrix product.
    memory_bytes, cpu_seconds
        Limits of the child process (address space, CPU time), for parsers of untrusted files.  To
        exceed them is an error of the input.
    settings_at
        JSON pointer to the settings that it goes by in the request; no part of the name.
    job_started
        Of a task whose result goes by a clock: seconds since 1970, part of the name, so that no
        other job recalls what a busy machine had no time for.
    """

    function: str
    args: dict[str, Any]
    label: str = ""
    threads: int = 1
    memory_bytes: int | None = None
    cpu_seconds: int | None = None
    settings_at: str = "/settings"
    job_started: float | None = None

    @cached_property
    def key(self) -> str:
        """64 hex digits that name the result."""
        identity = {
            "function": self.function,
            "args": self.args,
            "threads": self.threads,
            "code": code_version(),
        }
        if self.job_started is not None:
            identity["job_started"] = self.job_started
        return json_digest(identity)

    @property
    def title(self) -> str:
        """What people call it."""
        return self.label or self.function

    def to_dict(self) -> dict[str, Any]:
        """Write as JSON."""
        return asdict(self)

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> "Task":
        """Read back."""
        return Task(**data)


class Measured(NamedTuple):
    """What a task cost when it ran; it may have been long ago, for another job."""

    seconds: float
    peak_memory_bytes: int


class Round(NamedTuple):
    """What the tasks of one round left, in order, and what they cost."""

    values: list[dict[str, Any]]
    measured: list[Measured]


class Results(Mapping[str, list[dict[str, Any]]]):
    """Stage name -> the results of its tasks, in order; `measured` gives their costs.

    A stage that repeats is among the names when its last round has ended, with the results that it
    makes of all; until then, `rounds` has what it left so far.
    """

    def __init__(self) -> None:
        self._values: dict[str, list[dict[str, Any]]] = {}
        self._rounds: dict[str, list[Round]] = {}
        self._recalled: set[str] = set()

    def __getitem__(self, stage: str) -> list[dict[str, Any]]:
        return self._values[stage]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def measured(self, stage: str) -> list[Measured]:
        """Costs of a finished stage's tasks, in order, those of all rounds."""
        if stage not in self._values:
            raise KeyError(stage)
        return [cost for done in self.rounds(stage) for cost in done.measured]

    def rounds(self, stage: str) -> Sequence[Round]:
        """Return the rounds of a stage that have ended: one, where it does not repeat."""
        return self._rounds.get(stage, ())

    def recalled(self, stage: str) -> bool:
        """Tell whether a task of a finished stage had run before the job came to it."""
        return stage in self._recalled

    def add(
        self,
        stage: str,
        values: Sequence[dict[str, Any]],
        measured: Sequence[Measured],
        *,
        recalled: bool = False,
    ) -> None:
        """Enter a finished stage; its name must be new."""
        if stage in self._rounds:
            raise ValueError(f"two stages are called {stage!r}")
        self.add_round(stage, values, measured, recalled=recalled)
        self.close(stage, values)

    def add_round(
        self,
        stage: str,
        values: Sequence[dict[str, Any]],
        measured: Sequence[Measured],
        *,
        recalled: bool = False,
    ) -> None:
        """Enter a round of a stage that repeats."""
        if stage in self._values:
            raise ValueError(f"two stages are called {stage!r}")
        self._rounds.setdefault(stage, []).append(Round(list(values), list(measured)))
        if recalled:
            self._recalled.add(stage)

    def close(self, stage: str, values: Sequence[dict[str, Any]]) -> None:
        """Finish a stage whose rounds are entered, with its results."""
        if stage in self._values:
            raise ValueError(f"two stages are called {stage!r}")
        self._rounds.setdefault(stage, [])
        self._values[stage] = list(values)


@dataclass(frozen=True)
class Rounds:
    """How a stage repeats: until its list of tasks is empty.

    Attributes
    ----------
    most
        From the results of earlier stages to the most rounds that there can be, at least 1; its
        progress counts them, and a stage that asks for more is at fault.
    outcome
        From the results, with all rounds of the stage, to the results of the stage.
    """

    most: Callable[[Results], int]
    outcome: Callable[[Results], list[dict[str, Any]]]


@dataclass(frozen=True)
class Stage:
    """A step of a job.

    Attributes
    ----------
    name
        Unique in the job.
    unit
        What its progress counts, say "tiles".
    weight
        Its share of the job's progress; only the ratios matter.
    tasks
        From the results of earlier stages to this stage's tasks.  It must be a pure function
        without I/O: a recovered job calls it again and must get the same list.
    rounds
        Of a stage that repeats: ``tasks`` is asked after each round, which `Results.rounds` then
        has, for those of the next.  None for one list of tasks.
    """

    name: str
    unit: str
    weight: float
    tasks: Callable[[Results], list[Task]]
    rounds: Rounds | None = None

    def lists(self, results: Results) -> Iterator[list[Task]]:
        """Yield the tasks of each round; what one left must be entered before asking for the next.

        At the end the stage itself is entered, if it repeats.

        Raises
        ------
        RuntimeError
            After `Rounds.most` rounds there are tasks left.
        """
        most = 1 if self.rounds is None else self.rounds.most(results)
        yield self.tasks(results)
        if self.rounds is None:
            return
        n_rounds = 1
        while tasks := self.tasks(results):
            if n_rounds >= most:
                raise RuntimeError(f"stage {self.name!r} goes on after {most} rounds, its most")
            yield tasks
            n_rounds += 1
        results.close(self.name, self.rounds.outcome(results))


class ArtefactFile(NamedTuple):
    """A file that a job leaves: its name, its media type and the blob that holds it."""

    name: str
    media_type: str
    digest: str


@dataclass(frozen=True)
class Finished:
    """What a job leaves; two files of one name are a `ValueError`."""

    result: dict[str, Any]
    artefacts: Sequence[ArtefactFile | tuple[str, str, str]] = field(default_factory=list)
    rates: NewRates | None = None

    def __post_init__(self) -> None:
        names = [file[0] for file in self.artefacts]
        if twice := {name for name in names if names.count(name) > 1}:
            raise ValueError(f"two artefacts are called {min(twice)!r}")


class JobRunner(Protocol):
    """What the engine asks of the job kinds; all of it pure and quick."""

    def stages(self, kind: str, request: dict[str, Any], context: dict[str, Any]) -> list[Stage]:
        """List the stages of a job; an `InputError` fails it before any work."""

    def finish(
        self, kind: str, request: dict[str, Any], context: dict[str, Any], results: Results
    ) -> Finished:
        """Turn the results of all stages into the job's result and artefacts."""


def package_of(runner: JobRunner) -> str:
    """Name the package whose functions a task may name: the one that the job kinds lie in.

    What a worker is given as a task comes from the database; who may write there shall not choose
    among all functions of all installed packages.
    """
    module = type(runner).__module__
    return module.rpartition(".")[0] or module
