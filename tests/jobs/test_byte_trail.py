"""Where a search for an error in bytes stands, in worlds whose errors and sizes are known."""

import re
from math import hypot, sqrt

import pytest

from prtbake_storage.contract.jobs import job_request_adapter
from prtbake_storage.errors import SettingsError
from prtbake_storage.queue.stages import Measured, Results
from prtbake_workers.jobs import leaving
from prtbake_workers.jobs.error_attempts import BY_BYTES, FINER, MENDED
from prtbake_workers.jobs.error_trail import ErrorDecisions
from prtbake_workers.jobs.search_stages import numbered
from support.scenes import NO_RESOURCE

TARGET = 0.1
AIM = 0.085
COST = Measured(1.0, 1)
LINES = {"SRBF basis": 0.9, "vertex interpolation": 0.1, "light fit": 0.1}


NO_LINE = {"name": "compression", "error": 0.0, "noise": 0.0, "below_noise": False}


class World:
    """Pictures that err by known amounts; files whose sizes are known.

    ``bakes`` are what the transfer of each step errs by, the last for all above.  A compression for
    the squared error e is seen as its root, and takes ``scale`` / e bytes; one of all bytes is
    better than that by ``better``, in size.
    """

    def __init__(self, most, *, bakes=(0.04,), scale=2.0, better=0.8, held_out=1.0, refused=()):
        budget = {"max_error": TARGET} | ({} if most is None else {"max_bytes": most})
        asset = {
            "kind": "asset", "mesh": f"mesh-{NO_RESOURCE}", "brdf": {"model": "lambert"},
            "environment": f"environment-{NO_RESOURCE}", "budget": budget,
        }  # fmt: skip
        self.decisions = ErrorDecisions(job_request_adapter.validate_python(asset))
        self.bakes, self.scale, self.better = bakes, scale, better
        self.held_out, self.refused = held_out, refused
        self.results, self.made = Results(), []

    def run(self):
        while (trail := self.decisions.trail(self.results)).stage != "done":
            self.advance(trail)
            assert len(self.made) < 20
        return trail

    def advance(self, trail):
        """Add what is under way."""
        base = self.bakes[min(trail.rung, len(self.bakes) - 1)]
        if trail.stage == "bake":
            self.measure(numbered("measure", len(trail.rungs) - 1), transfer=base, light=base)
        elif trail.stage in ("compress", "finer", "mend"):
            place = list(trail.asked)[-1]
            if numbered("quantise", place) in self.results:
                self.validate("validate 2", base, trail.asked[place])
            else:
                self.compress(place, base, trail.asked[place])
        else:
            self.validate("validate 1", base, trail.asked[trail.delivered])

    def compress(self, place, base, asked):
        self.made.append(asked)
        squared, size = self.compression(asked)
        values = {"bytes": size}
        if place in self.refused:
            values = {"refused": {"detail": "too much", "pointer": "/settings/compress/max_bytes"}}
        self.results.add(numbered("compress", place), [{}], [COST])
        self.results.add(numbered("quantise", place), [values], [COST])
        if place != MENDED and place not in self.refused:
            self.measure(numbered("measure asset", place), asset=hypot(base, sqrt(squared)))

    def compression(self, asked):
        if "max_error" in asked:
            return asked["max_error"], round(self.scale / asked["max_error"])
        return self.better * self.scale / asked["max_bytes"], asked["max_bytes"]

    def measure(self, name, **errors):
        view = {
            "squared_norm": 1.0, "variance": 0.0, "samples": 64,
            "squared": {picture: error**2 for picture, error in errors.items()}, "lines": LINES,
        }  # fmt: skip
        self.results.add(name, [{"views": [view], "reference": "r"}], [COST])

    def validate(self, name, base, asked):
        budget = {
            "lines": [NO_LINE], "total": self.held_out * hypot(base, sqrt(self.compression(asked)[0])),
            "total_noise": 0.0, "total_below_noise": False, "reference_noise": 0.0,
            "squared_norm": 1.0, "black_reference": False,
        }  # fmt: skip
        self.results.add(name, [{"views": [{"budget": budget}]}], [COST])

    def fails(self):
        with pytest.raises(SettingsError) as raised:
            self.run()
        return raised.value.pointer, str(raised.value)


def size_without_bytes(**world):
    """What the file takes that an error alone asks for."""
    free = World(None, **world)
    trail = free.run()
    return trail.sizes[trail.delivered]


def taken(trail):
    return [one.name for one in trail.tried if one.taken]


def test_bytes_that_the_error_needs_no_more_of_change_nothing():
    size = size_without_bytes()
    free, held = World(None), World(size)
    assert taken(free.run()) == taken(held.run())
    assert held.made == free.made


def test_where_an_error_takes_too_much_all_bytes_are_made_the_most_of():
    most = round(0.85 * size_without_bytes())
    world = World(most)
    trail = world.run()
    assert trail.delivered == BY_BYTES
    assert world.made[-1] == {"max_bytes": most}
    assert [one for one in world.made if "max_bytes" in one] == [{"max_bytes": most}]
    assert taken(trail)[-1] == f"compression, max_bytes {most}"
    left = [one.why for one in trail.tried if not one.taken]
    assert f"takes more than {most} bytes" in left


