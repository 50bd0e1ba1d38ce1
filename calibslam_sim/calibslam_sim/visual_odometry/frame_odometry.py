"""RGB-D visual odometry: corners tracked by OpenCV, their depth, and the motion they tell with its covariance.

Corners of a reference image (Shi and Tomasi, 1994) are followed from image to image (pyramidal Lucas-Kanade, forwards
and back); the pose is found from their places in space (RANSAC, then robust least squares). A new reference begins when
too few are left. Rows are exposed one after the other: see `point_pose`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import gtsam
import numpy as np

from calibslam_msgs_py.measurements import SECOND, Array, Camera, InvalidMeasurement, RelativeMotion
from calibslam_msgs_py.settings import Settings, setting
from calibslam_sim.visual_odometry.point_pose import PointPose, Undetermined, moved, point_pose

QUALITY, SPACING = 0.005, 12  # of corners: share of the strongest, and least distance [px]
WINDOW, LEVELS = 15, 3  # of the tracker [px], and its pyramid beyond the image itself
RETURN_ERROR = 0.5  # how far from its start a corner may return when it is followed backwards [px]
RANSAC_ERROR, RANSAC_ITERATIONS = 3.0, 100  # [px]
SHUTTER_ITERATIONS = 2  # pose and velocity need each other
# Errors of neighbours are alike (blur, depth, lens): seen on fr1_xyz, all corners tell as much as one in 25 would.
CORRELATION = 5.0
FORGET = 0.2  # share of the newest change in the mean change of velocity
# What a camera may do unseen, in rad/s and m/s; with it ends every attempt to follow for `PATIENCE`.
UNSEEN_MOTION = 1.0
PATIENCE = 0.3  # [s]


@dataclass(frozen=True)
class VisualOdometrySettings(Settings):
    """Of visual odometry."""

    readout: float = setting(
        0.02, "time in which the camera exposes its rows one after the other; 0: global shutter", unit="s", low=0.0,
        high=0.1,
    )  # fmt: skip
    corners: int = setting(500, "corners to follow", low=50, high=5000)
    min_corners: int = setting(
        30, "fewest corners that must agree on a motion; with fewer the camera is lost", low=6, high=1000
    )
    keep: float = setting(
        0.6, "a new reference image is taken when a smaller share of its corners is still found", low=0.1, high=0.95
    )
    reference_images: int = setting(10, "images after which a new reference begins", low=1, high=1000)
    min_depth: float = setting(0.3, "nearest depth to believe", unit="m", low=0.0)
    max_depth: float = setting(5.0, "farthest depth to believe", unit="m", low=0.1)


@dataclass(frozen=True)
class Step:
    """A motion, and how it was found.

    Attributes:
        motion: since the step before, with its covariance.
        corners: that agree on it; 0 where it is bridged.
        sigma: standard deviation of their residuals [px].
        bridged: the camera was lost: the motion is that of before, its covariance what a camera may do unseen.
    """

    motion: RelativeMotion
    corners: int
    sigma: float
    bridged: bool = False


@dataclass
class _Reference:
    """Corners of one image: points (N, 3) in the camera as it was at their rows, lags (N,) of these [s], pixels (N, 2)
    in the last image, the number at the beginning, the camera's velocity then, its pose in the last image, age."""

    points: Array
    lags: Array
    pixels: np.ndarray
    begun_with: int
    velocity: Array
    T: Array
    age: int = 0


