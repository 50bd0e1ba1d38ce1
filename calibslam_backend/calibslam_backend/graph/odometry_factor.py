"""The factor between consecutive poses: what odometry measured, its gross failures and its drift.

Frame-to-frame odometry does not err by chance alone: what the scene and the sensor do to one step they do to the
next. Over a loop the part that stays the same outweighs the part that averages out, and no covariance of single
motions can say so. As with the biases of inertial sensors, the constant part is a variable of the graph: the drift d,
a velocity (6,) [rad/s, m/s] in the camera, with a prior around zero. Objects seen again tell it. Odometry that comes
with a covariance is taken at its word and has no drift.
"""

from __future__ import annotations

import gtsam
import numpy as np

from calibslam_backend.graph.robust import robust_scales
from calibslam_msgs_py.measurements import Array

DRIFT = 6  # dimension


def motion_factor(
    start: int, end: int, drift: int, motion: Array, covariance: Array, drifts: float, robust_scale: float
) -> gtsam.CustomFactor:
    """r = Log(M^-1 T_start^-1 T_end) - drifts * d, [rotation, translation] in the camera at the end.

    Args:
        start, end: keys of two Pose3, T_map_camera.
        drift: key of a (6,) vector d [rad/s, m/s]; no variable of the factor if `drifts` is 0.
        motion: (4, 4) M, the camera at the end in the camera at the start, as odometry measured it.
        covariance: (6, 6) of r.
        drifts: how long the motion drifts [s].
        robust_scale: Mahalanobis distance beyond which it is doubted, see `robust`.
    """
    measured = gtsam.Pose3(motion)
    whitener = np.linalg.inv(np.linalg.cholesky(covariance))
    by_drift = -drifts * whitener

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
        moved = values.atPose3(start).between(values.atPose3(end))
        wrong = measured.between(moved)
        r = whitener @ gtsam.Pose3.Logmap(wrong)
        if drifts:
            r += by_drift @ values.atVector(drift)
        for_error, for_linearisation = robust_scales(r @ r, robust_scale)
        if H is None:
            return np.asarray(for_error * r)
        J = for_linearisation * (whitener @ gtsam.Pose3.LogmapDerivative(wrong))
        H[0], H[1] = -J @ moved.inverse().AdjointMap(), J
        if drifts:
            H[2] = for_linearisation * by_drift
        return np.asarray(for_linearisation * r)

    keys = [start, end, drift] if drifts else [start, end]
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(DRIFT), keys, error)
