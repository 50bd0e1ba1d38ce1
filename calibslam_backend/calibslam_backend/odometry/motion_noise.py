"""What is believed of odometry that states no covariance: how wrong each of its steps is.

Frame-to-frame odometry errs anew in each step, the more the faster the body moves: blur, a rolling shutter, fewer
points that are found again. So its errors are white, and their variance grows with time, by

    floor^2 + (share * velocity)^2

in each second. Two motions of the same length are not known equally well: the slower one is the sum of more steps,
whose errors cancel more. A share of the whole motion, however long it took, would take slow odometry for worse than it
is and fast odometry for better (docs/method.md). What does not cancel is the constant drift, which the graph estimates
(see `odometry_factor`).

A camera that turns a little to the right sees nearly what one sees that moves a little to the right. Visual odometry
hardly tells the two apart, and takes a part of one for the other; what it sees stays where it is in the image. So it
knows well how the scene moves before the camera, and its errors of rotation turn the camera about the scene. On real
recordings its errors of sideways translation and of rotation correlate by 0.78 to 0.98. A turn about the optical axis,
which moves the image as no translation does, it knows better.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from calibslam_backend.odometry.failures import FailureSettings
from calibslam_msgs_py.measurements import Array
from calibslam_msgs_py.settings import setting


@dataclass(frozen=True)
class MotionNoise(FailureSettings):
    """Standard deviations after one second of a motion whose covariance is unknown, sqrt(floor^2 + (share *
    velocity)^2), and those of the drift that all such motions share. Both are of errors that are independent of each
    other at the scene, `scene_depth` in front of the camera on its optical axis. (`FailureSettings` say which motions
    are none.)"""

    rotation_floor: float = setting(
        0.005, "unknown odometry noise: rotation, after one second at rest", unit="rad/sqrt(s)", low=1e-6
    )
    rotation_share: float = setting(
        0.036,
        "unknown odometry noise: share of the rotation, after one second of steady turning",
        unit="sqrt(s)",
        low=0.0,
        high=1.0,
    )
    roll_share: float = setting(
        0.6, "unknown odometry noise: of rotation about the optical axis, as share of that about others", low=0.01
    )
    translation_floor: float = setting(
        0.004, "unknown odometry noise: translation, after one second at rest", unit="m/sqrt(s)", low=1e-6
    )
    translation_share: float = setting(
        0.018,
        "unknown odometry noise: share of the translation, after one second of steady motion",
        unit="sqrt(s)",
        low=0.0,
        high=1.0,
    )
    scene_depth: float = setting(
        1.0, "unknown odometry noise: how far away is what it sees; 0 if it is not visual", unit="m", low=0.0
    )
    drift_rotation: float = setting(0.003, "unknown odometry noise: constant drift in rotation", unit="rad/s", low=1e-9)
    drift_translation: float = setting(
        0.003, "unknown odometry noise: constant drift in translation", unit="m/s", low=1e-9
    )

    def covariance(self, velocity: Array, seconds: float) -> Array:
        """(6, 6) [rotation, translation] of a step of the camera with this velocity (6,) [rad/s, m/s], at its end."""
        rotation = np.hypot(self.rotation_floor, self.rotation_share * np.linalg.norm(velocity[:3]))
        translation = np.hypot(self.translation_floor, self.translation_share * np.linalg.norm(velocity[3:]))
        rates = np.array([rotation, rotation, self.roll_share * rotation, translation, translation, translation])
        return self._about_scene(np.sqrt(seconds) * rates)

    def drift_covariance(self) -> Array:
        """(6, 6) of the constant drift [rad/s, m/s]."""
        return self._about_scene(np.repeat([self.drift_rotation, self.drift_translation], 3))

    def _about_scene(self, deviations: Array) -> Array:
        """(6, 6) in the camera, of errors that are independent, with deviations (6,), in a frame at the scene."""
        T_camera_scene = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, self.scene_depth]))
        square_root = T_camera_scene.AdjointMap() * deviations
        return np.asarray(square_root @ square_root.T)
