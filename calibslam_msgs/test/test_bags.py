"""Bags: what is written is read, by others too; what is broken is said."""

from pathlib import Path

import numpy as np
import pytest
from full_disk import full_disk
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from calibslam_msgs_py import bags
from calibslam_msgs_py import conversions as c
from calibslam_msgs_py.bags import BagError, BagReader, BagWriter, refuse_to_replace
from calibslam_msgs_py.measurements import Boxes, RelativeMotion

SECOND = 1_000_000_000


def some_boxes(stamp: int) -> Boxes:
    corners = np.array([[1.0, 2.0, 3.0, 4.0 + stamp / SECOND]])
    return Boxes(stamp, 640, 480, corners, np.eye(4)[None], ("cup",), np.array([0.5]), ("x",))


def write(path: Path, n: int = 20, **options: bool) -> Path:
    with BagWriter(path, **options) as bag:
        for i in range(n):
            stamp = (i + 1) * SECOND
            bag.write("/detections", c.boxes_to_msg(some_boxes(stamp), bags.types), stamp)
            motion = RelativeMotion(stamp - 1, stamp, np.eye(4))
            bag.write("/relative_pose", c.motion_to_msg(motion, bags.types), stamp)
    return path


@pytest.mark.parametrize("name", ["bag", "run.mcap"])
def test_what_is_written_is_read(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / "new folder" / name)
    assert [p.name for p in path.parent.iterdir()] == [name]
    with BagReader(path) as bag:
        assert bag.topics == {
            "/detections": "calibslam_msgs/msg/BoundingBoxArray",
            "/relative_pose": "calibslam_msgs/msg/RelativePose",
        }
        assert (bag.start, bag.end, bag.counts["/detections"]) == (SECOND, 20 * SECOND, 20)
        boxes = [c.boxes_from_msg(msg) for _, _, msg in bag.messages(["/detections"])]
        both = [topic for topic, _, _ in bag.messages(["/relative_pose", "/detections"])]
        assert not bag.rejected
    assert [b.stamp for b in boxes] == [(i + 1) * SECOND for i in range(20)]
    np.testing.assert_array_equal(boxes[3].corners, [[1.0, 2.0, 3.0, 8.0]])
    assert both == ["/detections", "/relative_pose"] * 20  # of the same time: as written


def test_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    first, second = write(tmp_path / "a" / "bag"), write(tmp_path / "b" / "bag")
    for file in ("bag.mcap", "metadata.yaml"):
        assert (first / file).read_bytes() == (second / file).read_bytes()


def test_the_mcap_tools_read_it(tmp_path: Path) -> None:
    path = write(tmp_path / "bag")
    with (path / "bag.mcap").open("rb") as file:
        decoded = list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    assert len(decoded) == 40
    schema, channel, message, boxes = decoded[0]
    assert (schema.name, schema.encoding) == ("calibslam_msgs/msg/BoundingBoxArray", "ros2msg")
    assert (channel.topic, channel.message_encoding, message.log_time) == ("/detections", "cdr", SECOND)
    assert (boxes.boxes[0].class_id, list(boxes.boxes[0].corners)) == ("cup", [1.0, 2.0, 3.0, 5.0])


def test_serialised_messages_are_those_of_ros(tmp_path: Path) -> None:
    from calibslam_msgs.msg import BoundingBoxArray
    from rclpy.serialization import deserialize_message, serialize_message

    with BagReader(write(tmp_path / "bag")) as bag:
        _, stamp, data = next(bag.raw_messages(["/detections"]))
    live = deserialize_message(data, BoundingBoxArray)
    np.testing.assert_array_equal(c.boxes_from_msg(live).corners, some_boxes(stamp).corners)
    with BagWriter(tmp_path / "live") as bag:
        bag.write_raw("/detections", "calibslam_msgs/msg/BoundingBoxArray", serialize_message(live), stamp)
    with BagReader(tmp_path / "live") as bag:
        (only,) = bag.messages(["/detections"])
    assert c.boxes_from_msg(only[2]).class_ids == ("cup",)


