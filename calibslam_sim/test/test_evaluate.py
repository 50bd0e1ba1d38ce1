"""Evaluation of runs whose errors are known, because they were made."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibslam_backend.output.metrics import Trajectory
from calibslam_backend.output.object_map import ObjectMap
from calibslam_msgs_py.bags import BagWriter
from calibslam_msgs_py.measurements import QuadricEstimate
from calibslam_sim import evaluate, topics
from calibslam_sim.accuracy.reference import NoReference, Reference, read_reference
from calibslam_sim.simulate import write_bag
from calibslam_sim.simulation.recording import SimulationSettings, simulate

SIMULATION = simulate(SimulationSettings(seed=1, duration=4.0))
EVERY = 10  # image is a keyframe
OFFSET = 0.012  # [m]
SIGMA = 0.001  # [m] stated


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("reference") / "bag"
    write_bag(SIMULATION, path)
    return path


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A RUN folder with the truth in another frame, but for one keyframe that is off."""
    T_map_world = np.eye(4)
    T_map_world[:3, :3] = Rotation.from_rotvec([0.1, -0.2, 0.7]).as_matrix()
    T_map_world[:3, 3] = [3.0, -2.0, 1.0]
    poses = T_map_world @ SIMULATION.T_world_camera[::EVERY]
    poses[5, 0, 3] += OFFSET
    quadrics = tuple(
        QuadricEstimate(
            thing.id,
            thing.class_id,
            T_map_world @ thing.ellipsoid.T_world_object,
            thing.ellipsoid.radii,
            np.eye(9),
            3,
        )
        for thing in SIMULATION.world[:4]
    )
    covariances = np.tile(np.eye(6) * SIGMA**2, (len(poses), 1, 1))
    stamps = tuple(int(stamp) for stamp in SIMULATION.times[::EVERY])
    folder = tmp_path / "run"
    folder.mkdir()
    ObjectMap(stamps, poses, covariances, quadrics).save(folder / "map.json")
    return folder


def test_known_errors_are_measured(run: Path, bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run / "metrics.json").write_text('{"wall_s": 7.0, "ate_m": 9.0}')
    assert evaluate.main([str(run), "--reference", str(bag), "--json"]) == 0
    metrics = json.loads(capsys.readouterr().out)
    n = len(SIMULATION.times[::EVERY])
    # One of n keyframes is off; the alignment takes a little of it away.
    assert metrics["ate_m"] == pytest.approx(OFFSET / np.sqrt(n), rel=0.1)
    assert metrics["rpe_m"] == pytest.approx(OFFSET * np.sqrt(2.0 / (n - 1)), rel=0.01)
    assert metrics["nees_position"] == pytest.approx((OFFSET / SIGMA) ** 2 / (n - 1), rel=0.01)
    objects = metrics["object_accuracy"]
    assert (objects["true"], objects["estimated"], objects["matched"]) == (19, 4, 4)
    assert objects["centre_m"] < 0.05  # a short path fixes the rotation of the alignment badly
    assert objects["radii"] == pytest.approx(0.0, abs=1e-6)
    written = json.loads((run / "metrics.json").read_text())
    assert written["wall_s"] == 7.0
    assert written["ate_m"] == metrics["ate_m"]
    assert metrics["keyframes_with_truth"] == n
    assert len((run / "trajectory.tum").read_text().splitlines()) == n
    assert (run / "trajectory.png").stat().st_size > 10_000


def test_odometry_alone_is_measured_too(run: Path, bag: Path) -> None:
    metrics = evaluate.evaluate(run, read_reference(bag))
    step = np.sqrt(3.0) * 0.006 * np.sqrt(EVERY)
    assert metrics["odometry_rpe_m"] == pytest.approx(step, rel=0.5)
    assert 0.2 < metrics["odometry_nees_position"] < 15.0
    assert "estimate" in evaluate.table(metrics)
    assert "  4 of 19\n" in evaluate.table(metrics)


