"""What the graph is told and keeps: motions, and of each quadric its boxes."""

from __future__ import annotations

from dataclasses import dataclass, field

import gtsam
import numpy as np

from calibslam_backend.geometry.box_measurement import BoxMeasurement
from calibslam_backend.graph.known import Known
from calibslam_msgs_py.measurements import Array


@dataclass(frozen=True)
class Motion:
    """Between consecutive poses.

    Attributes:
        T: (4, 4), failures of odometry bridged.
        covariance: (6, 6) of it.
        drifts: time [s] during which it drifts.
        measured: (4, 4) as odometry said.
    """

    T: Array
    covariance: Array
    drifts: float
    measured: Array

    def carried(self, covariance: Array) -> Array:
        """(15, 15) of a pose and a quadric -> (15, 15) of the pose to which the motion leads from there, and of it."""
        # An error of a pose is told in its body; from the next one it looks different: a turn there is a shift here.
        to_end = np.eye(15)
        to_end[:6, :6] = gtsam.Pose3(self.T).inverse().AdjointMap()
        after = to_end @ covariance @ to_end.T
        after[:6, :6] += self.covariance
        return np.asarray(after)


@dataclass
class Landmark:
    """What the graph knows of a quadric.

    Attributes:
        born: keyframe.
        prior: what was known of it to begin with.
        boxes: by keyframe.
        linearised: for each box the vector (9,) of the quadric at which it was linearised last, and what it was worth.
        residuals: (4,) of each box there.
    """

    born: int
    prior: Known
    boxes: dict[int, BoxMeasurement] = field(default_factory=dict)
    linearised: dict[int, tuple[Array, float]] = field(default_factory=dict)
    residuals: dict[int, Array] = field(default_factory=dict)
