"""Where a camera begins in a map that is known."""

from __future__ import annotations

import gtsam
import numpy as np

from calibslam_backend.association.assignments import Frame
from calibslam_backend.association.data_association import DataAssociation
from calibslam_backend.association.relocalisation import Relocalised
from calibslam_backend.odometry.motion_chain import MotionChain
from calibslam_msgs_py.measurements import SECOND, Array


class MapSearch:
    """Places a camera where it is said to be, or by what it sees, once two images agree."""

    SIGHTINGS_APART = SECOND // 5
    SIGHTINGS_AGREE = 0.2  # [rad, m]

    def __init__(self, objects: DataAssociation, motions: MotionChain) -> None:
        self._objects, self._motions = objects, motions
        self._searching = False
        self._said: tuple[Array, float] | None = None  # where it is said to be, and how far off that may be
        self._sighting: tuple[int, Array] | None = None  # where it was seen last

    @property
    def needed(self) -> bool:
        """Whether the next image has to be placed before anything is estimated."""
        return self._searching or self._said is not None

    def search(self) -> None:
        """The camera may be anywhere."""
        self._searching = True

    def expect(self, T_map_camera: Array, error: float) -> None:
        """The camera is said to be at this pose (4, 4), within `error` [rad, m]."""
        self._said = T_map_camera, error

    def place(self, stamp: int, frame: Frame) -> Relocalised | None:
        """Where the camera of an image of this time [ns] is; None: not known yet."""
        found = self._objects.find(frame)
        if self._said is not None:
            (T, error), self._said = self._said, None
            result: Relocalised | None = Relocalised(T, [])
            if found is not None and _difference(T, found.T_map_camera) < error:
                result = found
        else:
            result = self._confirmed(stamp, found)
        if result is not None:
            self._searching = False
        return result

    def _confirmed(self, stamp: int, found: Relocalised | None) -> Relocalised | None:
        """What was found, if an image before was found where odometry says that the camera then was."""
        before = self._sighting
        if found is None or (before is not None and stamp - before[0] < self.SIGHTINGS_APART):
            return None
        self._sighting = stamp, found.T_map_camera
        motion = np.eye(4) if before is None else self._motions.motion(before[0], stamp)
        self._motions.forget_before(stamp)
        if before is None or _difference(before[1] @ motion, found.T_map_camera) > self.SIGHTINGS_AGREE:
            return None
        return found


def _difference(a: Array, b: Array) -> float:
    """Largest component [rad, m] of the motion from pose a (4, 4) to pose b."""
    return float(np.abs(gtsam.Pose3(a).localCoordinates(gtsam.Pose3(b))).max())
