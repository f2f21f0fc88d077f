"""What every benchmark shares: a row of the table, its printing, and measured child processes.

A benchmark is a plain script ``bench_<name>.py`` beside this file with one function,
``rows(quick: bool) -> list[Row]``.  ``run.py`` collects them.
"""

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TextIO

HERE = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Row:
    """One line of the table: what was measured, and the limit that it stands beside.

    Attributes
    ----------
    name
        What was measured, in a few words.
    seconds
        Wall-clock time of the measured part, or None.
    measured, unit
        The number that the limit is about and its unit; ``measured`` None means that the row
        reports only.
    limit, limit_is
        The limit, and which side of it is good: ``at most`` or ``at least``.
    limit_description
        Where the limit comes from, e.g. "bare embreex, same rays, same run".
    peak_memory_bytes, error
        Peak resident memory of the process that did the work, and the result's error (a ratio).
    """

    name: str
    seconds: float | None = None
    measured: float | None = None
    unit: str = ""
    limit: float | None = None
    limit_is: Literal["at most", "at least"] = "at most"
    limit_description: str = ""
    peak_memory_bytes: int | None = None
    error: float | None = None

    @property
    def ok(self) -> bool:
        """Whether the limit is kept; a row without a limit is kept, one with NaN is not."""
        if self.limit is None:
            return True
        if self.measured is None:
            return False
        if self.limit_is == "at most":
            return self.measured <= self.limit
        return self.measured >= self.limit


def print_table(rows: Sequence[Row], stream: TextIO = sys.stdout) -> None:
    """Print the rows as an aligned table, one line each."""
    header = ("what", "seconds", "peak", "error", "measured", "limit", "ok", "beside")
    lines = [header, *(_cells(row) for row in rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    for number, line in enumerate(lines):
        text = "  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip()
        stream.write(text + "\n")
        if number == 0:
            stream.write("  ".join("-" * w for w in widths) + "\n")
    stream.flush()


def _cells(row: Row) -> tuple[str, ...]:
    limit = "" if row.limit is None else f"{row.limit_is} {row.limit:.4g} {row.unit}".rstrip()
    return (
        row.name,
        "" if row.seconds is None else f"{row.seconds:.3f}",
        "" if row.peak_memory_bytes is None else f"{row.peak_memory_bytes / 2**20:.0f} MiB",
        "" if row.error is None else f"{100 * row.error:.4g} %",
        "" if row.measured is None else f"{row.measured:.4g} {row.unit}".rstrip(),
        limit,
        "" if row.limit is None else ("yes" if row.ok else "NO"),
        row.limit_description,
    )


def best_time(work: Callable[[], object], repeats: int = 3) -> float:
    """Return the shortest of ``repeats`` wall-clock times of ``work``, in seconds.

    The shortest, because what disturbs a run only ever makes it slower.
    """
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def peak_memory_bytes() -> int:
    """Return the peak resident memory of this process so far.

    ``VmHWM``, where there is one: on Linux a process started by a larger one inherits that one's
    peak in ``getrusage``, and would report memory that it never held.
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def in_child(script: str, function: str, **arguments: Any) -> dict[str, Any]:
    """Call ``function(**arguments)`` of ``script`` in a fresh process and return its result.

    Arguments and the result, a dictionary, travel as JSON.  The result gains ``peak_memory_bytes``:
    of that process alone, so that what an earlier benchmark held does not count.
    """
    program = (
        "import json, sys, importlib\n"
        f"sys.path.insert(0, {str(HERE)!r})\n"
        f"module = importlib.import_module({Path(script).stem!r})\n"
        f"result = getattr(module, {function!r})(**json.loads(sys.stdin.read()))\n"
        "import harness\n"
        "result['peak_memory_bytes'] = harness.peak_memory_bytes()\n"
        "sys.stdout.write('\\n' + json.dumps(result))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        input=json.dumps(arguments),
        capture_output=True,
        text=True,
        check=False,
        env=os.environ.copy(),
    )
    if done.returncode != 0:
        raise RuntimeError(f"{script}:{function} failed in its process:\n{done.stderr}")
    return dict(json.loads(done.stdout.splitlines()[-1]))