def test_a_map_file_is_evaluated_and_nothing_beside_it_changed(
    run: Path, bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate.main([str(run), "--reference", str(bag), "--json"]) == 0
    of_folder = capsys.readouterr().out
    (run / "map.json").rename(run / "live_map.json")
    before = {file.name: file.read_bytes() for file in run.iterdir()}
    assert evaluate.main([str(run / "live_map.json"), "--reference", str(bag), "--json"]) == 0
    assert capsys.readouterr().out == of_folder
    assert {file.name: file.read_bytes() for file in run.iterdir()} == before


def test_objects_that_are_none_are_told() -> None:
    for estimated, told in ((4, "4 of 19"), (5, "4 of 19, 1 that is none"), (6, "4 of 19, 2 that are none")):
        assert evaluate.found_objects({"true": 19, "matched": 4, "estimated": estimated}) == told


def test_how_much_ground_truth_there_is_is_said(run: Path) -> None:
    (run / "metrics.json").write_text('{"no_accuracy": "no ground truth"}')
    truth = Trajectory(SIMULATION.times[: 5 * EVERY], SIMULATION.T_world_camera[: 5 * EVERY])
    metrics = evaluate.evaluate(run, Reference(truth, [], None))
    assert metrics["keyframes_with_truth"] == 5
    assert f"ATE over 5 of {metrics['keyframes']} keyframes" in evaluate.table(metrics)
    assert "no_accuracy" not in json.loads((run / "metrics.json").read_text())


def test_a_tum_folder_or_file_is_a_reference(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "tum"
    folder.mkdir()
    lines = []
    for stamp, T in zip(SIMULATION.times, SIMULATION.T_world_camera, strict=True):
        numbers = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
        lines.append(f"{stamp // 10**9}.{stamp % 10**9:09d} " + " ".join(f"{x:.9f}" for x in numbers))
    (folder / "groundtruth.txt").write_text("\n".join(lines))
    of_file = evaluate.evaluate(run, read_reference(folder / "groundtruth.txt"))
    assert of_file["ate_m"] < 0.05
    assert "odometry_ate_m" not in of_file
    assert "object_accuracy" not in of_file
    (folder / "odometry.txt").write_text("\n".join(lines))
    assert evaluate.evaluate(run, read_reference(folder))["odometry_ate_m"] < 1e-6


def test_metrics_without_any_pair_are_json(run: Path, bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = ObjectMap.load(run / "map.json")
    strange = tuple(replace(quadric, class_id="unknown") for quadric in whole.quadrics)
    replace(whole, quadrics=strange).save(run / "map.json")
    assert evaluate.main([str(run), "--reference", str(bag)]) == 0
    assert "0 of 19" in capsys.readouterr().out

    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    objects = json.loads((run / "metrics.json").read_text(), parse_constant=refuse)["object_accuracy"]
    assert (objects["matched"], objects["centre_m"], objects["radii"], objects["iou"]) == (0, None, None, None)


@pytest.mark.parametrize("content", ["{", "[]", "\0"])
def test_damaged_metrics_are_said(run: Path, bag: Path, content: str, capsys: pytest.CaptureFixture[str]) -> None:
    (run / "metrics.json").write_text(content)
    assert evaluate.main([str(run), "--reference", str(bag)]) == 1
    assert "remove it, and it is written anew" in capsys.readouterr().err
    assert (run / "metrics.json").read_text() == content and not (run / "trajectory.tum").exists()


def test_what_cannot_be_compared_is_said(
    run: Path, bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with BagWriter(tmp_path / "empty") as writer:
        writer.add_topic(topics.ODOMETRY, "nav_msgs/msg/Odometry")
    with pytest.raises(NoReference, match="has no /ground_truth"):
        read_reference(tmp_path / "empty")
    (tmp_path / "tum").mkdir()
    (tmp_path / "tum" / "odometry.txt").touch()
    with pytest.raises(NoReference, match=r"tum has no groundtruth\.txt"):
        read_reference(tmp_path / "tum")
    with pytest.raises(NoReference, match=r"does not exist|cannot be read"):
        read_reference(tmp_path / "nowhere")
    (run / "map.json").unlink()
    assert evaluate.main([str(run), "--reference", str(bag)]) == 1
    assert "map.json" in capsys.readouterr().err
    shutil.rmtree(run)
    assert evaluate.main([str(run), "--reference", str(bag)]) == 1
