"""What `simulate` and `tum_to_bag` write: complete, the same every time, and clear about what is missing."""

from __future__ import annotations

from pathlib import Path

import cv2
import gtsam
import numpy as np
import pytest

from calibslam_msgs_py.bags import BagReader
from calibslam_msgs_py.conversions import (
    boxes_from_msg,
    camera_from_msg,
    odometry_from_msg,
    pose_from_msg,
    quadrics_from_msg,
    stamped_pose_from_msg,
    valid_boxes,
)
from calibslam_sim import simulate, topics, tum_to_bag
from calibslam_sim.simulation.recording import CAMERA, SimulationSettings
from calibslam_sim.simulation.recording import simulate as simulated

SETTINGS = SimulationSettings(seed=5, duration=1.0)
OPTIONS = ["--seed", "5", "--duration", "1"]


def messages(path: Path, topic: str) -> list:
    with BagReader(path) as bag:
        return [message for _, _, message in bag.messages([topic])]


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("simulated") / "bag"
    assert simulate.main(["--out", str(path), *OPTIONS]) == 0
    return path


def test_the_same_seed_writes_the_same_bytes(bag: Path, tmp_path: Path) -> None:
    # A bag holds its own name, so the folders are called the same.
    again, other = tmp_path / "again" / "bag", tmp_path / "other" / "bag"
    assert simulate.main(["--out", str(again), *OPTIONS]) == 0
    assert simulate.main(["--out", str(other), "--seed", "6", "--duration", "1"]) == 0
    assert (again / "bag.mcap").read_bytes() == (bag / "bag.mcap").read_bytes()
    assert (again / "metadata.yaml").read_bytes() == (bag / "metadata.yaml").read_bytes()
    assert (other / "bag.mcap").read_bytes() != (bag / "bag.mcap").read_bytes()


def test_a_bag_holds_the_simulation(bag: Path) -> None:
    simulation = simulated(SETTINGS)
    read = [boxes_from_msg(message) for message in messages(bag, topics.DETECTIONS)]
    assert [boxes.stamp for boxes in read] == list(simulation.times)
    for boxes, expected in zip(read, simulation.boxes, strict=True):
        np.testing.assert_array_equal(boxes.corners, expected.corners)
        np.testing.assert_allclose(boxes.covariances, expected.covariances, rtol=1e-12)
        assert boxes.object_ids == expected.object_ids
        assert valid_boxes(boxes)[1] == {}
    truth = [stamped_pose_from_msg(message) for message in messages(bag, topics.GROUND_TRUTH)]
    np.testing.assert_allclose([pose.T for pose in truth], simulation.T_world_camera, atol=1e-12)
    camera = camera_from_msg(messages(bag, topics.CAMERA_INFO)[0])
    np.testing.assert_array_equal(camera.K, CAMERA.K)
    (quadrics,) = (quadrics_from_msg(m) for m in messages(bag, topics.GROUND_TRUTH_QUADRICS))
    for quadric, thing in zip(quadrics, simulation.world, strict=True):
        np.testing.assert_allclose(quadric.T_map_object, thing.ellipsoid.T_world_object, atol=1e-12)
        np.testing.assert_array_equal(quadric.radii, thing.ellipsoid.radii)
        assert (quadric.id, quadric.class_id) == (thing.id, thing.class_id)


def test_odometry_carries_the_steps_and_their_covariance(bag: Path) -> None:
    simulation = simulated(SETTINGS)
    read = messages(bag, topics.ODOMETRY)
    for k, motion in enumerate(simulation.odometry):
        before, after = pose_from_msg(read[k].pose.pose), pose_from_msg(read[k + 1].pose.pose)
        np.testing.assert_allclose(np.linalg.inv(before) @ after, motion.T_start_end, atol=1e-12)
        twist = read[k + 1].twist.twist
        seconds = (motion.end - motion.start) * 1e-9
        velocity = [getattr(v, axis) for v in (twist.angular, twist.linear) for axis in "xyz"]
        step = gtsam.Pose3.Expmap(np.array(velocity) * seconds).matrix()
        np.testing.assert_allclose(step, motion.T_start_end, atol=1e-12)
        _, covariance = odometry_from_msg(read[k + 1])
        assert covariance is not None
        np.testing.assert_allclose(covariance * seconds**2, motion.covariance, rtol=1e-9)
    assert odometry_from_msg(read[0])[1] is None


