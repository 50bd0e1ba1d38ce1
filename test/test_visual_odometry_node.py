"""The visual odometry's node as a real process: images and depth of a bag in, motions out; what is wrong is counted."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
import plane_scene
import pytest
from calibslam_msgs.msg import RelativePose
from live import Process, Watcher, random_domain, wait_until
from sensor_msgs.msg import CameraInfo, Image

from calibslam_msgs_py.conversions import RosTypes, camera_to_msg, header_to_msg, motion_from_msg
from calibslam_msgs_py.measurements import SECOND
from calibslam_msgs_py.node import MEASUREMENT

TYPES = RosTypes()
PERIOD = SECOND // 15


@pytest.fixture(scope="module")
def live() -> Iterator[tuple[Watcher, Process]]:
    domain = random_domain()
    with (
        Watcher(domain) as watcher,
        Process(domain, "calibslam_sim", "visual_odometry", "--ros-args", "-p", "readout:=0.0") as process,
    ):
        watcher.listen(RelativePose, "/relative_pose", MEASUREMENT)
        wait_until(lambda: watcher.sees("/visual_odometry"), lambda: f"it is not there; it says: {process.output}")
        yield watcher, process


def image(stamp: int, pixels: np.ndarray, encoding: str, frame: str = "camera") -> Image:
    height, width = pixels.shape
    return Image(
        header=header_to_msg(stamp, frame, TYPES), height=height, width=width, encoding=encoding,
        step=width * pixels.itemsize, data=TYPES.octets(pixels.tobytes()),
    )  # fmt: skip


def test_images_and_depth_become_motions(live: tuple[Watcher, Process]) -> None:
    watcher, process = live
    publishers = {
        name: watcher.node.create_publisher(kind, f"/camera/{name}", MEASUREMENT)
        for name, kind in (("camera_info", CameraInfo), ("image_raw", Image), ("depth/image_raw", Image))
    }
    for publisher in publishers.values():
        wait_until(lambda p=publisher: p.get_subscription_count() == 1, "it does not subscribe")
    picture = plane_scene.texture()

    def counts() -> dict[str, str]:
        return watcher.counts("/visual_odometry")

    def send(k: int, frame: str = "camera", encoding: str = "16UC1") -> None:
        stamp = k * PERIOD
        grey, depth = plane_scene.take(picture, plane_scene.shaking, stamp / SECOND)
        publishers["image_raw"].publish(image(stamp, grey, "mono8"))
        depth = np.rint(depth * 1000.0).astype("<u2")
        publishers["depth/image_raw"].publish(image(stamp, depth, encoding, frame))

    def rejected(reason: str) -> bool:
        return int(counts().get(f"rejected_{reason}", 0)) > 0

    def hears(reason: str, publish: Callable[[], None]) -> bool:
        """Published again and again: it may not have heard of its new publishers yet."""
        publish()
        time.sleep(0.2)
        return rejected(reason)

    wait_until(lambda: hears("no_camera", lambda: send(1)), lambda: f"{counts()} {process.output}")
    camera = publishers["camera_info"]
    wait_until(lambda: hears("camera", lambda: camera.publish(CameraInfo())), lambda: f"{counts()} {process.output}")
    camera.publish(camera_to_msg(plane_scene.CAMERA, 0, TYPES))
    # Each only when the one before is done: none is dropped.
    for k in range(2, 8):
        send(k)
        wait_until(lambda k=k: k == 2 or watcher.received["/relative_pose"] == k - 2, lambda: f"{counts()}")
        if k == 2:
            wait_until(lambda: int(counts().get("images", 0)) == 1, lambda: f"{counts()} {process.output}")
    motion = motion_from_msg(watcher.last["/relative_pose"])
    assert (motion.start, motion.end, motion.frame_id) == (6 * PERIOD, 7 * PERIOD, "camera")
    poses = [plane_scene.shaking(k * PERIOD / SECOND).matrix() for k in (6, 7)]
    np.testing.assert_allclose(motion.T_start_end, np.linalg.inv(poses[0]) @ poses[1], atol=0.005)
    assert motion.covariance is not None
    # What is wrong is counted, by reason.
    send(8, frame="infrared")
    send(9, encoding="rgb8")
    send(9)
    for reason in ("depth_frame", "depth_encoding", "out_of_order"):
        wait_until(lambda r=reason: rejected(r), lambda: f"{counts()} {process.output}")
    assert counts()["motions"] == "5" and "bridged" not in counts()