def test_a_finer_bake_leaves_room_in_the_bytes_and_is_delivered():
    most = round(0.65 * size_without_bytes())
    world = World(most, bakes=(0.04, 0.02))
    trail = world.run()
    assert trail.delivered == FINER
    assert trail.rung == trail.finer > trail.rungs[-1] == 0
    coarse, finer = (one for one in trail.tried if one.name.startswith("bake"))
    assert (coarse.taken, finer.taken) == (False, True)
    assert finer.stages[0] == numbered("plan", len(world.decisions.rungs))
    assert taken(trail)[-1] == f"compression, max_bytes {most}"


def test_an_error_that_no_bake_meets_in_the_bytes_is_refused_with_the_best():
    size = size_without_bytes()
    most = round(0.4 * size)
    world = World(most)
    pointer, why = world.fails()
    assert pointer == "/budget/max_bytes"
    best = hypot(0.04, sqrt(world.compression({"max_bytes": most})[0]))
    assert f"an error of 10.00% in {most} bytes cannot be met: at best {best:.2%}" in why
    assert "the largest part of it is compression" in why
    # a trial that erred by too much took more
    assert re.search(r"or more than (\d+) bytes$", why)
    # what an error took can be asked for, where it was tried
    world = World(round(0.55 * size), better=1.2)
    (enough,) = re.search(r"or (\d+) bytes$", world.fails()[1]).groups()
    assert int(enough) == size
    assert World(size).run().stage == "done"


def test_the_line_that_binds_is_the_bakes_where_that_leaves_most():
    """Of two parts that together are just above the aim, and whose finer bakes are no better."""
    world = World(410, bakes=(0.0635,))
    pointer, why = world.fails()
    assert pointer == "/budget/max_bytes"
    assert "the largest part of it is SRBF basis" in why


def test_the_line_that_binds_is_of_the_bake_that_left_least():
    """The second is a little better than the first, and was predicted to leave hardly anything."""
    world = World(410, bakes=(0.0635, 0.063))
    why = world.fails()[1]
    best = hypot(0.063, sqrt(world.compression({"max_bytes": 410})[0]))
    assert f"at best {best:.2%} is left" in why
    assert "the largest part of it is compression" in why
    # where that one is the worse of the two, the first is told with its own line
    world = World(410, bakes=(0.0635, 0.064))
    why = world.fails()[1]
    best = hypot(0.0635, sqrt(world.compression({"max_bytes": 410})[0]))
    assert f"at best {best:.2%} is left" in why
    assert "the largest part of it is SRBF basis" in why


def test_bytes_below_mesh_and_tables_are_refused_as_the_file_was():
    assert World(50, refused=(BY_BYTES,)).fails() == ("/budget/max_bytes", "too much")


def test_a_finer_bake_whose_tables_do_not_fit_leaves_the_best_of_the_first():
    most = round(0.65 * size_without_bytes())
    pointer, why = World(most, bakes=(0.04, 0.02), refused=(FINER,)).fails()
    assert pointer == "/budget/max_bytes"
    assert "at best" in why


def test_held_out_views_are_mended_by_an_error_where_there_is_room():
    size = size_without_bytes()
    world = World(10 * size, held_out=1.25)
    trail = world.run()
    assert trail.delivered == MENDED
    assert list(world.made[-1]) == ["max_error"]
    # of all bytes where there is little of it
    world = World(round(1.4 * size), held_out=1.25)
    assert world.run().delivered == MENDED
    assert world.made[-1] == {"max_bytes": round(1.4 * size)}


def test_held_out_views_that_all_bytes_do_not_mend_are_refused():
    most = round(0.85 * size_without_bytes())
    pointer, why = World(most, held_out=1.25).fails()
    assert pointer == "/budget/max_bytes"
    assert "held-out views err by" in why
    # nor where they were not made the most of before
    size = size_without_bytes()
    world = World(round(1.02 * size), held_out=1.25, better=1.2)
    assert world.fails()[0] == "/budget/max_bytes"
    assert list(world.made[-1]) == ["max_bytes"]


def test_a_mend_that_is_refused_is_refused_by_the_field_of_the_budget():
    size = size_without_bytes()
    for room, field in ((1.4, "max_bytes"), (10.0, "max_error")):
        world = World(round(room * size), held_out=1.25, refused=(MENDED,))
        pointer, why = world.fails()
        assert pointer == f"/budget/{field}"
        assert "held-out views" in why
        assert list(world.made[-1]) == [field]


def test_held_out_views_that_the_bake_alone_spoils_are_no_fault_of_the_bytes():
    world = World(10**6, held_out=2.5)
    pointer, why = world.fails()
    assert pointer == "/budget/max_error"
    assert "bytes" not in why


def test_time_that_is_out_before_the_bytes_are_met_is_said():
    most = round(0.85 * size_without_bytes())
    world = World(most)
    while (trail := world.decisions.trail(world.results)).stage != "compress" or (
        list(trail.asked)[-1] != BY_BYTES
    ):
        world.advance(trail)
    world.results.add(numbered("compress", BY_BYTES), [leaving.LATE], [COST])
    pointer, why = world.fails()
    assert pointer == "/budget/max_seconds"
    assert f"for an error of 10.00% in {most} bytes" in why
