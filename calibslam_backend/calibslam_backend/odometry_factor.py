"""The factor between consecutive poses, for odometry whose error has a constant part.

Frame-to-frame odometry does not err by chance alone: what the scene and the sensor do to one step they do to the
next. Over a loop the part that stays the same outweighs the part that averages out, and no covariance of single
motions can say so. As with the biases of inertial sensors, the constant part is a variable of the graph: the drift d,
a velocity (6,) [rad/s, m/s] in the camera, with a prior around zero. Objects seen again tell it.
"""

from __future__ import annotations

import gtsam
import numpy as np

from calibslam_msgs_py.measurements import Array

DRIFT = 6  # dimension


def drifting_motion_factor(
    start: int, end: int, drift: int, motion: Array, seconds: float, noise: gtsam.noiseModel.Base
) -> gtsam.CustomFactor:
    """r = Log(M^-1 T_start^-1 T_end) - seconds * d, [rotation, translation] in the camera at the end.

    Args:
        start, end: keys of two Pose3, T_map_camera.
        drift: key of a (6,) vector, the drift [rad/s, m/s].
        motion: (4, 4) M, the camera at the end in the camera at the start, as odometry measured it.
        seconds: duration of the motion.
        noise: of the six errors.
    """
    measured = gtsam.Pose3(motion)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
        moved = values.atPose3(start).between(values.atPose3(end))
        wrong = measured.between(moved)
        if H is not None:
            H[1] = gtsam.Pose3.LogmapDerivative(wrong)
            H[0] = -H[1] @ moved.inverse().AdjointMap()
            H[2] = -seconds * np.eye(DRIFT)
        return np.asarray(gtsam.Pose3.Logmap(wrong) - seconds * values.atVector(drift))

    return gtsam.CustomFactor(noise, [start, end, drift], error)
