"""Pictures of a run, and its export to Rerun."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest

from calibslam_backend.geometry.visible_box import project
from calibslam_backend.output.object_map import ObjectMap
from calibslam_msgs_py import bags
from calibslam_msgs_py.bags import BagWriter
from calibslam_msgs_py.conversions import boxes_to_msg, camera_to_msg, header_to_msg, motion_to_msg
from calibslam_msgs_py.measurements import SECOND, Boxes, Camera, QuadricEstimate, RelativeMotion
from calibslam_sim import draw_run, export_rerun, topics
from calibslam_sim.draw_run import outline

CAMERA = Camera(320, 240, np.array([[250.0, 0.0, 160.0], [0.0, 250.0, 120.0], [0.0, 0.0, 1.0]]), np.zeros(5))
BALL = np.eye(4)
BALL[:3, 3] = 0.2, 0.1, 2.0


def quadric(number: int, T: np.ndarray) -> QuadricEstimate:
    return QuadricEstimate(number, "ball", T, np.full(3, 0.3), 1e-4 * np.eye(9), 7)


@pytest.fixture
def recorded(tmp_path: Path) -> tuple[Path, Path]:
    """A run with two keyframes, a ball in front and one behind, and its bag."""
    behind = BALL.copy()
    behind[2, 3] = -2.0
    (tmp_path / "run").mkdir()
    ObjectMap(
        (SECOND, 2 * SECOND), np.stack([np.eye(4)] * 2), np.zeros((2, 6, 6)), (quadric(0, BALL), quadric(1, behind))
    ).save(tmp_path / "run" / "map.json")
    boxes = Boxes(
        SECOND, 320, 240, np.array([[10.0, 10.0, 60.0, 50.0]]), np.full((1, 4, 4), np.nan), ("cup",), np.ones(1), ("",)
    )  # fmt: skip
    grey = cv2.imencode(".png", np.full((240, 320, 3), 90, np.uint8))[1].tobytes()
    with BagWriter(tmp_path / "bag") as bag:
        bag.write(topics.CAMERA_INFO, camera_to_msg(CAMERA, SECOND, bags.types), SECOND)
        for stamp, data in ((SECOND, grey), (SECOND + 5, grey), (2 * SECOND, b"no image")):
            message = bags.types("sensor_msgs/msg/CompressedImage")(
                header=header_to_msg(stamp, "camera", bags.types), format="png", data=bags.types.octets(data)
            )
            bag.write(topics.IMAGE, message, stamp)
        bag.write(topics.DETECTIONS_WITHOUT_COVARIANCE, boxes_to_msg(boxes, bags.types), SECOND)
        motion = RelativeMotion(SECOND, 2 * SECOND, np.eye(4))
        bag.write("/relative_pose", motion_to_msg(motion, bags.types), 2 * SECOND)
    return tmp_path / "run", tmp_path / "bag"


def test_an_outline_fits_the_box_of_its_ellipsoid() -> None:
    random = np.random.default_rng(0)
    for _ in range(20):
        T = gtsam.Pose3.Expmap(random.uniform(-1.0, 1.0, 6)).matrix()
        T[:3, 3] = random.uniform([-1.0, -1.0, 2.0], [1.0, 1.0, 4.0])
        radii = random.uniform(0.05, 0.5, 3)
        points = outline(T, radii)
        assert points is not None
        box = project(T[None], radii[None], np.eye(3))[0]
        found = np.concatenate([points.min(axis=0), points.max(axis=0)])
        np.testing.assert_allclose(found, box, atol=0.01 * (box[2:] - box[:2]).max())
    # A sphere straight ahead: tangent at asin(r / d).
    T = np.eye(4)
    T[2, 3] = 2.0
    points = outline(T, np.full(3, 0.5))
    assert points is not None
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), np.tan(np.arcsin(0.25)))
    for z in (-2.0, 0.2):  # behind, and around the camera
        T[2, 3] = z
        assert outline(T, np.full(3, 0.5)) is None


def test_pictures_show_boxes_and_outlines(recorded: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    run, bag = recorded
    out = run / "pictures"
    assert draw_run.main([str(run), str(bag), "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert "1 pictures" in said.out and "no image that can be decoded" in said.err
    assert [file.name for file in out.iterdir()] == ["1.000000.jpg"]
    changed = np.abs(cv2.imread(str(out / "1.000000.jpg")).astype(int) - 90).max(axis=2) > 40
    points = outline(BALL, np.full(3, 0.3))
    assert points is not None
    places = np.rint(points * 250.0 + [160.0, 120.0]).astype(int)
    assert changed[places[:, 1], places[:, 0]].all()
    assert changed[10:50, 10].mean() > 0.9  # the box's left edge
    assert not changed[200:].any()


def test_boxes_are_those_of_the_run(recorded: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    """The run was given other boxes than those on the usual topic of the bag with the images."""
    run, images = recorded
    own = images.with_name("own")
    boxes = Boxes(
        SECOND, 320, 240, np.array([[80.0, 60.0, 120.0, 90.0]]), np.full((1, 4, 4), np.nan), ("cup",), np.ones(1), ("",)
    )  # fmt: skip
    with BagWriter(own) as bag:
        bag.write(topics.CAMERA_INFO, camera_to_msg(CAMERA, SECOND, bags.types), SECOND)
        bag.write("/mine", boxes_to_msg(boxes, bags.types), SECOND)
        bag.write("/relative_pose", motion_to_msg(RelativeMotion(SECOND, 2 * SECOND, np.eye(4)), bags.types), SECOND)
    calibrator = run / "calibrator.json"
    calibrator.write_text('{"version": 1, "kind": "per_size", "parameters": {"floor": 9.0, "relative": 0.0}}')
    metrics = {"recording": str(own), "topics": {"detections": "/mine"}, "calibrator": str(calibrator)}
    (run / "metrics.json").write_text(json.dumps(metrics))
    assert draw_run.main([str(run), str(images), "--out", str(run / "pictures")]) == 0
    assert f"boxes: /mine of {own}" in capsys.readouterr().out
    changed = np.abs(cv2.imread(str(run / "pictures" / "1.000000.jpg")).astype(int) - 90).max(axis=2) > 40
    assert changed[60:90, 80].mean() > 0.9 and not changed[10:50, 10].any()
    assert changed[60 + 18, 80]  # 2 sigma of the run's own calibrator
    shutil.rmtree(own)
    assert draw_run.main([str(run), str(images), "--out", str(run / "pictures")]) == 1
    assert "/mine is not there" in capsys.readouterr().err


def test_a_bag_of_another_run_is_told(recorded: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    run, bag = recorded
    ObjectMap((5,), np.eye(4)[None], np.zeros((1, 6, 6)), ()).save(run / "map.json")
    assert draw_run.main([str(run), str(bag), "--out", str(run / "pictures")]) == 1
    assert "no image" in capsys.readouterr().err
    assert draw_run.main([str(run / "none"), str(bag), "--out", str(run / "pictures")]) == 1


class FakeRerun:
    """Takes what the real module takes, and remembers it."""

    ViewCoordinates = SimpleNamespace(RIGHT_HAND_Z_UP="z up")

    def __init__(self) -> None:
        self.logged: list[tuple[float | None, str, Any]] = []
        self.time: float | None = None

    def init(self, application: str, recording_id: str) -> None:
        self.logged.append((None, application, recording_id))

    def save(self, path: str) -> None:
        Path(path).write_bytes(b"rrd")

    def set_time(self, timeline: str, timestamp: float) -> None:
        self.time = timestamp

    def log(self, path: str, value: Any, static: bool = False) -> None:
        self.logged.append((None if static else self.time, path, value))

    def __getattr__(self, kind: str) -> Any:
        def make(*values: Any, **fields: Any) -> SimpleNamespace:
            made = SimpleNamespace(kind=kind, values=values, **fields)
            made.compress = lambda: made
            return made

        return make


def test_export_to_rerun(
    recorded: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run, bag = recorded
    rerun = FakeRerun()
    monkeypatch.setitem(sys.modules, "rerun", rerun)
    assert export_rerun.main([str(run), "--bag", str(bag), "--out", str(run / "run.rrd")]) == 0
    assert f"rerun {run / 'run.rrd'}" in capsys.readouterr().out
    by_path: dict[str, list[Any]] = {}
    for time, path, value in rerun.logged:
        by_path.setdefault(path, []).append((time, value))
    ((when, ball),) = by_path["map/objects/0"]
    assert when is None and ball.kind == "Ellipsoids3D" and ball.labels == ["ball 0"]
    np.testing.assert_array_equal(ball.half_sizes[0], [0.3, 0.3, 0.3])
    assert [time for time, _ in by_path["map/camera"]] == [1.0, 2.0, 1.0]  # two poses, then the pinhole
    assert [time for time, _ in by_path["map/camera/image"]] == [1.0, pytest.approx(1.0)]


def test_without_rerun_it_says_what_to_install(
    recorded: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert export_rerun.main([str(recorded[0]), "--out", "x.rrd"]) == 1
    assert "pip install 'rerun-sdk" in capsys.readouterr().err
