"""Run the benchmarks and print one table; exit code 1 when a row misses its limit.

``python tests/benchmarks/run.py [--quick] [name ...]`` runs every ``bench_<name>.py``, or those
named.  ``--quick`` shrinks each to a smoke test of under a minute.
"""

import argparse
import importlib
import os
import platform
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
N_THREADS = "2"
# Overrides of the kernel and block sizes that OpenBLAS picks by itself: timings are taken as a
# user's machine would give them.
UNWANTED = ("OPENBLAS_CORETYPE", "OPENBLAS_L2_SIZE")
MARK = "PRTBAKE_BENCH_CLEAN"


def _clean_environment() -> None:
    """Re-execute once, so that the BLAS reads a clean environment when numpy loads it."""
    if os.environ.get(MARK):
        return
    env = {key: value for key, value in os.environ.items() if key not in UNWANTED}
    env.update({"OPENBLAS_NUM_THREADS": N_THREADS, "OMP_NUM_THREADS": N_THREADS, MARK: "1"})
    os.execve(sys.executable, [sys.executable, *sys.argv], env)


def cpu_name() -> str:
    """Return the processor's name, or its architecture where it has none."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def machine_lines() -> list[str]:
    """Describe the machine: CPU, cores, BLAS with its kernel and threads, load, versions."""
    import numpy as np
    from threadpoolctl import threadpool_info

    lines = [
        f"cpu     {cpu_name()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.2f}",
        f"python  {platform.python_version()}, numpy {np.__version__}",
    ]
    lines += [
        f"blas    {pool['internal_api']} {pool['version']}, kernel {pool.get('architecture', '?')}, "
        f"{pool['num_threads']} threads"
        for pool in threadpool_info()
        if pool["user_api"] == "blas"
    ]
    return lines


def main(arguments: list[str]) -> int:
    """Run the benchmarks named, or all, and return the exit code."""
    known = sorted(path.stem.removeprefix("bench_") for path in HERE.glob("bench_*.py"))
    parser = argparse.ArgumentParser(description="Measure prtbake beside limits of the same run.")
    parser.add_argument("--quick", action="store_true", help="small sizes, under a minute each")
    parser.add_argument("names", nargs="*", metavar="name", help=f"of {', '.join(known)}")
    options = parser.parse_args(arguments)
    unknown = sorted(set(options.names) - set(known))
    if unknown:
        parser.error(f"no benchmark {', '.join(unknown)}; there are {', '.join(known)}")

    sys.path.insert(0, str(HERE))
    from harness import Row, print_table

    sys.stdout.write("\n".join(machine_lines()) + "\n\n")
    sys.stdout.flush()
    rows: list[Row] = []
    for name in options.names or known:
        found = importlib.import_module(f"bench_{name}").rows(quick=options.quick)
        sys.stdout.write(f"{name}\n")
        print_table(found)
        sys.stdout.write("\n")
        rows += found
    missed = [row.name for row in rows if not row.ok]
    if missed:
        sys.stdout.write(f"{len(missed)} of {len(rows)} rows miss their limit: {missed}\n")
    return 1 if missed else 0


if __name__ == "__main__":
    _clean_environment()
    sys.exit(main(sys.argv[1:]))
