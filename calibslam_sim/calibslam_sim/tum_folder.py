"""Recordings in the format of the TUM RGB-D benchmark: trajectories, image lists, boxes, camera.

Every error names the file and line, and what to do about it.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
import yaml

from calibslam_msgs_py.geometry_conversions import QUATERNION_TOLERANCE, rotation_from_quaternion
from calibslam_msgs_py.measurements import Boxes, Camera, StampedPose

FRAME_ID = "camera"
DETECTION_COLUMNS = ("timestamp", "xmin", "ymin", "xmax", "ymax", "score", "class_id")

SEPARATORS = ",;\t"
ZERO_IS_PINHOLE = ("plumb_bob", "rational_polynomial")  # distortion models

# Published intrinsics of the benchmark's colour cameras: fx fy cx cy, k1 k2 p1 p2 k3.
# https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
PRESETS: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "fr1": (
        (517.306408, 516.469215, 318.643040, 255.313989),
        (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    ),
    "fr2": (
        (520.908620, 521.007327, 325.141442, 249.701764),
        (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    ),
    "fr3": ((535.4, 539.2, 320.1, 247.6), (0.0, 0.0, 0.0, 0.0, 0.0)),
}


class TumError(ValueError):
    """A file that is missing or cannot be understood."""


def preset_camera(name: str) -> Camera:
    """The colour camera of one of the benchmark's three set-ups, a key of `PRESETS`."""
    (fx, fy, cx, cy), distortion = PRESETS[name]
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Camera(640, 480, K, np.array(distortion), FRAME_ID)


def read_camera(path: Path) -> Camera:
    """The camera of a ROS calibration file."""
    try:
        content = yaml.safe_load(_text(path))
        model = content.get("distortion_model", "plumb_bob")
        is_pinhole = not content.keys() & {"distortion_model", "distortion_coefficients"}
        coefficients = np.zeros(5) if is_pinhole else np.array(content["distortion_coefficients"]["data"], float)
        if model in ZERO_IS_PINHOLE and not coefficients.any():
            model, coefficients = "plumb_bob", np.zeros(5)
        camera = Camera(
            int(content["image_width"]),
            int(content["image_height"]),
            np.array(content["camera_matrix"]["data"], float).reshape(3, 3),
            coefficients,
            FRAME_ID,
        )
    except yaml.YAMLError as error:
        raise TumError(f"{path}: not YAML: {error}") from None
    except KeyError as error:
        raise TumError(f"{path}: {error} is missing; the file must be a ROS camera calibration") from None
    except (AttributeError, TypeError, ValueError) as error:
        raise TumError(f"{path}: not a ROS camera calibration: {error}") from None
    if model != "plumb_bob" or coefficients.shape != (5,):
        raise TumError(
            f"{path}: distortion must be plumb_bob with 5 coefficients, not {model} with {coefficients.size}"
        )
    if not (camera.width > 0 and camera.height > 0 and camera.K[0, 0] > 0.0 and camera.K[1, 1] > 0.0):
        raise TumError(f"{path}: image size and focal lengths must be above 0")
    if not (np.isfinite(camera.K).all() and np.isfinite(coefficients).all()):
        raise TumError(f"{path}: contains numbers that are not finite")
    return camera


def read_trajectory(path: Path) -> list[StampedPose]:
    """Poses from lines `timestamp[s] tx ty tz[m] qx qy qz qw`, in order of time."""
    poses: list[StampedPose] = []
    for line, words in _rows(path, 8, "timestamp tx ty tz qx qy qz qw"):
        stamp = _stamp(words[0], path, line)
        numbers = np.array([_number(word, path, line) for word in words[1:]])
        norm = float(np.linalg.norm(numbers[3:]))
        if abs(norm - 1.0) > QUATERNION_TOLERANCE:
            raise _line_error(path, line, f"quaternion of length {norm:.4g} instead of 1")
        if poses and stamp == poses[-1].stamp:
            raise TumError(f"{path}:{line}: a second pose of the time {words[0]}; keep one of them")
        if poses and stamp < poses[-1].stamp:
            raise TumError(f"{path}:{line}: time does not increase; sort the file by its first column")
        T = np.eye(4)
        T[:3, :3] = rotation_from_quaternion(numbers[3:] / norm)
        T[:3, 3] = numbers[:3]
        poses.append(StampedPose(stamp, T))
    if not poses:
        raise TumError(f"{path}: contains no pose")
    return poses


