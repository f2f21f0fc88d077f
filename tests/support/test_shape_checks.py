import dataclasses

import numpy as np
import pytest
from beartype import beartype
from hypothesis import given, settings, strategies
from jaxtyping import Float64, TypeCheckError, jaxtyped

from prtbake_workers.geometry.icosphere import icosphere
from support.shape_checks import begin_test

# what conftest put in its place
decorate = jaxtyped(typechecker=beartype)


@decorate
def doubled(x: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    return np.concatenate([x, x]) if len(x) == 3 else 2.0 * x


@decorate
@dataclasses.dataclass
class Pair:
    one: Float64[np.ndarray, " n"]
    other: Float64[np.ndarray, " n"]


@decorate
@dataclasses.dataclass
class Couple:
    """Another of the same fields: the code of its __init__ equals that of `Pair`'s."""

    one: Float64[np.ndarray, " n"]
    other: Float64[np.ndarray, " n"]


def test_arguments_and_results_are_checked():
    np.testing.assert_array_equal(doubled(np.ones(2)), [2.0, 2.0])
    with pytest.raises(TypeCheckError, match="parameters"):
        doubled(np.ones((2, 2)))
    with pytest.raises(TypeCheckError, match="return value"):
        doubled(np.ones(3))
    with pytest.raises(TypeCheckError):
        Pair(np.ones(2), np.ones(3))


def refuses_a_wrong_shape():
    try:
        doubled(np.ones((2, 2)))
    except TypeCheckError:
        return True
    return False


def test_the_first_calls_of_every_test_are_and_ever_fewer_of_the_rest():
    assert [n for n in range(1, 40) if refuses_a_wrong_shape()] == [1, 2, 3, 5, 9, 17, 33]
    begin_test()
    assert refuses_a_wrong_shape()


def test_functions_within_a_function_share_their_calls():
    def made():
        @decorate
        def inner(x: Float64[np.ndarray, " n"]):
            return x

        return inner

    for _ in range(3):
        made()(np.ones(2))
    assert made()(np.ones((2, 2))).shape == (2, 2)
    with pytest.raises(TypeCheckError):
        made()(np.ones((2, 2)))


def test_classes_of_the_same_fields_are_counted_apart():
    for _ in range(3):
        Pair(np.ones(2), np.ones(2))
    with pytest.raises(TypeCheckError):
        Couple(np.ones(2), np.ones(3))
    # negative twin: the fourth of the first is not checked
    assert len(Pair(np.ones(2), np.ones(3)).other) == 3
    made, other = (vars(one)["__init__"].__wrapped__ for one in (Pair, Couple))
    assert made.__code__ == other.__code__
    assert made.__code__ is not other.__code__


def test_what_a_class_defines_twice_under_one_name_is_counted_apart():
    class Box:
        def __init__(self):
            self.held = np.ones(2)

        @property
        @decorate
        def value(self) -> Float64[np.ndarray, " n"]:
            return self.held

        @value.setter
        @decorate
        def value(self, given: Float64[np.ndarray, " n"]):
            self.held = given

    box = Box()
    for _ in range(3):
        assert box.value.shape == (2,)
    with pytest.raises(TypeCheckError):
        box.value = np.ones((2, 2))


@pytest.mark.parametrize("init", [True, False], ids=["made", "its own"])
def test_a_data_class_is_counted_once_a_call(init):
    """Whether dataclass makes its __init__ or the import hook found one to decorate."""

    class Plain:
        one: Float64[np.ndarray, " n"]

        if not init:

            @decorate
            def __init__(self, one: Float64[np.ndarray, " n"]):
                self.one = one

    lone = decorate(dataclasses.dataclass(init=init)(Plain))
    checked = []
    for n in range(1, 10):
        try:
            lone(np.ones((2, 2)))
        except TypeCheckError:
            checked.append(n)
    assert checked == [1, 2, 3, 5, 9]


def test_every_call_within_the_examples_of_a_property_is_checked():
    refused = []

    @settings(max_examples=10, database=None)
    @given(strategies.integers())
    def examples(_):
        refused.append(refuses_a_wrong_shape())

    examples()
    assert len(refused) > 5
    assert all(refused)
    # negative twin: without examples the fourth call is not
    begin_test()
    assert [refuses_a_wrong_shape() for _ in range(4)] == [True, True, True, False]


def test_the_packages_are_checked():
    with pytest.raises(TypeCheckError):
        icosphere("two")
    assert icosphere(1).shape == (42, 3)
