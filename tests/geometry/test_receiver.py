"""The receiver plane."""

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.geometry.mesh import face_area_vectors
from prtbake_workers.geometry.receiver import receiver_plane

BOUNDS = np.array([[1.0, 2.0, 3.0], [3.0, 4.0, 4.0]])  # diagonal 3


@pytest.mark.parametrize("resolution", [2, 5])
def test_plane_lies_under_the_box(resolution):
    plane = receiver_plane(BOUNDS, resolution=resolution, extent=2.0, gap=0.5)
    assert plane.n_vertices == resolution**2
    assert plane.bounds == pytest.approx(np.array([[-1.0, 0.5, 0.5], [5.0, 0.5, 6.5]]))
    assert (plane.normals == [0.0, 1.0, 0.0]).all()
    assert face_area_vectors(plane.positions, plane.faces)[:, 1].min() > 0.0
    assert plane.vertex_areas.sum() == pytest.approx(36.0)
    assert (plane.uv.min(), plane.uv.max()) == (0.0, 1.0)


def test_without_gap_the_object_stands_on_it():
    plane = receiver_plane(BOUNDS, resolution=2, extent=1.0, gap=0.0)
    assert (plane.positions[:, 1] == 2.0).all()


def test_bad_settings_are_refused():
    with pytest.raises(SettingsError, match=r"receiver.resolution must be at least 2") as refused:
        receiver_plane(BOUNDS, resolution=1, extent=1.0, gap=0.0)
    assert refused.value.pointer == "/receiver/resolution"
    with pytest.raises(SettingsError, match="no extent"):
        receiver_plane(np.zeros((2, 3)), resolution=2, extent=1.0, gap=0.0)
