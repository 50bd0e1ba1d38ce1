"""Files of the TUM benchmark: read exactly, or refused with file and line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from calibslam_msgs_py.measurements import Camera
from calibslam_sim.tum_folder import (
    PRESETS,
    TumError,
    preset_camera,
    read_camera,
    read_detections,
    read_image_list,
    read_trajectory,
)
from calibslam_sim.tum_to_bag import doubts

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "tum"
HEADER = "timestamp,xmin,ymin,xmax,ymax,score,class_id\n"
CAMERA_FILE = """
image_width: 640
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [500.0, 0.0, 320.0, 0.0, 510.0, 240.0, 0.0, 0.0, 1.0]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0.0, 0.0, 0.0, 0.0]}
"""


def written(tmp_path: Path, text: str, name: str = "file.txt") -> Path:
    path = tmp_path / name
    path.write_text(text)
    return path


def test_a_pose_is_read_exactly(tmp_path: Path) -> None:
    half = np.sqrt(0.5)
    text = f"# comment\n\n1305031449.7996 1 2 3 0 0 {half} {half}\n1305031449.809600001 1 2 3 0 0 0 1\n"
    first, second = read_trajectory(written(tmp_path, text))
    assert first.stamp == 1305031449_799600000
    assert second.stamp == 1305031449_809600001
    np.testing.assert_allclose(first.T, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-12)


@given(
    st.integers(0, 2**31 * 10**9 - 1),
    st.tuples(*[st.floats(-1e3, 1e3)] * 3),
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
)
def test_any_pose_survives(tmp_path_factory: pytest.TempPathFactory, stamp: int, p: tuple, q: tuple) -> None:
    q = np.array(q) / np.linalg.norm(q)
    line = f"{stamp // 10**9}.{stamp % 10**9:09d} " + " ".join(repr(float(x)) for x in (*p, *q))
    (pose,) = read_trajectory(written(tmp_path_factory.mktemp("poses"), line))
    assert pose.stamp == stamp
    np.testing.assert_array_equal(pose.T[:3, 3], p)
    np.testing.assert_allclose(pose.T[:3, :3], Rotation.from_quat(q).as_matrix(), atol=1e-12)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("1 0 0 0 0 0 1", "file.txt:1: 7 values instead of 8"),
        ("# c\n1 0 0 0 0 0 0 x", "file.txt:2: 'x' is not a number"),
        ("1 nan 0 0 0 0 0 1", "file.txt:1: nan is not a finite number"),
        ("nan 0 0 0 0 0 0 1", "file.txt:1: nan is not a time"),
        ("1 0 0 0 0 0 0 0.9", "file.txt:1: quaternion of length 0.9"),
        ("1 0 0 0 0 0 0 0", "file.txt:1: quaternion of length 0 "),
        ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1", "file.txt:2: time does not increase; sort"),
        ("2 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1", "file.txt:2: a second pose of the time 2; keep one of them"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 0.", "file.txt:2: quaternion of length 0 instead of 1; is the file complete"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 -", "file.txt:2: 5 values instead of 8 .*; is the file complete"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 -", "file.txt:2: '-' is not a number; is the file complete"),
        ("1 0 0 0 0 0 0 0.9\n2 0 0 0 0 0 0 1", "file.txt:1: quaternion of length 0.9 instead of 1$"),
        ("# nothing", "contains no pose"),
    ],
)
def test_a_bad_trajectory_is_refused(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(TumError, match=says.replace(".", r"\.").replace(r"\.*", ".*")):
        read_trajectory(written(tmp_path, text))


@pytest.mark.parametrize("separator", ["\t", ";", ", ", "; "])
def test_poses_may_be_separated_otherwise(tmp_path: Path, separator: str) -> None:
    (pose,) = read_trajectory(written(tmp_path, "\ufeff# time\n" + "1 2 3 4 0 0 0 1".replace(" ", separator)))
    assert pose.stamp == 1_000_000_000
    np.testing.assert_array_equal(pose.T[:3, 3], [2, 3, 4])


def test_a_rounded_quaternion_is_normalised(tmp_path: Path) -> None:
    (pose,) = read_trajectory(written(tmp_path, "1 0 0 0 0.7071 0.0 0.0 0.7072"))
    np.testing.assert_allclose(pose.T[:3, :3] @ pose.T[:3, :3].T, np.eye(3), atol=1e-12)


def test_a_missing_or_binary_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(TumError, match=r"nowhere\.txt: cannot be read"):
        read_trajectory(tmp_path / "nowhere.txt")
    (tmp_path / "binary.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(TumError, match="not a text file"):
        read_trajectory(tmp_path / "binary.txt")


def test_boxes_are_grouped_by_image(tmp_path: Path) -> None:
    text = (
        "timestamp,xmin,ymin,xmax,ymax,score,class_id,object_id\n"
        "2.5,1,2,3,4,0.9,62,7\n"
        "1.5,10,20,30,40,0.5,41,\n"
        "2.5,5,6,7,8,0.8,62,3\n"
    )
    first, second = read_detections(written(tmp_path, text), preset_camera("fr3"))
    assert (first.stamp, second.stamp) == (1_500_000_000, 2_500_000_000)
    assert (second.class_ids, second.object_ids) == (("62", "62"), ("7", "3"))
    np.testing.assert_array_equal(second.corners, [[1, 2, 3, 4], [5, 6, 7, 8]])
    assert first.object_ids == ("",)
    assert not second.has_covariance.any()
    assert (first.width, first.height) == (640, 480)


@pytest.mark.parametrize("separator", [",", ";", "\t", " ; "])
def test_boxes_may_be_separated_otherwise(tmp_path: Path, separator: str) -> None:
    """And the file may begin with the mark of some editors, and hold comments."""
    rows = [HEADER.strip(), "1,1,2,3,4,0.9,62", "2,5,6,7,8,0.8,41"]
    first, second = (row.replace(",", separator) for row in rows[1:])
    text = f"\ufeff# boxes, of a detector\n\n{rows[0].replace(',', separator)}\n{first}\n# a comment\n\n{second}\n"
    images = read_detections(written(tmp_path, text), preset_camera("fr3"))
    assert [boxes.stamp for boxes in images] == [1_000_000_000, 2_000_000_000]
    np.testing.assert_array_equal(images[1].corners, [[5, 6, 7, 8]])
    with pytest.raises(TumError, match=r":8: 1 values instead of 7; is the file complete\?"):
        read_detections(written(tmp_path, text + "3"), preset_camera("fr3"))


def test_identities_may_be_missing(tmp_path: Path) -> None:
    text = "timestamp,xmin,ymin,xmax,ymax,score,class_id\n1,1,2,3,4,0.9,62\n"
    (boxes,) = read_detections(written(tmp_path, text), preset_camera("fr3"))
    assert boxes.object_ids == ("",)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no column timestamp, xmin"),
        ("timestamp,xmin,ymin,xmax,ymax,score\n", "no column class_id"),
        ("# c\nTimestamp x1 y1\n1 2 3\n", "txt:2: no column timestamp, .*; it is 'Timestamp x1 y1'"),
        (HEADER + "1,2,3\n", ":2: 3 values instead of 7"),
        (HEADER + "1,2,3,a,5,1,9\n", ":2: 'a' is not a number"),
        (HEADER + "\n1,2,3,inf,5,1,9\n", ":3: inf is not a finite number"),
    ],
)
def test_bad_boxes_are_refused(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(TumError, match=says):
        read_detections(written(tmp_path, text), preset_camera("fr3"))


def test_a_calibration_file_is_read(tmp_path: Path) -> None:
    camera = read_camera(written(tmp_path, CAMERA_FILE))
    assert (camera.width, camera.height) == (640, 480)
    np.testing.assert_array_equal(camera.K, [[500, 0, 320], [0, 510, 240], [0, 0, 1]])
    np.testing.assert_array_equal(camera.distortion, [0.1, 0, 0, 0, 0])


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [(None, None), ("rational_polynomial", [0.0] * 8), ("plumb_bob", []), ("plumb_bob", [0.0] * 4)],
)
def test_a_camera_without_distortion(tmp_path: Path, model: str | None, coefficients: list[float] | None) -> None:
    text = "".join(line for line in CAMERA_FILE.splitlines(keepends=True) if "distortion" not in line)
    if model:
        text += f"distortion_model: {model}\ndistortion_coefficients: {{data: {coefficients}}}\n"
    np.testing.assert_array_equal(read_camera(written(tmp_path, text)).distortion, np.zeros(5))
    fisheye = CAMERA_FILE.replace("plumb_bob", "equidistant").replace("0.1", "0.0")  # bends even without coefficients
    with pytest.raises(TumError, match="not equidistant with 5"):
        read_camera(written(tmp_path, fisheye))


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("plumb_bob", "rational_polynomial", "must be plumb_bob with 5 coefficients, not rational"),
        ("distortion_coefficients", "distortion", "'distortion_coefficients' is missing"),
        ("image_width: 640", "", "'image_width' is missing"),
        ("image_width: 640", "image_width: 0", "must be above 0"),
        ("image_width: 640", "image_width: wide", "not a ROS camera calibration"),
        ("plumb_bob", "equidistant", "must be plumb_bob with 5 coefficients, not equidistant"),
        ("0.0, 0.0, 1.0]", "0.0, 1.0]", "not a ROS camera calibration"),
        ("500.0", ".nan", "above 0"),
        ("image_width: 640", "- [", "not YAML"),
    ],
)
def test_a_bad_calibration_file_is_refused(tmp_path: Path, old: str, new: str, says: str) -> None:
    with pytest.raises(TumError, match=says):
        read_camera(written(tmp_path, CAMERA_FILE.replace(old, new)))


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_cameras(name: str) -> None:
    camera: Camera = preset_camera(name)
    assert 500.0 < camera.K[0, 0] < 550.0
    assert camera.distortion.shape == (5,)


def test_a_listed_image_must_exist(tmp_path: Path) -> None:
    (tmp_path / "rgb").mkdir()
    (tmp_path / "rgb" / "1.png").touch()
    listed = written(tmp_path, "# timestamp filename\n1.25 rgb/1.png\n", "rgb.txt")
    assert read_image_list(listed) == [(1_250_000_000, tmp_path / "rgb" / "1.png")]
    with pytest.raises(TumError, match=r"rgb\.txt:1: there is no file .*2\.png"):
        read_image_list(written(tmp_path, "1.25 rgb/2.png\n", "rgb.txt"))


@pytest.mark.parametrize(
    ("corners", "says"),
    [
        ([[0.1, 0.2, 0.5, 1.0]], "no corner is above 1"),
        ([[300.0, 20.0, 40.0, 50.0], [10.0, 20.0, 40.0, 50.0]], "xmax is not above xmin in 1 of 2 boxes"),
        ([[300.0, 20.0, 40.0, 50.0], *[[10.0, 20.0, 40.0, 50.0]] * 9], None),
        ([], "holds no boxes"),
    ],
)
def test_boxes_that_are_hardly_meant_so_are_noted(tmp_path: Path, corners: list[list[float]], says: str | None) -> None:
    rows = "".join(f"{k},{','.join(map(str, box))},0.9,62\n" for k, box in enumerate(corners, start=1))
    file = written(tmp_path, HEADER + rows, "detections.csv")
    notes = doubts(file, read_detections(file, preset_camera("fr3")))
    assert len(notes) == (1 if says else 0)
    assert not says or says in notes[0]


@pytest.mark.skipif(not SHARED.is_dir(), reason=f"no real recordings at {SHARED}")
def test_real_recordings_are_read_whole() -> None:
    folder = SHARED / "fr3_office"
    boxes = read_detections(folder / "detections.csv", read_camera(folder / "camera_info.yaml"))
    assert sum(map(len, boxes)) == 16_948
    stamps = {pose.stamp for pose in read_trajectory(folder / "odometry.txt")}
    assert sum(image.stamp in stamps for image in boxes) > 0.95 * len(boxes)  # a few images have no odometry
