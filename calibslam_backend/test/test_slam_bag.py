"""`slam_bag` on bags: what it writes, and what it says of bags that are broken or hold nonsense."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evo.tools import file_interface
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import StoragePlugin, Writer
from small_bag import WORLD, Message, messages, write

from calibslam_backend import slam_bag
from calibslam_backend.association.data_association import DataAssociation
from calibslam_backend.output.object_map import ObjectMap
from calibslam_backend.recording import Recording
from calibslam_msgs_py import bags
from calibslam_msgs_py import conversions as c
from calibslam_msgs_py.bags import BagReader

CONTRACT = {
    "ate_m", "rpe_m", "odometry_ate_m", "odometry_rpe_m", "keyframes", "objects", "boxes_used", "boxes_rejected",
    "update_ms", "wall_s", "sequence_s", "peak_rss_mb", "association", "nees_position",
}  # fmt: skip
COUNTED = {"images", "motions"}


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("small") / "bag", messages())


def run(path: Path, out: Path, *options: str) -> dict[str, Any]:
    assert slam_bag.main([str(path), "--out", str(out), *options]) == 0
    metrics: dict[str, Any] = json.loads((out / "metrics.json").read_text())
    return metrics


@pytest.fixture(scope="module")
def done(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The RUN folder of `bag` with all defaults; not to be changed."""
    out = tmp_path_factory.mktemp("done") / "run"
    run(bag, out)
    return out


