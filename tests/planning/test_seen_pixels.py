"""Pixels and vertices that cameras show, against a picture of them."""

import numpy as np
import pytest

from prtbake_storage.contract.settings import Camera
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.primitives import sphere_mesh
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.planning.seen_pixels import MOST_RAYS, look

SPHERE = sphere_mesh(4)


FRONT = Camera()


def seen(width, height, *, media=(), cameras=(FRONT,)):
    scene = Scene.from_parts([SPHERE])
    return look(
        scene, Accelerator(scene.positions, scene.faces), cameras, width=width, height=height,
        object_ranges=[(0, scene.n_vertices)], media=media,
    )  # fmt: skip


def test_a_ball_fills_the_circle_that_it_is_framed_in():
    one, other = seen(240, 180, cameras=(FRONT, Camera(name="back", azimuth_deg=210.0)))
    # from the other side it looks alike, and so does the box that it is framed by
    assert one.pixels == pytest.approx(other.pixels, rel=0.01)
    rows, columns = np.mgrid[:180, :240]
    radius = np.sqrt(one.pixels / np.pi)
    inside = (rows - 89.5) ** 2 + (columns - 119.5) ** 2 < radius**2
    assert 30 < radius < 90
    assert inside.sum() == pytest.approx(one.pixels, rel=0.01)
    # less than half of the ball is seen from a finite distance
    assert 0.3 < one.vertices / SPHERE.n_vertices < 0.5
    assert one.inside == 0


def test_a_large_picture_is_looked_at_through_fewer_pixels():
    small, large = seen(160, 120)[0], seen(640, 480)[0]
    assert 640 * 480 > MOST_RAYS > 160 * 120
    assert large.pixels == pytest.approx(16 * small.pixels, rel=0.02)


def test_pixels_of_a_medium_are_counted():
    (one,) = seen(96, 72, media=[0])
    assert one.inside == one.pixels > 0
    assert one.parts == (one.pixels,)
    # negative twin: without one none is
    assert seen(96, 72)[0].inside == 0
