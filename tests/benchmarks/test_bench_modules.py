"""No test runs `make bench`: at least what its scripts import is there."""

import importlib
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
NAMES = sorted(path.stem for path in HERE.glob("bench_*.py"))


@pytest.mark.parametrize("name", NAMES)
def test_a_benchmark_imports_what_exists(name, monkeypatch):
    monkeypatch.syspath_prepend(str(HERE))
    module = importlib.import_module(name)
    assert callable(module.rows)


def test_all_benchmarks_are_seen():
    assert len(NAMES) >= 6
