"""`visual_odometry_bag`: a bag with images and depth becomes one with relative motions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import plane_scene
import pytest

from calibslam_msgs_py import bags
from calibslam_msgs_py.bags import BagReader, BagWriter
from calibslam_msgs_py.conversions import camera_to_msg, header_to_msg, motion_from_msg, stamped_pose_to_msg
from calibslam_msgs_py.measurements import SECOND, StampedPose
from calibslam_sim import topics, visual_odometry_bag
from calibslam_sim.tum_to_bag import convert

PERIOD = SECOND // 15
RECORDING = Path(__file__).resolve().parents[3] / "shared" / "data" / "tum" / "fr1_xyz_first_half"


def image_msg(stamp: int, grey: np.ndarray, frame: str = "camera") -> Any:
    return bags.types("sensor_msgs/msg/CompressedImage")(
        header=header_to_msg(stamp, frame, bags.types),
        format="png",
        data=bags.types.octets(cv2.imencode(".png", grey)[1].tobytes()),
    )


def depth_msg(stamp: int, depth: np.ndarray, encoding: str, frame: str = "camera") -> Any:
    height, width = depth.shape
    metres = encoding == "32FC1"
    pixels = depth.astype("<f4") if metres else np.rint(depth * 1000.0).astype("<u2")
    return bags.types("sensor_msgs/msg/Image")(
        header=header_to_msg(stamp, frame, bags.types), height=height, width=width, encoding=encoding, is_bigendian=0,
        step=width * pixels.itemsize, data=bags.types.octets(pixels.tobytes()),
    )  # fmt: skip


def make(
    path: Path, encoding: str = "16UC1", depth_frame: str = "camera", images: int = 15, camera: bool = True
) -> Path:
    picture = plane_scene.texture()
    with BagWriter(path) as bag:
        for k in range(images):
            stamp = SECOND + k * PERIOD
            grey, depth = plane_scene.take(picture, plane_scene.shaking, stamp / SECOND)
            if camera:
                bag.write(topics.CAMERA_INFO, camera_to_msg(plane_scene.CAMERA, stamp, bags.types), stamp)
            bag.write(topics.IMAGE, image_msg(stamp, grey), stamp)
            bag.write(topics.DEPTH, depth_msg(stamp + 2_000_000, depth, encoding, depth_frame), stamp + 2_000_000)
        for stamp in range(SECOND, SECOND + images * PERIOD, 10_000_000):
            pose = StampedPose(stamp, plane_scene.shaking(stamp / SECOND).matrix())
            bag.write(topics.GROUND_TRUTH, stamped_pose_to_msg(pose, topics.WORLD, bags.types), stamp)
    return path


def run(bag: Path, out: Path, *options: str) -> int:
    return visual_odometry_bag.main([str(bag), "--out", str(out), "--readout", "0", *options])


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_motions_are_added(encoding: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = make(tmp_path / "bag", encoding)
    assert run(bag, tmp_path / "out") == 0
    text = capsys.readouterr().out
    assert "14 motions, 0 of them bridged" in text and "ATE 0.0" in text and "inside 90 %" in text
    with BagReader(bag) as before, BagReader(tmp_path / "out") as after:
        assert after.topics == {**before.topics, "/relative_pose": "calibslam_msgs/msg/RelativePose"}
        assert {t: n for t, n in after.counts.items() if t != "/relative_pose"} == before.counts
        found = list(after.messages(["/relative_pose"]))
    motions = [motion_from_msg(message) for _, _, message in found]
    # As live: known with the depth image, not before.
    assert [time for _, time, _ in found] == [motion.end + 2_000_000 for motion in motions]
    assert [motion.end for motion in motions] == [SECOND + k * PERIOD for k in range(1, 15)]
    assert all(motion.covariance is not None for motion in motions)
    # Motions of before are replaced; the same bag gives the same bytes.
    assert run(tmp_path / "out", tmp_path / "replaced") == 0
    assert "/relative_pose is not copied" in capsys.readouterr().out
    assert run(bag, tmp_path / "again" / "out") == 0
    again, out = ((tmp_path / name / "out.mcap").read_bytes() for name in ("again/out", "out"))
    assert again == out


def test_what_is_missing_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = make(tmp_path / "bag", images=3, camera=False)
    assert run(bag, tmp_path / "out") == 1
    assert f"no topic {topics.CAMERA_INFO}; name another with --camera-info" in capsys.readouterr().err
    assert run(bag, tmp_path / "out", "--depth", "/depth") == 1
    error = capsys.readouterr().err
    assert "no topic /depth; name another with --depth. It has:" in error and topics.DEPTH in error
    assert not (tmp_path / "out").exists()


def test_the_recording_is_not_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = make(tmp_path / "bag", images=3)
    for read in (bag, bag / "bag.mcap"):
        assert run(read, bag, "--overwrite") == 1
        assert "would replace" in capsys.readouterr().err
    assert sorted(path.name for path in bag.iterdir()) == ["bag.mcap", "metadata.yaml"]


def test_depth_of_another_frame_is_refused_unless_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = make(tmp_path / "bag", depth_frame="infrared", images=4)
    assert run(bag, tmp_path / "out") == 1
    error = capsys.readouterr().err
    assert "'infrared', the image in 'camera': it is not registered" in error and "depth_frame 4" in error
    assert run(bag, tmp_path / "out", "--any-depth-frame") == 0
    assert "3 motions" in capsys.readouterr().out


@pytest.mark.skipif(not RECORDING.is_dir(), reason=f"there is no {RECORDING}")
def test_a_real_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The target: ATE <= 0.03 m over the 200 images; measured 0.020 m."""
    convert(RECORDING, tmp_path / "bag")
    assert visual_odometry_bag.main([str(tmp_path / "bag"), "--out", str(tmp_path / "out")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("199 motions, 0 of them bridged")
    assert float(next(line for line in lines if line.startswith("ATE")).split()[1]) <= 0.03
    # Over five steps: measured 73 % inside the 90 % ellipsoids.
    row = next(line.split() for line in lines if line.startswith("    5"))
    assert int(row[-1].rstrip("%")) >= 65
