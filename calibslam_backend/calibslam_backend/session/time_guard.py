"""Which measurements are of the present: what comes twice, a clock that is wrong for a moment, a time that jumps.

One wrong stamp must not move the time of the estimator, which never goes back. So a motion far from the present is
held until a few more have gone on from it: then time has jumped, otherwise it was a stray one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from calibslam_msgs_py.measurements import SECOND, Boxes, InvalidMeasurement, RelativeMotion
from calibslam_msgs_py.settings import Settings, setting

REJECT, RESET, KEEP_MAP = "reject", "reset", "keep_map"
Measurement = Boxes | RelativeMotion


@dataclass(frozen=True)
class TimeSettings(Settings):
    """What is believed of stamps."""

    time_jump: str = setting(
        REJECT,
        "when time jumps back, as in a bag that is looped: reject what comes until ~/reset, reset by itself, or begin "
        "a new trajectory in the map there is",
        choices=(REJECT, RESET, KEEP_MAP),
    )
    largest_gap: float = setting(
        10.0,
        "longest gap of odometry that is bridged; what is farther ahead is believed once five motions agree",
        unit="s",
        low=0.1,
    )


@dataclass(frozen=True)
class Present:
    """What is to be used now, in this order; `jumped`: after time has jumped back."""

    measurements: list[Measurement]
    jumped: bool = False


NOTHING = Present([])


class TimeGuard:
    """Sorts out measurements by their stamps, before the estimator sees them."""

    LATE = SECOND  # what is older is of another time
    AGREE = 5  # motions, one going on from the other
    MOST_HELD = 1000  # measurements

    def __init__(self, settings: TimeSettings, reject: Callable[[InvalidMeasurement], None]) -> None:
        self._settings, self._reject = settings, reject
        self._gap = int(settings.largest_gap * SECOND)
        self.reset()

    def reset(self) -> None:
        """Forget the time: the next motion begins it."""
        self._now: int | None = None  # end of the last motion
        self._motions = 0  # since then
        self._newest: dict[type, int] = {}
        self._may_repeat: set[type] = set()
        self._held: list[Measurement] = []

    def resumed(self) -> None:
        """After an interruption: publishers may now send again what had been taken in before."""
        if self._now is not None:  # an image before all odometry may have had a wrong stamp
            self._newest = {kind: min(newest, self._now + self._gap) for kind, newest in self._newest.items()}
        self._may_repeat = set(self._newest)

    def take(self, measurement: Measurement) -> Present:
        """What is to be used now that this one has come."""
        if self._is_repeated(measurement):
            self._reject(InvalidMeasurement("repeated", f"{_text(measurement)} is in the journal already"))
            return NOTHING
        if isinstance(measurement, RelativeMotion):
            return self._motion(measurement)
        if self._now is not None and not self._near(measurement, self._now) and self._goes_on(measurement):
            self._hold(measurement)
            return NOTHING
        self._note(measurement)
        return Present([measurement])

    def _motion(self, motion: RelativeMotion) -> Present:
        if self._now is None or self._near(motion, self._now):
            self._drop("is far from the odometry before and after it")
            self._note(motion)
            return Present([motion])
        if not self._goes_on(motion):
            self._drop("is far from the odometry before and after it")
        self._hold(motion)
        if sum(isinstance(m, RelativeMotion) for m in self._held) < self.AGREE:
            return NOTHING
        back = motion.end < self._now
        # A single motion may have been the stray one, if all began with it.
        if back and self._settings.time_jump == REJECT and self._motions >= self.AGREE:
            self._drop("is of before a jump of time back; call ~/reset, or set time_jump")
            return NOTHING
        held, self._held = self._held, []
        if back:
            self.reset()
        for each in held:
            self._note(each)
        return Present(held, back)

    def _near(self, measurement: Measurement, time: int) -> bool:
        _, end = _interval(measurement)
        return end > time - self.LATE and end <= time + self._gap

    def _goes_on(self, measurement: Measurement) -> bool:
        """Whether it follows the motions that are held."""
        ends = [m.end for m in self._held if isinstance(m, RelativeMotion)]
        if not ends:
            return False
        if isinstance(measurement, Boxes):
            return self._near(measurement, ends[-1])
        return ends[-1] <= measurement.start <= ends[-1] + self._gap

    def _hold(self, measurement: Measurement) -> None:
        if len(self._held) == self.MOST_HELD:
            self._drop("is far from the odometry before it")
        self._held.append(measurement)

    def _drop(self, why: str) -> None:
        for each in self._held:
            self._reject(InvalidMeasurement("time_jump", f"{_text(each)} {why}"))
        self._held = []

    def _note(self, measurement: Measurement) -> None:
        _, end = _interval(measurement)
        kind = type(measurement)
        if self._now is None or kind is RelativeMotion or self._near(measurement, self._now):
            self._newest[kind] = max(end, self._newest.get(kind, end))
            self._may_repeat.discard(kind)
        if isinstance(measurement, RelativeMotion):
            self._motions += 1
            self._now = end if self._now is None else max(self._now, end)

    def _is_repeated(self, measurement: Measurement) -> bool:
        kind = type(measurement)
        return kind in self._may_repeat and _interval(measurement)[1] <= self._newest[kind]


def _interval(measurement: Measurement) -> tuple[int, int]:
    """First and last time [ns]."""
    if isinstance(measurement, Boxes):
        return measurement.stamp, measurement.stamp
    return measurement.start, measurement.end


def _text(measurement: Measurement) -> str:
    return f"{'an image' if isinstance(measurement, Boxes) else 'a motion'} of {_interval(measurement)[1]} ns"
