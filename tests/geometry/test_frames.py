"""Tangent frames."""

import numpy as np
import pytest

from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.geometry.icosphere import icosphere

AXES = np.concatenate([np.eye(3), -np.eye(3), [[0.0, 1e-9, -1.0]], [[1e-200, 0.0, -1.0]]])
NORMALS = np.concatenate([icosphere(3), AXES])


@pytest.mark.parametrize("seed", [None, 7])
def test_frames_are_rotations_onto_the_normal(seed):
    frames = tangent_frames(NORMALS, seed=seed)
    # float64 rounding; measured 4e-16
    assert np.abs(frames @ frames.transpose(0, 2, 1) - np.eye(3)).max() < 2e-15
    assert np.linalg.det(frames) == pytest.approx(1.0, abs=1e-14)
    local = np.einsum("vij,vj->vi", frames, NORMALS)
    assert np.abs(local - [0.0, 0.0, 1.0]).max() < 2e-15


def test_a_mirrored_frame_would_be_found():
    frames = tangent_frames(NORMALS)[:, [1, 0, 2]]
    assert np.linalg.det(frames).max() < -0.99


def test_seed_turns_each_frame_about_its_normal():
    plain, turned = tangent_frames(NORMALS), tangent_frames(NORMALS, seed=1)
    assert (turned[:, 2] == plain[:, 2]).all()
    cosines = np.einsum("vi,vi->v", plain[:, 0], turned[:, 0])
    assert cosines.min() < -0.95
    assert cosines.max() > 0.95
    assert (tangent_frames(NORMALS, seed=1) == turned).all()
    assert (tangent_frames(NORMALS, seed=2) != turned).any()


def test_tangents_are_horizontal_and_bitangents_climb():
    frames = tangent_frames(icosphere(3))
    away = np.abs(frames[:, 2, 1]) < 1.0 - 1e-12
    assert np.abs(frames[away, 0, 1]).max() < 1e-15
    assert frames[away, 1, 1].min() > 0.0
