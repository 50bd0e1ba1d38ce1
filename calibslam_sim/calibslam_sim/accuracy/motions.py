"""How far the motions of an odometry are from the truth, and how honest their covariances are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.stats import chi2

from calibslam_backend.odometry.motion_chain import dead_reckoning
from calibslam_backend.output.metrics import Trajectory, interpolated
from calibslam_msgs_py.measurements import Array, RelativeMotion

NEIGHBOURS = 3  # poses of the truth on each side that tell its noise
GAP = 3.0  # times the usual period, beyond which they do not


@dataclass(frozen=True)
class MotionAccuracy:
    """Of motions over some number of steps.

    Attributes:
        steps: they span.
        count: how many were judged.
        rotation_rms: [rad]; translation_rms: [m], of the error's length.
        nees: mean normalised squared error, 6 if the covariances are right; more if they are overconfident.
        covered_50, covered_90: share of errors inside the ellipsoids that shall hold 50 % and 90 % of them.
    """

    steps: int
    count: int
    rotation_rms: float
    translation_rms: float
    nees: float
    covered_50: float
    covered_90: float


def trajectory_of(motions: Sequence[RelativeMotion]) -> Trajectory:
    """Poses at the ends of consecutive motions, the first at the start of the first one."""
    poses = [np.eye(4)]
    for motion in motions:
        poses.append(poses[-1] @ motion.T_start_end)
    return Trajectory(np.array([motions[0].start, *(motion.end for motion in motions)]), np.stack(poses))


def truth_noise(truth: Trajectory) -> Array:
    """(6,) standard deviations [rad, m] of the white part of a measured truth's noise, in the body.

    That is what remains of each pose beside the parabola through it and its `NEIGHBOURS`; slow errors do not show. At
    100 Hz a hand moves along such a parabola to some hundredths of a millimetre.
    """
    offsets = np.arange(-NEIGHBOURS, NEIGHBOURS + 1)
    windows = np.arange(NEIGHBOURS, len(truth.stamps) - NEIGHBOURS)[:, None] + offsets
    if not len(windows):
        return np.zeros(6)
    seconds = (truth.stamps[windows] - truth.stamps[windows[:, NEIGHBOURS], None]) * 1e-9
    whole = np.diff(seconds, axis=1).max(axis=1) < GAP * np.median(np.diff(truth.stamps)) * 1e-9
    squares = []
    for indices, times in zip(windows[whole], seconds[whole], strict=True):
        centre = gtsam.Pose3(truth.poses[indices[NEIGHBOURS]])
        tangents = np.array([gtsam.Pose3.Logmap(centre.between(gtsam.Pose3(truth.poses[i]))) for i in indices])
        A = np.vander(times, 3)
        residuals = tangents - A @ np.linalg.lstsq(A, tangents, rcond=None)[0]
        squares.append((residuals**2).sum(axis=0) / (len(offsets) - 3))
    return np.sqrt(np.mean(squares, axis=0)) if squares else np.zeros(6)


def motion_accuracy(
    motions: Sequence[RelativeMotion], truth: Trajectory, steps: int, noise: Array | None = None
) -> MotionAccuracy | None:
    """Every motion over `steps` consecutive motions against the truth; None where the truth covers none.

    Args:
        motions: each begins where the last one ended, and has a covariance.
        truth: of the same camera, in any frame.
        steps: taken together; overlapping spans all count.
        noise: (6,) standard deviations of the truth itself, see `truth_noise`; None: it is exact.
    """
    trajectory = trajectory_of(motions)
    covered, poses = interpolated(truth, trajectory.stamps)
    true = np.full((len(covered), 4, 4), np.nan)
    true[covered] = poses
    errors, squares = [], []
    of_truth = np.diag(np.zeros(6) if noise is None else noise**2)
    for first in range(len(motions) - steps + 1):
        expected = np.linalg.inv(true[first]) @ true[first + steps]
        if np.isnan(expected).any():
            continue
        span = [(m.T_start_end, m.covariance) for m in motions[first : first + steps] if m.covariance is not None]
        ends, covariances = dead_reckoning(np.eye(4), np.zeros((6, 6)), span)
        error = gtsam.Pose3.Logmap(gtsam.Pose3(np.linalg.inv(expected) @ ends[-1]))
        errors.append(error)
        to_end = gtsam.Pose3(expected).inverse().AdjointMap()
        covariance = covariances[-1] + of_truth + to_end @ of_truth @ to_end.T
        squares.append(error @ np.linalg.solve(covariance, error))
    if not errors:
        return None
    return _summary(steps, np.array(errors), np.array(squares))


def _summary(steps: int, errors: Array, squares: Array) -> MotionAccuracy:
    lengths = np.sqrt((errors.reshape(-1, 2, 3) ** 2).sum(axis=2).mean(axis=0))
    inside = [float((squares < chi2.ppf(share, 6)).mean()) for share in (0.5, 0.9)]
    return MotionAccuracy(steps, len(errors), float(lengths[0]), float(lengths[1]), float(squares.mean()), *inside)