def test_an_existing_bag_is_only_replaced_if_asked(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert simulate.main(["--out", str(bag), *OPTIONS]) == 1
    assert "exists already" in capsys.readouterr().err
    assert simulate.main(["--out", str(bag), *OPTIONS, "--overwrite"]) == 0
    assert " frames, without images (--images), " in capsys.readouterr().out


@pytest.mark.parametrize(
    "options", [["--duration", "0"], ["--seed", "-1"], ["--outliers", "2"], ["--scenario", "moon"]]
)
def test_bad_options_are_refused(options: list[str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as caught:
        simulate.main(["--out", str(tmp_path / "bag"), *options])
    assert caught.value.code == 2
    assert not (tmp_path / "bag").exists()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A small recording in the format of the TUM benchmark."""
    path = tmp_path / "tum"
    (path / "rgb").mkdir(parents=True)
    (path / "depth").mkdir()
    poses = "# timestamp tx ty tz qx qy qz qw\n1.0 0 0 0 0 0 0 1\n1.5 0.1 0 0 0 0 0.6 0.8\n"
    (path / "odometry.txt").write_text(poses)
    (path / "groundtruth.txt").write_text(poses)
    (path / "detections.csv").write_text(
        "timestamp,xmin,ymin,xmax,ymax,score,class_id,object_id\n1.5,10,20,30,40,0.9,41,3\n"
    )
    (path / "camera_info.yaml").write_text(
        "image_width: 4\nimage_height: 2\n"
        "camera_matrix: {data: [500.0, 0.0, 2.0, 0.0, 500.0, 1.0, 0.0, 0.0, 1.0]}\n"
        "distortion_coefficients: {data: [0.0, 0.0, 0.0, 0.0, 0.0]}\n"
    )
    cv2.imwrite(str(path / "rgb" / "1.png"), np.arange(24, dtype=np.uint8).reshape(2, 4, 3))
    cv2.imwrite(str(path / "depth" / "1.png"), np.array([[0, 5000, 5, 65535]] * 2, np.uint16))
    (path / "rgb.txt").write_text("1.0 rgb/1.png\n")
    (path / "depth.txt").write_text("1.0 depth/1.png\n")
    return path


def test_numbers_of_classes_become_names(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = tmp_path / "coco.names"
    names.write_text("\n".join(f"class {n}" for n in range(42)) + "\n\n")
    arguments = [str(folder), "--out", str(tmp_path / "bag"), "--class-names", str(names)]
    assert tum_to_bag.main(arguments) == 0
    (boxes,) = (boxes_from_msg(m) for m in messages(tmp_path / "bag", topics.DETECTIONS_WITHOUT_COVARIANCE))
    assert boxes.class_ids == ("class 41",)
    for content, said in (
        ("cup\nbook\n", "class 41 is not one of the 2 of --class-names"),
        ("cup\n\nbook\n", "must hold a name in each line"),
    ):
        names.write_text(content)
        assert tum_to_bag.main([*arguments, "--overwrite"]) == 1
        assert said in capsys.readouterr().err


def test_a_tum_folder_becomes_a_bag(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "bag"
    assert tum_to_bag.main([str(folder), "--out", str(out)]) == 0
    with BagReader(out) as reader:
        assert dict(reader.counts) == {
            topics.ODOMETRY: 2,
            topics.GROUND_TRUTH: 2,
            topics.DETECTIONS_WITHOUT_COVARIANCE: 1,
            topics.CAMERA_INFO: 2,
            topics.IMAGE: 1,
            topics.DEPTH: 1,
        }
    boxes = boxes_from_msg(messages(out, topics.DETECTIONS_WITHOUT_COVARIANCE)[0])
    assert (boxes.stamp, boxes.width, boxes.height) == (1_500_000_000, 4, 2)
    assert (boxes.class_ids, boxes.object_ids) == (("41",), ("3",))
    assert not boxes.has_covariance.any()
    odometry = messages(out, topics.ODOMETRY)
    pose, covariance = odometry_from_msg(odometry[1])
    assert covariance is None
    assert odometry[1].twist.twist.angular.z == pytest.approx(2.0 * 2.0 * np.arctan2(0.6, 0.8))
    np.testing.assert_allclose(pose.T[:3, 3], [0.1, 0.0, 0.0])
    image = messages(out, topics.IMAGE)[0]
    assert image.format == "png"
    assert bytes(image.data) == (folder / "rgb" / "1.png").read_bytes()


def test_depth_is_written_in_millimetres(folder: Path, tmp_path: Path) -> None:
    assert tum_to_bag.main([str(folder), "--out", str(tmp_path / "bag")]) == 0
    depth = messages(tmp_path / "bag", topics.DEPTH)[0]
    assert (depth.encoding, depth.height, depth.width, depth.step) == ("16UC1", 2, 4, 8)
    assert np.frombuffer(bytes(depth.data), "<u2").tolist() == [0, 1000, 1, 13107] * 2


def test_what_a_folder_lacks_is_said(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("odometry.txt", "groundtruth.txt", "detections.csv"):
        (folder / name).unlink()
    assert tum_to_bag.main([str(folder), "--out", str(tmp_path / "bag"), "--class-names", "coco.names"]) == 0
    said = capsys.readouterr().out
    assert "no odometry.txt" in said
    assert "--detections" in said
    assert "coco.names is not used" in said
    (folder / "rgb.txt").unlink()
    assert tum_to_bag.main([str(folder), "--out", str(tmp_path / "other")]) == 1
    assert "nothing to convert" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


def test_a_plain_benchmark_folder_needs_the_name_of_its_camera(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "camera_info.yaml").unlink()
    assert tum_to_bag.main([str(folder), "--out", str(tmp_path / "bag")]) == 1
    assert "--camera fr1, fr2 or fr3" in capsys.readouterr().err
    assert tum_to_bag.main([str(folder), "--out", str(tmp_path / "bag"), "--camera", "fr2"]) == 0
    assert camera_from_msg(messages(tmp_path / "bag", topics.CAMERA_INFO)[0]).K[0, 0] == 520.908620


def test_other_boxes_can_be_named(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "other.csv"
    other.write_text("timestamp,xmin,ymin,xmax,ymax,score,class_id\n1.0,1,1,2,2,0.9,7\n")
    options = [str(folder), "--out", str(tmp_path / "bag"), "--detections"]
    assert tum_to_bag.main([*options, str(tmp_path / "nowhere.csv")]) == 1
    assert "nowhere.csv: cannot be read" in capsys.readouterr().err
    assert tum_to_bag.main([*options, str(other)]) == 0
    (message,) = messages(tmp_path / "bag", topics.DETECTIONS_WITHOUT_COVARIANCE)
    assert boxes_from_msg(message).class_ids == ("7",)


def test_an_image_that_is_none_leaves_no_bag_behind(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cv2.imwrite(str(folder / "depth" / "1.png"), np.zeros((2, 4), np.uint8))
    assert tum_to_bag.main([str(folder), "--out", str(tmp_path / "bag")]) == 1
    assert "not a 16-bit PNG" in capsys.readouterr().err
    assert not (tmp_path / "bag").exists()
