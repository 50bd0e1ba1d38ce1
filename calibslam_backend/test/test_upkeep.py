"""Which quadrics there are: begun, united, dropped; cups before a camera that moves sideways, books kept by hand."""

from __future__ import annotations

import pytest
from small_map import FRAMES, LEFT, RIGHT, World

from calibslam_backend.association.matching import GIVEN

# Nearer to the left one than 0.7 of their radii's sum. Its box of 30 px is 12 px away (overlap 0.4), 20 px (0.2), and
# behind it hardly smaller.
NEIGHBOURS = {(-0.25, 0.0, 2.0): True, (-0.22, 0.0, 2.0): False, (-0.31, 0.0, 2.07): True}


def test_an_object_that_was_begun_twice_is_one() -> None:
    """A track was lost and found, 2 cm off: the second quadric fits its boxes best, the first nearly as well.

    5 px of 2 px and a fifth of the 30 px that the box is wide: d^2 = 1.2, six times, is far less than 4 * 9 log 6.
    """
    world = World()
    moved = (-0.28, 0.0, 2.0)
    first, second = world.books.begin(world.cup(LEFT)), world.books.begin(world.cup(moved))
    for k in range(FRAMES):
        world.show((LEFT, 0) if k < 6 else (moved, 1))
    world.books.bind(0, first)
    world.books.bind(1, second)
    world.upkeep.revise()
    assert list(world.graph.landmarks) == [first]
    assert world.keyframes(first) == list(range(FRAMES))
    assert world.books.tracks[1].quadric == first
    assert world.counts["quadrics_superfluous"] == 1


def test_neighbours_that_are_seen_together_are_two() -> None:
    world = World()
    ids = [world.books.begin(world.cup(place)) for place in (LEFT, (-0.2, 0.0, 2.0))]
    for _ in range(FRAMES):
        world.show((LEFT, 0), ((-0.2, 0.0, 2.0), 1))
    for track, j in enumerate(ids):
        world.books.bind(track, j)
    world.upkeep.revise()
    assert sorted(world.graph.landmarks) == ids
    assert world.counts["quadrics_superfluous"] == 0


def test_a_quadric_that_was_not_judged_yet_is_not_dropped() -> None:
    """While boxes are too new to be judged, what they say of others is not known."""
    world = World()
    moved = (-0.28, 0.0, 2.0)
    ids = [world.books.begin(world.cup(place)) for place in (LEFT, moved)]
    for k in range(FRAMES):
        world.show((LEFT, 0) if k < 6 else (moved, 1))
    for track, j in enumerate(ids):
        world.books.bind(track, j)
    for _ in range(4):
        world.upkeep.revise(number=2)  # of 12 keyframes the first two have settled
    assert sorted(world.graph.landmarks) == ids


def test_boxes_of_a_track_that_slipped_change_hands() -> None:
    """The left one is lost from sight, and its track goes on with the right one, whose own track has ended."""
    world = World()
    ids = [world.books.begin(world.cup(place)) for place in (LEFT, RIGHT)]
    for k in range(FRAMES):
        world.show(*([(LEFT, 0), (RIGHT, 1)] if k < 6 else [(RIGHT, 0)]))
    for track, j in enumerate(ids):
        world.books.bind(track, j)
    assert world.keyframes(ids[0]) == list(range(FRAMES))
    assert world.upkeep.revise() == 6
    assert world.keyframes(ids[0]) == list(range(6))
    assert world.keyframes(ids[1]) == list(range(FRAMES))


@pytest.mark.parametrize("together", [True, False])
def test_relocalisation_does_not_unite_what_was_seen_side_by_side(together: bool) -> None:
    world = World()
    ids = [world.books.begin(world.cup(place)) for place in (LEFT, RIGHT)]
    for k in range(FRAMES):
        seen = [(LEFT, 0), (RIGHT, 1)]
        world.show(*(seen if together else seen[k % 2 : k % 2 + 1]))
    for track, j in enumerate(ids):
        world.books.bind(track, j)
    world.books.same.append((ids[1], ids[0]))
    world.upkeep.merge()
    assert len(world.graph.landmarks) == (2 if together else 1)
    assert world.counts["merged"] == (0 if together else 1)
    assert world.books.same == []


@pytest.mark.parametrize(("place", "one"), NEIGHBOURS.items())
def test_what_is_near_is_no_new_object_if_it_explains_the_boxes(place: tuple[float, float, float], one: bool) -> None:
    """Seen one after the other."""
    world = World()
    first = world.books.begin(world.cup(LEFT))
    for k in range(FRAMES):
        world.show((LEFT, 0) if k < 2 else (place, 1))
    world.books.bind(0, first)
    world.new.start([1])
    assert sorted(world.graph.landmarks) == ([first] if one else [first, first + 1])
    world.upkeep.merge()
    assert world.books.tracks[1].quadric == (first if one else first + 1)


@pytest.mark.parametrize(("place", "one"), NEIGHBOURS.items())
def test_what_is_near_is_united_if_it_explains_the_boxes(place: tuple[float, float, float], one: bool) -> None:
    """Both were begun, and seen one after the other."""
    world = World()
    ids = [world.books.begin(world.cup(cup)) for cup in (LEFT, place)]
    for k in range(FRAMES):
        world.show((LEFT, 0) if k < 2 else (place, 1))
    for track, j in enumerate(ids):
        world.books.bind(track, j)
    world.upkeep.merge()
    assert sorted(world.graph.landmarks) == (ids[:1] if one else ids)
    assert world.keyframes(ids[0]) == list(range(FRAMES if one else 2))
    assert world.books.tracks[1].quadric == ids[0 if one else 1]


def test_three_that_are_one_become_the_oldest() -> None:
    world = World()
    ids = [world.books.begin(world.cup((-0.3 + 0.005 * n, 0.0, 2.0))) for n in range(3)]
    for k in range(FRAMES):
        world.show((LEFT, k // 4))
    for track, j in enumerate(ids):
        world.books.bind(track, j)
    world.upkeep.merge()
    assert list(world.graph.landmarks) == ids[:1]
    assert world.keyframes(ids[0]) == list(range(FRAMES))
    assert world.counts["merged"] == 2


def test_given_identities_are_left_alone() -> None:
    world = World(association=GIVEN)
    ids = [world.books.begin(world.cup(LEFT)) for _ in range(2)]
    world.show((LEFT, 0))
    world.books.bind(0, ids[0])
    assert world.upkeep.revise() == 0
    world.upkeep.merge()
    assert sorted(world.graph.landmarks) == ids
