"""Shapes and types are checked in the first calls of every function in every test, then rarely.

``--jaxtyping-packages`` has jaxtyping decorate all functions of a package, and check their
arguments and results in every call.  A wrong shape is wrong in the first call as in the thousandth,
and checks of thousands of calls took a quarter of the time of all tests.  `check_rarely` therefore
has a test's calls 1, 2, 3, 5, 9, 17 ... of a function checked, and makes the checks of a function
when it is first called: most of those that a test file imports never are.
"""

import dataclasses
import functools
from collections import Counter
from collections.abc import Callable
from types import CodeType
from typing import Any

import jaxtyping

_seen: Counter[CodeType] = Counter()


def check_rarely() -> None:
    """Have jaxtyping's import hook decorate what is imported from now on with `some_calls`."""
    jaxtyping.jaxtyped = functools.partial(some_calls, jaxtyping.jaxtyped)


def begin_test() -> None:
    """Count calls anew."""
    _seen.clear()


def some_calls(jaxtyped: Callable[..., Any], *, typechecker: Any) -> Callable[[Any], Any]:
    """A decorator of functions and data classes: ``jaxtyped`` in some of their calls."""

    def decorate(decorated: Any) -> Any:
        if not isinstance(decorated, type):
            return _checked(decorated, functools.partial(jaxtyped, typechecker=typechecker))
        if dataclasses.is_dataclass(decorated) and "__init__" in vars(decorated):
            decorated.__init__ = decorate(decorated.__init__)
        return decorated

    return decorate


def _checked(function: Callable[..., Any], jaxtyped: Callable[..., Any]) -> Callable[..., Any]:
    checked = None
    # a function within another is made anew in every call of that: its code is the same
    code = function.__code__

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal checked
        before = _seen[code]
        _seen[code] = before + 1
        if before & (before - 1):  # neither 0 nor a power of two
            return function(*args, **kwargs)
        if checked is None:
            checked = jaxtyped(function)
        return checked(*args, **kwargs)

    return call
