"""Maps on disk: what is saved is loaded, what is damaged is said."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from evo.tools import file_interface

from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.geometry.transform import transform_from_text
from calibslam_backend.graph.known import Known, MapPrior
from calibslam_backend.output.object_map import MapFileError, ObjectMap, tum_lines
from calibslam_msgs_py.measurements import Array, QuadricEstimate

STAMPS = (1_305_031_102_175_304_001, 1_305_031_103_000_000_000, 1_305_031_104_999_999_999)


def poses(n: int, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    return np.stack([gtsam.Pose3.Expmap(rng.normal(0.0, 2.0, size=6)).matrix() for _ in range(n)])


def some_map() -> ObjectMap:
    rng = np.random.default_rng(1)
    A, B = rng.normal(size=(3, 6, 6)), rng.normal(size=(2, 9, 9))
    quadrics = tuple(
        QuadricEstimate(7 + i, ("cup", "Tasse ☕")[i], T, rng.uniform(0.01, 1.0, 3), b @ b.T, 10 + i)
        for i, (T, b) in enumerate(zip(poses(2, 2), B, strict=True))
    )
    first, second = (Ellipsoid(quadric.T_map_object, quadric.radii).vector() for quadric in quadrics)
    known = {7: Known(first, np.eye(9) * 0.04), 8: Known(second, np.eye(9) * 0.09, 7, np.eye(9) * 0.03)}
    prior = MapPrior(np.diag(rng.uniform(0.1, 1.0, 6)), known)
    return ObjectMap(STAMPS, poses(3), A @ A.transpose(0, 2, 1), quadrics, "front_camera", prior)


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    saved = some_map()
    saved.save(tmp_path / "map.json")
    loaded = ObjectMap.load(tmp_path / "map.json")
    assert (loaded.stamps, loaded.camera) == (saved.stamps, saved.camera)
    np.testing.assert_allclose(loaded.poses, saved.poses, atol=1e-12)
    np.testing.assert_array_equal(loaded.covariances, saved.covariances)
    for a, b in zip(loaded.quadrics, saved.quadrics, strict=True):
        assert (a.id, a.class_id, a.observations) == (b.id, b.class_id, b.observations)
        np.testing.assert_allclose(a.T_map_object, b.T_map_object, atol=1e-12)
        np.testing.assert_array_equal(a.radii, b.radii)
        np.testing.assert_array_equal(a.covariance, b.covariance)
    np.testing.assert_array_equal(loaded.prior.frame, saved.prior.frame)
    assert list(loaded.prior.quadrics) == list(saved.prior.quadrics)
    for j, known in loaded.prior.quadrics.items():
        there = saved.prior.quadrics[j]
        assert known.parent == there.parent
        for name in ("vector", "covariance", "cross"):
            np.testing.assert_array_equal(getattr(known, name), getattr(there, name))


def test_maps_without_priors_and_quadrics_whose_parent_has_none(tmp_path: Path) -> None:
    """As earlier versions wrote them, or where somebody has moved an object and left its prior out, as he was told."""
    path = tmp_path / "map.json"
    some_map().save(path)
    content = json.loads(path.read_text())
    del content["quadrics"][0]["prior"]
    path.write_text(json.dumps(content))
    (alone,) = ObjectMap.load(path).prior.quadrics.values()
    assert alone.parent is None and not alone.cross.any()
    del content["quadrics"][1]["prior"], content["frame_covariance"]
    path.write_text(json.dumps(content))
    prior = ObjectMap.load(path).prior
    assert not prior.quadrics and not prior.frame.any()


def test_saving_twice_gives_the_same_bytes_and_leaves_nothing_behind(tmp_path: Path) -> None:
    some_map().save(tmp_path / "a.json")
    ObjectMap((), np.empty((0, 4, 4)), np.empty((0, 6, 6)), ()).save(tmp_path / "b.json")
    some_map().save(tmp_path / "b.json")
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.json", "b.json"]


def test_an_empty_map(tmp_path: Path) -> None:
    ObjectMap((), np.empty((0, 4, 4)), np.empty((0, 6, 6)), ()).save(tmp_path / "map.json")
    loaded = ObjectMap.load(tmp_path / "map.json")
    assert (loaded.stamps, loaded.quadrics, loaded.poses.shape) == ((), (), (0, 4, 4))


def set_in(path: str, value: Any) -> Callable[[dict[str, Any]], None]:
    """A change of one entry, such as "quadrics.0.radii"."""

    def change(content: dict[str, Any]) -> None:
        *folders, last = [int(p) if p.isdigit() else p for p in path.split(".")]
        target: Any = content
        for folder in folders:
            target = target[folder]
        if value is None:
            del target[last]
        else:
            target[last] = value

    return change


DAMAGES = {
    "other format": (set_in("format", "other-map"), 'does not say "format": "calibslam-map"'),
    "no format": (set_in("format", None), 'does not say "format": "calibslam-map"'),
    "future version": (set_in("version", 99), "has version 99, this program reads 1"),
    "no quadrics": (set_in("quadrics", None), "is damaged: it has no 'quadrics'"),
    "no camera": (set_in("camera", None), "is damaged: it has no 'camera'"),
    "no radii": (set_in("quadrics.1.radii", None), r"quadrics\[1\] \(id 8\): it has no 'radii'"),
    "a radius too few": (set_in("quadrics.1.radii", [1.0, 2.0]), r"\(id 8\): radii does not consist of 3 numbers"),
    "a negative radius": (set_in("quadrics.1.radii", [1.0, -2.0, 1.0]), "radii .* are not from 1e-06 to 1e.06 m"),
    "a radius of nothing": (set_in("quadrics.1.radii", [1e-200, 1.0, 1.0]), "radii .* are not from"),
    "a radius of the sun": (set_in("quadrics.1.radii", [7e8, 7e8, 7e8]), "radii .* are not from"),
    "an infinite position": (set_in("quadrics.0.position", [0.0, 1e999, 0.0]), "a number of position is not finite"),
    "a position of garbage": (set_in("quadrics.0.position", [0.0, 1e300, 0.0]), "position .* is farther than 1e.09 m"),
    "a long number": (set_in("quadrics.0.position", [0.0, 10**400, 0.0]), "position does not consist of 3 numbers"),
    "a text for a number": (set_in("quadrics.0.position", ["a", 0.0, 0.0]), "position does not consist of 3 numbers"),
    "no unit quaternion": (set_in("keyframes.0.orientation", [1.0, 1.0, 0.0, 0.0]), "is damaged.*no unit quaternion"),
    "a short covariance": (set_in("keyframes.2.covariance", [0.0] * 35), "covariance does not consist of 36 numbers"),
    "a negative covariance": (set_in("quadrics.1.covariance", (-0.01 * np.eye(9)).ravel().tolist()), "its covariance"),
    "an asymmetric covariance": (set_in("quadrics.1.covariance.1", 1e3), r"\(id 8\): its covariance is not symmetric"),
    "a huge covariance": (set_in("quadrics.1.covariance.80", 1e300), "its covariance .* of sensible size"),
    "a negative variance": (set_in("keyframes.1.covariance.0", -1.0), r"keyframes\[1\]: its covariance is not"),
    "an asymmetric pose": (set_in("keyframes.1.covariance.1", 1e3), r"keyframes\[1\]: its covariance is not symmetric"),
    "keyframes are no list": (set_in("keyframes", 7), "keyframes is no list"),
    "a quadric is no object": (set_in("quadrics.0", 7), r"quadrics\[0\] is no object"),
    "a stamp is missing": (set_in("keyframes.1.stamp", None), r"keyframes\[1\]: it has no 'stamp'"),
    "an infinite stamp": (set_in("keyframes.1.stamp", 1e999), "stamp inf is no whole number"),
    "a stamp that ROS cannot tell": (set_in("keyframes.1.stamp", 2**62), "stamp .* is no whole number from"),
    "an id twice": (set_in("quadrics.1.id", 7), "quadrics: id 7 is there 2 times"),
    "a negative id": (set_in("quadrics.0.id", -1), r"quadrics\[0\] \(id -1\): id -1 is no whole number from 0 to"),
    "an infinite id": (set_in("quadrics.0.id", 1e999), "id inf is no whole number"),
    "an id that no message holds": (set_in("quadrics.0.id", 2**60), "id 1152921504606846976 is no whole number"),
    "half an observation": (set_in("quadrics.0.observations", 0.5), "observations 0.5 is no whole number"),
    "a prior of elsewhere": (set_in("quadrics.0.prior.vector.0", 9.0), r"\(id 7\): its prior is of another position"),
    "a prior of nothing": (set_in("quadrics.0.prior", 3), r"\(id 7\): its prior is no object of JSON"),
    "a negative prior": (set_in("quadrics.0.prior.covariance.0", -1.0), "the covariance of its prior is not"),
    "a prior of its own": (set_in("quadrics.0.prior.parent", 7), "prior of quadric 7 depends on itself"),
    "too large a cross": (
        set_in("quadrics.1.prior.cross_covariance.0", 0.07),
        "prior of quadric 8: its covariance with",
    ),
    "a huge cross": (set_in("quadrics.1.prior.cross_covariance.0", 1e308), "prior of quadric 8: its covariance with"),
    "a huge frame": (set_in("frame_covariance.0", 1e300), "frame_covariance is not symmetric and of sensible size"),
    "a negative frame": (set_in("frame_covariance.0", -0.5), "frame_covariance is not positive semidefinite"),
    "half a character": (set_in("quadrics.0.class_id", "\ud800"), "class_id .* is no text"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_maps(damage: str, tmp_path: Path) -> None:
    path = tmp_path / "map.json"
    some_map().save(path)
    content = json.loads(path.read_text())
    change, text = DAMAGES[damage]
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(MapFileError, match=text) as caught:
        ObjectMap.load(path)
    assert str(path) in str(caught.value)


def test_a_pose_may_be_known_in_some_directions_only(tmp_path: Path) -> None:
    """As by odometry that measures no height: what such a run saves can be loaded."""
    whole = some_map()
    axes = poses(1)[0, :3, :3]
    covariance = np.eye(6) * 1e-6
    covariance[3:, 3:] = (axes * [1e9, 1e-6, 1e-6]) @ axes.T
    ObjectMap(whole.stamps[:1], whole.poses[:1], covariance[None], ()).save(tmp_path / "map.json")
    np.testing.assert_array_equal(ObjectMap.load(tmp_path / "map.json").covariances[0], covariance)


def test_files_that_are_no_maps(tmp_path: Path) -> None:
    path = tmp_path / "map.json"
    with pytest.raises(MapFileError, match="cannot be read: No such file"):
        ObjectMap.load(path)
    with pytest.raises(MapFileError, match="cannot be read: Is a directory"):
        ObjectMap.load(tmp_path)
    some_map().save(path)
    whole = path.read_bytes()
    for content in (b"", b"[]", b"\xff\xfe\x00", whole[: len(whole) // 2], b"null"):
        path.write_bytes(content)
        with pytest.raises(MapFileError, match=r"is not JSON|does not say"):
            ObjectMap.load(path)


def test_evo_reads_the_trajectory(tmp_path: Path) -> None:
    path = tmp_path / "trajectory.tum"
    path.write_text(tum_lines(STAMPS, poses(3)))
    read = file_interface.read_tum_trajectory_file(str(path))
    np.testing.assert_allclose(np.stack(read.poses_se3), poses(3), atol=1e-8)
    np.testing.assert_allclose(read.timestamps, np.array(STAMPS) * 1e-9, atol=1e-6)
    # Doubles cannot hold nanoseconds since 1970; the text does.
    assert path.read_text().split()[0] == "1305031102.175304001"
    assert path.read_text().splitlines()[2].startswith("1305031104.999999999 ")


# -- poses as text --------------------------------------------------------------------------------------------------


def test_a_pose_as_text() -> None:
    T = transform_from_text("1 2.5 -3 0 0 0.6 0.8")
    np.testing.assert_allclose(T[:3, 3], [1.0, 2.5, -3.0])
    np.testing.assert_allclose(T[:3, :3], gtsam.Rot3.Quaternion(0.8, 0.0, 0.0, 0.6).matrix(), atol=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3", "seven numbers"),
        ("", "seven numbers"),
        ("1 2 3 0 0 0 one", "seven numbers"),
        ("1 2 3 0 0 nan 1", "seven numbers"),
        ("1 2 3 0 0 0 0.9", "length 0.9000, not 1"),
    ],
)
def test_what_is_no_pose(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        transform_from_text(text)
