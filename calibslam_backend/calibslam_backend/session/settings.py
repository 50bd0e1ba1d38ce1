"""How measurements are taken in, and what is believed of their times."""

from __future__ import annotations

from dataclasses import dataclass

from calibslam_backend.session.time_guard import TimeSettings
from calibslam_msgs_py.settings import setting


@dataclass(frozen=True)
class SessionSettings(TimeSettings):
    """Settings of a live session."""

    refine_after: float = setting(1.0, "wall time without measurements after which all is refined", unit="s", low=0.1)
    queue_size: int = setting(
        10_000, "measurements that may wait; beyond, images are dropped, beyond twice as many motions too", low=10
    )
    images_without_odometry: int = setting(
        1000, "images that may wait for odometry; the latest ones beyond are dropped", low=1
    )
    max_keyframes: int = setting(
        5000,
        "of a trajectory, which bounds memory and time; then a new one begins where it ends, in the map there is",
        low=10,
    )
