"""Relative motions from odometry, and what is believed of them.

Odometry covariances are often missing. `MotionNoise` then stands in: a share of the motion itself plus a floor,
which is what frame-to-frame visual odometry was seen to do on recordings of slow and fast motion alike, and a
constant part, which the graph estimates (see `odometry_factor`).

A camera that turns a little to the right sees nearly what one sees that moves a little to the right. Visual odometry
hardly tells the two apart, and takes a part of one for the other; what it sees stays where it is in the image. So it
knows well how the scene moves before the camera, and its errors of rotation turn the camera about the scene. On real
recordings its errors of sideways translation and of rotation correlate by 0.73 to 0.96 (docs/method.md).
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass

import gtsam
import numpy as np

from calibslam_backend.odometry_failures import FailureFilter, FailureSettings
from calibslam_msgs_py.measurements import SECOND, Array, InvalidMeasurement, RelativeMotion
from calibslam_msgs_py.settings import setting


@dataclass(frozen=True)
class MotionNoise(FailureSettings):
    """Standard deviations of a motion whose covariance is unknown: sqrt(floor^2 + (share * motion)^2), and those of
    the drift that all such motions share. Both are of errors that are independent of each other at the scene,
    `scene_depth` in front of the camera on its optical axis. (`FailureSettings` say which motions are none.)"""

    rotation_floor: float = setting(0.003, "unknown odometry noise: rotation at rest", unit="rad", low=1e-6)
    rotation_share: float = setting(0.05, "unknown odometry noise: share of the rotation", low=0.0, high=1.0)
    translation_floor: float = setting(0.003, "unknown odometry noise: translation at rest", unit="m", low=1e-6)
    translation_share: float = setting(0.02, "unknown odometry noise: share of the translation", low=0.0, high=1.0)
    scene_depth: float = setting(
        1.0, "unknown odometry noise: how far away is what it sees; 0 if it is not visual", unit="m", low=0.0
    )
    drift_rotation: float = setting(0.003, "unknown odometry noise: constant drift in rotation", unit="rad/s", low=1e-9)
    drift_translation: float = setting(
        0.003, "unknown odometry noise: constant drift in translation", unit="m/s", low=1e-9
    )

    def covariance(self, T_start_end: Array) -> Array:
        """(6, 6) [rotation, translation] for a motion (4, 4) of the camera, at its end."""
        motion = gtsam.Pose3.Logmap(gtsam.Pose3(T_start_end))
        rotation = np.hypot(self.rotation_floor, self.rotation_share * np.linalg.norm(motion[:3]))
        translation = np.hypot(self.translation_floor, self.translation_share * np.linalg.norm(motion[3:]))
        return self._about_scene(np.repeat([rotation, translation], 3))

    def drift_covariance(self) -> Array:
        """(6, 6) of the constant drift [rad/s, m/s]."""
        return self._about_scene(np.repeat([self.drift_rotation, self.drift_translation], 3))

    def _about_scene(self, deviations: Array) -> Array:
        """(6, 6) in the camera, of errors that are independent, with deviations (6,), in a frame at the scene."""
        T_camera_scene = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, self.scene_depth]))
        square_root = T_camera_scene.AdjointMap() * deviations
        return np.asarray(square_root @ square_root.T)


class OdometryDifferencer:
    """Differences of consecutive poses of an odometry source: the only thing it measures."""

    def __init__(self) -> None:
        self._stamp: int | None = None
        self._T: Array | None = None

    def add(
        self,
        stamp: int,
        T_odom_body: Array,
        velocity_covariance: Array | None = None,
        frame_id: str = "camera",
    ) -> RelativeMotion | None:
        """The motion since the last pose; None for the first.

        Args:
            stamp: time [ns].
            T_odom_body: (4, 4).
            velocity_covariance: (6, 6) [rotation rad/s, translation m/s] in the body, over the step that ends here:
                the motion has this covariance times the step's duration squared. None: unknown.
            frame_id: name of the body.

        Raises:
            InvalidMeasurement: "duplicate" or "time_backwards". After a jump of time backwards the next motion
                starts at the new time.
        """
        if stamp == self._stamp:
            raise InvalidMeasurement("duplicate", f"odometry at {stamp} ns came twice")
        last_stamp, last_T = self._stamp, self._T
        self._stamp, self._T = stamp, T_odom_body
        if last_stamp is None or last_T is None:
            return None
        if stamp < last_stamp:
            raise InvalidMeasurement("time_backwards", f"odometry jumped from {last_stamp} back to {stamp} ns")
        covariance = velocity_covariance
        if covariance is not None:
            covariance = covariance * ((stamp - last_stamp) / SECOND) ** 2
        return RelativeMotion(last_stamp, stamp, np.linalg.inv(last_T) @ T_odom_body, covariance, frame_id)


def dead_reckoning(start: Array, covariance: Array, steps: Iterable[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Poses (N + 1, 4, 4) and their covariances (N + 1, 6, 6) by odometry alone.

    Args:
        start: (4, 4) first pose.
        covariance: (6, 6) of it, [rotation, translation] in the body.
        steps: N motions (4, 4) in the body, each with its covariance (6, 6) in the body at its end.
    """
    poses, covariances = [gtsam.Pose3(start)], [covariance]
    for motion, noise in steps:
        step = gtsam.Pose3(motion)
        back = step.inverse().AdjointMap()
        poses.append(poses[-1] * step)
        covariances.append(back @ covariances[-1] @ back.T + noise)
    return np.stack([pose.matrix() for pose in poses]), np.stack(covariances)


