"""Real recordings, where they are present: figures that must be reached, the same bytes always, live as offline."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from live import Process, Watcher, asking_for_kept, keeping_all, random_domain, trajectory_of, wait_until
from nav_msgs.msg import Path as PathMessage

from calibslam_backend import slam_bag
from calibslam_backend.output.metrics import ate
from calibslam_backend.recording import Recording
from calibslam_msgs_py.bags import BagReader
from calibslam_sim import tum_to_bag

RECORDINGS = Path(__file__).resolve().parents[2] / "shared" / "data" / "tum"
GIVEN = ("--association", "given")
FIXED = ("--noise-model", "fixed")
RATE = 5.0


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Name of the recording -> bag."""
    names = ("fr3_office", "fr1_desk")
    missing = [str(RECORDINGS / name) for name in names if not (RECORDINGS / name).is_dir()]
    if missing:
        pytest.skip(f"needs the recordings {', '.join(missing)}")
    folder = tmp_path_factory.mktemp("tum")
    for name in names:
        assert tum_to_bag.main([str(RECORDINGS / name), "--out", str(folder / name)]) == 0
    return {name: folder / name for name in names}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[Any, ...], Path]:
    return {}


def run(bag: Path, runs: dict[tuple[Any, ...], Path], tmp_path_factory: pytest.TempPathFactory, *options: str) -> Path:
    """The RUN folder; each is computed once."""
    key = (bag, *options)
    if key not in runs:
        out = tmp_path_factory.mktemp("run")
        assert slam_bag.main([str(bag), "--out", str(out), *options]) == 0
        runs[key] = out
    return runs[key]


@pytest.mark.parametrize(
    ("name", "options", "most"),
    [
        ("fr3_office", (*FIXED, *GIVEN), 0.12),
        ("fr3_office", FIXED, 0.16),
        ("fr3_office", (), 0.16),
        ("fr1_desk", (*FIXED, *GIVEN), None),
    ],
    ids=str,
)
def test_accuracy(
    name: str,
    options: tuple[str, ...],
    most: float | None,
    bags: dict[str, Path],
    runs: dict[tuple[Any, ...], Path],
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """At most so many metres; where none is named, 20 % less than odometry alone. Boxes and odometry only."""
    metrics = json.loads((run(bags[name], runs, tmp_path_factory, *options) / "metrics.json").read_text())
    assert metrics["ate_m"] <= (0.8 * metrics["odometry_ate_m"] if most is None else most)
    assert metrics["objects"] > 10 and metrics["boxes_used"] > 100
    if "given" in options:
        assert metrics["association"]["precision"] == 1.0


def test_two_runs_write_the_same_bytes(
    bags: dict[str, Path], runs: dict[tuple[Any, ...], Path], tmp_path_factory: pytest.TempPathFactory
) -> None:
    """The recording with the fast motion, all defaults."""
    first = run(bags["fr1_desk"], runs, tmp_path_factory)
    second = run(bags["fr1_desk"], {}, tmp_path_factory)
    for file in ("trajectory.tum", "map.json"):
        assert (first / file).read_bytes() == (second / file).read_bytes()


def test_live_equals_offline(
    bags: dict[str, Path], runs: dict[tuple[Any, ...], Path], tmp_path_factory: pytest.TempPathFactory
) -> None:
    """fr3_office at five times its speed through calibrator, odometry and back end: nothing lost, ATE within 10 %."""
    bag = bags["fr3_office"]
    offline = json.loads((run(bag, runs, tmp_path_factory) / "metrics.json").read_text())
    recording = Recording.open(bag)
    truth = recording.ground_truth()
    assert truth is not None
    with BagReader(bag) as reader:
        images, motions = reader.counts["/detections_raw"], reader.counts["/odom"] - 1
    everybody = ("/odom:1", "/relative_pose:1", "/detections_raw:1", "/detections:1", "/camera/camera_info:1")
    waiting = [part for topic in everybody for part in ("--wait-for", topic)]
    domain = random_domain()
    with (
        Watcher(domain) as watcher,
        Process(domain, "calibslam_sim", "odometry", *keeping_all("/relative_pose")) as odometry,
        Process(domain, "calibslam_detector", "calibrator", *keeping_all("/detections")) as calibrator,
        Process(domain, "calibslam_backend", "backend", *asking_for_kept("/detections", "/relative_pose")) as backend,
    ):
        watcher.listen(PathMessage, "/trajectory")
        options = [str(bag), "--rate", str(RATE), *waiting, "--wait-timeout", "120"]
        with Process(domain, "calibslam_sim", "play", *options) as play:
            assert play.wait(600.0) == 0, play.output
        expected = {"images": str(images), "motions": str(motions)}
        wait_until(
            lambda: watcher.counts("/backend").items() >= expected.items(),
            lambda: f"expected {expected}, reported {watcher.counts('/backend')}",
            timeout=300.0,
        )

        def error() -> float:
            return ate(trajectory_of(watcher.last["/trajectory"]), truth)

        # The map is published now and then: the newest one may lack the last keyframe still.
        wait_until(
            lambda: len(watcher.last["/trajectory"].poses) == offline["keyframes"],
            lambda: f"{len(watcher.last['/trajectory'].poses)} keyframes live, {offline['keyframes']} offline",
        )
        wait_until(
            lambda: error() == pytest.approx(offline["ate_m"], rel=0.1),
            lambda: f"ATE {error():.4f} live, {offline['ate_m']:.4f} offline",
        )
        lost = {
            "rejected_queue_full",
            "rejected_late",
            "rejected_duplicate",
            "rejected_overlap",
            "odometry_gap",
            "errors",
        }
        assert not lost & watcher.counts("/backend").keys()
        for process in (odometry, calibrator, backend):
            assert process.end() == 0, process.output
