"""Quadrics of tracks that are too short alone, and tracks that are moved: cups, books kept by hand."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from small_map import FRAMES, LEFT, RIGHT, World

from calibslam_backend.association import data_association
from calibslam_backend.association.assignments import Assignments
from calibslam_backend.association.matching import GIVEN
from calibslam_backend.association.relocalisation import Relocalised
from calibslam_backend.graph.known import Known
from calibslam_backend.objects.new_quadrics import NewQuadrics


def flickering(**settings: str) -> World:
    """The left cup is seen in every second pair of keyframes, each time in a track of its own, and not at the end."""
    world = World(**settings)
    for k in range(FRAMES):
        world.show(*([(LEFT, k // 4)] if k % 4 < 2 and k < FRAMES - 1 else []))
    return world


def test_tracks_that_have_ended_begin_a_quadric_together() -> None:
    world = flickering()
    world.new.join_ended(6)
    assert world.keyframes(0) == [0, 1, 4, 5]
    assert [world.books.tracks[track].quadric for track in range(3)] == [0, 0, None]
    assert world.counts["joined"] == 1


def test_a_track_in_view_may_still_be_told_by_itself() -> None:
    world = flickering()
    world.new.join_ended(5)
    assert world.graph.landmarks == {}


def test_while_the_map_grows_only_recent_tracks_are_joined(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(NewQuadrics, "RECENT", 3)
    world = flickering()
    world.new.join_ended(6)
    assert world.graph.landmarks == {}
    world.new.start_leftovers()
    assert world.keyframes(0) == [0, 1, 4, 5, 8, 9]


def test_tracks_of_given_identities_are_whole() -> None:
    world = flickering(association=GIVEN)
    world.new.join_ended(6)
    world.new.start_leftovers()
    assert world.graph.landmarks == {}


def test_joined_tracks_of_a_known_object_are_bound_to_it() -> None:
    world = flickering()
    world.books.know(7, Known(world.cup(LEFT), np.eye(9) * 1e-4), Counter(cup=1))
    world.new.start_leftovers()
    assert list(world.graph.landmarks) == [7]
    assert [world.books.tracks[track].quadric for track in range(3)] == [7] * 3


def test_tracks_move_at_once() -> None:
    """Each makes room for the other."""
    world = swapped()
    world.books.move({0: 0, 1: 1})
    assert [frame.quadrics for frame in world.books.frames] == [[0, 1]] * FRAMES
    assert [world.books.tracks[track].quadric for track in (0, 1)] == [0, 1]
    assert [world.keyframes(j) for j in (0, 1)] == [list(range(FRAMES))] * 2


@pytest.mark.parametrize("times", [2, 3])
def test_relocalisation_moves_tracks_that_are_bound_to_neighbours(times: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once it has found so in three keyframes, since images show both quadrics."""
    world = swapped()
    monkeypatch.setattr(data_association, "relocalise", lambda *_: Relocalised(np.eye(4), [(0, 0), (1, 1)]))
    monkeypatch.setattr(Assignments, "YOUNG", -FRAMES)  # all quadrics are old
    monkeypatch.setattr(world.objects, "_is_recent", lambda track: True)
    monkeypatch.setattr(world.graph, "is_solved", lambda j: True)
    for k in range(times):
        world.objects.relocalise(k)
    assert [world.books.tracks[track].quadric for track in (0, 1)] == ([0, 1] if times == 3 else [1, 0])
    assert world.counts["moved"] == (2 if times == 3 else 0)
    assert world.books.same == []


def swapped() -> World:
    """Two cups side by side, each bound to the other's quadric."""
    world = World()
    ids = [world.books.begin(world.cup(place)) for place in (LEFT, RIGHT)]
    for _ in range(FRAMES):
        world.show((LEFT, 0), (RIGHT, 1))
    for track, j in zip((1, 0), ids, strict=True):
        world.books.bind(track, j)
    return world
