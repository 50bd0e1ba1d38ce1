"""Agreement of ellipsoids against cases computed by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_sim.accuracy.objects import MAX_CENTRE_DISTANCE, MapObject, iou, matches, object_accuracy
from calibslam_sim.simulation.sampling import unit_cube


def thing(centre: list[float], radii: list[float], class_id: str = "cup") -> MapObject:
    return MapObject(class_id, ellipsoid(centre, radii))


def ellipsoid(centre: list[float], radii: list[float], rotation: list[float] | None = None) -> Ellipsoid:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation or [0.0, 0.0, 0.0]).as_matrix()
    T[:3, 3] = centre
    return Ellipsoid(T, np.array(radii))


def test_points_fill_the_cube_evenly() -> None:
    points = unit_cube(4000)
    assert points.min() >= 0.0
    assert points.max() < 1.0
    counts, _ = np.histogramdd(points, bins=4, range=[(0.0, 1.0)] * 3)
    assert counts.min() > 0.8 * 4000 / 64


def test_nested_spheres_overlap_by_their_volumes() -> None:
    assert iou(ellipsoid([1, 2, 3], [0.5] * 3), ellipsoid([1, 2, 3], [1.0] * 3)) == pytest.approx(1 / 8, abs=0.005)


def test_shifted_spheres_overlap_by_their_lens() -> None:
    # Unit spheres at distance d share a lens of volume pi (4 + d) (2 - d)^2 / 12.
    lens = np.pi * 5.0 / 12.0
    expected = lens / (2.0 * 4.0 / 3.0 * np.pi - lens)
    assert iou(ellipsoid([0, 0, 0], [1.0] * 3), ellipsoid([1, 0, 0], [1.0] * 3)) == pytest.approx(expected, abs=0.005)


@given(
    st.lists(st.floats(0.02, 1.0), min_size=3, max_size=3),
    st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3),
)
@settings(max_examples=20, deadline=None)
def test_an_ellipsoid_is_itself_however_it_is_written(radii: list[float], rotation: list[float]) -> None:
    a = ellipsoid([0, 1, 2], radii, rotation)
    # The same body with its axes renamed.
    T = a.T_world_object.copy()
    T[:3, :3] = T[:3, :3][:, [1, 2, 0]]
    b = Ellipsoid(T, a.radii[[1, 2, 0]])
    assert iou(a, b) == pytest.approx(1.0)
    accuracy = object_accuracy([MapObject("cup", a)], [MapObject("cup", b)])
    assert accuracy.matched == 1
    assert accuracy.centre_m == pytest.approx(0.0)
    assert accuracy.radii == pytest.approx(0.0)


def test_far_estimates_are_nobodys() -> None:
    true = [thing([0, 0, 0], [0.1] * 3), thing([1, 0, 0], [0.1] * 3)]
    estimated = [thing([9, 0, 0], [0.1] * 3), thing([1.1, 0, 0], [0.11, 0.1, 0.1])]
    assert matches(estimated, true) == [(1, 1)]
    accuracy = object_accuracy(estimated, true)
    assert (accuracy.true, accuracy.estimated, accuracy.matched) == (2, 2, 1)
    assert accuracy.centre_m == pytest.approx(0.1)
    assert accuracy.radii == pytest.approx(0.1 / 3.0)
    assert matches([thing([MAX_CENTRE_DISTANCE + 0.01, 0, 0], [0.1] * 3)], true[:1]) == []


def test_an_estimate_is_of_an_object_of_its_class() -> None:
    # A bear, and the bottle that a detector sees in its belly: the bottle is nearer to the bear's true centre.
    true = [thing([0, 0, 0], [0.1] * 3, "teddy bear"), thing([0.4, 0, 0], [0.1] * 3, "bottle")]
    bear, belly = thing([0.05, 0, 0], [0.1] * 3, "teddy bear"), thing([0.01, 0, 0], [0.02] * 3, "bottle")
    assert matches([belly, bear], true[:1]) == [(1, 0)]
    accuracy = object_accuracy([belly, bear], true[:1])
    assert (accuracy.true, accuracy.estimated, accuracy.matched) == (1, 2, 1)
    assert accuracy.centre_m == pytest.approx(0.05)
    # Where there is a bottle within reach it is taken for that one, far as it is.
    assert matches([belly, bear], true) == [(0, 1), (1, 0)]
    assert matches([belly], [true[0]]) == []


def test_an_empty_map_matches_nothing() -> None:
    accuracy = object_accuracy([], [thing([0, 0, 0], [0.1] * 3)])
    assert (accuracy.true, accuracy.estimated, accuracy.matched) == (1, 0, 0)
    assert np.isnan(accuracy.iou)
