"""Job kinds for the acceptance tests of the engine, and the tasks they are made of.

Every task notes in the folder that the worker's ``PRTBAKE_TOY_NOTES`` names that it started and that
it finished, which is how the tests see what was run, how often, and by which process.
"""

import hashlib
import os
import signal
import time
from pathlib import Path
from typing import Any

from prtbake_storage.errors import ResourceExhausted, SettingsError
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import ArtefactFile, Finished, Results, Stage, Task

HERE = "toy_registry"


def note(args: dict[str, Any], kind: str, name: str) -> None:
    """Leave a file that says what happened, when and in which process."""
    path = Path(args["notes"]) / f"{kind}.{name}.{os.getpid()}.{time.time_ns()}"
    path.write_text(str(os.getppid()))


def spin(args: dict[str, Any], context: TaskContext) -> None:
    """Take ``seconds``, burning CPU if told to, and say how far it is."""
    end = time.monotonic() + args["seconds"]
    begin = time.monotonic()
    while (now := time.monotonic()) < end:
        context.progress(now - begin, args["seconds"], "s")
        if args["burn"]:
            sum(range(20_000))
        else:
            time.sleep(0.02)


def tile(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Make a blob of 64 KiB that depends on the seed and the index only."""
    name = f"{args['seed']}-{args['index']}"
    note(args, "started", name)
    (context.scratch / "half-done").write_bytes(b"x" * 1000)
    context.log("tile begins", index=args["index"])
    spin(args, context)
    block = hashlib.sha256(name.encode()).digest() * 2048
    path = context.scratch / "tile.bin"
    path.write_bytes(block)
    digest = context.store.put_file(path, move=True)
    note(args, "finished", name)
    return {"digest": digest, "index": args["index"]}


def join(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Concatenate the tiles."""
    note(args, "started", "join")
    with context.store.writer() as writer:
        for digest in args["digests"]:
            writer.write(context.store.read_bytes(digest))
        return {"digest": writer.commit()}


def poison(args: dict[str, Any], _context: TaskContext) -> dict[str, Any]:
    """Go wrong in the way that ``how`` says."""
    note(args, "started", args["how"])
    if args["how"] == "dies":
        os.kill(os.getpid(), signal.SIGKILL)
    if args["how"] == "kills-worker":
        os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(60.0)
    if args["how"] == "input":
        raise SettingsError("the toy is broken", pointer="/how")
    if args["how"] == "once":
        flag = Path(args["notes"]) / f"once.{args['seed']}"
        if not flag.exists():
            flag.write_text("")
            raise PassingError("not yet")
    if args["how"] == "nan":
        return {"value": float("nan")}
    return {"how": args["how"]}


class PassingError(ResourceExhausted):
    """An error that the next attempt will not meet."""

    retryable = True


class ToyRegistry:
    """``tiles``: n tiles and a join.  ``poison``: one bad task among good ones.  ``quick``: one task."""

    def stages(self, kind: str, request: dict[str, Any], _context: dict[str, Any]) -> list[Stage]:
        """List the stages."""
        if kind == "quick":
            task = _task("poison", {"how": "fine", "seed": request["seed"]})
            return [Stage("parse", "files", 1.0, lambda _results: [task])]
        if kind == "poison":
            bad = _task("poison", {"how": request["how"], "seed": request["seed"]})
            good = _tiles(request)
            return [Stage("mixed", "tasks", 1.0, lambda _results: [bad, *good])]
        return [
            Stage("tiles", "tiles", 9.0, lambda _results: _tiles(request)),
            Stage("join", "files", 1.0, _join),
        ]

    def finish(
        self, kind: str, request: dict[str, Any], _context: dict[str, Any], results: Results
    ) -> Finished:
        """Name the joined file."""
        if kind != "tiles":
            return Finished(dict(results.items()))
        digest = results["join"][0]["digest"]
        seconds = [cost.seconds for cost in results.measured("tiles")]
        return Finished(
            {"n_tiles": len(results["tiles"]), "timed": all(value > 0 for value in seconds)},
            [ArtefactFile("joined.bin", "application/octet-stream", digest)],
        )


def _task(name: str, args: dict[str, Any], label: str = "") -> Task:
    # tasks are given no variables of ours
    return Task(f"{HERE}:{name}", args | {"notes": os.environ["PRTBAKE_TOY_NOTES"]}, label)


def _tiles(request: dict[str, Any]) -> list[Task]:
    return [
        _task(
            "tile",
            {
                "index": index,
                "seconds": request["seconds"],
                "seed": request["seed"],
                "burn": request.get("burn", False),
            },
            label=f"tile {index}",
        )
        for index in range(request["n"])
    ]


def _join(results: Results) -> list[Task]:
    return [_task("join", {"digests": [tile["digest"] for tile in results["tiles"]]})]


REGISTRY = ToyRegistry()
