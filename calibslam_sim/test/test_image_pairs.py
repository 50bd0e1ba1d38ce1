"""Images and depth images joined by their stamps."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from calibslam_msgs_py.measurements import SECOND
from calibslam_sim.visual_odometry.image_pairs import WAITING, ImagePairs, Pair

MS = 1_000_000


def joined(pairs: list[Pair[str, str]]) -> list[tuple[int, int]]:
    return [(pair.stamp // MS, pair.depth_stamp // MS) for pair in pairs]


def test_equal_stamps_are_joined_at_once_in_either_order() -> None:
    pairs: ImagePairs[str, str] = ImagePairs(0.02)
    assert pairs.add_image(0, "i") == []
    assert pairs.add_depth(0, "d") == [Pair(0, "i", 0, "d")]
    assert pairs.add_depth(33 * MS, "d") == []
    assert joined(pairs.add_image(33 * MS, "i")) == [(33, 33)]
    assert not pairs.dropped


def test_the_nearest_is_waited_for_only_while_it_may_come() -> None:
    pairs: ImagePairs[str, str] = ImagePairs(0.02)
    assert pairs.add_depth(0, "d") == []
    assert pairs.add_image(15 * MS, "i") == []  # a depth image at 16 ms may be to come
    assert joined(pairs.add_depth(33 * MS, "d")) == [(15, 0)]
    # Their period is known now: the next one comes at 66 ms, and cannot be nearer to 45 ms.
    assert joined(pairs.add_image(45 * MS, "i")) == [(45, 33)]
    assert pairs.add_image(60 * MS, "i") == []
    assert joined(pairs.add_depth(66 * MS, "d")) == [(60, 66)]


def test_too_far_apart() -> None:
    pairs: ImagePairs[str, str] = ImagePairs(0.02)
    pairs.add_image(0, "i")
    assert pairs.add_depth(21 * MS, "d") == []
    assert pairs.dropped == {"no_depth": 1}
    assert joined(pairs.add_image(22 * MS, "i") + pairs.finish()) == [(22, 21)]


def test_disorder_and_jumps_back() -> None:
    pairs: ImagePairs[str, str] = ImagePairs(0.02)
    for add in (pairs.add_image, pairs.add_depth):
        add(5 * SECOND, "")
        assert add(5 * SECOND, "") == [] and add(5 * SECOND - 40 * MS, "") == []
    assert pairs.dropped == {"out_of_order": 4}
    # A bag that loops: everything begins anew.
    pairs.add_image(0, "i")
    assert joined(pairs.add_depth(0, "d")) == [(0, 0)]


def test_what_never_comes_fills_no_memory() -> None:
    pairs: ImagePairs[str, str] = ImagePairs(0.02)
    for k in range(100):
        pairs.add_image(k * 33 * MS, "i")
    assert pairs.dropped == {"overflow": 100 - WAITING}
    assert len(pairs.finish()) == 0 and pairs.dropped["no_depth"] == WAITING


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.integers(0, 1000), unique=True, max_size=25),
    st.integers(20, 60),
    st.integers(0, 60),
    st.lists(st.booleans(), min_size=60, max_size=60),
)
def test_every_image_gets_its_nearest_depth_or_is_counted(
    images: list[int], period: int, first: int, turns: list[bool]
) -> None:
    """Depth at a steady rate, images at any times, each stream in order, the two mixed anyhow."""
    pairs: ImagePairs[str, str] = ImagePairs(0.02)
    depths = [(first + k * period) * MS for k in range(25)]
    streams = {True: [t * MS for t in sorted(images)], False: list(depths)}
    found = []
    for turn in [*turns, *[True] * 25, *[False] * 25]:
        if streams[turn]:
            found += (pairs.add_image if turn else pairs.add_depth)(streams[turn].pop(0), "")
    found += pairs.finish()
    assert len(found) + pairs.dropped["no_depth"] == len(images)
    for pair in found:
        assert abs(pair.depth_stamp - pair.stamp) == np.abs(np.array(depths) - pair.stamp).min() <= 20 * MS
