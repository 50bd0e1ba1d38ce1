"""How good a trajectory is, and how honest its covariances: pure functions, ATE and RPE by evo."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from evo.core import metrics, sync
from evo.core.geometry import GeometryException
from evo.core.trajectory import PoseTrajectory3D
from scipy.spatial.transform import Rotation, Slerp

from calibslam_backend.output.object_map import MotionCovariances
from calibslam_msgs_py.measurements import Array, StampedPose

MAX_STAMP_DIFFERENCE = 0.02  # [s] between a keyframe and its ground truth


@dataclass(frozen=True)
class Trajectory:
    """Poses (N, 4, 4) of a camera at `stamps` (N,) [ns], ascending."""

    stamps: Array
    poses: Array

    @classmethod
    def of(cls, poses: Sequence[StampedPose]) -> Trajectory:
        """Of at least one pose, in the order of time."""
        return cls(np.array([pose.stamp for pose in poses]), np.stack([pose.T for pose in poses]))

    def evo(self) -> PoseTrajectory3D:
        """The same for evo."""
        return PoseTrajectory3D(poses_se3=list(self.poses), timestamps=np.asarray(self.stamps) * 1e-9)


class NoGroundTruth(ValueError):
    """Estimate and ground truth have too few times in common, or do not determine an alignment."""


def _near(estimate: Trajectory, truth: Trajectory) -> tuple[PoseTrajectory3D, PoseTrajectory3D]:
    if not len(estimate.stamps):
        raise NoGroundTruth("there is no keyframe")
    try:
        reference, matched = sync.associate_trajectories(truth.evo(), estimate.evo(), max_diff=MAX_STAMP_DIFFERENCE)
    except sync.SyncException as error:
        raise NoGroundTruth(
            f"no ground truth within {MAX_STAMP_DIFFERENCE} s of any keyframe: is it of this time, and of one clock?"
        ) from error
    return reference, matched


def keyframes_with_truth(estimate: Trajectory, truth: Trajectory) -> int:
    """How many poses of the estimate have ground truth."""
    try:
        return len(np.unique(_near(estimate, truth)[1].timestamps))
    except NoGroundTruth:
        return 0


def _matched(estimate: Trajectory, truth: Trajectory) -> tuple[PoseTrajectory3D, PoseTrajectory3D]:
    reference, matched = _near(estimate, truth)
    if matched.num_poses < 3:
        raise NoGroundTruth(f"only {matched.num_poses} keyframes have ground truth; an alignment needs 3")
    return reference, matched


def _align(matched: PoseTrajectory3D, reference: PoseTrajectory3D) -> tuple[Array, Array]:
    """Move a trajectory to its best SE(3) alignment; returns that rotation (3, 3) and translation (3,)."""
    try:
        R, t, _ = matched.align(reference, correct_scale=False)
    except GeometryException as error:
        raise NoGroundTruth("the camera stands still or moves on a line: no alignment is determined") from error
    return R, t


def ate(estimate: Trajectory, truth: Trajectory) -> float:
    """Absolute trajectory error [m], rms after SE(3) alignment without scale.

    Raises:
        NoGroundTruth: fewer than three keyframes have ground truth, or all on a line.
    """
    reference, matched = _matched(estimate, truth)
    aligned = copy.deepcopy(matched)
    _align(aligned, reference)
    metric = metrics.APE(metrics.PoseRelation.translation_part)
    metric.process_data((reference, aligned))
    return float(metric.get_statistic(metrics.StatisticsType.rmse))


def rpe(estimate: Trajectory, truth: Trajectory) -> float:
    """Relative pose error [m], rms of the translation part between consecutive keyframes that both have ground truth.

    Raises:
        NoGroundTruth: fewer than three keyframes have ground truth, or no two consecutive ones.
    """
    reference, matched = _matched(estimate, truth)
    metric = metrics.RPE(metrics.PoseRelation.translation_part, 1.0, metrics.Unit.frames)
    metric.process_data((reference, matched))
    # Those on both sides of a gap of the ground truth are no consecutive keyframes.
    indices = np.searchsorted(estimate.evo().timestamps, matched.timestamps)
    errors = np.asarray(metric.error)[np.diff(indices) == 1]
    if not len(errors):
        raise NoGroundTruth("no two consecutive keyframes have ground truth")
    return float(np.sqrt(np.mean(errors**2)))


def alignment(estimate: Trajectory, truth: Trajectory) -> Array:
    """(4, 4) T_world_map of the best SE(3) alignment.

    Raises:
        NoGroundTruth: fewer than three keyframes have ground truth, or all on a line.
    """
    reference, matched = _matched(estimate, truth)
    R, t = _align(copy.deepcopy(matched), reference)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def interpolated(truth: Trajectory, stamps: Array) -> tuple[Array, Array]:
    """Which of the times (N,) [ns] the truth covers, and its poses (M, 4, 4) at those.

    A time is covered between two poses if the nearer one is at most `MAX_STAMP_DIFFERENCE` away.
    """
    times, at = np.asarray(truth.stamps), np.asarray(stamps)
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    distance = np.minimum(np.abs(at - times[after - 1]), np.abs(times[after] - at))
    covered = (at >= times[0]) & (at <= times[-1]) & (distance <= MAX_STAMP_DIFFERENCE * 1e9)
    seconds, wanted = (times - times[0]) * 1e-9, (at[covered] - times[0]) * 1e-9
    poses = np.tile(np.eye(4), (len(wanted), 1, 1))
    if len(wanted):
        poses[:, :3, :3] = Slerp(seconds, Rotation.from_matrix(truth.poses[:, :3, :3]))(wanted).as_matrix()
        for axis in range(3):
            poses[:, axis, 3] = np.interp(wanted, seconds, truth.poses[:, axis, 3])
    return covered, poses


def position_nees(estimate: Trajectory, covariances: Array, truth: Trajectory) -> float | None:
    """Mean normalised squared error of the positions; 3 if the covariances are right, more if overconfident.

    Covariances are relative to the first keyframe, so the truth is tied to the estimate at one keyframe, the first
    that it covers, not by a best fit; that keyframe, which then has no error, does not count. None if the truth
    covers fewer than two keyframes.

    Args:
        estimate: N poses in the map.
        covariances: (N, 6, 6) [rotation, translation] in the body.
        truth: in any frame.
    """
    covered, true = interpolated(truth, estimate.stamps)
    if np.count_nonzero(covered) < 2:
        return None
    poses, covariances = estimate.poses[covered], covariances[covered]
    errors = poses[:, :3, 3] - (poses[0] @ np.linalg.inv(true[0]) @ true)[:, :3, 3]
    R = poses[:, :3, :3]
    in_map = R @ covariances[:, 3:, 3:] @ R.transpose(0, 2, 1)
    return float(_normalised(errors[1:], in_map[1:]).mean())


def motion_nees(estimate: Trajectory, motions: MotionCovariances, truth: Trajectory) -> dict[int, float]:
    """Mean normalised squared error of the translation of motions, by how many keyframes they span; 3 if covariances
    are right, more if overconfident.

    The positions of one recording have the error of its beginning in common, so that their NEES is hardly more than
    one sample. Motions in different parts of it have little in common.

    Args:
        estimate: N poses in the map.
        motions: between them.
        truth: in any frame; motions whose ends it does not cover do not count.
    """
    covered, found = interpolated(truth, estimate.stamps)
    true = np.full((len(estimate.stamps), 4, 4), np.nan)
    true[covered] = found
    spans = motions.last - motions.first
    counts = covered[motions.first] & covered[motions.last]
    first, last = motions.first[counts], motions.last[counts]
    estimated = np.linalg.inv(estimate.poses[first]) @ estimate.poses[last]
    truly = np.linalg.inv(true[first]) @ true[last]
    # In the frame of the last pose, as the covariances are.
    errors = np.einsum("nji,nj->ni", estimated[:, :3, :3], (estimated - truly)[:, :3, 3])
    squared = _normalised(errors, motions.covariances[counts][:, 3:, 3:])
    return {int(n): float(squared[spans[counts] == n].mean()) for n in np.unique(spans[counts])}


def _normalised(errors: Array, covariances: Array) -> Array:
    """(N,) errors (N, d) squared over their covariances (N, d, d)."""
    return np.asarray(np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]))


@dataclass(frozen=True)
class AssociationScores:
    """Precision: of the boxes given to quadrics, the share whose object is the one most boxes of that quadric are of.
    Recall: of all boxes of known objects, the share given to the one quadric that has most of that object's boxes
    and is mostly of it."""

    precision: float
    recall: float


def association_scores(pairs: Sequence[tuple[int | None, str]]) -> AssociationScores | None:
    """Scores of the boxes in keyframes, each with its quadric (None: unused) and its true identity ("": unknown).

    None where no identity is known.
    """
    known = [(quadric, name) for quadric, name in pairs if name]
    if not known:
        return None
    names: dict[int, Counter[str]] = {}
    for quadric, name in known:
        if quadric is not None:
            names.setdefault(quadric, Counter())[name] += 1
    used = sum(counter.total() for counter in names.values())
    right = sum(counter.most_common(1)[0][1] for counter in names.values())
    best: Counter[str] = Counter()
    for counter in names.values():
        name, count = counter.most_common(1)[0]
        best[name] = max(best[name], count)
    return AssociationScores(right / used if used else 0.0, best.total() / len(known))
