"""What becomes of measurements that come late, early, twice, or after time has jumped."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
import pytest

from calibslam_backend.session.time_guard import KEEP_MAP, REJECT, RESET, Measurement, TimeGuard, TimeSettings
from calibslam_msgs_py.measurements import SECOND, Boxes, InvalidMeasurement, RelativeMotion

RATE = 30


def stamp(k: float) -> int:
    """Of image k [ns]."""
    return 1000 * SECOND + round(k * SECOND / RATE)


def motion(k: float) -> RelativeMotion:
    """From image k - 1 to image k."""
    return RelativeMotion(stamp(k - 1), stamp(k), np.eye(4))


def boxes(k: float) -> Boxes:
    return Boxes(stamp(k), 640, 480, np.zeros((0, 4)), np.zeros((0, 4, 4)), (), np.zeros(0), ())


def names(measurements: Sequence[Measurement]) -> list[str]:
    """In words, to be compared."""
    return [f"{type(m).__name__} {m.stamp if isinstance(m, Boxes) else m.end}" for m in measurements]


class Guarded:
    """A guard, what it let through (see `names`), and what it rejected."""

    def __init__(self, time_jump: str = REJECT) -> None:
        self.rejected: Counter[str] = Counter()
        self.used: list[str] = []
        self.jumps = 0
        self.guard = TimeGuard(TimeSettings(time_jump=time_jump), self._reject)

    def _reject(self, error: InvalidMeasurement) -> None:
        self.rejected[error.reason] += 1

    def take(self, *measurements: Measurement) -> None:
        for measurement in measurements:
            present = self.guard.take(measurement)
            if present.jumped:
                self.jumps += 1
                self.used.clear()
            self.used += names(present.measurements)


def drive(start: int, end: int) -> list[Measurement]:
    """Motions and images from `start` to `end` - 1."""
    return [m for k in range(start, end) for m in (motion(k), boxes(k))]


@pytest.fixture
def guarded() -> Guarded:
    return Guarded()


def test_the_present_passes(guarded: Guarded) -> None:
    """Also what is a little late or twice, which the estimator judges, and images before any odometry."""
    content = [boxes(0), *drive(1, 50), motion(49), boxes(40), motion(45), *drive(50, 60)]
    guarded.take(*content)
    assert guarded.used == names(content) and not guarded.rejected


@pytest.mark.parametrize("wrong", [-3000, -60, 1000, 10**9])
def test_a_stray_motion_changes_nothing(guarded: Guarded, wrong: int) -> None:
    guarded.take(*drive(1, 40), motion(wrong), *drive(40, 60))
    assert guarded.used == names(drive(1, 60))
    assert guarded.rejected == {"time_jump": 1}


def test_a_motion_without_end(guarded: Guarded) -> None:
    """From now until long from now."""
    endless = RelativeMotion(stamp(39), stamp(10**9), np.eye(4))
    guarded.take(*drive(1, 40), endless, *drive(40, 60))
    assert guarded.used == names(drive(1, 60)) and guarded.rejected == {"time_jump": 1}


def test_an_image_far_ahead_does_not_move_time(guarded: Guarded) -> None:
    guarded.take(*drive(1, 40), boxes(10**9), *drive(40, 60))
    assert set(guarded.used) - set(names(drive(1, 60))) == set(names([boxes(10**9)]))  # it waits for its odometry


def test_odometry_that_pauses_is_gone_on_with(guarded: Guarded) -> None:
    """Short gaps at once; long ones when five motions agree, and nothing of them is lost."""
    guarded.take(*drive(1, 40), *drive(100, 110))
    assert guarded.used == names(drive(1, 40) + drive(100, 110))
    guarded.take(*drive(1000, 1004))
    assert guarded.used == names(drive(1, 40) + drive(100, 110))
    guarded.take(*drive(1004, 1020))
    assert guarded.used == names(drive(1, 40) + drive(100, 110) + drive(1000, 1020))
    assert not guarded.rejected and guarded.jumps == 0


def test_a_bag_that_loops_is_rejected_by_default(guarded: Guarded) -> None:
    guarded.take(*drive(1000, 1040), *drive(1, 40))
    # Some images pass between the motions that are held five at a time; the estimator finds them late.
    assert set(names(drive(1, 40))) & set(guarded.used) <= set(names([boxes(k) for k in range(1, 40)]))
    assert guarded.rejected["time_jump"] > 35 and guarded.jumps == 0
    guarded.guard.reset()
    guarded.take(*drive(1, 40))
    assert guarded.used[-78:] == names(drive(1, 40))


@pytest.mark.parametrize("time_jump", [RESET, KEEP_MAP])
def test_a_bag_that_loops_begins_again(time_jump: str) -> None:
    """With all that came after the jump."""
    guarded = Guarded(time_jump)
    guarded.take(*drive(1000, 1040), *drive(1, 40))
    assert guarded.jumps == 1 and not guarded.rejected
    assert guarded.used == names(drive(1, 40))


def test_a_first_motion_that_is_wrong(guarded: Guarded) -> None:
    """All others are then of another time; the guard changes its mind, whatever the setting."""
    guarded.take(motion(10**9), *drive(1, 40))
    assert guarded.jumps == 1 and guarded.used == names(drive(1, 40))


def test_what_is_sent_again_after_an_interruption(guarded: Guarded) -> None:
    guarded.take(*drive(1, 40), boxes(10**9))  # one wrong stamp, too
    guarded.guard.resumed()
    guarded.used.clear()
    guarded.take(*[boxes(k) for k in range(1, 45)], *[motion(k) for k in range(1, 45)])
    assert guarded.rejected == {"repeated": 78}
    assert guarded.used == names([boxes(k) for k in range(40, 45)] + [motion(k) for k in range(40, 45)])
    guarded.take(*drive(45, 50), boxes(44))  # later, what comes twice is the estimator's business
    assert guarded.rejected == {"repeated": 78}
