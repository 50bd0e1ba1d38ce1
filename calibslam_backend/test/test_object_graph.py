"""The factor graph itself: what it says of a pose to come, what it holds for linearised, and motions it cannot take."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from small_map import CAMERA

from calibslam_backend.estimator_settings import EstimatorSettings
from calibslam_backend.geometry.box_measurement import BoxMeasurement
from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.geometry.visible_box import ALL_EDGES, box_of_visible_part, image_bounds
from calibslam_backend.graph.known import Known
from calibslam_backend.graph.measured import Motion
from calibslam_backend.graph.object_graph import ObjectGraph
from calibslam_backend.kernels import load_kernels
from calibslam_msgs_py.measurements import Array

BOUNDS = image_bounds(CAMERA.width, CAMERA.height)
TURN = gtsam.Pose3(gtsam.Rot3.Ypr(0.05, 0.3, -0.1), np.array([0.2, 0.1, -0.1])).matrix()


def motion(T: Array, sigma: float) -> Motion:
    return Motion(T, np.eye(6) * sigma**2, 0.0, T)


def graph_of_one_quadric(off: float = 0.0) -> ObjectGraph:
    """Ten poses that drift, and a known quadric, which the last five see `off` [m] beside where it should be."""
    load_kernels()
    settings = EstimatorSettings(box_correlation=False)
    graph = ObjectGraph(CAMERA.K, settings, settings, settings)
    graph.add_origin()
    sideways = np.eye(4)
    sideways[0, 3] = 0.1
    for _ in range(10):
        step = motion(sideways, 0.02)
        graph.add_pose(step, graph.predict(step))
    place = np.eye(4)
    place[:3, 3] = 0.8, 0.1, 3.0
    known = Ellipsoid(graph.pose(0) @ place, np.array([0.1, 0.12, 0.15])).vector()
    graph.add_known_quadric(0, Known(known.copy(), np.eye(9) * 1e-5))
    known[0] += off
    for k in range(6, 11):
        corners = box_of_visible_part(graph.pose(k), known, CAMERA.K, BOUNDS, ~ALL_EDGES)[1]
        graph.add_box(k, 0, BoxMeasurement(corners, np.eye(4), BOUNDS, ~ALL_EDGES))
    return graph


def test_covariances_are_carried_along_a_motion() -> None:
    """As the graph itself has them once the next pose is in it."""
    graph = graph_of_one_quadric()
    graph.update()
    step = motion(TURN, 0.01)
    before = graph.joint_covariances(10, [0])[0]
    graph.add_pose(step, graph.pose(10) @ TURN)
    graph.update()
    expected = graph.joint_covariances(11, [0])[0]
    np.testing.assert_allclose(step.carried(before), expected, atol=1e-6 * np.abs(expected).max())
    before[:6, :6] += step.covariance  # as if an error were the same, seen from either pose
    assert np.abs(before - expected).max() > 0.1 * np.abs(expected).max()


def test_what_an_iteration_moves_is_linearised_anew() -> None:
    """The solution of an iteration is not where its factors were linearised."""
    graph = graph_of_one_quadric(off=0.2)
    before = graph.poses()
    graph.iterate()
    assert np.abs(graph.poses() - before)[:6].max() > 0.02
    assert graph.settle() is not None


def test_a_motion_that_is_none_changes_nothing() -> None:
    graph = graph_of_one_quadric()
    graph.update()
    poses = graph.poses()
    with pytest.raises(np.linalg.LinAlgError):
        graph.add_pose(Motion(TURN, -np.eye(6), 0.0, TURN), graph.pose(10) @ TURN)
    assert graph.size == len(poses)
    assert graph.add_pose(motion(TURN, 0.01), graph.pose(10) @ TURN) == 11
    graph.update()
    np.testing.assert_allclose(graph.pose(11), poses[10] @ TURN, atol=1e-6)
