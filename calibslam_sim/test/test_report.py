"""Runs on a page: what it shows, that it needs nothing else, and what is said of folders that are none."""

from __future__ import annotations

import base64
import json
import re
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibslam_backend.geometry.box_measurement import BORDER_SIGMAS
from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.geometry.visible_box import project
from calibslam_backend.output.object_map import ObjectMap
from calibslam_msgs_py.bags import BagReader, BagWriter, types
from calibslam_msgs_py.conversions import boxes_to_msg
from calibslam_msgs_py.measurements import Boxes, QuadricEstimate
from calibslam_sim import report
from calibslam_sim.rendering.looks import FAMILIES
from calibslam_sim.rendering.render import Renderer
from calibslam_sim.run_report import boxes, style
from calibslam_sim.run_report.image_view import projected_outline
from calibslam_sim.run_report.loading import ReportError, load_run, load_runs, names
from calibslam_sim.run_report.page import metrics_table, page
from calibslam_sim.run_report.sightings import Sightings, find_sightings
from calibslam_sim.run_report.space import unit_sphere
from calibslam_sim.simulate import write_bag
from calibslam_sim.simulation.recording import CAMERA, SimulationSettings, simulate

SIMULATION = simulate(SimulationSettings(seed=1, duration=4.0))
EVERY = 3  # image is a keyframe
KEYFRAMES = range(0, len(SIMULATION.times), EVERY)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "bag"
    write_bag(SIMULATION, path)
    return path


def a_run(folder: Path, metrics: dict[str, Any]) -> Path:
    """A RUN folder whose map is the truth, but for 1 mm of noise on the poses, as it states."""
    poses = SIMULATION.T_world_camera[list(KEYFRAMES)].copy()
    rng = np.random.default_rng(0)
    poses[1:, :3, 3] += rng.normal(scale=1e-3, size=(len(poses) - 1, 3))
    quadrics = tuple(
        QuadricEstimate(t.id, t.class_id, t.ellipsoid.T_world_object, t.ellipsoid.radii, np.eye(9) * 1e-4, 9)
        for t in SIMULATION.world
    )
    stamps = tuple(int(SIMULATION.times[k]) for k in KEYFRAMES)
    folder.mkdir()
    ObjectMap(stamps, poses, np.tile(np.eye(6) * 1e-6, (len(poses), 1, 1)), quadrics).save(folder / "map.json")
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


METRICS = {
    "ate_m": 0.0123, "rpe_m": 0.5, "keyframes": 24, "update_ms": {"p50": 3.0, "p99": 20.0, "max": 31.5},
    "settings": {"noise_model": "calibrated"},
}  # fmt: skip