def test_missing_topic_is_said_with_those_there_are(tmp_path: Path) -> None:
    with (
        BagReader(write(tmp_path / "bag")) as bag,
        pytest.raises(BagError, match=r"no topic /odom.*\n.*/detections"),
    ):
        list(bag.messages(["/odom", "/detections"]))


def test_not_a_bag(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "note.txt").write_text("x")
    (tmp_path / "text.mcap").write_text("not an mcap file at all, but long enough to be one")
    (tmp_path / "nothing.mcap").touch()
    cases = {
        "none": "does not exist",
        "empty": "not a rosbag2 folder",
        "note.txt": "not a bag",
        "text.mcap": "truncated or damaged.*mcap recover",
        "nothing.mcap": "truncated or damaged.*mcap recover",
    }
    for name, text in cases.items():
        with pytest.raises(BagError, match=text):
            BagReader(tmp_path / name)


def test_truncated_bags_raise_nothing_but_bag_errors(tmp_path: Path) -> None:
    path = write(tmp_path / "bag")
    whole = (path / "bag.mcap").read_bytes()
    for share in np.linspace(0.0, 0.999, 25):
        (path / "bag.mcap").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(BagError, match="mcap recover"):
            BagReader(path)


def test_damaged_bags_raise_nothing_but_bag_errors(tmp_path: Path) -> None:
    path = write(tmp_path / "bag")
    whole = (path / "bag.mcap").read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(100):
        damaged = bytearray(whole)
        for position in rng.integers(0, len(whole), size=3):
            damaged[position] = rng.integers(256)
        (path / "bag.mcap").write_bytes(damaged)
        try:
            with BagReader(path) as bag:
                list(bag.messages(bag.topics))
        except BagError:
            pass


def test_folder_without_metadata_is_read_if_its_file_is_complete(tmp_path: Path) -> None:
    path = write(tmp_path / "bag")
    (path / "metadata.yaml").unlink()
    with BagReader(path) as bag:
        assert len(list(bag.messages(["/detections"]))) == 20