class MotionChain:
    """Consecutive relative motions of the camera, readable between any two times.

    Times inside a step are interpolated along the geodesic, its covariance in proportion.

    Where odometry fails the body is taken to go on as it did, and to do unseen what it may, see `odometry_failures`.
    """

    # What a body may do unseen, while odometry is missing or where it leaves a direction open: 1 rad/s and 1 m/s.
    UNSEEN_MOTION = 1.0
    # A standard deviation [rad, m] of one step that says: not measured.
    OPEN = 1.0
    SHORTEST = 0.03  # [s]: a shorter step leaves no less open

    def __init__(self, noise: MotionNoise, T_body_camera: Array) -> None:
        self._noise = noise
        self._extrinsic = gtsam.Pose3(T_body_camera)
        self._times: list[int] = []  # ends of steps; the first is the start of the chain
        self._poses: list[gtsam.Pose3] = []  # camera in the chain's own frame, at those times
        self._measured: list[gtsam.Pose3] = []  # the same, nothing bridged
        self._covariances: list[Array | None] = []  # of the step that ends there
        self._unseen: list[Array] = []  # (6,) what the body may have done unseen in that step [rad, m]
        self._failures = FailureFilter(noise, is_visual=noise.scene_depth > 0.0)

    @property
    def start(self) -> int | None:
        """First time it knows [ns]."""
        return self._times[0] if self._times else None

    @property
    def end(self) -> int | None:
        """Last time it knows [ns]."""
        return self._times[-1] if self._times else None

    def add(self, motion: RelativeMotion) -> str:
        """Append a motion of the body.

        Returns what was wrong and is bridged: "odometry_gap", "odometry_implausible", or "".

        Raises:
            InvalidMeasurement: "not_finite", "covariance", "time_backwards" or "overlap".
        """
        if not np.isfinite(motion.T_start_end).all():
            raise InvalidMeasurement("not_finite", f"motion ending at {motion.end} ns is not finite")
        if motion.end <= motion.start:
            raise InvalidMeasurement("time_backwards", f"motion from {motion.start} to {motion.end} ns ends first")
        covariance = motion.covariance
        if covariance is not None:
            if not np.isfinite(covariance).all() or np.linalg.eigvalsh(covariance)[0] <= 0.0:
                raise InvalidMeasurement("covariance", f"covariance at {motion.end} ns is not positive definite")
            to_camera = self._extrinsic.inverse().AdjointMap()
            covariance = to_camera @ covariance @ to_camera.T
        if not self._times:
            self._append(motion.start, gtsam.Pose3(), gtsam.Pose3(), None, np.zeros(6))
        last = self._times[-1]
        if motion.start < last:
            raise InvalidMeasurement(
                "overlap",
                f"motion from {motion.start} to {motion.end} ns starts before {last} ns, the last one's end",
            )
        problem = ""
        if motion.start > last:
            problem = "odometry_gap"
            gap = (motion.start - last) / SECOND
            moved = np.full(6, self.UNSEEN_MOTION * gap)
            self._append(motion.start, gtsam.Pose3(), gtsam.Pose3(), np.zeros((6, 6)), moved)
            self._failures.unseen(gap)
        seconds = (motion.end - motion.start) / SECOND
        measured = self._extrinsic.inverse() * gtsam.Pose3(motion.T_start_end) * self._extrinsic
        believed = self._failures.believe(gtsam.Pose3.Logmap(measured) / seconds, seconds, covariance)
        step = gtsam.Pose3.Expmap(believed.velocity * seconds) if believed.variance.any() else measured
        closed, unseen = None, np.sqrt(believed.variance)
        if covariance is not None:
            closed = self._closed(covariance, seconds)
            is_open = np.diag(covariance) > self.OPEN**2
            unseen = np.where(is_open, np.minimum(unseen, self.UNSEEN_MOTION), unseen)
        self._append(motion.end, step, measured, closed, unseen * seconds)
        return "odometry_implausible" if believed.failed > 0.5 else problem

    def _closed(self, covariance: Array, seconds: float) -> Array:
        """A covariance (6, 6) with the directions that odometry leaves open bounded by what a body does unseen.

        A robot in a plane states variances of 1e6 and more for height, roll and pitch. Taken at their word they let
        the estimate fall into solutions upside down.
        """
        if np.diag(covariance).max() <= self.OPEN**2:
            return covariance
        variances, axes = np.linalg.eigh(covariance)
        unseen = (self.UNSEEN_MOTION * max(seconds, self.SHORTEST)) ** 2
        return np.asarray(
            (axes * np.where(variances > self.OPEN**2, np.minimum(variances, unseen), variances)) @ axes.T
        )

    def motion(self, start: int, end: int) -> Array:
        """(4, 4) of the camera from start to end [ns], which must lie inside the chain."""
        return np.asarray(self._pose_at(start, self._poses).between(self._pose_at(end, self._poses)).matrix())

    def between(self, start: int, end: int) -> tuple[Array, Array]:
        """`motion` and its covariance (6, 6) [rotation, translation]."""
        first, last = self._pose_at(start, self._poses), self._pose_at(end, self._poses)
        motion = first.between(last)
        covariance, unseen, unknown = np.zeros((6, 6)), np.zeros(6), False
        for i in range(bisect_right(self._times, start), len(self._times)):
            begin, finish = max(start, self._times[i - 1]), min(end, self._times[i])
            if begin >= end:
                break
            share = (finish - begin) / (self._times[i] - self._times[i - 1])
            unseen += share * self._unseen[i]  # of one wrong velocity, hence not in squares
            known = self._covariances[i]
            if known is None:
                unknown = True
            else:
                to_end = last.inverse().compose(self._pose_at(finish, self._poses)).AdjointMap()
                covariance += to_end @ (share * known) @ to_end.T
        if unknown:
            covariance = self._noise.covariance(motion.matrix())
        return motion.matrix(), covariance + np.diag(unseen**2)

    def forget_before(self, time: int) -> None:
        """Drop what is not needed to read times from `time` [ns] on."""
        keep = max(bisect_right(self._times, time) - 1, 0)
        del self._times[:keep], self._poses[:keep], self._measured[:keep]
        del self._covariances[:keep], self._unseen[:keep]

    def measured(self, start: int, end: int) -> Array:
        """Motion (4, 4) of the camera from start to end [ns] as odometry said, possible or not."""
        return np.asarray(self._pose_at(start, self._measured).between(self._pose_at(end, self._measured)).matrix())

    def drifts(self, start: int, end: int) -> float:
        """How long [s] the motion from start to end [ns] drifts: all the time if its covariance is not known."""
        steps = range(bisect_right(self._times, start), bisect_right(self._times, end - 1) + 1)
        unknown = any(self._covariances[i] is None for i in steps if i < len(self._times))
        return (end - start) / SECOND if unknown else 0.0

    def _append(
        self, time: int, step: gtsam.Pose3, measured: gtsam.Pose3, covariance: Array | None, unseen: Array
    ) -> None:
        self._times.append(time)
        self._poses.append(self._poses[-1] * step if self._poses else step)
        self._measured.append(self._measured[-1] * measured if self._measured else measured)
        self._covariances.append(covariance)
        self._unseen.append(unseen)

    def _pose_at(self, time: int, poses: list[gtsam.Pose3]) -> gtsam.Pose3:
        i = bisect_right(self._times, time) - 1
        if i == len(self._times) - 1:
            return poses[i]
        share = (time - self._times[i]) / (self._times[i + 1] - self._times[i])
        step = gtsam.Pose3.Logmap(poses[i].between(poses[i + 1]))
        return poses[i].compose(gtsam.Pose3.Expmap(share * step))