class Contents(HTMLParser):
    """What a page refers to, how often each element occurs, and its text without scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.references: list[str] = []
        self.elements: Counter[str] = Counter()
        self.text: list[str] = []
        self._inside = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements[tag] += 1
        self._inside = tag
        self.references += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data", "action")]

    def handle_data(self, data: str) -> None:
        if self._inside not in ("script", "style"):
            self.text.append(data)


def figures(text: str) -> list[dict[str, Any]]:
    found = re.findall(r'<script type="application/json" id="figure-\d+">(.*?)</script>', text, re.DOTALL)
    return [json.loads(each) for each in found]


def numbers(values: Any) -> np.ndarray:
    """What plotly has encoded."""
    if isinstance(values, dict):
        return np.frombuffer(base64.b64decode(values["bdata"]), values["dtype"])
    return np.asarray(values)


# -- the page -------------------------------------------------------------------------------------------------------


def test_the_page_needs_nothing_else(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = a_run(tmp_path / "run", {**METRICS, "recording": str(bag)})
    assert report.main([str(run)]) == 0
    assert f"{run}/report.html: 1 run" in capsys.readouterr().out
    text = (run / "report.html").read_text()
    contents = Contents(text)
    assert contents.references == [] and contents.elements["link"] == contents.elements["iframe"] == 0
    assert "@import" not in text.split("</style>")[0] and "url(" not in text.split("</style>")[0]
    shown = " ".join(contents.text)
    for words in (
        "ATE [m]", "0.012", "31.5", "Position errors", "Reliability of positions", "Update times", "Map from above",
        "Map in space", "Heuristic and calibrated deviations", "measured at this run's map", "at the true objects",
    ):  # fmt: skip
        assert words in shown, words
    assert contents.elements["details"] == 1 and contents.elements["svg"] == 4
    # Nothing in the recording is an image: the boxes stand on grey.
    assert contents.elements["image"] == 0
    assert len(figures(text)) == 9
    assert text == page(load_runs([run]))


def test_figures_show_the_run(bag: Path, tmp_path: Path) -> None:
    """Errors of 1 mm as stated lie inside 2 sigma nearly always, and the estimate is where the truth is."""
    run = load_run(a_run(tmp_path / "run", METRICS), "run", bag, None)
    drawn = {trace["name"]: trace for figure in figures(page([run])) for trace in figure["data"] if "name" in trace}
    assert len(drawn["estimate"]["x"]) and {"odometry alone", "ground truth (best fit)", "objects"} <= drawn.keys()
    found = run.true_poses()
    assert found is not None
    covered, true = found
    errors = run.map.poses[covered][:, :3, 3] - true[:, :3, 3]
    assert covered.all() and errors[0] == pytest.approx(0.0) and 5e-4 < errors.std() < 2e-3
    inside = np.abs(errors) <= 2.0 * np.sqrt(np.diagonal(run.position_covariances(), axis1=1, axis2=2))
    assert inside.mean() > 0.9
    longest = drawn["longest"]
    assert numbers(longest["x"]).tolist() == [31.5] and longest["y"] == ["run"]


def test_images_are_inside(tmp_path: Path) -> None:
    simulation = simulate(SimulationSettings(seed=1, duration=0.5, frame_rate=5.0))
    write_bag(simulation, tmp_path / "bag", render=Renderer(simulation.world, CAMERA, 1, 1.0, FAMILIES[0]).render)
    folder = a_run(tmp_path / "run", METRICS)
    known = ObjectMap.load(folder / "map.json")
    n = len(simulation.times)
    stamps = tuple(int(stamp) for stamp in simulation.times)
    replace(known, stamps=stamps, poses=simulation.T_world_camera, covariances=known.covariances[:n]).save(
        folder / "map.json"
    )
    contents = Contents(page([load_run(folder, "run", tmp_path / "bag", None)]))
    assert contents.elements["image"] == contents.elements["svg"] >= 2
    for reference in contents.references:
        kind, data = reference.split(",", 1)
        assert kind == "data:image/jpeg;base64" and base64.b64decode(data).startswith(b"\xff\xd8")


def test_names_cannot_break_the_page(bag: Path, tmp_path: Path) -> None:
    run = load_run(a_run(tmp_path / "a", METRICS), "</script><b>&", bag, None)
    contents = Contents(page([run]))
    assert contents.elements["b"] == 1  # that of <noscript>


def test_the_best_run_is_marked(tmp_path: Path) -> None:
    runs = [
        load_run(a_run(tmp_path / name, {**METRICS, "ate_m": ate}), name, None, None)
        for name, ate in (("a", 0.2), ("b", 0.1), ("c", None))
    ]
    table = metrics_table(runs)
    assert "<td>ATE [m]</td><td>0.200</td><td class=best>0.100</td><td>–</td>" in table
    # Equal everywhere, and a number of which less is not better.
    assert "<td>RPE [m]</td><td>0.5000</td><td>0.5000</td>" in table and "<td>keyframes</td><td>24</td>" in table
    assert "NEES" not in table


# -- what is missing, what is wrong -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("recording", "said"),
    [({"recording": "/gone/bag"}, "its recording /gone/bag is gone"), ({}, "metrics.json names no recording")],
)
def test_without_recording(
    recording: dict[str, str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is missing is the recording; whether there was ground truth, nobody knows."""
    run = a_run(tmp_path / "run", {**METRICS, **recording})
    assert report.main([str(run)]) == 0
    assert f"report: warning: run: {said}; " in capsys.readouterr().err
    shown = " ".join(Contents((run / "report.html").read_text()).text)
    assert said in shown and "No recording of these runs" in shown and "No ground truth" not in shown
    assert "Map in space" in shown and "Heuristic" not in shown