def test_undecodable_message_is_counted_and_skipped(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.write("/detections", c.boxes_to_msg(some_boxes(1), bags.types), 1)
        bag.write_raw("/detections", "calibslam_msgs/msg/BoundingBoxArray", b"\0\1\0\0garbage", 2)
        bag.write("/detections", c.boxes_to_msg(some_boxes(3), bags.types), 3)
    with BagReader(tmp_path / "bag") as bag:
        assert [time for _, time, _ in bag.messages(["/detections"])] == [1, 3]
        assert bag.rejected == {"/detections": 1}


def test_definitions_inside_the_bag_are_used(tmp_path: Path) -> None:
    """A message type that is installed nowhere."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("float64 degrees\nstd_msgs/Header header", "other_msgs/msg/Thing"))
    thing = store.types["other_msgs/msg/Thing"]
    header = bags.types("std_msgs/msg/Header")(stamp=c.stamp_to_msg(5, bags.types), frame_id="f")
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/thing", thing.__msgtype__, typestore=store)
        writer.write(connection, 5, store.serialize_cdr(thing(degrees=1.5, header=header), thing.__msgtype__))
        bare = writer.add_connection("/bare", "nowhere_msgs/msg/Thing", msgdef="", rihs01="x")
        writer.write(bare, 6, b"\0\1\0\0")
    with BagReader(tmp_path / "bag") as bag:
        ((_, _, message),) = bag.messages(["/thing"])
        assert (message.degrees, message.header.frame_id) == (1.5, "f")
        with pytest.raises(BagError, match="nowhere_msgs/msg/Thing"):
            list(bag.messages(["/bare"]))


def test_nothing_is_overwritten_unasked(tmp_path: Path) -> None:
    for name in ("bag", "run.mcap"):
        path = write(tmp_path / name)
        with pytest.raises(BagError, match=r"exists already; .*--overwrite"):
            BagWriter(path)
        write(path, n=3, overwrite=True)
        with BagReader(path) as bag:
            assert bag.counts["/detections"] == 3


def test_only_bags_are_overwritten(tmp_path: Path) -> None:
    folder = tmp_path / "thesis"
    folder.mkdir()
    (folder / "chapter.tex").touch()
    with pytest.raises(BagError, match=r"chapter\.tex"):
        BagWriter(folder, overwrite=True)
    assert (folder / "chapter.tex").exists()


@pytest.mark.parametrize(
    ("read", "out"),
    [
        ("bag", "bag"),
        ("bag", "bag/bag.mcap"),
        ("bag", "bag/metadata.yaml"),
        ("bag", "bag/../bag"),
        ("bag/bag.mcap", "bag/bag.mcap"),
        ("bag/bag.mcap", "bag"),  # with --overwrite the whole folder goes
        ("bag", "link"),
        ("link", "bag"),
        ("link", "link/bag.mcap"),
        ("bag", "file.mcap"),
        ("file.mcap", "bag"),
        ("file.mcap", "file.mcap"),
    ],
)
def test_what_is_read_is_not_replaced(read: str, out: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "bag")
    (tmp_path / "link").symlink_to("bag")
    (tmp_path / "file.mcap").symlink_to("bag/bag.mcap")
    monkeypatch.chdir(tmp_path)
    for first in (Path(read), tmp_path / read):
        for second in (Path(out), tmp_path / out):
            with pytest.raises(BagError, match=r"would replace .* which is read"):
                refuse_to_replace(second, tmp_path / "nowhere", first)


@pytest.mark.parametrize("out", ["other", "bag/other.mcap", "bag/run", "copy"])
def test_beside_what_is_read_there_is_room(out: str, tmp_path: Path) -> None:
    write(tmp_path / "copy")
    refuse_to_replace(tmp_path / out, write(tmp_path / "bag"), tmp_path / "bag" / "bag.mcap")


@pytest.mark.parametrize("name", ["bag", "run.mcap"])
def test_a_failed_write_leaves_nothing_behind(tmp_path: Path, name: str) -> None:
    with pytest.raises(RuntimeError), BagWriter(tmp_path / name) as bag:
        bag.write("/detections", c.boxes_to_msg(some_boxes(1), bags.types), 1)
        raise RuntimeError
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["bag", "run.mcap"])
@pytest.mark.parametrize("ending", [RuntimeError, KeyboardInterrupt])
def test_a_failed_write_leaves_the_old_bag_alone(tmp_path: Path, name: str, ending: type[BaseException]) -> None:
    path = write(tmp_path / name, n=2)
    with pytest.raises(ending), BagWriter(path, overwrite=True) as bag:
        bag.write("/detections", c.boxes_to_msg(some_boxes(1), bags.types), 1)
        raise ending
    assert list(tmp_path.iterdir()) == [path]
    with BagReader(path) as bag:
        assert bag.counts["/detections"] == 2


@pytest.mark.parametrize("name", ["bag", "run.mcap"])
def test_a_full_disk_is_said_and_leaves_the_old_bag_alone(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / name, n=2)
    with full_disk(512), pytest.raises(BagError, match=rf"cannot write .*{name}: File too large; make room"):
        write(path, n=20, overwrite=True)
    assert list(tmp_path.iterdir()) == [path]
    with BagReader(path) as bag:
        assert bag.counts["/detections"] == 2


@pytest.mark.parametrize("name", ["bag", "run.mcap"])
def test_a_link_is_replaced_and_not_what_it_leads_to(tmp_path: Path, name: str) -> None:
    first = write(tmp_path / "first" / name, n=2)
    link = tmp_path / name
    link.symlink_to(first)
    write(link, n=3, overwrite=True)
    for path, n in ((first, 2), (link, 3)):
        with BagReader(path) as bag:
            assert bag.counts["/detections"] == n
    assert not link.is_symlink()


def test_what_came_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="exists already"), BagWriter(tmp_path / "bag"):
        write(tmp_path / "other").rename(tmp_path / "bag")
    with BagReader(tmp_path / "bag") as bag:
        assert bag.counts["/detections"] == 20


def test_topics_keep_their_type(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/odom", "nav_msgs/msg/Odometry")
        with pytest.raises(BagError, match="has type nav_msgs/msg/Odometry"):
            bag.add_topic("/odom", "nav_msgs/msg/Path")
        with pytest.raises(BagError, match="unknown message type"):
            bag.add_topic("/x", "x_msgs/msg/X")
    with BagReader(tmp_path / "bag") as bag:
        assert list(bag.messages(["/odom"])) == []
