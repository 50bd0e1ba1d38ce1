"""How the processes begin and end: signals, bad parameters, bad command lines."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from live import Process, Watcher, random_domain, wait_until

from calibslam_sim import simulate

NODES = {
    "odometry": "calibslam_sim",
    "calibrator": "calibslam_detector",
    "backend": "calibslam_backend",
}


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("desk") / "bag"
    assert simulate.main(["--out", str(path), "--duration", "1"]) == 0
    return path


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_every_process_with_0(number: signal.Signals, bag: Path) -> None:
    """All at once, while they work on a recording that is played again and again."""
    domain = random_domain()
    processes = [Process(domain, package, name) for name, package in NODES.items()]
    processes.append(Process(domain, "calibslam_sim", "play", str(bag), "--loop", "--wait-for", "/detections:1"))
    try:
        with Watcher(domain) as watcher:
            for process in processes:
                wait_until(lambda p=process: watcher.sees(f"/{p.name}"), f"{process.name} does not start")
            wait_until(lambda: int(watcher.counts("/backend").get("keyframes", 0)) > 0, "there is no keyframe")
            wait_until(lambda: watcher.counts("/calibrator") is not None, "the calibrator says nothing")
            for process in processes:
                assert process.running, process.output
                assert process.end(number) == 0, process.output
                assert "Traceback" not in process.output
    finally:
        for process in processes:
            process.__exit__()


@pytest.mark.parametrize("name", NODES)
def test_signals_that_come_at_once(name: str) -> None:
    """As soon as the node is there, before anything came in."""
    domain = random_domain()
    with Watcher(domain) as watcher, Process(domain, NODES[name], name) as process:
        wait_until(lambda: watcher.sees(f"/{name}"), f"{name} does not start")
        assert process.end(signal.SIGTERM) == 0, process.output


@pytest.mark.parametrize(
    ("name", "parameter", "text"),
    [
        ("odometry", "sead:=3", "unknown parameter sead; valid are: rotation_noise, seed, source"),
        ("calibrator", "kalibrator:=x", "unknown parameter kalibrator; valid are: calibrator"),
        ("backend", "noise_modell:=fixed", "unknown parameter noise_modell; valid are: agility, ambiguity"),
        ("odometry", "source:=gps", "must be one of odom, ground_truth"),
        ("calibrator", "calibrator:=/nowhere.json", "calibrator file /nowhere.json cannot be read"),
        ("backend", "noise_model:=best", "must be one of calibrated, fixed, quadricslam"),
        ("backend", "votes:=0", "votes = 0: must be at least 1"),
        ("backend", "votes:=two", "votes = 'two': must be an integer"),
        ("backend", "camera_in_body:=1 2 3", "camera_in_body: a pose is seven numbers"),
    ],
)
def test_bad_parameters(name: str, parameter: str, text: str) -> None:
    with Process(random_domain(), NODES[name], name, "--ros-args", "-p", parameter) as process:
        assert process.wait() == 2, process.output
        assert text in process.output and "Traceback" not in process.output


def test_what_cannot_be_played(bag: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes((bag / "bag.mcap").read_bytes()[:5000])
    for path, text in ((tmp_path / "none", "does not exist"), (damaged, "mcap recover")):
        with Process(random_domain(), "calibslam_sim", "play", str(path)) as process:
            assert process.wait() == 1
            assert text in process.output and "Traceback" not in process.output
    options = [str(bag), "--wait-for", "/detections:1", "--wait-timeout", "0.5"]
    with Process(random_domain(), "calibslam_sim", "play", *options) as process:
        assert process.wait() == 1
        assert "/detections has 0 subscribers, not 1" in process.output
