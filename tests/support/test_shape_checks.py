import dataclasses

import numpy as np
import pytest
from beartype import beartype
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


def test_the_packages_are_checked():
    with pytest.raises(TypeCheckError):
        icosphere("two")
    assert icosphere(1).shape == (42, 3)
