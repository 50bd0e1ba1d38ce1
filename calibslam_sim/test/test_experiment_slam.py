"""Experiments that run the back end: `quadric_sim` in simulated worlds, `tum` on a folder in TUM format."""

from __future__ import annotations

import io
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibslam_backend.output.object_map import MotionCovariances, ObjectMap
from calibslam_msgs_py.measurements import SECOND, Array, Boxes, Camera, QuadricEstimate, RelativeMotion
from calibslam_sim import experiment
from calibslam_sim.experiments import quadric_sim, tum
from calibslam_sim.experiments.design import ExperimentError, repetition_seed
from calibslam_sim.experiments.object_slam import Estimate, estimate
from calibslam_sim.simulation.failing_odometry import OdometryFailures
from calibslam_sim.simulation.recording import Simulation, SimulationSettings, simulate

QUICK = quadric_sim.QuadricSimSettings(duration=8.0)


@pytest.fixture(scope="module")
def recording() -> Simulation:
    return simulate(SimulationSettings(seed=4, duration=8.0))


@pytest.fixture(scope="module")
def folder(recording: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording in TUM format; its "good trajectory" is the truth."""
    path = tmp_path_factory.mktemp("tum") / "fr3_office"
    path.mkdir()
    measured = [np.eye(4)]
    for motion in recording.odometry:
        measured.append(measured[-1] @ motion.T_start_end)
    for name, poses in {
        "groundtruth.txt": recording.T_world_camera,
        "odometry.txt": np.array(measured),
        "reference_orbslam.txt": recording.T_world_camera,
    }.items():
        (path / name).write_text(tum_text(recording.times, poses))
    rows = ["timestamp,xmin,ymin,xmax,ymax,score,class_id,object_id"]
    for boxes in recording.boxes:
        for corners, score, class_id, identity in zip(
            boxes.corners, boxes.scores, boxes.class_ids, boxes.object_ids, strict=True
        ):
            rows.append(",".join([f"{boxes.stamp / 1e9:.9f}", *map(str, corners), str(score), class_id, identity]))
    (path / "detections.csv").write_text("\n".join(rows) + "\n")
    K = recording.camera.K.ravel().tolist()
    (path / "camera_info.yaml").write_text(
        f"image_width: 640\nimage_height: 480\ncamera_matrix: {{data: {K}}}\n"
        "distortion_model: plumb_bob\ndistortion_coefficients: {data: [0, 0, 0, 0, 0]}\n"
    )
    return path


def tum_text(times: Array, poses: Array) -> str:
    numbers = np.column_stack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])
    return "".join(
        f"{time / 1e9:.9f} {' '.join(map(repr, row))}\n" for time, row in zip(times, numbers.tolist(), strict=True)
    )


def test_conditions_of_quadric_sim_share_their_world() -> None:
    """Conditions differ as they say: the same world, other boxes only with outliers, other noise models."""
    seed = repetition_seed(0, 0)
    found = {name: quadric_sim.run(QUICK, name, seed) for name in ("calibrated", "fixed", "outliers_calibrated")}
    again = quadric_sim.run(QUICK, "calibrated", repetition_seed(0, 0))
    np.testing.assert_equal(again, found["calibrated"])
    # Too short for motions over 30 keyframes.
    assert [name for name, value in again.items() if np.isnan(value)] == ["nees_motion_30"]
    assert len({metrics["ate_m"] for metrics in found.values()}) == 3
    for metrics in found.values():
        assert 0.0 < metrics["rpe_m"] < 0.05 and 0.0 < metrics["ate_m"] < 0.3
        assert 0.0 <= metrics["iou_error"] <= 1.0 and 0 <= metrics["missed"] <= 19


def test_quadric_sims_accuracy_of_the_truth_is_perfect(recording: Simulation) -> None:
    # The truth, seen from its first camera.
    T_map_world = np.linalg.inv(recording.T_world_camera[0])
    quadrics = tuple(
        QuadricEstimate(
            thing.id, thing.class_id, T_map_world @ thing.ellipsoid.T_world_object, thing.ellipsoid.radii, np.eye(9), 9
        )
        for thing in recording.world
    )
    poses = T_map_world @ recording.T_world_camera
    covariances = np.tile(np.eye(6), (len(poses), 1, 1))
    result = ObjectMap(tuple(int(t) for t in recording.times), poses, covariances, quadrics, "camera")
    steps = np.arange(len(poses) - 1)
    motions = MotionCovariances(steps, steps + 1, covariances[1:])
    found = quadric_sim.accuracy(Estimate(result, motions), recording)
    for name in ("ate_m", "rpe_m", "centre_m", "nees_position", "nees_motion_1", "missed"):
        assert found[name] == pytest.approx(0.0, abs=1e-6), name
    assert found["iou_error"] == pytest.approx(0.0, abs=1e-3)


def test_tum_sees_what_the_folder_holds(folder: Path, recording: Simulation) -> None:
    found = tum.recorded(tum.TumSettings(folder=str(folder)))
    assert len(found.good) == len(found.odometry) == len(recording.odometry)
    np.testing.assert_allclose(found.odometry[7].T_start_end, recording.odometry[7].T_start_end, atol=1e-6)
    assert all(boxes.has_covariance.all() for boxes in found.images)


def test_boxes_without_labels_have_the_conditions_that_need_none(folder: Path, tmp_path: Path) -> None:
    """As those of another detector on the same images, named by `detections`: also when no box has a label."""
    rows = (folder / "detections.csv").read_text().splitlines()
    other = tmp_path / "other.csv"
    other.write_text("".join(row.rsplit(",", 1)[0] + "\n" for row in rows[:1] + rows[2:]))
    settings = tum.TumSettings(folder=str(folder), detections=str(other))
    assert len(np.concatenate([boxes.corners for boxes in tum.recorded(settings).images])) == len(rows) - 2
    assert tum.inputs(settings)[str(other)] == other
    families = ("real", "backwards", "few", "failing")
    models = ("calibrated", "fixed", "quadricslam")
    assert tum.conditions(settings) == [f"{family}_estimated_{model}" for family in families for model in models]
    assert tum.comparisons(settings) == [
        (f"{family}_estimated_calibrated", f"{family}_estimated_{model}") for family in families for model in models[1:]
    ]


def test_tum_backwards_undoes_every_motion(folder: Path) -> None:
    forwards = tum.recorded(tum.TumSettings(folder=str(folder)))
    found = forwards.backwards
    first, last = forwards.images[0].stamp, forwards.images[-1].stamp
    assert [boxes.stamp for boxes in found.images] == [first + last - boxes.stamp for boxes in forwards.images[::-1]]
    assert (found.images[0].stamp, found.images[-1].stamp) == (first, last)
    np.testing.assert_array_equal(found.images[3].corners, forwards.images[-4].corners)
    assert all(a.end == b.start for a, b in pairwise(found.odometry))
    whole = np.linalg.multi_dot([motion.T_start_end for motion in found.good + forwards.good])
    np.testing.assert_allclose(whole, np.eye(4), atol=1e-9)
    # The truth still says where the camera was when an image was taken.
    np.testing.assert_array_equal(found.truth.poses[0], forwards.truth.poses[-1])
    assert found.truth.stamps[0] == first + last - forwards.truth.stamps[-1]
    again = found.backwards
    np.testing.assert_array_equal(again.truth.stamps, forwards.truth.stamps)
    np.testing.assert_allclose(again.odometry[5].T_start_end, forwards.odometry[5].T_start_end, atol=1e-12)


def reaching_the_back_end(
    settings: tum.TumSettings, conditions: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> list[tuple[list[RelativeMotion], list[Boxes]]]:
    """Motions and images that each condition gives to the back end, which is not run; the same seed for all."""
    given: list[tuple[list[RelativeMotion], list[Boxes]]] = []

    class Seen(Exception):
        pass

    def seeing(camera: Camera, motions: list[RelativeMotion], images: list[Boxes], back_end: object) -> ObjectMap:
        given.append((motions, images))
        raise Seen

    monkeypatch.setattr(tum, "estimate", seeing)
    for name in conditions:
        with pytest.raises(Seen):
            tum.run(settings, name, 3)
    return given


def test_tum_gives_few_conditions_a_third_of_the_images(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = tum.TumSettings(folder=str(folder))
    given = reaching_the_back_end(
        settings, ("real_given_fixed", "few_given_fixed", "few_given_calibrated"), monkeypatch
    )
    usual, few, same = ([boxes.stamp for boxes in images] for _, images in given)
    count = len(tum.recorded(settings).images)
    assert len(few) < 0.5 * count < 0.8 * count < len(usual) < count
    assert same == few  # conditions are compared on the same images


def test_tum_gives_sparse_conditions_the_same_objects(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = tum.TumSettings(folder=str(folder))
    given = reaching_the_back_end(
        settings, ("real_given_fixed", "sparse_given_fixed", "sparse_estimated_calibrated"), monkeypatch
    )
    usual, sparse, same = (
        [(boxes.stamp, boxes.object_ids, boxes.corners.tolist()) for boxes in images] for _, images in given
    )
    assert sparse == same
    there, left = ({name for _, names, _ in images for name in names} for images in (usual, sparse))
    assert left < there and len(left) > 0.3 * len(there)
    for (stamp, names, corners), (same_stamp, kept, kept_corners) in zip(usual, sparse, strict=True):
        assert stamp == same_stamp
        assert kept_corners == [c for name, c in zip(names, corners, strict=True) if name in left]
        assert list(kept) == [name for name in names if name in left]


def test_sparse_leaves_boxes_without_label() -> None:
    corners = np.array([[10.0, 10.0, 50.0, 50.0], [60.0, 10.0, 90.0, 50.0], [100.0, 10.0, 150.0, 50.0]])
    boxes = Boxes(0, 640, 480, corners, np.full((3, 4, 4), np.nan), ("cup",) * 3, np.ones(3), ("a", "", "b"))
    found = tum.sparse([boxes] * 3, 1.0 - 1e-9, np.random.default_rng(0))
    assert [each.object_ids for each in found] == [("",)] * 3
    np.testing.assert_array_equal(found[2].corners, corners[1:2])
    assert tum.sparse([boxes], 0.0, np.random.default_rng(0))[0].object_ids == boxes.object_ids


def test_tum_gives_failing_conditions_the_same_failures(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = tum.TumSettings(folder=str(folder))
    monkeypatch.setattr(tum, "OdometryFailures", lambda: OdometryFailures(every=1.0))
    given = reaching_the_back_end(
        settings, ("real_given_fixed", "failing_given_fixed", "failing_estimated_calibrated"), monkeypatch
    )
    usual, failing, same = ([motion.T_start_end for motion in motions] for motions, _ in given)
    np.testing.assert_array_equal(failing, same)
    changed = [not np.array_equal(a, b) for a, b in zip(usual, failing, strict=True)]
    assert 0.1 < np.mean(changed) < 0.95


def test_failures_of_odometry() -> None:
    """Ten minutes at 30 Hz: how often, for how long, and what is said; times of steps stay, and the seed decides."""
    step = SECOND // 30
    T = gtsam.Pose3(gtsam.Rot3(), np.array([0.01, 0.0, 0.0])).matrix()
    motions = [RelativeMotion(k * step, (k + 1) * step, T) for k in range(18_000)]
    failures = OdometryFailures()
    spoilt = failures.spoil(motions, np.random.default_rng(0))
    assert [(m.start, m.end) for m in spoilt] == [(m.start, m.end) for m in motions]
    wrong = np.array([m is not motion for m, motion in zip(spoilt, motions, strict=True)])
    begins, ends = np.flatnonzero(np.diff(wrong.astype(int)) == 1), np.flatnonzero(np.diff(wrong.astype(int)) == -1)
    lengths = (ends - begins) / 30.0
    assert 0.36 < lengths.min() < 0.5 and 0.9 < lengths.max() < 1.04
    assert 30 <= len(begins) <= 60 and np.diff(begins).min() >= 295  # 15 s give or take 5
    said = np.stack([m.T_start_end for m, w in zip(spoilt, wrong, strict=True) if w])
    still = (said == np.eye(4)).all(axis=(1, 2))
    assert abs(still.mean() - failures.nothing) < 4.0 * np.sqrt(0.2 * 0.8 / len(said))
    error = (said[~still, :3, 3] - T[:3, 3]) * 30.0  # [m/s]
    expected = np.sqrt((0.3 * 0.25**2 + 0.5) / 0.8) * failures.velocity
    assert np.sqrt((error[:, 1:] ** 2).mean()) == pytest.approx(expected, rel=0.1)
    again = failures.spoil(motions, np.random.default_rng(0))
    assert all(np.array_equal(a.T_start_end, b.T_start_end) for a, b in zip(spoilt, again, strict=True))
    assert failures.spoil([], np.random.default_rng(0)) == []


def test_tum_command(folder: Path, tmp_path: Path) -> None:
    arguments = ["tum", "--quick", "--folder", str(folder), "--seeds", "1", "--jobs", "1", "--out", str(tmp_path)]
    assert experiment.main(arguments) == 0
    result = json.loads((tmp_path / "result.json").read_text())
    assert {
        "calibrated",
        "fixed",
        "quadricslam",
        "real_given_fixed",
        "real_estimated_calibrated",
        "backwards_estimated_fixed",
        "few_estimated_quadricslam",
    } <= set(result["conditions"])
    assert "backwards_given_calibrated_vs_backwards_given_fixed" in result["paired"]
    for metrics in result["conditions"].values():
        assert 0.0 < metrics["ate_m"]["mean"] < 0.5
    assert tum.document(result["settings"])["fixed"]["ate_m"] == (0.429, 0.117)
    assert tum.document({"folder": "somewhere/fr1_desk"}) == {}


def test_tum_names_every_file_that_it_reads(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "calibrator.json").write_text('{"version": 1, "kind": "per_size"}')
    settings = tum.TumSettings(folder=str(folder), calibrator=str(tmp_path / "calibrator.json"), most_images=10)
    read = set()
    plainly = io.open

    def noted(file: Any, *args: Any, **kwargs: Any) -> Any:
        read.add(Path(file))
        return plainly(file, *args, **kwargs)

    monkeypatch.setattr(io, "open", noted)
    monkeypatch.setattr("builtins.open", noted)
    tum.recorded.cache_clear()
    tum.recorded(settings)
    assert {path for path in read if path.parent in (folder, tmp_path)} == set(tum.EXPERIMENT.inputs(settings).values())


def test_tum_noise_has_its_size(folder: Path) -> None:
    """With almost no noise the estimate is almost the truth; with the document's it is not."""
    small = tum.TumSettings(folder=str(folder), rotation_noise=1e-4, translation_noise=1e-6)
    large = tum.TumSettings(folder=str(folder))
    exact, noisy = (tum.run(settings, "fixed", repetition_seed(0, 0)) for settings in (small, large))
    assert exact["ate_m"] < 1e-3 < noisy["ate_m"]


def test_tum_says_what_is_missing(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path / "out"), "--jobs", "1"]
    assert experiment.main(["tum", *out]) == 1
    assert "--folder (not given)" in capsys.readouterr().err
    assert experiment.main(["tum", "--folder", str(folder), "--good-trajectory", "no.txt", *out]) == 1
    assert "no.txt" in capsys.readouterr().err
    with pytest.raises(ExperimentError, match=r"nothing\.json"):
        tum.recorded(tum.TumSettings(folder=str(folder), calibrator="nothing.json"))


def test_measurements_reach_the_back_end_in_order_of_time(recording: Simulation) -> None:
    """Also where they are given out of order."""
    settings = quadric_sim.EstimatorSettings(association="given")
    motions, images = recording.odometry[:60], recording.boxes[:60]
    a = estimate(recording.camera, motions, images, settings)
    b = estimate(recording.camera, motions, images[::-1], settings)
    np.testing.assert_array_equal(a.map.poses, b.map.poses)
