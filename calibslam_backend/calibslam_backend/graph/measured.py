"""What the graph is told and keeps: motions, and of each quadric its boxes."""

from __future__ import annotations

from dataclasses import dataclass, field

from calibslam_backend.geometry.box_measurement import BoxMeasurement
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


@dataclass
class Landmark:
    """What the graph knows of a quadric.

    Attributes:
        born: keyframe.
        prior: (9, 9) covariance.
        boxes: by keyframe.
        linearised: for each box the vector (9,) of the quadric at which it was linearised last, and what it was worth.
        residuals: (4,) of each box there.
    """

    born: int
    prior: Array
    boxes: dict[int, BoxMeasurement] = field(default_factory=dict)
    linearised: dict[int, tuple[Array, float]] = field(default_factory=dict)
    residuals: dict[int, Array] = field(default_factory=dict)
