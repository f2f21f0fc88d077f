"""Tasks that the tests of the child process run."""

import ctypes
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from cProfile import run as profile  # noqa: F401 - for a test that no task may name it
from typing import Any

from prtbake_storage.errors import MeshError
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Finished, Results, Rounds, Stage, Task


def surroundings(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Tell what the process looks like."""
    digest = context.store.put_bytes(b"from the child")
    return {
        "args": args,
        "digest": digest,
        "threads": os.environ["OPENBLAS_NUM_THREADS"],
        "hash_seed": os.environ["PYTHONHASHSEED"],
        "temporary": tempfile.gettempdir(),
        "environment": sorted(os.environ),
        "heavy": sorted({"dbos", "sqlalchemy", "pydantic_settings"} & set(sys.modules)),
    }


def chatter(_args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Talk on every channel."""
    sys.stdout.write('{"result": "a lie"}\n')
    os.write(1, b"native code prints too\n")
    for done in range(1001):
        context.progress(done, 1000, "rows")
    context.log("half way", n=1)
    return {"fine": True}


def fail(args: dict[str, Any], _context: TaskContext) -> dict[str, Any]:
    """End without a result, in the way that ``how`` says."""
    how = args["how"]
    if how == "mesh":
        raise MeshError("vertex 7 is NaN", pointer="/blob")
    if how == "bug":
        return {}["missing"]  # type: ignore[no-any-return]
    if how == "eio":
        raise OSError(5, "Input/output error")
    if how == "no-memory":
        raise MemoryError
    if how == "no-dict":
        return [1]  # type: ignore[return-value]
    if how == "nan":
        return {"value": float("inf")}
    if how == "segfault":
        ctypes.string_at(0)
    if how == "exit":
        sys.stderr.write("giving up\n")
        os._exit(7)
    if how == "memory":
        return {"size": len(bytearray(1 << 33))}
    if how == "cpu":
        while True:
            pass
    return {}


def hang(_args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Never end, with a process of one's own beside."""
    helper = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    (context.scratch / "file").write_bytes(b"x")
    context.log("pids", own=os.getpid(), helper=helper.pid)
    time.sleep(600.0)
    return {}


def stray_thread(_args: dict[str, Any], _context: TaskContext) -> dict[str, Any]:
    """Leave a thread behind that would keep the process alive."""
    threading.Thread(target=time.sleep, args=(600.0,)).start()
    return {"fine": True}


def store_text(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Leave a blob."""
    return {"digest": context.store.put_bytes(args["text"].encode())}


class TwoStages:
    """A task for each of the request's words, then one that puts them together.

    Of kind ``chain`` words come in rounds of two tasks, each knowing what the round before left.
    """

    def stages(self, kind: str, request: dict[str, Any], _context: dict[str, Any]) -> list[Stage]:
        """List the stages."""
        if kind not in ("words", "chain"):
            raise MeshError(f"there is no kind {kind}")

        def words(_: Results) -> list[Task]:
            return [Task("child_tasks:store_text", {"text": word}) for word in request["words"]]

        def join(results: Results) -> list[Task]:
            digests = [word["digest"] for word in results["words"]]
            return [Task("child_tasks:store_text", {"text": " ".join(digests)})]

        def links(results: Results) -> list[Task]:
            done = results.rounds("words")
            before = " ".join(value["digest"] for value in done[-1].values) if done else ""
            return [
                Task("child_tasks:store_text", {"text": f"{before} {word} {n}"})
                for word in request["words"][len(done) : len(done) + 1]
                for n in range(2)
            ]

        rounds = Rounds(
            lambda _: len(request["words"]) + 2, lambda results: results.rounds("words")[-1].values
        )
        first = Stage("words", "words", 1.0, words)
        if kind == "chain":
            first = Stage("words", "words", 1.0, links, rounds)
        return [first, Stage("join", "files", 1.0, join)]

    def finish(
        self, _kind: str, _request: dict[str, Any], _context: dict[str, Any], results: Results
    ) -> Finished:
        """Name the file."""
        digest = results["join"][0]["digest"]
        return Finished({}, [("joined.txt", "text/plain", digest)])


TWO_STAGES = TwoStages()


def leave(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """End, with a process left behind that holds our pipes."""
    if args["how"] == "fork" or args["how"] == "fork-and-die":
        pid = os.fork()
        if pid == 0:
            time.sleep(25.0)
            os._exit(0)
    else:
        own_session = args["how"] == "session"
        pid = subprocess.Popen(["sleep", "25"], start_new_session=own_session).pid
    context.log("left", pid=pid)
    if args["how"] == "fork-and-die":
        os.kill(os.getpid(), signal.SIGKILL)
    return {"fine": True}
