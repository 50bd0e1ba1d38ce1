"""A new keyframe's pose from odometry and boxes, each of which may fail grossly."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from small_world import CAMERA, SmallWorld, around, objects

from calibslam_backend.association.localisation import localise
from calibslam_backend.geometry.box_measurement import BoxMeasurement, prepare
from calibslam_backend.graph.box_factor import INVISIBLE, whitened_residual
from calibslam_backend.graph.robust import robust_loss
from calibslam_msgs_py.measurements import Array

POSES = around(10)
COVARIANCE = np.diag(np.repeat([0.01, 0.01], 3) ** 2)
VECTORS = [thing.vector() for thing in objects()]


def boxes_at(k: int, sigma: float = 1.0, seed: int = 0) -> list[BoxMeasurement]:
    boxes = SmallWorld(POSES, objects(), box_sigma=sigma, seed=seed).boxes()[k]
    assert len(boxes) == len(VECTORS)
    return prepare(boxes, np.tile(np.eye(4) * sigma**2, (len(boxes), 1, 1)), CAMERA)


def find(predicted: Array, boxes: list[BoxMeasurement], n: int = 9) -> Array:
    return localise(predicted, COVARIANCE, VECTORS[:n], boxes[:n], CAMERA.K, 2.0, 3.0)


def off(T: Array, tangent: list[float]) -> Array:
    return np.asarray(gtsam.Pose3(T).retract(np.array(tangent)).matrix())


def error(T: Array, truth: Array) -> tuple[float, float]:
    difference = gtsam.Pose3.Logmap(gtsam.Pose3(truth).between(gtsam.Pose3(T)))
    return float(np.linalg.norm(difference[:3])), float(np.linalg.norm(difference[3:]))


def test_without_boxes_odometry_is_all_there_is() -> None:
    np.testing.assert_array_equal(localise(POSES[3], COVARIANCE, [], [], CAMERA.K, 2.0, 3.0), POSES[3])


def test_boxes_correct_a_small_error() -> None:
    predicted = off(POSES[3], [0.01, -0.01, 0.01, 0.01, 0.01, -0.01])
    rotation, translation = error(find(predicted, boxes_at(3)), POSES[3])
    assert rotation < 0.008 and translation < 0.012


def test_a_gross_failure_of_odometry_is_recovered() -> None:
    """20 and more standard deviations off: nine boxes say where the camera is."""
    for seed in range(10):
        direction = np.random.default_rng(seed).normal(size=6)
        direction /= np.linalg.norm(direction)
        predicted = off(POSES[4], list(0.25 * direction))
        rotation, translation = error(find(predicted, boxes_at(4, seed=seed)), POSES[4])
        assert rotation < 0.01 and translation < 0.02, seed


def test_one_gross_box_does_not_move_a_pose() -> None:
    """Among others; alone it is no worse than odometry if it is wrong by more than both could explain."""
    for n, shifts in ((9, (20.0, 60.0, 300.0)), (1, (300.0,))):
        for shift in shifts:
            boxes = boxes_at(2)
            wrong = boxes[0]
            boxes[0] = BoxMeasurement(wrong.corners + shift, wrong.whitener, wrong.bounds, wrong.clip)
            rotation, translation = error(find(POSES[2], boxes, n), POSES[2])
            assert rotation < 0.01 and translation < 0.02, (n, shift)


def test_the_result_is_never_worse_than_odometry_s_start() -> None:
    """Random failures of odometry and boxes at once: the cost of the result is at most that of the prediction."""
    rng = np.random.default_rng(5)
    whitener = np.linalg.inv(np.linalg.cholesky(COVARIANCE))

    def cost(T: Array, predicted: Array, boxes: list[BoxMeasurement]) -> float:
        e = whitener @ gtsam.Pose3.Logmap(gtsam.Pose3(predicted).between(gtsam.Pose3(T)))
        total = robust_loss(e @ e, 3.0)[0]
        for vector, box in zip(VECTORS, boxes, strict=True):
            visible, r, _ = whitened_residual(T, vector, CAMERA.K, *vars(box).values())
            total += robust_loss(r @ r if visible else INVISIBLE**2, 2.0)[0]
        return float(total)

    for trial in range(20):
        predicted = off(POSES[trial % 10], list(rng.normal(0.0, 0.1, size=6)))
        boxes = [
            BoxMeasurement(b.corners + rng.normal(0, 30.0) * (rng.random() < 0.3), b.whitener, b.bounds, b.clip)
            for b in boxes_at(trial % 10, seed=trial)
        ]
        assert cost(find(predicted, boxes), predicted, boxes) <= cost(predicted, predicted, boxes) + 1e-9


def test_a_quadric_behind_the_camera_is_survived() -> None:
    backwards = POSES[0].copy()
    backwards[:3, :3] = backwards[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    assert np.isfinite(find(backwards, boxes_at(0))).all()


def test_boxes_count_by_their_worth() -> None:
    """A quarter of it is twice the deviation, where nothing is doubted."""
    predicted, boxes = off(POSES[3], [0.01, -0.01, 0.01, 0.01, 0.01, -0.01]), boxes_at(3)
    wider = [replace(box, whitener=0.5 * box.whitener) for box in boxes]

    def found(boxes: list[BoxMeasurement], worth: float = 1.0) -> Array:
        return localise(predicted, COVARIANCE, VECTORS, boxes, CAMERA.K, 1e6, 1e6, worth)

    np.testing.assert_allclose(found(boxes, worth=0.25), found(wider), atol=1e-9)
    assert error(found(wider), predicted) < error(found(boxes), predicted)