def test_boxes_are_those_that_the_run_was_given(bag: Path, tmp_path: Path) -> None:
    """The recording has others, too, on the usual topic."""
    with BagReader(bag) as reader, BagWriter(tmp_path / "bag") as writer:
        for topic, time, data in reader.raw_messages(list(reader.topics)):
            writer.write_raw(topic, reader.topics[topic], data, time)
        empty = Boxes(int(SIMULATION.times[0]), 640, 480, np.empty((0, 4)), np.empty((0, 4, 4)), (), np.empty(0), ())
        writer.write("/other", boxes_to_msg(empty, types), int(SIMULATION.times[0]))
    for topic, count in (("/detections", len(KEYFRAMES)), ("/other", 0)):
        metrics = {"recording": str(tmp_path / "bag"), "topics": {"detections": topic}}
        run = load_run(a_run(tmp_path / topic[1:], metrics), "run", None, None)
        assert run.recorded is not None and len(run.recorded.boxes) == count


def test_without_ground_truth(bag: Path, tmp_path: Path) -> None:
    with BagReader(bag) as reader, BagWriter(tmp_path / "bag") as writer:
        kept = [topic for topic in reader.topics if not topic.startswith("/ground_truth")]
        for topic, time, data in reader.raw_messages(kept):
            writer.write_raw(topic, reader.topics[topic], data, time)
    folder = a_run(tmp_path / "run", {})
    (folder / "metrics.json").unlink()
    shown = " ".join(Contents(page(load_runs([folder], tmp_path / "bag"))).text)
    assert "No ground truth" in shown and "Heuristic and calibrated" in shown and "true objects" not in shown


