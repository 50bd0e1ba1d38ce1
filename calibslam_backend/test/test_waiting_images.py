"""Images that wait for odometry."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibslam_backend.odometry.waiting_images import WaitingImages
from calibslam_msgs_py.measurements import Boxes, Camera, InvalidMeasurement

CAMERA = Camera(640, 480, np.eye(3), np.zeros(5))


def image(stamp: int, width: int = 640) -> Boxes:
    return Boxes(stamp, width, 480, np.zeros((0, 4)), np.zeros((0, 4, 4)), (), np.zeros(0), ())


@settings(max_examples=50, deadline=None, derandomize=True)
@given(stamps=st.lists(st.integers(1, 1000), unique=True), until=st.integers(0, 1000), most=st.integers(0, 10))
def test_the_earliest_come_first_and_the_latest_are_left_out(stamps: list[int], until: int, most: int) -> None:
    waiting = WaitingImages(CAMERA)
    for stamp in stamps:
        waiting.add(image(stamp), newest_used=None)
    assert waiting.limit(most) == max(len(stamps) - most, 0)
    kept = sorted(stamps)[:most]
    assert len(waiting) == len(kept)
    taken = []
    while (boxes := waiting.take(until)) is not None:
        taken.append(boxes.stamp)
    assert taken == [stamp for stamp in kept if stamp <= until]
    assert len(waiting) == len(kept) - len(taken)


@pytest.mark.parametrize(
    ("boxes", "reason"),
    [(image(30, width=320), "image_size"), (image(9), "late"), (image(10), "duplicate"), (image(20), "duplicate")],
)
def test_what_cannot_be_used_is_refused(boxes: Boxes, reason: str) -> None:
    waiting = WaitingImages(CAMERA)
    waiting.add(image(20), newest_used=10)
    with pytest.raises(InvalidMeasurement) as error:
        waiting.add(boxes, newest_used=10)
    assert error.value.reason == reason
    assert len(waiting) == 1
