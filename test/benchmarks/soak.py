"""The back end under load and among faults: many boxes, a consumer that stops reading, a peer that publishes garbage.

    ./calibslam shell -c 'python test/benchmarks/soak.py [--minutes 10] [--rate 60] [--boxes 40] [--max-keyframes 400]'

A camera goes round and round a floor with objects. After a third of the time a subscriber of all maps stops reading;
all the time another node publishes what no node should. Each line states what came, what was left out, and memory; at
the end every image that was sent must be accounted for; stated are the growth of memory per keyframe, and the most in
each trajectory (`max_keyframes`), which must not grow.
"""

from __future__ import annotations

import argparse
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import gtsam
import helpers_on_path  # noqa: F401
import numpy as np
from calibslam_msgs.msg import BoundingBox, BoundingBoxArray, RelativePose
from live import Watcher, random_domain, wait_until
from live_graph import KEPT, TYPES, backend, cpu_seconds
from sensor_msgs.msg import CameraInfo
from small_world import CAMERA, SmallWorld, around

from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_msgs_py.conversions import boxes_to_msg, camera_to_msg, motion_to_msg, stamp_to_msg
from calibslam_msgs_py.measurements import SECOND

LAP = 60.0  # [s]
GARBAGE_PERIOD = 0.5  # [s]
LISTENER = """
import sys, rclpy
from calibslam_msgs.msg import QuadricArray
from calibslam_msgs_py.node import LATCHED
from nav_msgs.msg import Path
from visualization_msgs.msg import MarkerArray
rclpy.init()
node = rclpy.create_node("stuck")
for kind, topic in ((Path, "trajectory"), (QuadricArray, "quadrics"), (MarkerArray, "quadric_markers")):
    node.create_subscription(kind, topic, lambda message: None, LATCHED)
rclpy.spin(node)
"""