def fails(path: Path, out: Path, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    """What it says; exactly one line that begins with "error:", or its name where a file is in the way."""
    assert slam_bag.main([str(path), "--out", str(out), *options]) == 1
    said = capsys.readouterr().err
    assert said.startswith(("error: ", "slam_bag: ")) and "Traceback" not in said
    return said


# -- what it writes -------------------------------------------------------------------------------------------------


def test_a_run_folder(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    metrics = run(bag, tmp_path / "run")
    assert metrics.keys() >= CONTRACT
    assert metrics["ate_m"] < metrics["odometry_ate_m"] < 0.1
    assert metrics["objects"] == 9 and metrics["association"]["precision"] > 0.95
    assert metrics["warnings"] == []
    assert (metrics["counts"]["images"], metrics["counts"]["motions"]) == (110, 109)
    assert 0.0 < metrics["update_ms"]["p50"] <= metrics["update_ms"]["p99"] <= metrics["update_ms"]["max"]
    assert metrics["sequence_s"] == pytest.approx(109 / 30, abs=0.01)
    assert (metrics["recording"], metrics["calibrator"]) == (str(bag.resolve()), None)
    said = capsys.readouterr().out
    assert f"{metrics['keyframes']} keyframes, 9 objects" in said and f"ATE {metrics['ate_m']:.3f} m" in said
    assert sorted(p.name for p in (tmp_path / "run").iterdir()) == [
        "map.json", "metrics.json", "run.mcap", "trajectory.png", "trajectory.tum"
    ]  # fmt: skip
    trajectory = file_interface.read_tum_trajectory_file(str(tmp_path / "run" / "trajectory.tum"))
    assert trajectory.num_poses == metrics["keyframes"]
    assert len(ObjectMap.load(tmp_path / "run" / "map.json").quadrics) == 9


def test_run_mcap_holds_what_is_published(done: Path) -> None:
    with BagReader(done / "run.mcap") as result:
        assert set(result.topics) == {"/trajectory", "/pose", "/quadrics", "/quadric_markers", "/tf"}
        last = {topic: message for topic, _, message in result.messages(list(result.topics))}
        keyframes = result.counts["/pose"]
    known = ObjectMap.load(done / "map.json")
    assert len(last["/trajectory"].poses) == keyframes == len(known.stamps)
    for message, T in zip(last["/trajectory"].poses, known.poses, strict=True):
        np.testing.assert_allclose(c.pose_from_msg(message.pose), T, atol=1e-9)
    published = c.quadrics_from_msg(last["/quadrics"])
    for a, b in zip(published, known.quadrics, strict=True):
        assert (a.id, a.class_id, a.observations) == (b.id, b.class_id, b.observations)
        np.testing.assert_allclose(a.T_map_object, b.T_map_object, atol=1e-9)
    assert len(last["/quadric_markers"].markers) == 1 + 2 * 9


def test_run_mcap_opens_elsewhere(done: Path) -> None:
    """By a reader that knows nothing but the file: every definition is inside, and the camera stands in the map."""
    messages: dict[str, list[Any]] = {}
    with (done / "run.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, _, message in reader.iter_decoded_messages():
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            messages.setdefault(channel.topic, []).append(message)
    assert set(messages) == {"/trajectory", "/pose", "/quadrics", "/quadric_markers", "/tf"}
    assert len(messages["/tf"]) == len(messages["/pose"])
    for transforms, pose in zip(messages["/tf"], messages["/pose"], strict=True):
        (transform,) = transforms.transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("map", "camera")
        stamps = [(header.stamp.sec, header.stamp.nanosec) for header in (transform.header, pose.header)]
        assert stamps[0] == stamps[1]
        for part, same in (("translation", "position"), ("rotation", "orientation")):
            there, here = getattr(transform.transform, part), getattr(pose.pose.pose, same)
            assert all(getattr(there, axis) == getattr(here, axis) for axis in "xyzw" if hasattr(here, axis))
    for topic in ("/trajectory", "/pose", "/quadrics"):
        assert {message.header.frame_id for message in messages[topic]} == {"map"}
    markers = [marker for message in messages["/quadric_markers"] for marker in message.markers]
    assert {marker.header.frame_id for marker in markers} == {"map"}


@pytest.mark.parametrize("options", [[], ["--association", "given", "--noise-model", "fixed"], ["--batch"]], ids=str)
def test_two_runs_write_the_same_bytes(bag: Path, done: Path, tmp_path: Path, options: list[str]) -> None:
    first, second = (tmp_path / "a" if options else done), tmp_path / "b"
    if options:
        run(bag, first, *options)
    run(bag, second, *options)
    for file in ("trajectory.tum", "map.json", "run.mcap"):
        assert (first / file).read_bytes() == (second / file).read_bytes(), file


def test_a_map_is_gone_on_with(bag: Path, done: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Found or begun in the map of a run before: no object is begun a second time."""
    known = str(done / "map.json")
    for start in ("found", "begin"):
        metrics = run(bag, tmp_path / start, "--map", known, "--start-in-map", start)
        assert metrics["objects"] == 9 and metrics["ate_m"] < 0.05
    assert "cannot be read" in fails(bag, tmp_path / "x", capsys, "--map", str(tmp_path / "no.json"))


def test_a_camera_outside_the_map_is_told(
    bag: Path, done: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = json.loads((done / "map.json").read_text())
    for quadric in content["quadrics"]:
        quadric["class_id"] = "whale"
    (tmp_path / "sea.json").write_text(json.dumps(content))
    said = fails(bag, tmp_path / "run", capsys, "--map", str(tmp_path / "sea.json"))
    assert "was not found in" in said and "--start-in-map begin" in said


def test_a_run_is_replaced_by_the_next(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(bag, tmp_path / "run", "--noise-model", "fixed")
    assert "instead of" not in capsys.readouterr().out
    assert run(bag, tmp_path / "run")["settings"]["noise_model"] == "calibrated"
    assert f"result: {tmp_path}/run (instead of the run that was there)" in capsys.readouterr().out


def test_true_objects_are_read_and_drawn(done: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What is none of them, of this topic or of this type, does not matter."""
    known = ObjectMap.load(done / "map.json").quadrics
    true = ("/ground_truth_quadrics", WORLD.stamps[0], c.quadrics_to_msg(WORLD.stamps[0], known, bags.types, "world"))
    objects = Recording.open(write(tmp_path / "bag", [*messages(), true])).true_objects()
    assert objects is not None and len(objects) == len(known)
    np.testing.assert_allclose(objects[3].T_world_object, known[3].T_map_object, atol=1e-12)
    run(tmp_path / "bag", tmp_path / "run")
    pictures = [folder / "trajectory.png" for folder in (done, tmp_path / "run")]
    assert pictures[0].read_bytes() != pictures[1].read_bytes()
    other = [(topic if topic != "/odom" else "/ground_truth_quadrics", s, m) for topic, s, m in messages(odometry=True)]
    assert Recording.open(write(tmp_path / "other", [*other, *messages()])).true_objects() is None


def test_odometry_poses_serve_as_well(bag: Path, tmp_path: Path) -> None:
    """/odom instead of /relative_pose, without covariance."""
    path = write(tmp_path / "bag", messages(odometry=True))
    metrics = run(path, tmp_path / "run")
    assert metrics["counts"]["motions"] == 109
    assert metrics["ate_m"] < 0.05


def test_topics_may_have_other_names(bag: Path, done: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    named = {"/detections": "/my/boxes", "/relative_pose": "/my/motions", "/camera/camera_info": "/my/camera_info"}
    path = write(tmp_path / "bag", [(named.get(t, t), s, m) for t, s, m in messages()])
    options = ["--detections", "/my/boxes", "--odom", "/my/motions", "--camera-info", "/my/camera_info"]
    metrics = run(path, tmp_path / "run", *options)
    assert list(metrics["topics"].values()) == list(named.values())
    for file in ("trajectory.tum", "map.json"):
        assert (tmp_path / "run" / file).read_bytes() == (done / file).read_bytes()
    assert "/nothing is not there; topics of" in fails(path, tmp_path / "x", capsys, "--detections", "/nothing")
    said = fails(path, tmp_path / "x", capsys, "--odom", "/my/boxes")
    assert "/my/boxes is calibslam_msgs/msg/BoundingBoxArray; topics of" in said and said.endswith(": /my/motions\n")


def test_boxes_without_covariance_get_one(tmp_path: Path) -> None:
    raw = [("/detections_raw" if t == "/detections" else t, s, without_covariance(m)) for t, s, m in messages()]
    write(tmp_path / "bag", raw)
    calibrated = run(tmp_path / "bag", tmp_path / "run")
    assert calibrated["ate_m"] < calibrated["odometry_ate_m"]
    model = tmp_path / "model.json"
    model.write_text('{"version": 1, "kind": "per_size", "parameters": {"floor": 50.0}}')
    other = run(tmp_path / "bag", tmp_path / "other", "--calibrator", str(model))
    assert other["ate_m"] != calibrated["ate_m"]


def without_covariance(message: Any) -> Any:
    for box in getattr(message, "boxes", []):
        box.covariance[:] = 0.0
        box.covariance[0] = -1.0
    return message


def test_without_ground_truth_there_is_no_error_to_state(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "bag", [m for m in messages() if m[0] != "/ground_truth"])
    metrics = run(tmp_path / "bag", tmp_path / "run")
    assert metrics["ate_m"] is None and metrics["nees_position"] is None and metrics["nees_motion"] is None
    assert metrics["keyframes_with_truth"] == 0
    assert "no ATE: no ground truth\n" in capsys.readouterr().out


def test_how_much_ground_truth_there_is_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content = list(messages())
    write(tmp_path / "bag", [m for m in content if m[0] != "/ground_truth" or m[1] < WORLD.stamps[40]])
    metrics = run(tmp_path / "bag", tmp_path / "run")
    some, all_keyframes = metrics["keyframes_with_truth"], metrics["keyframes"]
    assert 3 < some < all_keyframes / 2
    said = capsys.readouterr().out
    assert f"ATE {metrics['ate_m']:.3f} m over {some} of {all_keyframes} keyframes (odometry alone: " in said
    for topic, _, message in content:
        if topic == "/ground_truth":
            message.header.stamp.sec += 5000
    write(tmp_path / "later", content)
    assert run(tmp_path / "later", tmp_path / "run")["ate_m"] is None
    assert "no ATE: no ground truth within 0.02 s of any keyframe" in capsys.readouterr().out


# -- bags that cannot be used ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("missing", "text"),
    [
        ("/detections", "no topic /detections or /detections_raw"),
        ("/relative_pose", "no topic /relative_pose or /odom"),
        ("/camera/camera_info", "no topic /camera/camera_info"),
    ],
)
def test_a_missing_topic_is_named_with_those_there_are(
    missing: str, text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "bag", [m for m in messages() if m[0] != missing])
    said = fails(tmp_path / "bag", tmp_path / "run", capsys)
    assert text in said
    assert "it has: " in said and "/ground_truth (110)" in said
    assert not (tmp_path / "run").exists()


def test_an_empty_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "bag", [])
    assert "it has: nothing" in fails(tmp_path / "bag", tmp_path / "run", capsys)


def test_truncated_bags(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = (bag / "bag.mcap").read_bytes()
    path = tmp_path / "bag"
    path.mkdir()
    (path / "metadata.yaml").write_bytes((bag / "metadata.yaml").read_bytes())
    for share in (0.0, 0.3, 0.9, 0.999):
        (path / "bag.mcap").write_bytes(whole[: int(share * len(whole))])
        said = fails(path, tmp_path / "run", capsys)
        assert "truncated or damaged" in said and "mcap recover" in said


def test_what_is_no_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "does not exist" in fails(tmp_path / "nothing", tmp_path / "run", capsys)
    (tmp_path / "text.txt").write_text("hello")
    assert "is not a bag" in fails(tmp_path / "text.txt", tmp_path / "run", capsys)
    (tmp_path / "folder").mkdir()
    assert "is not a rosbag2 folder" in fails(tmp_path / "folder", tmp_path / "run", capsys)


@pytest.mark.parametrize("linked", [False, True])
def test_the_recording_is_not_replaced_by_the_result(
    linked: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write(tmp_path / "desk" / "run.mcap", messages())
    before = bag.read_bytes()
    out = tmp_path / "link" if linked else bag.parent
    if linked:
        out.symlink_to(bag.parent)
    for path in (bag, bag.parent):
        assert "run.mcap would replace" in fails(path, out, capsys)
    assert bag.read_bytes() == before and list(bag.parent.iterdir()) == [bag]


def test_an_unknown_message_type_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """On a topic that is needed it is an error, elsewhere it does not matter."""
    path = tmp_path / "bag"
    content = list(messages())
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        bare = writer.add_connection("/detections", "nowhere_msgs/msg/Boxes", msgdef="", rihs01="x")
        writer.write(bare, 1, b"\0\1\0\0")
        from calibslam_msgs_py.bag_types import calibslam_typestore

        store, connections = calibslam_typestore(), {}
        for topic, stamp, message in content:
            if topic != "/detections":
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=store)
                writer.write(connections[topic], stamp, store.serialize_cdr(message, kind))
    said = fails(path, tmp_path / "run", capsys)
    assert "unknown message type nowhere_msgs/msg/Boxes (topic /detections)" in said


def test_clocks_that_do_not_agree(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shifted = []
    for topic, stamp, message in messages():
        if topic == "/relative_pose":
            message.start.sec += 1000
            message.header.stamp.sec += 1000
        shifted.append((topic, stamp, message))
    write(tmp_path / "bag", shifted)
    assert "do their clocks agree?" in fails(tmp_path / "bag", tmp_path / "run", capsys)


def test_odometry_of_one_pose(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content = list(messages(odometry=True))
    write(tmp_path / "bag", [m for m in content if m[0] != "/odom" or m[1] == WORLD.stamps[0]])
    assert "odometry needs at least two poses" in fails(tmp_path / "bag", tmp_path / "run", capsys)


def test_input_that_cannot_be_right_is_warned_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Corners as shares of the image, and two seconds without odometry."""
    content = []
    for topic, stamp, message in messages():
        if topic == "/relative_pose" and WORLD.stamps[5] < stamp < WORLD.stamps[70]:
            continue
        for box in getattr(message, "boxes", []):
            box.corners[:] /= [message.width, message.height] * 2
        content.append((topic, stamp, message))
    write(tmp_path / "bag", content)
    metrics = run(tmp_path / "bag", tmp_path / "run")
    first, second = metrics["warnings"]
    assert first.startswith("no objects, though ") and "are corners in pixels" in first
    assert " s without odometry at t = " in second
    assert f"warning: {first}\nwarning: {second}\n" in capsys.readouterr().out


# -- options --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--noise-model", "best"], "'calibrated', 'fixed', 'quadricslam'"),
        (["--association", "guessed"], "'estimated', 'given'"),
        (["--fixed-sigma", "-1"], "fixed_sigma = -1.0: must be 0.1 to 1000.0"),
        (["--fixed-sigma", "wide"], "invalid float value: 'wide'"),
        (["--fixd-sigma", "1"], "unrecognized arguments: --fixd-sigma"),
    ],
)
def test_bad_options(options: list[str], text: str, bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        slam_bag.main([str(bag), "--out", "nowhere", *options])
    assert caught.value.code == 2
    said = capsys.readouterr().err.replace('"', "'")
    assert text in said or text.replace("'", "") in said
    assert not Path("nowhere").exists()


def test_bad_files_and_poses(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = fails(bag, tmp_path / "run", capsys, "--calibrator", str(tmp_path / "none.json"))
    assert "none.json cannot be read" in said
    assert "seven numbers" in fails(bag, tmp_path / "run", capsys, "--camera-in-body", "1 2 3")
    (tmp_path / "file").touch()
    assert "file" in fails(bag, tmp_path / "file", capsys)


# -- nonsense inside a bag is counted, and the rest is used ---------------------------------------------------------


def nan_box(message: Any) -> None:
    message.boxes[0].corners[1] = np.nan


def empty_box(message: Any) -> None:
    message.boxes[0].corners[2] = message.boxes[0].corners[0]


def box_outside(message: Any) -> None:
    message.boxes[0].corners[:] = [700.0, 10.0, 800.0, 100.0]


def indefinite_covariance(message: Any) -> None:
    message.boxes[0].covariance[:] = np.diag([1.0, 1.0, -1.0, 1.0]).ravel()


def other_image_size(message: Any) -> None:
    message.width = 1280


def no_image_size(message: Any) -> None:
    message.width = 0


def infinite_motion(message: Any) -> None:
    message.motion.pose.position.x = np.inf


def no_quaternion(message: Any) -> None:
    message.motion.pose.orientation.w = 7.0


def indefinite_motion(message: Any) -> None:
    message.motion.covariance[0] = -5.0


def motion_backwards(message: Any) -> None:
    message.start.sec += 100


def late_boxes(message: Any) -> None:
    message.header.stamp.sec -= 1


NONSENSE: dict[str, tuple[str, Callable[[Any], None], str]] = {
    "NaN box": ("/detections", nan_box, "box_nan"),
    "empty box": ("/detections", empty_box, "box_empty"),
    "box outside the image": ("/detections", box_outside, "box_outside"),
    "covariance of a box": ("/detections", indefinite_covariance, "box_covariance"),
    "other image size": ("/detections", other_image_size, "image_size"),
    "no image size": ("/detections", no_image_size, "image_size"),
    "boxes that are late": ("/detections", late_boxes, "late"),
    "infinite motion": ("/relative_pose", infinite_motion, "pose"),
    "no unit quaternion": ("/relative_pose", no_quaternion, "pose"),
    "covariance of a motion": ("/relative_pose", indefinite_motion, "covariance"),
    "a motion that ends first": ("/relative_pose", motion_backwards, "time"),
}


@pytest.mark.parametrize("kind", NONSENSE)
def test_nonsense_is_counted(kind: str, tmp_path: Path) -> None:
    """Every tenth message from the 60th on is spoiled: five of them."""
    topic, spoil, reason = NONSENSE[kind]
    content: list[Message] = []
    seen = 0
    for message in messages():
        if message[0] == topic:
            seen += 1
            if seen in range(60, 110, 10):
                spoil(message[2])
        content.append(message)
    write(tmp_path / "bag", content)
    metrics = run(tmp_path / "bag", tmp_path / "run")
    assert metrics["rejected"][reason] == 5
    assert metrics["boxes_rejected"] == (5 if reason.startswith("box_") else 0)
    assert metrics["ate_m"] < 0.05 and metrics["keyframes"] > 20


def test_undecodable_messages_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with bags.BagWriter(path) as bag:
        for k, (topic, stamp, message) in enumerate(messages()):
            bag.write(topic, message, stamp)
            if k == 100:
                bag.write_raw("/detections", "calibslam_msgs/msg/BoundingBoxArray", b"\0\1\0\0garbage", stamp)
    assert run(path, tmp_path / "run")["rejected"]["undecodable/detections"] == 1


def test_time_that_goes_backwards_in_a_bag(tmp_path: Path) -> None:
    """A recorder's clock was set back by two seconds: what cannot be placed any more is counted, and the run ends."""
    content = []
    for topic, stamp, message in messages(odometry=True):
        if stamp > WORLD.stamps[80]:
            message.header.stamp.sec -= 2
        content.append((topic, stamp, message))
    write(tmp_path / "bag", content)
    metrics = run(tmp_path / "bag", tmp_path / "run")
    assert metrics["rejected"]["time_backwards"] == 1
    assert metrics["rejected"]["overlap"] == 28
    assert metrics["rejected"]["late"] + metrics["rejected"].get("duplicate", 0) == 29
    assert metrics["keyframes"] > 20


def test_an_estimator_that_fails_is_counted(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As in a live session: what it failed in is left out, early or late in an image, and the run is written."""
    vote, localise = DataAssociation.vote, DataAssociation.localise
    failed: list[int] = []

    def failing_vote(self: DataAssociation, k: int, motion: Any) -> None:
        if k == 10:
            raise np.linalg.LinAlgError("Eigenvalues did not converge")
        vote(self, k, motion)

    def failing_localise(self: DataAssociation, *arguments: Any) -> Any:
        k = len(self._assignments.frames)
        if k == 20 and not failed:
            failed.append(k)
            raise np.linalg.LinAlgError("Singular matrix")
        return localise(self, *arguments)

    monkeypatch.setattr(DataAssociation, "vote", failing_vote)
    monkeypatch.setattr(DataAssociation, "localise", failing_localise)
    metrics = run(bag, tmp_path / "run")
    assert metrics["counts"]["errors"] == 2
    assert metrics["keyframes"] > 20 and metrics["ate_m"] < 0.05 and metrics["online_ate_m"] < 0.1
    assert "LinAlgError: Eigenvalues did not converge" in caplog.text