@pytest.mark.parametrize(
    ("prepare", "said"),
    [
        (lambda folder: None, "is no folder, so it is no RUN; make one: ./calibslam run calibslam_backend slam_bag"),
        (lambda folder: folder.mkdir(), "holds no map.json, so it is no RUN"),
        (lambda folder: (folder.mkdir(), (folder / "map.json").write_text("{")), "is not JSON"),
        (lambda folder: ObjectMap((), np.empty((0, 4, 4)), np.empty((0, 6, 6)), ()).save(
            (folder.mkdir(), folder / "map.json")[1]), "holds no keyframe"),
        (lambda folder: (a_run(folder, {}), (folder / "metrics.json").write_text("[]")), "holds no metrics of a run"),
        (lambda folder: (a_run(folder, {}), (folder / "metrics.json").write_text("{")), "cannot be read"),
    ],
)  # fmt: skip
def test_what_is_no_run_is_refused(prepare: Any, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    prepare(tmp_path / "run")
    assert report.main([str(tmp_path / "run"), "--out", str(tmp_path / "page.html")]) == 1
    message = capsys.readouterr().err
    assert message.startswith("report: ") and said in message and "Traceback" not in message
    assert not (tmp_path / "page.html").exists()


def test_a_wrong_recording_is_refused(tmp_path: Path) -> None:
    folder = a_run(tmp_path / "run", {})
    known = ObjectMap.load(folder / "map.json")
    later = replace(known, stamps=tuple(stamp + 10**12 for stamp in known.stamps))
    write_bag(simulate(SimulationSettings(seed=2, duration=0.5)), tmp_path / "bag")
    later.save(folder / "map.json")
    with pytest.raises(ReportError, match="no time in common"):
        load_run(folder, "run", tmp_path / "bag", None)
    with pytest.raises(ReportError, match="does not exist"):
        load_run(folder, "run", tmp_path / "nothing", None)


def test_names_tell_folders_apart(tmp_path: Path) -> None:
    paths = [tmp_path / "a" / "run", tmp_path / "b" / "run", tmp_path / "b" / "other"]
    assert names(paths) == ["a/run", "b/run", "b/other"]
    assert names(paths[1:]) == ["run", "other"]
    assert names([paths[0], paths[0]]) == ["run (1)", "run (2)"]


# -- geometry and boxes -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(20))
def test_the_outline_touches_the_projected_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, radii = np.eye(4), rng.uniform(0.02, 0.4, 3)
    T[:3, :3], T[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.uniform([-1.0, -1.0, 0.6], [1.0, 1.0, 5.0])
    outline = projected_outline(np.eye(4), T, radii, CAMERA.K)
    (box,) = project(T, radii, CAMERA.K)
    assert outline is not None
    reach = np.sqrt(np.diag(outline[1]))
    np.testing.assert_allclose(np.concatenate([outline[0] - reach, outline[0] + reach]), box, rtol=1e-6, atol=1e-6)


def test_no_outline_of_what_is_not_in_front() -> None:
    T = np.eye(4)
    for depth in (-2.0, 0.05):
        T[2, 3] = depth
        assert projected_outline(np.eye(4), T, np.full(3, 0.1), CAMERA.K) is None


def test_an_ellipse_by_hand() -> None:
    points = style.ellipse(np.array([1.0, 2.0]), np.diag([4.0, 9.0]))
    np.testing.assert_allclose(((points - [1.0, 2.0]) ** 2 / [4.0, 9.0]).sum(axis=1), 1.0)
    np.testing.assert_allclose(points.max(axis=0), [3.0, 5.0])


def test_the_sphere_is_closed_and_round() -> None:
    points, triangles = unit_sphere()
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0)
    edges = Counter((int(t[i]), int(t[(i + 1) % 3])) for t in triangles for i in range(3))
    # Each edge belongs to two triangles that run along it in opposite directions, seen from outside anticlockwise.
    assert set(edges.values()) == {1} and all((b, a) in edges for a, b in edges)
    assert len(points) - len(edges) // 2 + len(triangles) == 2
    a, b, c = points[triangles].transpose(1, 0, 2)
    assert (np.einsum("ni,ni->n", np.cross(b - a, c - a), a + b + c) > 0.0).all()


def exact(image: Boxes, pose: np.ndarray, ids: list[int]) -> Boxes:
    """Boxes of true objects without noise, which are said to err by 2 px."""
    things = {t.id: t for t in SIMULATION.world}
    corners = project(
        np.linalg.inv(pose) @ np.array([things[i].ellipsoid.T_world_object for i in ids]),
        np.array([things[i].ellipsoid.radii for i in ids]), CAMERA.K,
    )  # fmt: skip
    n = len(ids)
    return Boxes(
        image.stamp, image.width, image.height, corners, np.tile(np.eye(4) * 4.0, (n, 1, 1)),
        tuple(things[i].class_id for i in ids), np.ones(n), tuple(map(str, ids)),
    )  # fmt: skip


def test_boxes_find_their_quadrics() -> None:
    """Exact boxes have no error and the right quadric; of another class, or of nothing, none."""
    k = 30
    pose, image = SIMULATION.T_world_camera[k], SIMULATION.boxes[k]
    ids = [int(i) for i in image.object_ids]
    corners = exact(image, pose, ids).corners
    margin = BORDER_SIGMAS * 2.0 + 0.1  # nearer edges may be the border's
    whole = (corners > margin).all(axis=1) & (corners < np.tile([CAMERA.width, CAMERA.height], 2) - margin).all(axis=1)
    ids = [i for i, free in zip(ids, whole, strict=True) if free]
    measured = exact(image, pose, ids)
    quadrics = [Ellipsoid(t.ellipsoid.T_world_object, t.ellipsoid.radii) for t in SIMULATION.world]
    classes = [t.class_id for t in SIMULATION.world]
    seen = find_sightings([measured], pose[None], quadrics, classes, CAMERA)
    assert len(ids) >= 5
    assert [SIMULATION.world[q].id for q in seen.quadric] == [ids[b] for b in seen.box] and len(seen.box) == len(ids)
    np.testing.assert_allclose(seen.errors, 0.0, atol=1e-6)
    np.testing.assert_allclose(seen.calibrated(), 2.0)
    none = find_sightings([measured], pose[None], quadrics, ["none of these"] * len(classes), CAMERA)
    assert len(none.box) == 0 and none.errors.shape == (0, 4)


def test_the_heuristic_by_hand() -> None:
    """Widths 10 and 30, heights 10 and 14: deviations 10 and 2, together 12 (eq. 4.3.1)."""
    corners = np.array([[0.0, 0.0, 10.0, 10.0], [5.0, 5.0, 35.0, 19.0], [1.0, 1.0, 2.0, 2.0]])
    three = np.arange(3)
    seen = Sightings(three, three * 0, np.array([4, 4, 7]), corners, np.zeros((3, 4)), np.full((3, 4, 4), np.nan))
    assert seen.heuristic().tolist() == [12.0, 12.0, 1.0]
    assert np.isnan(seen.calibrated()).all() and seen.often_seen() == []


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_correlation_of_neighbours(correlation: float) -> None:
    """An autoregressive error of known correlation, of two objects seen in turns; n pairs tell it to 1 / sqrt(n)."""
    rng = np.random.default_rng(5)
    n = 1500
    errors = rng.normal(size=(2, n, 4))
    for k in range(1, n):
        errors[:, k] = correlation * errors[:, k - 1] + np.sqrt(1.0 - correlation**2) * errors[:, k]
    image, quadric = np.tile(np.arange(n), 2), np.repeat([0, 1], n)
    mixed = rng.permutation(2 * n)
    sigma = 3.0
    seen = Sightings(
        image[mixed], image[mixed] * 0, quadric[mixed], np.zeros((2 * n, 4)), sigma * errors.reshape(-1, 4)[mixed],
        np.tile(np.eye(4) * sigma**2, (2 * n, 1, 1)),
    )  # fmt: skip
    assert seen.neighbour_correlation() == pytest.approx(correlation, abs=4.0 / np.sqrt(8 * n))
    few = Sightings(*(value[:20] for value in vars(seen).values()))
    assert np.isnan(few.neighbour_correlation())


def test_reliability_of_boxes_that_are_as_stated() -> None:
    """Errors drawn from the stated covariances follow the diagonal, within the band of chance."""
    rng = np.random.default_rng(3)
    n = 2000
    A = rng.normal(size=(n, 4, 4))
    covariances = A @ A.transpose(0, 2, 1) + np.eye(4)
    errors = (np.linalg.cholesky(covariances) @ rng.normal(size=(n, 4, 1)))[:, :, 0]
    zeros = np.zeros(n, int)
    seen = Sightings(zeros, zeros, zeros, rng.uniform(0.0, 300.0, (n, 4)), errors, covariances)
    figure = boxes.reliability_of_boxes(seen)
    assert figure is not None
    curves = {trace.name: np.asarray(trace.y) for trace in figure.data[1:]}
    levels = np.asarray(figure.data[1].x)
    # Dvoretzky, Kiefer, Wolfowitz: a probability of 1e-3 of a distance above this.
    assert np.abs(curves[f"covariances of the boxes ({n})"] - levels).max() < np.sqrt(np.log(2e3) / (2 * n))
    assert (curves[f"QuadricSLAM's heuristic ({n})"] > 0.9).all()