def floor(number: int) -> list[Ellipsoid]:
    """Objects of many sizes on a grid of 40 cm."""
    random, side = np.random.default_rng(1), int(np.ceil(np.sqrt(number)))
    places = [
        np.array([0.4 * (i % side - (side - 1) / 2), 0.4 * (i // side - (side - 1) / 2), 0.1]) for i in range(number)
    ]
    return [
        Ellipsoid(gtsam.Pose3(gtsam.Rot3.Yaw(0.7 * i), place).matrix(), random.uniform(0.05, 0.12, size=3))
        for i, place in enumerate(places)
    ]


class Load:
    """Publishes lap after lap, with stamps that go on."""

    def __init__(self, watcher: Watcher, rate: float, boxes: int) -> None:
        lap = round(LAP * rate)
        poses = around(lap + 1, turn=2.0 * np.pi, radius=4.0, height=2.5)
        world = SmallWorld(poses, floor(boxes), rate=rate, identities=False)
        self._images = [boxes_to_msg(each, TYPES) for each in world.boxes()[1:]]
        self._motions = [motion_to_msg(each, TYPES) for each in world.motions()]
        self.boxes_per_image = float(np.mean([len(message.boxes) for message in self._images]))
        node = watcher.node
        self._camera = node.create_publisher(CameraInfo, "camera/camera_info", 10)
        self._box_publisher = node.create_publisher(BoundingBoxArray, "detections", KEPT)
        self._motion_publisher = node.create_publisher(RelativePose, "relative_pose", KEPT)
        self._rate = rate
        self.sent = 0

    def run(self, stop: threading.Event) -> None:
        begin = time.monotonic()
        for n, (image, motion) in enumerate(itertools.cycle(zip(self._images, self._motions, strict=True)), start=1):
            if stop.wait(max(begin + n / self._rate - time.monotonic(), 0.0)):
                return
            stamp = stamp_to_msg(SECOND + round(n * SECOND / self._rate), TYPES)
            motion.start = stamp_to_msg(SECOND + round((n - 1) * SECOND / self._rate), TYPES)
            motion.header.stamp = image.header.stamp = stamp
            if n % round(self._rate) == 1:
                self._camera.publish(camera_to_msg(CAMERA, 0, TYPES))
            self._motion_publisher.publish(motion)
            self._box_publisher.publish(image)
            self.sent = n


def garbage(watcher: Watcher, load: Load, stop: threading.Event) -> None:
    """What no node should publish, on the same topics."""
    boxes = watcher.node.create_publisher(BoundingBoxArray, "detections", 10)
    motions = watcher.node.create_publisher(RelativePose, "relative_pose", 10)
    huge = BoundingBoxArray(width=640, height=480, boxes=[BoundingBox()] * 20_000)

    def now(message: Any) -> Any:
        message.header.stamp = stamp_to_msg(SECOND + round(load.sent * SECOND / 60.0), TYPES)
        return message

    nan = BoundingBox(corners=[float("nan")] * 4, covariance=[float("inf")] * 16)
    acts: list[Callable[[], None]] = [
        lambda: boxes.publish(BoundingBoxArray()),
        lambda: boxes.publish(now(BoundingBoxArray(width=640, height=480, boxes=[nan] * 30))),
        lambda: boxes.publish(huge),
        lambda: boxes.publish(b"\0\1\0\0" + b"\xff" * 100),
        lambda: motions.publish(RelativePose()),
        lambda: motions.publish(b"\0\1\0\0"),
    ]
    other = BoundingBoxArray(width=640, height=480)
    other.header.frame_id = "another camera"
    acts.append(lambda: boxes.publish(now(other)))
    for act in itertools.cycle(acts):
        if stop.wait(GARBAGE_PERIOD):
            return
        act()


def images_accounted(counts: dict[str, str]) -> int:
    """Images of which the back end says what became of them. Garbage is counted by other names."""
    return sum(int(counts.get(name, 0)) for name in ("images", "rejected_queue_full", "lost_detections"))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=60.0, help="images per second (default: 60)")
    parser.add_argument("--boxes", type=int, default=40, help="objects in view (default: 40)")
    parser.add_argument("--queue-size", type=int, default=10_000, help="parameter of the back end (default: 10000)")
    parser.add_argument("--max-keyframes", type=int, default=400, help="parameter of the back end (default: 400)")
    arguments = parser.parse_args()
    domain, stop = random_domain(), threading.Event()
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    rows: list[tuple[int, int, float]] = []
    limits = f"queue_size:={arguments.queue_size}", f"max_keyframes:={arguments.max_keyframes}"
    with Watcher(domain) as watcher, backend(domain, *limits) as process:
        load = Load(watcher, arguments.rate, arguments.boxes)
        print(f"{load.boxes_per_image:.1f} boxes per image at {arguments.rate:g} Hz", flush=True)
        wait_until(lambda: watcher.counts("/backend"), lambda: process.output)
        stuck = subprocess.Popen([sys.executable, "-c", LISTENER])
        threads = [
            threading.Thread(target=load.run, args=(stop,)),
            threading.Thread(target=garbage, args=(watcher, load, stop)),
        ]
        for thread in threads:
            thread.start()
        began, length = time.monotonic(), 60.0 * arguments.minutes
        try:
            while (elapsed := time.monotonic() - began) < length and process.running:
                time.sleep(min(15.0, length / 10.0))
                if elapsed > length / 3.0:
                    stuck.send_signal(signal.SIGSTOP)
                counts = watcher.counts("/backend")
                if "keyframes" in counts:
                    ended = int(counts.get("trajectories_ended", 0))
                    rows.append((ended, int(counts["keyframes"]), float(counts["memory_mb"])))
                print(line(elapsed, load.sent, counts, cpu_seconds(process.pid) / (elapsed + 1.0)), flush=True)
        finally:
            stop.set()
            for thread in threads:
                thread.join()
            stuck.kill()
            stuck.wait()
        if not process.running:
            print(f"the back end has ended:\n{process.output}")
            return 1
        waited = time.monotonic()
        while images_accounted(watcher.counts("/backend")) < load.sent and time.monotonic() < waited + 120.0:
            time.sleep(0.5)
        counts = watcher.counts("/backend")
        print(line(time.monotonic() - began, load.sent, counts, 0.0))
        missing = load.sent - images_accounted(counts)
        print(f"sent {load.sent} images, {missing} of them not accounted for; all counts: {counts}")
        print(memory(rows), f"{counts['memory_peak_mb']} MiB at most")
        code = process.end()
    return 0 if missing <= 0 and code == 0 else 1


def memory(rows: list[tuple[int, int, float]]) -> str:
    """Of trajectories ended, keyframes, and memory [MiB]: growth in the first trajectory, the most in each."""
    first = [(k, mb) for ended, k, mb in rows if not ended]
    growth = np.polyfit(*zip(*first, strict=True), 1)[0] if len(first) > 2 else np.nan
    most = {ended: max(mb for e, _, mb in rows if e == ended) for ended, _, _ in rows}
    each = ", ".join(f"{mb:.0f}" for mb in most.values())
    return f"memory: {1024 * growth:.0f} KiB per keyframe in the first trajectory; the most in each: {each} MiB;"


def line(elapsed: float, sent: int, counts: dict[str, str], cpu: float) -> str:
    names = (
        "images",
        "keyframes",
        "trajectories_ended",
        "objects",
        "queue",
        "update_ms_p50",
        "update_ms_p99",
        "delay_ms_p50",
        "memory_mb",
    )
    values = ", ".join(f"{name} {counts.get(name)}" for name in names)
    left_out = {k: int(v) for k, v in counts.items() if k.startswith(("rejected", "lost", "errors"))}
    return f"{elapsed:5.0f} s: sent {sent}, {values}, cores {cpu:.2f}, left out {left_out}"


if __name__ == "__main__":
    sys.exit(main())
