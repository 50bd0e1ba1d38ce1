"""A generated recording through real processes: play, odometry and two back ends, watched by an independent node."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibslam_msgs.msg import QuadricArray
from calibslam_msgs.srv import LoadMap, SaveMap
from geometry_msgs.msg import PoseWithCovarianceStamped
from live import Process, Watcher, asking_for_kept, keeping_all, random_domain, trajectory_of, wait_until
from nav_msgs.msg import Path as PathMessage
from visualization_msgs.msg import MarkerArray

from calibslam_backend import slam_bag
from calibslam_backend.output.metrics import Trajectory, ate
from calibslam_backend.recording import Recording
from calibslam_msgs_py.bags import BagReader
from calibslam_msgs_py.conversions import quadrics_from_msg, stamp_from_msg
from calibslam_sim import simulate

MAPS = {
    "trajectory": PathMessage,
    "quadrics": QuadricArray,
    "quadric_markers": MarkerArray,
    "pose": PoseWithCovarianceStamped,
}
NAMESPACES = {"": "calibrated", "/other": "fixed"}  # a back end in each, with another noise model
INPUTS = ("detections", "relative_pose", "camera/camera_info")


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("desk") / "bag"
    assert simulate.main(["--out", str(path), "--duration", "20", "--seed", "3"]) == 0
    return path


@pytest.fixture(scope="module")
def offline(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """metrics.json of slam_bag, by namespace."""
    result = {}
    for namespace, model in NAMESPACES.items():
        out = tmp_path_factory.mktemp("offline")
        assert slam_bag.main([str(bag), "--out", str(out), "--noise-model", model]) == 0
        result[namespace] = json.loads((out / "metrics.json").read_text())
    return result


@dataclass
class Live:
    """A graph whose recording is played to its end and whose measurements are all used."""

    domain: int
    watcher: Watcher
    truth: Trajectory
    played: str

    def trajectory(self, namespace: str) -> Trajectory:
        return trajectory_of(self.watcher.last[f"{namespace}/trajectory"])


@pytest.fixture(scope="module")
def live(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    domain = random_domain()
    truth = Recording.open(bag).ground_truth()
    assert truth is not None
    with BagReader(bag) as reader:
        images, motions = reader.counts["/detections"], reader.counts["/odom"] - 1
    backends = [
        [*asking_for_kept("/relative_pose"), "-r", f"__ns:={namespace or '/'}", "-p", f"noise_model:={model}",
         "-p", f"map_folder:={tmp_path_factory.getbasetemp()}",
         *(part for topic in INPUTS for part in ("-r", f"{topic}:=/{topic}"))]
        for namespace, model in NAMESPACES.items()
    ]  # fmt: skip
    waiting = [p for t, n in (("/odom", 1), ("/relative_pose", 2), ("/detections", 2), ("/camera/camera_info", 2))
               for p in ("--wait-for", f"{t}:{n}")]  # fmt: skip
    with (
        Watcher(domain) as watcher,
        Process(domain, "calibslam_sim", "odometry", *keeping_all("/relative_pose")) as odometry,
        Process(domain, "calibslam_backend", "backend", *backends[0]) as one,
        Process(domain, "calibslam_backend", "backend", *backends[1]) as other,
    ):
        for namespace in NAMESPACES:
            for topic, kind in MAPS.items():
                watcher.listen(kind, f"{namespace}/{topic}")
        with Process(
            domain, "calibslam_sim", "play", str(bag), "--rate", "3", *waiting, "--wait-timeout", "120"
        ) as play:
            assert play.wait(300.0) == 0, play.output
            played = play.output
        for namespace in NAMESPACES:
            expected = {"images": str(images), "motions": str(motions)}
            wait_until(
                lambda n=namespace, e=expected: watcher.counts(f"{n}/backend").items() >= e.items(),
                lambda n=namespace, e=expected: f"{n}/backend has not used {e}: {watcher.counts(f'{n}/backend')}",
            )
        yield Live(domain, watcher, truth, played)
        for process in (odometry, one, other):
            assert process.running, process.output
            assert process.end() == 0, process.output
            assert "Traceback" not in process.output


@pytest.mark.parametrize("namespace", NAMESPACES)
def test_nothing_is_lost(live: Live, bag: Path, namespace: str) -> None:
    counts = live.watcher.counts(f"{namespace}/backend")
    with BagReader(bag) as reader:
        assert int(counts["images"]) == reader.counts["/detections"]
        assert int(counts["motions"]) == reader.counts["/odom"] - 1
        assert f"played {sum(reader.counts.values())} messages" in live.played
    lost = {"rejected_queue_full", "rejected_late", "rejected_duplicate", "rejected_overlap", "odometry_gap", "errors"}
    assert not lost & counts.keys(), counts
    assert counts["images_waiting_for_odometry"] == "0"


@pytest.mark.parametrize("namespace", NAMESPACES)
def test_live_ends_as_offline(live: Live, offline: dict[str, dict[str, Any]], namespace: str) -> None:
    """Within 10 % of the offline ATE, better than odometry alone, on as many keyframes."""
    expected = offline[namespace]
    wait_until(
        lambda: ate(live.trajectory(namespace), live.truth) == pytest.approx(expected["ate_m"], rel=0.1),
        lambda: f"ATE {ate(live.trajectory(namespace), live.truth):.4f} live, {expected['ate_m']:.4f} offline",
        timeout=60.0,
    )
    assert len(live.trajectory(namespace).stamps) == expected["keyframes"]
    assert len(live.watcher.last[f"{namespace}/quadrics"].quadrics) == expected["objects"]
    assert ate(live.trajectory(namespace), live.truth) < expected["odometry_ate_m"]


def test_the_two_back_ends_are_two(live: Live) -> None:
    ends = [live.trajectory(namespace).poses[-1] for namespace in NAMESPACES]
    assert not np.allclose(*ends, atol=1e-6)


def test_what_is_published_belongs_together(live: Live) -> None:
    """All in `map`, with the stamps of images; the pose is the newest of the trajectory."""
    last = live.watcher.last
    trajectory = live.trajectory("")
    for topic in ("trajectory", "pose", "quadrics"):
        assert last[f"/{topic}"].header.frame_id == "map"
        assert stamp_from_msg(last[f"/{topic}"].header.stamp) == trajectory.stamps[-1]
    assert set(trajectory.stamps.tolist()) <= set(live.truth.stamps.tolist())
    assert live.watcher.received["/pose"] > live.watcher.received["/trajectory"] > 1
    covariance = np.array(last["/pose"].pose.covariance).reshape(6, 6)
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    quadrics = quadrics_from_msg(last["/quadrics"])
    assert len(last["/quadric_markers"].markers) == 1 + 2 * len(quadrics)
    for quadric in quadrics:
        assert np.linalg.eigvalsh(quadric.covariance).min() > -1e-12


def test_who_joins_late_gets_the_whole_map(live: Live) -> None:
    with Watcher(live.domain) as late:
        for topic, kind in MAPS.items():
            late.listen(kind, f"/{topic}")
        wait_until(lambda: late.last.keys() >= {f"/{topic}" for topic in MAPS}, "the map does not come")
        assert late.received["/trajectory"] == 1
        assert late.last["/trajectory"] == live.watcher.last["/trajectory"]
        assert late.last["/quadrics"] == live.watcher.last["/quadrics"]


def test_a_map_is_saved_and_loaded(live: Live, tmp_path: Path) -> None:
    """In the second back end, which is not needed any more."""
    watcher, path = live.watcher, tmp_path / "new folder" / "map.json"
    saved = watcher.call(SaveMap, "/other/backend/save_map", path=str(path))
    assert saved.success, saved.message
    content = json.loads(path.read_text())
    assert f"{len(content['quadrics'])} objects and {len(content['keyframes'])} keyframes in {path}" == saved.message
    published = quadrics_from_msg(watcher.last["/other/quadrics"])
    assert [q["id"] for q in content["quadrics"]] == [q.id for q in published]
    damaged = tmp_path / "damaged.json"
    shutil.copy(path, damaged)
    damaged.write_text(damaged.read_text()[:1000])
    for bad, text in (
        (tmp_path / "none.json", "cannot be read"),
        (damaged, "is not JSON"),
        (tmp_path, "cannot be read"),
    ):
        refused = watcher.call(LoadMap, "/other/backend/load_map", path=str(bad))
        assert not refused.success and text in refused.message and str(bad) in refused.message
    loaded = watcher.call(LoadMap, "/other/backend/load_map", path=str(path))
    assert loaded.success and f"{len(published)} objects" in loaded.message
    empty = watcher.call(SaveMap, "/other/backend/save_map", path=str(path))
    assert not empty.success and "no keyframe yet" in empty.message