def read_image_list(path: Path) -> list[tuple[int, Path]]:
    """Stamps [ns] and files of images from lines `timestamp[s] filename`, in order of time."""
    images = []
    for line, words in _rows(path, 2, "timestamp filename"):
        file = path.parent / words[1]
        if not file.is_file():
            raise TumError(f"{path}:{line}: there is no file {file}; copy the images beside {path.name}")
        images.append((_stamp(words[0], path, line), file))
    return sorted(images)


def read_detections(path: Path, camera: Camera) -> list[Boxes]:
    """Boxes of each image, without covariances, in order of time.

    The first line names the columns: `DETECTION_COLUMNS`, and `object_id` where identities are known. Commas,
    semicolons or tabs separate them. Lines that begin with # are comments.
    """
    rows: dict[int, list[tuple[list[float], str, str]]] = {}
    # Comments stay as empty lines, so that the others keep their numbers.
    lines = ["" if line.lstrip().startswith("#") else line for line in _text(path).splitlines()]
    first = next((n for n, line in enumerate(lines) if line.strip()), len(lines))
    named = lines[first] if first < len(lines) else ""
    reader = csv.reader(lines[first:], delimiter=max(SEPARATORS, key=named.count))
    header = [name.strip() for name in next(reader, [])]
    missing = [name for name in DETECTION_COLUMNS if name not in header]
    if missing:
        raise TumError(
            f"{path}:{first + 1}: no column {', '.join(missing)}; the first line must name the columns: "
            f"{','.join(DETECTION_COLUMNS)}, and object_id where identities are known; it is {named[:80]!r}"
        )
    for words in reader:
        line = first + reader.line_num
        if not words:
            continue
        if len(words) != len(header):
            raise _line_error(path, line, f"{len(words)} values instead of {len(header)}")
        row = dict(zip(header, (word.strip() for word in words), strict=True))
        numbers = [_number(row[name], path, line) for name in DETECTION_COLUMNS[1:6]]
        stamp = _stamp(row["timestamp"], path, line)
        rows.setdefault(stamp, []).append((numbers, row["class_id"], row.get("object_id", "")))
    return [_boxes(stamp, rows[stamp], camera) for stamp in sorted(rows)]


def read_class_names(path: Path) -> list[str]:
    """Names of classes by their numbers, a line for each, from 0 on."""
    names = [line.strip() for line in _text(path).splitlines()]
    while names and not names[-1]:
        names.pop()
    if not names or not all(names):
        raise TumError(f"{path}: must hold a name in each line, that of class 0 first")
    return names


def _boxes(stamp: int, rows: list[tuple[list[float], str, str]], camera: Camera) -> Boxes:
    numbers = np.array([row[0] for row in rows])
    return Boxes(
        stamp=stamp,
        width=camera.width,
        height=camera.height,
        corners=numbers[:, :4],
        covariances=np.full((len(rows), 4, 4), np.nan),
        class_ids=tuple(row[1] for row in rows),
        scores=numbers[:, 4],
        object_ids=tuple(row[2] for row in rows),
        frame_id=camera.frame_id,
    )


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")  # some editors begin a file with a mark
    except UnicodeDecodeError:
        raise TumError(f"{path}: not a text file") from None
    except OSError as error:
        raise TumError(f"{path}: cannot be read: {error.strerror}") from None


def _line_error(path: Path, line: int, problem: str) -> TumError:
    """What is wrong in a line; the last one may be there in part only."""
    text = _text(path)
    is_cut = line == len(text.splitlines()) and not text.endswith("\n")
    return TumError(f"{path}:{line}: {problem}{'; is the file complete?' if is_cut else ''}")


def _rows(path: Path, columns: int, meaning: str) -> Iterator[tuple[int, list[str]]]:
    """Line number and words of each line that is neither empty nor a comment."""
    for number, line in enumerate(_text(path).splitlines(), start=1):
        words = line.replace(",", " ").replace(";", " ").split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) != columns:
            raise _line_error(path, number, f"{len(words)} values instead of {columns} ({meaning})")
        yield number, words


def _stamp(word: str, path: Path, line: int) -> int:
    """Nanoseconds of a time in decimal seconds, exactly as written."""
    try:
        seconds = Decimal(word)
    except InvalidOperation:
        raise _line_error(path, line, f"{word!r} is not a number") from None
    if not seconds.is_finite() or not 0 <= seconds < 2**31:
        raise TumError(f"{path}:{line}: {word} is not a time in seconds")
    return int(seconds.scaleb(9).to_integral_value())


def _number(word: str, path: Path, line: int) -> float:
    try:
        value = float(word)
    except ValueError:
        raise _line_error(path, line, f"{word!r} is not a number") from None
    if not np.isfinite(value):
        raise TumError(f"{path}:{line}: {word} is not a finite number")
    return value
