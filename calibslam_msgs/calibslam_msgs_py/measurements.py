"""What the algorithms of CalibSLAM exchange, as plain data: numpy inside, no ROS.

Conventions: SI units, radians, pixels; time is integer nanoseconds; `T_a_b` maps coordinates of frame b to
frame a. An image covers 0 to its width and 0 to its height [px]: centres of pixels lie at halves. A 6x6 covariance
here is that of GTSAM's Pose3 tangent, [rotation, translation] in the body frame; `calibslam_msgs_py.conversions` turns
it into the ROS order and back.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SECOND = 1_000_000_000  # [ns]


class InvalidMeasurement(ValueError):
    """A measurement that must not enter the estimate; `reason` is a short name to count by."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with plumb_bob distortion.

    Attributes:
        width, height: image size [px].
        K: (3, 3) camera matrix [px].
        distortion: (5,) k1 k2 p1 p2 k3; zeros for a rectified image.
        frame_id: name of the optical frame (x right, y down, z forward).
    """

    width: int
    height: int
    K: Array
    distortion: Array
    frame_id: str = "camera"


@dataclass(frozen=True)
class Boxes:
    """All boxes of one image.

    Attributes:
        stamp: of the image [ns].
        width, height: image size [px].
        corners: (N, 4) xmin ymin xmax ymax [px].
        covariances: (N, 4, 4) of the corners [px^2]; a box of unknown covariance holds NaN throughout.
        class_ids: N class names or numbers, as the detector calls them.
        scores: (N,) in [0, 1].
        object_ids: N identities, "" where unknown.
        frame_id: camera optical frame.
    """

    stamp: int
    width: int
    height: int
    corners: Array
    covariances: Array
    class_ids: tuple[str, ...]
    scores: Array
    object_ids: tuple[str, ...]
    frame_id: str = "camera"

    def __len__(self) -> int:
        return len(self.corners)

    @property
    def has_covariance(self) -> NDArray[np.bool_]:
        """(N,) whether the covariance of a box is known."""
        return ~np.isnan(self.covariances[:, 0, 0])

    @property
    def to_border(self) -> Array:
        """(N, 4) how far the edges xmin ymin xmax ymax are inside the border of the image [px]."""
        return np.concatenate([self.corners[:, :2], [self.width, self.height] - self.corners[:, 2:]], axis=1)

    def select(self, indices: NDArray[np.int_]) -> Boxes:
        """The boxes with these indices, in this order."""
        return replace(
            self,
            corners=self.corners[indices],
            covariances=self.covariances[indices],
            class_ids=tuple(self.class_ids[i] for i in indices),
            scores=self.scores[indices],
            object_ids=tuple(self.object_ids[i] for i in indices),
        )


@dataclass(frozen=True)
class RelativeMotion:
    """A measured motion of a body between two times.

    Attributes:
        start, end: times [ns], start < end.
        T_start_end: (4, 4) pose of the body at end in the body at start.
        covariance: (6, 6) [rotation rad^2, translation m^2] in the body at end; None where unknown.
        frame_id: name of the moving body.
    """

    start: int
    end: int
    T_start_end: Array
    covariance: Array | None = None
    frame_id: str = "camera"


@dataclass(frozen=True)
class StampedPose:
    """Pose of a body in a fixed frame: `T` (4, 4) at `stamp` [ns]."""

    stamp: int
    T: Array


@dataclass(frozen=True)
class QuadricEstimate:
    """An ellipsoid with its uncertainty.

    Attributes:
        id: unique in a map.
        class_id: the class most of its boxes carry.
        T_map_object: (4, 4) centre and axes.
        radii: (3,) semi-axes [m].
        covariance: (9, 9) of [rotation, translation] (body tangent) and radii [m]; NaN where it is not known.
        observations: number of boxes it rests on.
    """

    id: int
    class_id: str
    T_map_object: Array
    radii: Array
    covariance: Array
    observations: int
