"""What a run gives away of its input: bad input is told, and of good input nothing."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import pytest

from calibslam_backend.output.doubts import Course, doubts
from calibslam_msgs_py.measurements import SECOND

# fr1_desk with real odometry and boxes, which fails now and then.
GOOD = Course(
    keyframes=119,
    objects=16,
    boxes=453,
    used=412,
    valid=2348,
    rejected={"box_empty": 10, "late": 600},
    counts={"motions": 572, "odometry_implausible": 29, "images": 613},
    beyond="",
    motions=[k * SECOND // 30 for k in range(573)],
)


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"objects": 2, "boxes": 114, "used": 114},
        {"keyframes": 8, "boxes": 31, "used": 12},  # too short to tell
        {"keyframes": 38, "boxes": 140, "used": 116},  # two images a second
        {"objects": 0, "boxes": 0, "used": 0, "valid": 0, "rejected": {}},
        {"motions": [k * 3 * SECOND for k in range(20)]},  # slow odometry
    ],
)
def test_of_a_good_run_nothing_is_said(change: dict[str, Any]) -> None:
    assert doubts(replace(GOOD, **change)) == []


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"counts": {"motions": 572, "odometry_implausible": 563}}, "563 of 572 motions are implausible"),
        ({"counts": {"motions": 572, "errors": 3}}, "the estimator failed 3 times"),
        ({"rejected": {"box_empty": 1778, "box_nan": 1}, "valid": 570}, r"1779 of 2349 boxes .*1778 empty, 1 nan"),
        ({"objects": 0, "used": 0}, "no objects, though 2348 boxes came"),
        ({"boxes": 496, "used": 40}, "only 40 of 496 boxes"),  # T_cw
        ({"boxes": 473, "used": 172}, "only 172 of 473 boxes"),  # poses of a body
        ({"beyond": "70 boxes go beyond"}, "70 boxes go beyond"),
        ({"motions": [0, SECOND, 2 * SECOND, 22 * SECOND, 23 * SECOND]}, r"20\.0 s without odometry at t = 2\.00"),
        ({"keyframes": 0, "counts": {}}, "at least two poses that can be used; left out: 600 late, 10 box_empty"),
        ({"keyframes": 0, "counts": {"motions": 9}, "rejected": {"image_size": 9}}, "no image can be used; .*9 image"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told(change: dict[str, Any], says: str) -> None:
    (told,) = doubts(replace(GOOD, **change))
    assert re.search(says, told)


def test_two_doubts_are_enough() -> None:
    everything = replace(
        GOOD,
        counts={"motions": 572, "odometry_implausible": 563, "errors": 1},
        rejected={"box_empty": 1778},
        used=0,
        beyond="70 boxes go beyond",
        motions=[0, 1, 2, 9 * SECOND],
    )
    assert [told.split(" ")[0] for told in doubts(everything)] == ["the", "563", "9.0"]
