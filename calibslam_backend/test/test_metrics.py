"""Metrics against numbers computed by hand."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from calibslam_backend.output.metrics import (
    NoGroundTruth,
    Trajectory,
    alignment,
    association_scores,
    ate,
    interpolated,
    keyframes_with_truth,
    motion_nees,
    position_nees,
    rpe,
)
from calibslam_backend.output.object_map import MotionCovariances
from calibslam_msgs_py.measurements import Array

SECOND = 1_000_000_000
MOVE = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.5, -0.8, 2.0), np.array([3.0, -2.0, 1.0])).matrix()


def at(*positions: tuple[float, float, float], step: int = SECOND // 50) -> Trajectory:
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 3] = positions
    return Trajectory(SECOND + step * np.arange(len(positions)), poses)


def moved(trajectory: Trajectory, T: Array) -> Trajectory:
    return Trajectory(trajectory.stamps, T @ trajectory.poses)


def random_walk(n: int = 20) -> Trajectory:
    rng = np.random.default_rng(0)
    pose, poses = gtsam.Pose3(), []
    for _ in range(n):
        pose = pose.compose(gtsam.Pose3.Expmap(rng.normal(0.0, 0.3, size=6)))
        poses.append(pose.matrix())
    return Trajectory(SECOND + (SECOND // 50) * np.arange(n), np.stack(poses))


def test_an_offset_and_a_turn_are_no_error() -> None:
    truth = random_walk()
    estimate = moved(truth, MOVE)
    assert ate(estimate, truth) == pytest.approx(0.0, abs=1e-9)
    assert rpe(estimate, truth) == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(alignment(estimate, truth), np.linalg.inv(MOVE), atol=1e-9)
    np.testing.assert_allclose(estimate.poses, MOVE @ truth.poses)  # nothing was changed on the way


def test_ate_by_hand() -> None:
    """A square of side 2 with corners pushed out and in by 0.3 by turns, across its plane: rms 0.3, no better fit."""
    truth = at((1, 1, 0), (-1, 1, 0), (-1, -1, 0), (1, -1, 0))
    estimate = at((1, 1, 0.3), (-1, 1, -0.3), (-1, -1, 0.3), (1, -1, -0.3))
    assert ate(estimate, truth) == pytest.approx(0.3)
    assert ate(moved(estimate, MOVE), truth) == pytest.approx(0.3)


def test_scale_is_an_error() -> None:
    """A square with corners 1 m from its middle, measured 1.1 m from it: each is 0.1 m off."""
    truth = at((1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0))
    estimate = Trajectory(truth.stamps, truth.poses.copy())
    estimate.poses[:, :3, 3] *= 1.1
    assert ate(estimate, truth) == pytest.approx(0.1)


@pytest.mark.parametrize("length", [0.0, 1.0])
def test_a_point_or_a_line_determines_no_alignment(length: float) -> None:
    truth = at(*[(length * x, 0, 0) for x in range(5)])
    for metric in (ate, alignment):
        with pytest.raises(NoGroundTruth, match="stands still or moves on a line"):
            metric(truth, truth)
    assert rpe(truth, truth) == pytest.approx(0.0, abs=1e-12)


def test_rpe_by_hand() -> None:
    """Steps of 1 m measured as 1.1, 0.9 and 1.2: rms of 0.1, 0.1, 0.2."""
    truth = at((0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0))
    estimate = at((0, 0, 0), (1.1, 0, 0), (2.0, 0, 0), (3.2, 0, 0))
    assert rpe(estimate, truth) == pytest.approx(np.sqrt((0.01 + 0.01 + 0.04) / 3))
    assert rpe(moved(estimate, MOVE), truth) == pytest.approx(np.sqrt(0.02))


def test_keyframes_are_matched_within_20_ms() -> None:
    truth = at(*[(x, x**2, 0) for x in range(10)], step=SECOND)
    shifted = Trajectory(truth.stamps + 19_000_000, truth.poses)
    assert ate(shifted, truth) == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(NoGroundTruth, match="no ground truth within"):
        ate(Trajectory(truth.stamps + 21_000_000, truth.poses), truth)
    with pytest.raises(NoGroundTruth, match="there is no keyframe"):
        ate(Trajectory(truth.stamps[:0], truth.poses[:0]), truth)
    with pytest.raises(NoGroundTruth, match="only 2 keyframes"):
        rpe(Trajectory(truth.stamps[:2], truth.poses[:2]), truth)


def test_rpe_does_not_reach_across_a_gap_of_the_truth() -> None:
    """Steps of 1 m measured as 1.1 m, but for three without truth, measured as 2 m."""
    truth = at(*[(x, 0, 0) for x in range(10)], step=SECOND)
    estimate = Trajectory(truth.stamps, truth.poses.copy())
    estimate.poses[:, 0, 3] = np.cumsum([0, 1.1, 1.1, 1.1, 2, 2, 2, 1.1, 1.1, 1.1])
    known = [0, 1, 2, 3, 6, 7, 8, 9]
    with_gap = Trajectory(truth.stamps[known], truth.poses[known])
    assert keyframes_with_truth(estimate, with_gap) == 8
    assert rpe(estimate, with_gap) == pytest.approx(0.1)
    with pytest.raises(NoGroundTruth, match="no two consecutive"):
        rpe(estimate, Trajectory(truth.stamps[::2], truth.poses[::2]))


def test_keyframes_with_truth_are_counted_once() -> None:
    """Ground truth of 100 Hz that covers two of five keyframes, and two poses of it that cover one."""
    estimate = at(*[(x, 0, 0) for x in range(5)], step=SECOND)
    dense = at(*[(0.01 * x, 0, 0) for x in range(110)], step=SECOND // 100)
    assert keyframes_with_truth(estimate, dense) == 2
    assert keyframes_with_truth(estimate, Trajectory(dense.stamps[:2], dense.poses[:2])) == 1
    assert keyframes_with_truth(estimate, Trajectory(dense.stamps + 90 * SECOND, dense.poses)) == 0


def test_truth_between_its_poses() -> None:
    """Half way: half the translation, half the turn. Not across a gap, and not beyond the ends."""
    truth = at((0, 0, 0), (1, 2, 3), (9, 9, 9))
    turned = gtsam.Rot3.Yaw(0.4).matrix()
    truth.poses[1, :3, :3] = turned
    stamps = truth.stamps.copy()
    stamps[2] += SECOND
    with_gap = Trajectory(stamps, truth.poses)
    asked = np.array([stamps[0] - 1, stamps[0], (stamps[0] + stamps[1]) // 2, (stamps[1] + stamps[2]) // 2])
    covered, poses = interpolated(with_gap, asked)
    assert covered.tolist() == [False, True, True, False]
    np.testing.assert_allclose(poses[1][:3, 3], [0.5, 1.0, 1.5])
    np.testing.assert_allclose(poses[1][:3, :3], gtsam.Rot3.Yaw(0.2).matrix(), atol=1e-12)
    # A pose of slow ground truth covers its own time, also beside a gap.
    covered, poses = interpolated(with_gap, stamps)
    assert covered.all()
    np.testing.assert_allclose(poses[2][:3, 3], [9.0, 9.0, 9.0])
    # Near a pose of slow ground truth, the first and the last included, and not in the middle.
    slow = Trajectory(np.arange(4) * SECOND, np.tile(np.eye(4), (4, 1, 1)))
    asked = np.array([0.015, 0.5, 0.99, 1.015, 2.5, 2.99]) * SECOND
    assert interpolated(slow, asked)[0].tolist() == [True, False, True, True, False, True]


def test_nees_by_hand() -> None:
    """Errors (0.1, 0, 0) and (0, 0.2, 0) after the first keyframe, with sigmas 0.1 and 0.1: (1 + 4) / 2."""
    truth = moved(at((0, 0, 0), (1, 0, 0), (2, 0, 0)), MOVE)
    estimate = at((0, 0, 0), (1.1, 0, 0), (2, 0.2, 0))
    covariances = np.tile(np.eye(6) * 0.01, (3, 1, 1))
    assert position_nees(estimate, covariances, truth) == pytest.approx(2.5)
    # A body that is turned carries its covariance with it: sigma 0.2 along its own y, which is the map's x.
    estimate.poses[1:, :3, :3] = gtsam.Rot3.Yaw(-np.pi / 2).matrix()
    covariances[1:, 4, 4] = 0.04
    assert position_nees(estimate, covariances, truth) == pytest.approx((0.25 + 4.0) / 2)
    # Rotations do not count.
    covariances[:, :3, :3] *= 100.0
    assert position_nees(estimate, covariances, truth) == pytest.approx(2.125)


def test_nees_needs_truth() -> None:
    truth = at((0, 0, 0), (1, 0, 0))
    far = Trajectory(truth.stamps + 100 * SECOND, truth.poses)
    assert position_nees(far, np.tile(np.eye(6), (2, 1, 1)), truth) is None


def test_nees_of_honest_covariances_is_three() -> None:
    """2,000 positions with the errors they state: mean 3, its standard deviation sqrt(6 / 2000) = 0.055."""
    rng = np.random.default_rng(1)
    truth = at(*[(0.01 * x, 0, 0) for x in range(2001)])
    estimate = Trajectory(truth.stamps, truth.poses.copy())
    A = rng.normal(size=(3, 3))
    covariance = np.eye(6)
    covariance[3:, 3:] = A @ A.T
    estimate.poses[1:, :3, 3] += rng.multivariate_normal(np.zeros(3), A @ A.T, size=2000)
    nees = position_nees(estimate, np.tile(covariance, (2001, 1, 1)), truth)
    assert nees == pytest.approx(3.0, abs=0.2)


def test_nees_of_motions_by_hand() -> None:
    """Steps of 1 m are 1.1, 1.0 and 0.8 m long in the estimate, sigmas 0.1: (1 + 0 + 4) / 3 and, of two, 1 and 4."""
    truth = moved(at((0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)), MOVE)
    estimate = at((0, 0, 0), (1.1, 0, 0), (2.1, 0, 0), (2.9, 0, 0))
    motions = MotionCovariances(
        np.array([0, 1, 2, 0, 1]), np.array([1, 2, 3, 2, 3]), np.tile(0.01 * np.eye(6), (5, 1, 1))
    )
    assert motion_nees(estimate, motions, truth) == pytest.approx({1: 5.0 / 3.0, 2: 2.5})
    # What all have in common is no error of a motion, and rotations do not count.
    motions.covariances[:, :3, :3] *= 100.0
    assert motion_nees(moved(estimate, MOVE), motions, truth) == pytest.approx({1: 5.0 / 3.0, 2: 2.5})
    # The covariance is in the body at the end: sigma 0.2 along its own y, which is the map's x.
    estimate.poses[:, :3, :3] = truth.poses[:, :3, :3] = gtsam.Rot3.Yaw(-np.pi / 2).matrix()
    truth.poses[:, :3, 3] = at((0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)).poses[:, :3, 3]
    motions.covariances[:, 4, 4] = 0.04
    assert motion_nees(estimate, motions, truth) == pytest.approx({1: 5.0 / 12.0, 2: 0.625})
    # Without truth at the last pose, two motions are left.
    short = Trajectory(truth.stamps[:3], truth.poses[:3])
    late = Trajectory(estimate.stamps + np.array([0, 0, 0, SECOND]), estimate.poses)
    assert motion_nees(late, motions, short) == pytest.approx({1: 0.125, 2: 0.25})
    none = MotionCovariances(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 6, 6)))
    assert motion_nees(estimate, none, truth) == {}


def test_association_scores_by_hand() -> None:
    """Quadric 0: cup cup book. Quadric 1: cup. Quadric 2: book book. One cup unused, one box of unknown identity.

    Right are 2 + 1 + 2 of the 6 used. Each object has one quadric: cup 2, book 2, of 7 known boxes.
    """
    pairs = [(0, "cup"), (0, "cup"), (0, "book"), (1, "cup"), (2, "book"), (2, "book"), (None, "cup"), (0, "")]
    scores = association_scores(pairs)
    assert scores is not None
    assert (scores.precision, scores.recall) == (pytest.approx(5 / 6), pytest.approx(4 / 7))


def test_association_scores_of_nothing() -> None:
    assert association_scores([]) is None
    assert association_scores([(0, ""), (None, "")]) is None
    unused = association_scores([(None, "cup")])
    assert unused is not None and (unused.precision, unused.recall) == (0.0, 0.0)
