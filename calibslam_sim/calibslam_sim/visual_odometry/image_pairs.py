"""Images and depth images of one camera, joined by their stamps."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from typing import Generic, TypeVar

from calibslam_msgs_py.measurements import SECOND

Image = TypeVar("Image")
Depth = TypeVar("Depth")

WAITING = 30  # images or depth images at most, whatever does not come


@dataclass(frozen=True)
class Pair(Generic[Image, Depth]):
    """An image with the depth image nearest in time."""

    stamp: int
    image: Image
    depth_stamp: int
    depth: Depth


class ImagePairs(Generic[Image, Depth]):
    """Gives each image the nearest depth image, as soon as it is certain which that is.

    Args:
        tolerance: largest difference of the two stamps [s].

    Attributes:
        dropped: how many were left out, by reason: `no_depth` within the tolerance, `out_of_order`, `overflow`.
    """

    def __init__(self, tolerance: float) -> None:
        self._tolerance = int(tolerance * SECOND)
        self._images: deque[tuple[int, Image]] = deque()
        self._depths: deque[tuple[int, Depth]] = deque()
        self._period: int | None = None  # of depth images
        self._last_image: int | None = None
        self.dropped: Counter[str] = Counter()

    def clear(self) -> None:
        """Forget what waits, such as after a jump of time backwards."""
        self._images.clear()
        self._depths.clear()
        self._period = self._last_image = None

    def add_image(self, stamp: int, image: Image) -> list[Pair[Image, Depth]]:
        """The pairs that are certain now."""
        if self._last_image is not None and stamp <= self._last_image:
            self.dropped["out_of_order"] += 1
            if stamp < self._last_image - SECOND:  # a recording that begins anew
                self.clear()
            else:
                return []
        self._last_image = stamp
        self._images.append((stamp, image))
        if len(self._images) > WAITING:
            self._images.popleft()
            self.dropped["overflow"] += 1
        return self._certain()

    def add_depth(self, stamp: int, depth: Depth) -> list[Pair[Image, Depth]]:
        """The pairs that are certain now."""
        if self._depths and stamp <= self._depths[-1][0]:
            self.dropped["out_of_order"] += 1
            if stamp < self._depths[-1][0] - SECOND:
                self.clear()
            else:
                return []
        if self._depths:
            self._period = stamp - self._depths[-1][0]
        self._depths.append((stamp, depth))
        if len(self._depths) > WAITING:
            self._depths.popleft()  # no image of its time came: nothing is lost with it
        return self._certain()

    def finish(self) -> list[Pair[Image, Depth]]:
        """Nothing more comes: the pairs of what still waits."""
        return self._certain(ended=True)

    def _certain(self, ended: bool = False) -> list[Pair[Image, Depth]]:
        pairs: list[Pair[Image, Depth]] = []
        while self._images:
            stamp, image = self._images[0]
            nearest = min(self._depths, key=lambda d: abs(d[0] - stamp), default=None)
            known = ended or (bool(self._depths) and self._depths[-1][0] >= stamp)
            if nearest is not None and not known and self._period is not None:
                # The next depth image cannot be nearer.
                known = 2 * (stamp - nearest[0]) <= self._period and stamp - nearest[0] <= self._tolerance
            if not known:
                break
            self._images.popleft()
            if nearest is None or abs(nearest[0] - stamp) > self._tolerance:
                self.dropped["no_depth"] += 1
                continue
            pairs.append(Pair(stamp, image, *nearest))
            while len(self._depths) > 1 and self._depths[1][0] <= stamp:
                self._depths.popleft()
        return pairs
