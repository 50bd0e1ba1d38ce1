"""Counts and times of an estimator at work."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Sequence

from calibslam_backend.estimator import Estimator
from calibslam_backend.keyframe import Keyframe
from calibslam_backend.session.intake import Report
from calibslam_msgs_py.measurements import InvalidMeasurement

WINDOW = 1000  # that statistics are of
# What an estimator leaves out where all is well: second boxes of an object, and boxes that do not fit.
USUALLY_LEFT_OUT = ("rejected_double_box", "rejected_misfit")
# What else, in words.
LEFT_OUT = {
    "rejected_before_odometry": "images from before the first motion",
    "rejected_no_identity": "boxes without identity, and association is given",
}


class Tally:
    """What an estimator counts, told as it grows, and what its last keyframes took.

    Attributes:
        update_ms: of updates.
        between_ms: the longest of the images before each, which are no keyframes.
        delay_ms: from the arrival of the boxes to the end of their update.
        nis: normalised innovations squared, see `innovation`.
    """

    def __init__(self, report: Report) -> None:
        self._report = report
        self._counts: Counter[str] = Counter()
        self._told: Counter[str] = Counter()
        self.update_ms: deque[float] = deque(maxlen=WINDOW)
        self.between_ms: deque[float] = deque(maxlen=WINDOW)
        self.delay_ms: deque[float] = deque(maxlen=WINDOW)
        self.nis: deque[float] = deque(maxlen=WINDOW)

    def tell(self, estimator: Estimator) -> None:
        """Report what its counts have grown by. One that was reset counts from zero: call this before, too."""
        if estimator.counts is not self._counts:
            self._counts, self._told = estimator.counts, Counter()
        for name, count in (self._counts - self._told).items():
            if name in LEFT_OUT:
                reason = name.removeprefix("rejected_")
                self._report.reject(InvalidMeasurement(reason, LEFT_OUT[name]), count)
            else:
                self._report.count(name, count)
        self._told = self._counts.copy()

    def keyframes(self, keyframes: Sequence[Keyframe], arrived: float) -> None:
        """New ones, of a measurement that came at a time (monotonic [s]; 0: long ago)."""
        for keyframe in keyframes:
            self.nis.extend(keyframe.nis)
            self.update_ms.append(keyframe.seconds * 1e3)
            self.between_ms.append(keyframe.between * 1e3)
            if arrived:
                self.delay_ms.append((time.monotonic() - arrived) * 1e3)
            if keyframe.repaired:
                self._report.say(f"repaired: {keyframe.repaired}")
        self._report.count("keyframes", len(keyframes))
