"""Studies as they go over the wire: axes, points, and what is refused."""

import pytest
from pydantic import ValidationError

from prtbake_storage.contract.jobs import CompressRequest, StudyRequest, job_request_adapter
from prtbake_storage.contract.settings import CompressSettings
from prtbake_storage.contract.study import laid_over

COMPRESS = {"kind": "compress", "transfer": "a/transfer.h5", "settings": {"max_iterations": 3}}
BAKE = {"kind": "bake", "mesh": "mesh-0000000000000000", "brdf": {"model": "lambert"}}


def study(base, axes, **fields):
    return job_request_adapter.validate_python(
        {"kind": "study", "base": base, "axes": axes, **fields}
    )


def refusal(base, axes, **fields):
    with pytest.raises(ValidationError) as refused:
        study(base, axes, **fields)
    (first, *_) = refused.value.errors()
    return first["loc"], first["msg"]


def test_points_are_the_product_laid_over_the_base():
    request = study(
        COMPRESS, {"settings.n_clusters": [2, 4], "settings.ranks": [[1, 2, 3], [4, 5, 6], None]}
    )
    points = request.points()
    assert [point.index for point in points] == list(range(6))
    # the last axis changes fastest
    assert [point.values["settings.n_clusters"] for point in points] == [2, 2, 2, 4, 4, 4]
    settings = points[4].request.settings
    assert (settings.n_clusters, settings.ranks, settings.max_iterations) == (4, (4, 5, 6), 3)
    assert points[4].request.transfer == "a/transfer.h5"


def test_both_ways_to_write_axes_are_one():
    short = study(COMPRESS, {"seed": [1, 2]})
    long = study(COMPRESS, [{"path": "seed", "values": [1, 2]}])
    assert short == long


def test_what_is_stored_is_read_back_as_it_was():
    """The service stores JSON; a worker must see the same points."""
    own = StudyRequest(
        base=CompressRequest(transfer="a/b.h5", settings=CompressSettings(n_clusters=3)),
        axes=[{"path": "settings.method", "values": ["cpca", "cta"]}],
    )
    for request in (own, study(BAKE, {"settings.basis": ["srbf", "sh"]})):
        again = job_request_adapter.validate_python(request.model_dump(mode="json"))
        assert [point.request for point in again.points()] == [p.request for p in request.points()]


def test_a_default_of_the_base_stands_in_no_axis_way():
    """642 centres go with srbf alone; spelled out in the base they would forbid sh."""
    points = study(BAKE, {"settings.basis": ["srbf", "sh"]}).points()
    assert [p.request.settings.n_centres for p in points] == [642, None]
    assert [p.request.settings.sh_order for p in points] == [None, 25]


def test_fields_under_null_are_made():
    (point,) = study(BAKE, {"receiver.resolution": [12]}).points()
    assert point.request.receiver.resolution == 12


def test_axes_that_are_illegal_together_are_named():
    axes = {"settings.basis": ["srbf", "sh"], "settings.n_centres": [162, 642]}
    where, why = refusal(BAKE, axes)
    assert where == ("study", "axes")
    assert "2 of 4 points" in why
    assert 'settings.basis = "sh", settings.n_centres = 162' in why
    assert "n_centres is of basis 'srbf'" in why


def test_or_left_out_if_asked():
    axes = {"settings.basis": ["srbf", "sh"], "settings.n_centres": [162, 642]}
    points = study(BAKE, axes, skip_illegal=True).points()
    assert [point.request is None for point in points] == [False, False, True, True]
    assert "n_centres" in points[2].refused
    # but not all of them
    _, why = refusal(BAKE, {"settings.nothing": [1, 2]}, skip_illegal=True)
    assert "2 of 2 points" in why
    assert "settings.nothing" in why


@pytest.mark.parametrize(
    ("axes", "why"),
    [
        ({}, "at least 1 item"),
        ({"seed": []}, "at least 1 item"),
        ({"seed": [1, 1]}, "values 0 and 1 are both 1"),
        ([{"path": "seed", "values": [1]}, {"path": "seed", "values": [2]}], "the same field"),
        ({"settings": [{}], "settings.n_clusters": [1]}, "the same field"),
        ({"seed": list(range(17)), "settings.n_clusters": list(range(1, 17))}, "272 points"),
        ({"label": ["a", "b"]}, "cannot be an axis"),
        ({"kind": ["bake"]}, "cannot be an axis"),
        ({"transfer.name": [1]}, "has no fields"),
        ({"nothing": [1]}, "nothing"),
        ({"seed": [float("nan")]}, ""),
        ({"transfer": ["a\0b"]}, "no text"),
        ({"transfer": ["\ud800"]}, ""),
        ({"seed..x": [1]}, "pattern"),
    ],
)
def test_axes_that_make_no_sense_are_refused(axes, why):
    # with the illegal left out they would be stored
    for skip_illegal in (False, True):
        where, message = refusal(COMPRESS, axes, skip_illegal=skip_illegal)
        assert where[:2] == ("study", "axes")
        assert why in message


def test_names_that_only_begin_alike_are_no_conflict():
    values = {"settings.max_iterations": [1], "settings.max": [1]}
    assert "Extra inputs" in refusal(COMPRESS, values)[1]


@pytest.mark.parametrize("kind", ["render", "validate", "study"])
def test_some_kinds_cannot_be_studied(kind):
    where, _ = refusal({"kind": kind}, {"seed": [1]})
    assert where == ("study", "base")


def test_the_base_stays_as_it_was():
    base = {"a": {"b": 1, "c": 2}, "d": None}
    assert laid_over(base, {"a.b": 5, "d.e": 6}) == {"a": {"b": 5, "c": 2}, "d": {"e": 6}}
    assert base == {"a": {"b": 1, "c": 2}, "d": None}
