"""Relative motions from odometry: differences of its poses, and the chain of them that can be read at any time."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import gtsam
import numpy as np

from calibslam_backend.geometry.transform import on_the_way
from calibslam_backend.odometry.failures import FailureFilter
from calibslam_backend.odometry.motion_noise import MotionNoise
from calibslam_msgs_py.measurements import SECOND, Array, InvalidMeasurement, RelativeMotion


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


@dataclass(frozen=True)
class _Step:
    """One motion of a chain.

    Attributes:
        end: time [ns]; it starts where the one before ends.
        pose: of the camera at its end, in the chain's own frame.
        measured: the same, nothing bridged.
        covariance: (6, 6) of the motion, in the camera at its end.
        unseen: (6,) what the body may have done unseen besides [rad, m].
        drifts: how long [s] odometry's constant drift acts in it.
    """

    end: int
    pose: gtsam.Pose3
    measured: gtsam.Pose3
    covariance: Array
    unseen: Array
    drifts: float


class MotionChain:
    """Consecutive relative motions of the camera, readable between any two times.

    Times inside a step are interpolated along the geodesic, its covariance in proportion.

    Where odometry fails the body is taken to go on as it did, and to do unseen what it may, see `odometry_failures`.
    """

    # What a body may do unseen, while odometry is missing or where it leaves a direction open: 1 rad/s and 1 m/s.
    UNSEEN_MOTION = 1.0
    # A standard deviation [rad, m] of one step that says: not measured.
    OPEN = 1.0
    # One that says it as well as any larger one, and beside which those of other directions are more than rounding.
    LARGEST = 1e3
    # Steps that are kept, as many as no camera needs: if no image comes, the older half of them is joined in tens.
    MOST, JOINED = 10_000, 10
    SHORTEST = 0.03  # [s]: a shorter step leaves no less open

    def __init__(self, noise: MotionNoise, T_body_camera: Array) -> None:
        self._noise = noise
        self._extrinsic = gtsam.Pose3(T_body_camera)
        self._steps: list[_Step] = []  # the first, of no duration, is the start of the chain
        self._failures = FailureFilter(noise, is_visual=noise.scene_depth > 0.0)

    @property
    def start(self) -> int | None:
        """First time it knows [ns]."""
        return self._steps[0].end if self._steps else None

    @property
    def end(self) -> int | None:
        """Last time it knows [ns]."""
        return self._steps[-1].end if self._steps else None

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
        if covariance is not None and (not np.isfinite(covariance).all() or np.linalg.eigvalsh(covariance)[0] <= 0.0):
            raise InvalidMeasurement("covariance", f"covariance at {motion.end} ns is not positive definite")
        last = self.end
        if last is None:
            last = motion.start
            self._stay(last, 0.0)
        if motion.start < last:
            raise InvalidMeasurement(
                "overlap",
                f"motion from {motion.start} to {motion.end} ns starts before {last} ns, the last one's end",
            )
        problem = ""
        if motion.start > last:
            problem = "odometry_gap"
            gap = (motion.start - last) / SECOND
            self._stay(motion.start, self.UNSEEN_MOTION * gap)
            self._failures.unseen(gap)
        seconds = (motion.end - motion.start) / SECOND
        measured = self._extrinsic.inverse() * gtsam.Pose3(motion.T_start_end) * self._extrinsic
        stated = None if covariance is None else self._in_camera(covariance)
        believed = self._failures.believe(gtsam.Pose3.Logmap(measured) / seconds, seconds, stated)
        step = gtsam.Pose3.Expmap(believed.velocity * seconds) if believed.variance.any() else measured
        unseen = np.sqrt(believed.variance)
        if covariance is None or stated is None:
            noise = self._noise.covariance(believed.velocity, seconds)
        else:
            # Closed as it is stated: in another frame, an open direction's rounding is larger than what others are.
            noise = self._in_camera(self._closed(covariance, seconds))
            is_open = np.diag(stated) > self.OPEN**2
            unseen = np.where(is_open, np.minimum(unseen, self.UNSEEN_MOTION), unseen)
        before = self._steps[-1]
        self._steps.append(
            _Step(
                motion.end,
                before.pose * step,
                before.measured * measured,
                noise,
                unseen * seconds,
                drifts=seconds if covariance is None else 0.0,
            )
        )
        if len(self._steps) > self.MOST:
            self._join_older()
        return "odometry_implausible" if believed.failed > 0.5 else problem

    def _in_camera(self, covariance: Array) -> Array:
        """(6, 6) of a motion of the body, at its end, as one of the camera."""
        to_camera = self._extrinsic.inverse().AdjointMap()
        return np.asarray(to_camera @ covariance @ to_camera.T)

    def _closed(self, covariance: Array, seconds: float) -> Array:
        """A covariance (6, 6) with the directions that odometry leaves open bounded by what a body does unseen.

        A robot in a plane states variances of 1e6 and more for height, roll and pitch. Taken at their word they let
        the estimate fall into solutions upside down.
        """
        if np.diag(covariance).max() <= self.OPEN**2:
            return covariance
        scale = np.minimum(self.LARGEST / np.sqrt(np.diag(covariance)), 1.0)
        variances, axes = np.linalg.eigh(scale[:, None] * covariance * scale)
        unseen = (self.UNSEEN_MOTION * max(seconds, self.SHORTEST)) ** 2
        return np.asarray(
            (axes * np.where(variances > self.OPEN**2, np.minimum(variances, unseen), variances)) @ axes.T
        )

    def _stay(self, time: int, unseen: float) -> None:
        """Nothing is measured up to this time, and the body may do so much [rad, m]."""
        origin = gtsam.Pose3()
        pose, measured = (self._steps[-1].pose, self._steps[-1].measured) if self._steps else (origin, origin)
        self._steps.append(_Step(time, pose, measured, np.zeros((6, 6)), np.full(6, unseen), drifts=0.0))

    def motion(self, start: int, end: int) -> Array:
        """(4, 4) of the camera from start to end [ns], which must lie inside the chain."""
        return np.asarray(self._pose_at(start).between(self._pose_at(end)).matrix())

    def between(self, start: int, end: int) -> tuple[Array, Array]:
        """`motion` and its covariance (6, 6) [rotation, translation]."""
        first, last = self._pose_at(start), self._pose_at(end)
        covariance, unseen = self._uncertainty(start, end)
        return np.asarray(first.between(last).matrix()), covariance + np.diag(unseen**2)

    def _uncertainty(self, start: int, end: int) -> tuple[Array, Array]:
        """Of the motion between two times [ns]: its covariance (6, 6), and what the body may have done unseen (6,)."""
        last = self._pose_at(end)
        covariance, unseen = np.zeros((6, 6)), np.zeros(6)
        for step, share in self._inside(start, end):
            unseen += share * step.unseen  # of one wrong velocity, hence not in squares
            to_end = last.between(self._pose_at(min(end, step.end))).AdjointMap()
            covariance += to_end @ (share * step.covariance) @ to_end.T
        return covariance, unseen

    def measured(self, start: int, end: int) -> Array:
        """Motion (4, 4) of the camera from start to end [ns] as odometry said, possible or not."""
        return np.asarray(self._pose_at(start, "measured").between(self._pose_at(end, "measured")).matrix())

    def drifts(self, start: int, end: int) -> float:
        """How long [s] the motion from start to end [ns] drifts: in steps whose covariance is not known."""
        return sum(share * step.drifts for step, share in self._inside(start, end))

    def forget_before(self, time: int) -> None:
        """Drop what is not needed to read times from `time` [ns] on."""
        del self._steps[: max(self._after(time) - 1, 0)]

    def _after(self, time: int) -> int:
        """Which is the first step that ends after this time."""
        return bisect_right(self._steps, time, key=lambda step: step.end)

    def _join_older(self) -> None:
        """A motion between times that stay is the same as before."""
        joined = [self._steps[0]]
        for i in range(self.JOINED, self.MOST // 2, self.JOINED):
            last, start = self._steps[i], joined[-1].end
            noise, unseen = self._uncertainty(start, last.end)
            joined.append(_Step(last.end, last.pose, last.measured, noise, unseen, self.drifts(start, last.end)))
        self._steps[: i + 1] = joined

    def _inside(self, start: int, end: int) -> Iterator[tuple[_Step, float]]:
        """The steps between two times [ns], and the share of each that lies between them."""
        for i in range(max(self._after(start), 1), len(self._steps)):
            before, step = self._steps[i - 1 : i + 1]
            duration = min(end, step.end) - max(start, before.end)
            if duration <= 0:
                return
            yield step, duration / (step.end - before.end)

    def _pose_at(self, time: int, which: str = "pose") -> gtsam.Pose3:
        i = self._after(time) - 1
        pose: gtsam.Pose3 = getattr(self._steps[i], which)
        if i == len(self._steps) - 1:
            return pose
        before, after = self._steps[i : i + 2]
        return on_the_way(pose, getattr(after, which), (time - before.end) / (after.end - before.end))
