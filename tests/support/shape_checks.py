"""Shapes and types are checked in the first calls of every function in every test, then rarely.

``--jaxtyping-packages`` has jaxtyping decorate all functions of a package, and check their
arguments and results in every call; of a data class it checks what ``__init__`` is given, not what
the fields hold afterwards.  A wrong shape is wrong in the first call as in the thousandth, and
checks of thousands of calls took a quarter of the time of all tests.  `check_rarely` therefore has
a test's calls 1, 2, 3, 5, 9, 17 ... of a function checked, and makes the checks of a function when
it is first called: most of those that a test file imports never are.  The examples of a hypothesis
test differ in their shapes: within them every call is checked.
"""

import dataclasses
import functools
from collections import Counter
from collections.abc import Callable
from typing import Any

import jaxtyping
from hypothesis import currently_in_test_context

_Key = tuple[str, str, int]
_seen: Counter[_Key] = Counter()


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
        if dataclasses.is_dataclass(decorated):
            made = vars(decorated).get("__init__")
            # one that the class writes itself was decorated as any function
            if made is not None and not hasattr(made, "__wrapped__"):
                decorated.__init__ = decorate(made)
        return decorated

    return decorate


def _key(function: Callable[..., Any]) -> _Key:
    """What is counted as one function.

    A function within another is made anew in every call of that, and remains one by its name.  Its
    code would be no key: classes of the same fields have equal ``__init__``.  The line tells apart
    what a module defines twice under one name, as a property's getter and setter.
    """
    return function.__module__, function.__qualname__, function.__code__.co_firstlineno


def _checked(function: Callable[..., Any], jaxtyped: Callable[..., Any]) -> Callable[..., Any]:
    checked = None
    key = _key(function)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal checked
        before = _seen[key]
        _seen[key] = before + 1
        # neither 0 nor a power of two
        if before & (before - 1) and not currently_in_test_context():
            return function(*args, **kwargs)
        if checked is None:
            checked = jaxtyped(function)
        return checked(*args, **kwargs)

    return call