class VisualOdometry:
    """Motions of one camera; depth has to be registered to the image.

    Args:
        camera: of the images.
        settings: see there.
    """

    def __init__(self, camera: Camera, settings: VisualOdometrySettings) -> None:
        self._camera, self._settings = camera, settings
        self._focal = float(camera.K[0, 0])
        self._stamp: int | None = None
        self._grey = np.empty((0, 0), np.uint8)
        self._reference: _Reference | None = None
        self._velocity: Array | None = None  # of the last step [rad/s, m/s]
        self._change: Array | None = None  # mean square of its change from step to step

    def add(self, stamp: int, grey: np.ndarray, depth: np.ndarray) -> Step | None:
        """The motion since the last step; None for the first image, and while the camera may still be found again.

        Args:
            stamp: of the image [ns].
            grey: (H, W) uint8.
            depth: (H, W) float32 [m] along the view; 0 or not finite where unknown.

        Raises:
            InvalidMeasurement: `time_backwards` (then it begins anew), `duplicate`, `image_size`, `depth_size`.
        """
        shape = (self._camera.height, self._camera.width)
        if grey.shape != shape:
            raise InvalidMeasurement(
                "image_size", f"image of {grey.shape[::-1]} pixels, camera_info says {shape[::-1]}"
            )
        if depth.shape != shape:
            raise InvalidMeasurement(
                "depth_size", f"depth of {depth.shape[::-1]} pixels is not registered to an image of {shape[::-1]}"
            )
        last = self._stamp
        if stamp == last:
            raise InvalidMeasurement("duplicate", f"image at {stamp} ns came twice")
        if last is not None and stamp < last:
            self._begin(stamp, grey, depth, None)
            raise InvalidMeasurement("time_backwards", f"images jumped from {last} back to {stamp} ns")
        if last is None:
            self._begin(stamp, grey, depth, None)
            return None
        seconds = (stamp - last) / SECOND
        try:
            return self._follow(stamp, last, grey, depth)
        except Undetermined:
            # A dark or blurred image may be skipped: the next one is tried against the same reference.
            if seconds < PATIENCE and self._reference is not None:
                return None
        velocity = np.zeros(6) if self._velocity is None else self._velocity
        T = gtsam.Pose3.Expmap(velocity * seconds).matrix()
        covariance = np.eye(6) * (UNSEEN_MOTION * seconds) ** 2
        self._begin(stamp, grey, depth, None)
        return Step(RelativeMotion(last, stamp, T, covariance, self._camera.frame_id), 0, float("nan"), True)

    def _begin(self, stamp: int, grey: np.ndarray, depth: np.ndarray, velocity: Array | None) -> None:
        """Take this image as the reference; without a velocity it stands for a new beginning."""
        self._stamp, self._grey, self._velocity = stamp, grey, velocity
        self._reference = None
        found = cv2.goodFeaturesToTrack(grey, self._settings.corners, QUALITY, SPACING)
        if found is None:
            return
        pixels = found.reshape(-1, 2)
        column, row = np.rint(pixels).astype(int).T
        z = depth[np.minimum(row, depth.shape[0] - 1), np.minimum(column, depth.shape[1] - 1)]
        near = (z > self._settings.min_depth) & (z < self._settings.max_depth)  # NaN is not
        pixels, z = pixels[near], z[near].astype(np.float64)
        if len(pixels) < self._settings.min_corners:
            return
        points = np.column_stack([self._normalised(pixels), np.ones(len(z))]) * z[:, None]
        initial = np.zeros(6) if velocity is None else velocity
        self._reference = _Reference(points, self._lags(pixels), pixels, len(pixels), initial, np.eye(4))

    def _follow(self, stamp: int, last: int, grey: np.ndarray, depth: np.ndarray) -> Step:
        """Raises Undetermined where too few corners agree."""
        reference = self._reference
        if reference is None:
            raise Undetermined("no corners with depth")
        pixels, kept = self._track(reference.pixels, grey)
        pixels, points, lags = pixels[kept], reference.points[kept], reference.lags[kept]
        seen = self._normalised(pixels) if len(pixels) else np.empty((0, 2))
        guess, agreeing = self._ransac(points, seen)
        pixels, points, lags, seen = pixels[agreeing], points[agreeing], lags[agreeing], seen[agreeing]
        seconds = (stamp - last) / SECOND
        before, first = self._velocity, reference.age == 0
        then, now = reference.velocity, np.zeros(6) if before is None else before
        lags_now = self._lags(pixels)
        for _ in range(SHUTTER_ITERATIONS if self._settings.readout else 1):
            found = point_pose(moved(points, then, lags), seen, guess, self._focal, now, lags_now)
            guess = found.T
            T = np.linalg.inv(reference.T) @ found.T
            now = gtsam.Pose3.Logmap(gtsam.Pose3(T)) / seconds
            if first:  # the velocity in the middle of the reference is that between the steps around it
                then = now if before is None else (before + now) / 2.0
        inliers = found.inliers
        if inliers.sum() < self._settings.min_corners:
            raise Undetermined(f"{inliers.sum()} corners agree")
        covariance = self._covariance(found, now)
        motion = RelativeMotion(last, stamp, T, covariance, self._camera.frame_id)
        self._stamp, self._grey, self._velocity = stamp, grey, now
        if inliers.sum() < self._settings.keep * reference.begun_with or (
            reference.age + 1 >= self._settings.reference_images
        ):
            self._begin(stamp, grey, depth, now)
        else:
            self._reference = _Reference(
                points[inliers], lags[inliers], pixels[inliers], reference.begun_with, then, found.T, reference.age + 1
            )
        return Step(motion, int(inliers.sum()), found.sigma)

    def _covariance(self, found: PointPose, velocity: Array) -> Array:
        """(6, 6) of a step: two images err alike, by their pixels and by what the velocity changed within them."""
        change = velocity if self._velocity is None else velocity - self._velocity
        squares = np.repeat([(change[:3] ** 2).mean(), (change[3:] ** 2).mean()], 3)
        self._change = squares if self._change is None else (1.0 - FORGET) * self._change + FORGET * squares
        return 2.0 * found.covariance(CORRELATION * found.sigma, np.sqrt(self._change))

    def _track(self, pixels: np.ndarray, grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where corners (N, 2) of the last image are in this one, and (N,) whether they were found."""
        options: dict[str, Any] = {"winSize": (WINDOW, WINDOW), "maxLevel": LEVELS}
        there, found, _ = cv2.calcOpticalFlowPyrLK(self._grey, grey, pixels, None, **options)
        back, returned, _ = cv2.calcOpticalFlowPyrLK(grey, self._grey, there, None, **options)
        near = np.linalg.norm(back - pixels, axis=1) < RETURN_ERROR
        inside = ((there >= 0.0) & (there <= [grey.shape[1] - 1, grey.shape[0] - 1])).all(axis=1)
        return there, (found.ravel() > 0) & (returned.ravel() > 0) & near & inside

    def _ransac(self, points: Array, seen: Array) -> tuple[Array, np.ndarray]:
        """A first pose (4, 4) of the camera in the reference, and indices of the points that agree with it."""
        enough = self._settings.min_corners
        if len(points) < enough:
            raise Undetermined(f"{len(points)} corners are left")
        done, rotation, translation, agreeing = cv2.solvePnPRansac(
            points, seen, np.eye(3), None, iterationsCount=RANSAC_ITERATIONS, flags=cv2.SOLVEPNP_EPNP,
            reprojectionError=RANSAC_ERROR / self._focal,
        )  # fmt: skip
        if not done or agreeing is None or len(agreeing) < enough:
            raise Undetermined("the corners do not move as one")
        T_camera_reference = np.eye(4)
        T_camera_reference[:3, :3] = cv2.Rodrigues(rotation)[0]
        T_camera_reference[:3, 3] = translation.ravel()
        return np.asarray(np.linalg.inv(T_camera_reference), np.float64), agreeing.ravel()

    def _normalised(self, pixels: np.ndarray) -> Array:
        """Undistorted, normalised coordinates (N, 2) of pixels."""
        points = pixels.reshape(-1, 1, 2).astype(np.float64)
        return np.asarray(cv2.undistortPoints(points, self._camera.K, self._camera.distortion).reshape(-1, 2))

    def _lags(self, pixels: np.ndarray) -> Array:
        """(N,) when the rows of pixels are read, after the middle one [s]."""
        return np.asarray(self._settings.readout * (pixels[:, 1].astype(np.float64) / self._camera.height - 0.5))
