"""What a keyframe brought, for whoever publishes or writes it."""

from __future__ import annotations

from dataclasses import dataclass

from calibslam_msgs_py.measurements import Array


@dataclass(frozen=True)
class Keyframe:
    """What one keyframe brought.

    Attributes:
        index: its number, from 0.
        stamp: of its image [ns].
        T_map_camera: (4, 4) as known right after it.
        boxes: boxes that were given to quadrics.
        added, removed: ids of quadrics, since the keyframe before.
        repaired: what had to be repaired since the keyframe before; "" if nothing.
        seconds: that it took.
        between: the longest [s] that an image since the keyframe before took, which is none itself.
        nis: normalised innovations squared of its boxes, see `innovation`; empty for most keyframes.
    """

    index: int
    stamp: int
    T_map_camera: Array
    boxes: int
    added: list[int]
    removed: list[int]
    repaired: str
    seconds: float
    between: float
    nis: Array
