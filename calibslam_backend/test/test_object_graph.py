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
from calibslam_backend.graph import published as published_module
from calibslam_backend.graph.known import Known, MapPrior, moved_with_map, prior_of
from calibslam_backend.graph.measured import Motion
from calibslam_backend.graph.object_graph import T_MAP_FIRST_CAMERA, ObjectGraph
from calibslam_backend.graph.published import PublishedCovariances
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


def test_motions_are_as_uncertain_as_odometry_where_nothing_else_is_known() -> None:
    """Two steps add up in the body at the end; where the first pose is takes no part in it."""
    load_kernels()
    settings = EstimatorSettings()
    graph = ObjectGraph(CAMERA.K, settings, settings, settings)
    graph.add_origin()
    steps = [motion(TURN, 0.01), motion(np.linalg.inv(TURN) @ TURN @ TURN, 0.03)]
    for step in steps:
        graph.add_pose(step, graph.predict(step))
    graph.update()
    published = PublishedCovariances(graph)
    np.testing.assert_allclose(published.motion(0, 1), steps[0].covariance, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(published.motion(1, 2), steps[1].covariance, rtol=1e-6, atol=1e-9)
    undone = gtsam.Pose3(steps[1].T).inverse().AdjointMap()
    expected = undone @ steps[0].covariance @ undone.T + steps[1].covariance
    np.testing.assert_allclose(published.motion(0, 2), expected, rtol=1e-6, atol=1e-9)


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


def known_map() -> tuple[ObjectGraph, MapPrior]:
    """A graph of nothing, and five cups of a map that is moved as a whole and err by a centimetre each."""
    load_kernels()
    settings = EstimatorSettings(box_correlation=False)
    vectors = []
    for j in range(5):
        T = T_MAP_FIRST_CAMERA.copy()
        T[:3, 3] = 2.0 + 0.3 * (j % 2), 0.25 * (j - 2), 0.1 * j
        vectors.append(Ellipsoid(T, np.array([0.05, 0.08, 0.1])).vector())
    G = np.concatenate([moved_with_map(vector) for vector in vectors])
    S = G @ np.diag([0.02**2] * 3 + [0.05**2] * 3) @ G.T + np.eye(45) * 1e-4
    prior = prior_of(range(5), vectors, S.reshape(5, 9, 5, 9).swapaxes(1, 2))
    graph = ObjectGraph(CAMERA.K, settings, settings, settings)
    graph.frame = prior.frame
    for j, known in prior.quadrics.items():
        graph.add_known_quadric(j, known)
    return graph, prior


def test_a_camera_at_the_origin_tells_where_the_map_is() -> None:
    """It sees the map moved, which then is where it sees it, and as sure as it is of itself."""
    graph, prior = known_map()
    graph.add_origin()
    off = gtsam.Pose3.Expmap(np.array([0.01, -0.02, 0.015, 0.05, -0.03, 0.04]))
    true = {}
    for j, known in prior.quadrics.items():
        ellipsoid = Ellipsoid.from_vector(known.vector)
        true[j] = Ellipsoid(off.matrix() @ ellipsoid.T_world_object, ellipsoid.radii).vector()
        corners = box_of_visible_part(T_MAP_FIRST_CAMERA, true[j], CAMERA.K, BOUNDS, ~ALL_EDGES)[1]
        graph.add_box(0, j, BoxMeasurement(corners, np.eye(4), BOUNDS, ~ALL_EDGES))
    graph.update()
    for _ in range(3):
        graph.iterate()
    np.testing.assert_allclose(graph.pose(0), T_MAP_FIRST_CAMERA, atol=2e-3)
    published = PublishedCovariances(graph)
    assert not graph.frame.any() and np.sqrt(np.diag(published.pose(0))).max() < 2e-3
    for j, covariance in published.quadrics().items():
        error = true[j] - graph.quadric(j)
        assert error @ np.linalg.solve(covariance, error) < 9.0


def test_what_is_published_allows_for_more_than_the_tree(monkeypatch: pytest.MonkeyPatch) -> None:
    """For errors that are alike, here by a factor of 4, of motions by that of their length, but not of what is not in
    the tree yet; and for a motion of the whole map, but not of motions."""
    graph, _ = known_map()
    graph.add_origin(T_MAP_FIRST_CAMERA)
    for _ in range(3):
        step = motion(TURN, 0.02)
        graph.add_pose(step, graph.predict(step))
    graph.update()
    new = graph.quadric(0) + 0.1
    graph.add_quadric(5, new)
    monkeypatch.setattr(graph.correlation, "understated", lambda keyframes=np.inf: min(keyframes, 4.0))
    published, frame = PublishedCovariances(graph), graph.frame
    assert np.linalg.eigvalsh(frame).max() > 1e-4

    moved = np.zeros((6, 6))  # of the pose in its body, by a motion of the map
    for axis, by in enumerate(1e-6 * np.eye(6)):
        there = gtsam.Pose3(gtsam.Pose3.Expmap(by).matrix() @ graph.pose(2))
        moved[:, axis] = gtsam.Pose3(graph.pose(2)).localCoordinates(there) / 1e-6
    expected = 4.0 * graph.pose_covariance(2) + moved @ frame @ moved.T
    np.testing.assert_allclose(published.pose(2), expected, rtol=1e-4, atol=1e-9)

    undone = np.hstack([-gtsam.Pose3(np.linalg.inv(TURN @ TURN)).AdjointMap(), np.eye(6)])
    expected = 2.0 * undone @ graph.joint_of_poses(1, 3) @ undone.T
    np.testing.assert_allclose(published.motion(1, 3), expected, rtol=1e-4, atol=1e-9)

    prior = graph.landmarks[5].prior.covariance
    for j, own in ((0, 4.0 * graph.quadric_covariances()[0]), (5, prior)):
        G = moved_with_map(graph.quadric(j))
        np.testing.assert_allclose(published.quadrics()[j], own + G @ frame @ G.T)

    known = published.known()
    np.testing.assert_array_equal(known.quadrics[5].covariance, prior)
    graph.frame = 2.0 * frame
    np.testing.assert_allclose(published.known().frame - known.frame, frame, atol=1e-12)
    assert np.linalg.eigvalsh(known.frame - frame).min() > -1e-9


def test_without_the_quadric_that_others_depend_on() -> None:
    """They are still known as well as they were, at once and after the next update."""
    graph, prior = known_map()
    graph.add_origin(T_MAP_FIRST_CAMERA)
    graph.update()
    root = next(j for j, known in prior.quadrics.items() if known.parent is None)
    published = PublishedCovariances(graph)
    before = published.quadrics()
    graph.remove_quadric(root)
    children = [j for j, known in prior.quadrics.items() if known.parent == root]
    assert children and all(graph.is_solved(j) for j in children)
    assert published.known().quadrics.keys() == before.keys() - {root}
    graph.update()
    after = published.quadrics()
    for j in children:
        np.testing.assert_allclose(after[j], before[j], atol=0.1 * np.abs(before[j]).max())
    published.known().check()


def test_a_map_whose_covariances_are_none_of_one_distribution_can_be_gone_on_with(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(*_: object) -> MapPrior:
        raise np.linalg.LinAlgError("Singular matrix")

    graph, _ = known_map()
    graph.add_origin(T_MAP_FIRST_CAMERA)
    graph.update()
    monkeypatch.setattr(published_module, "prior_of", fails)
    published = PublishedCovariances(graph)
    found = published.known()
    assert "is not kept: Singular matrix" in caplog.text
    for j, covariance in published.quadrics().items():
        assert found.quadrics[j].parent is None
        np.testing.assert_allclose(found.with_frame()[j].covariance, covariance)
