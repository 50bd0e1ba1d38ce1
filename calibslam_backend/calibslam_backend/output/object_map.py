"""What the back end knows, as a file: objects and trajectory, with covariances."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.graph.known import NOTHING_KNOWN, Known, MapPrior
from calibslam_msgs_py.covariance import LARGEST_VARIANCE, SYMMETRY_TOLERANCE, is_covariance
from calibslam_msgs_py.files import write_whole
from calibslam_msgs_py.measurements import SECOND, Array, QuadricEstimate

FORMAT, VERSION = "calibslam-map", 1
LARGEST_ID = 2**31 - 1  # messages have 32 bits, and new objects are numbered on from the largest
LARGEST_COUNT = 2**32 - 1  # of observations, as messages have it
LATEST = 2**31 * SECOND  # [ns] that a stamp of ROS can tell
# What is beyond these is garbage: farther than the moon, and no semi-axis of an object [m].
LARGEST_POSITION, SMALLEST_RADIUS, LARGEST_RADIUS = 1e9, 1e-6, 1e6

Entry = TypeVar("Entry")


class MapFileError(ValueError):
    """A map file that cannot be read; the text names it and what is wrong."""


@dataclass(frozen=True)
class MotionCovariances:
    """How well motions between keyframes are known, which the covariances of their poses alone do not tell.

    Attributes:
        first, last: (M,) indices of the keyframes.
        covariances: (M, 6, 6) [rotation, translation], in the camera frame of the last.
    """

    first: Array
    last: Array
    covariances: Array


@dataclass(frozen=True)
class ObjectMap:
    """Objects and trajectory.

    Attributes:
        stamps: of the N keyframes [ns].
        poses: (N, 4, 4) T_map_camera.
        covariances: (N, 6, 6) of the poses, [rotation, translation] in the camera frame.
        quadrics: the objects, in the frame `map`.
        camera: name of the camera frame.
        prior: what to begin with when the map is gone on with. A quadric that it lacks begins with its estimate and
            covariance, which tell neither what it errs by together with others nor all of its shape.
    """

    stamps: tuple[int, ...]
    poses: Array
    covariances: Array
    quadrics: tuple[QuadricEstimate, ...]
    camera: str = "camera"
    prior: MapPrior = NOTHING_KNOWN

    def save(self, path: Path) -> None:
        """Write it as JSON, and its folder; the same map gives the same bytes. A file is replaced in one step."""
        write_whole(path, self.to_json().encode())

    def to_json(self) -> str:
        """As it stands in a file."""
        keyframes = [
            {"stamp": stamp, **_pose(T), "covariance": covariance.ravel().tolist()}
            for stamp, T, covariance in zip(self.stamps, self.poses, self.covariances, strict=True)
        ]
        quadrics = [
            {
                "id": q.id,
                "class_id": q.class_id,
                **_pose(q.T_map_object),
                "radii": q.radii.tolist(),
                "covariance": q.covariance.ravel().tolist(),
                "observations": q.observations,
                **({"prior": _prior(self.prior.quadrics[q.id])} if q.id in self.prior.quadrics else {}),
            }
            for q in self.quadrics
        ]
        content = {
            "format": FORMAT,
            "version": VERSION,
            "frame_id": "map",
            "camera": self.camera,
            "frame_covariance": self.prior.frame.ravel().tolist(),
            "units": "m, rad, ns; orientation x y z w; covariances row-major: rotation, translation (body), radii; "
            "prior: centre and logarithmic shape, cross-covariance of it (rows) and its parent's",
            "quadrics": quadrics,
            "keyframes": keyframes,
        }
        return json.dumps(content, indent=1) + "\n"

    @classmethod
    def load(cls, path: Path) -> ObjectMap:
        """Read what `save` wrote.

        Raises:
            MapFileError: the file is missing, is no map, or holds numbers that cannot be.
        """
        if path.exists() and not (path.is_file() or path.is_dir()):  # a pipe would wait for ever
            raise MapFileError(f"map {path} cannot be read: it is no file")
        try:
            text = path.read_text(encoding="utf-8")
        except OSError as error:
            raise MapFileError(f"map {path} cannot be read: {error.strerror}") from None
        except ValueError as error:
            raise MapFileError(f"map {path} is not JSON: {error}") from None
        return cls.from_json(text, str(path))

    @classmethod
    def from_json(cls, text: str, path: str) -> ObjectMap:
        """The map in a text that came from somewhere; raises MapFileError as `load`."""
        try:
            content = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise MapFileError(f"map {path} is not JSON: {error}") from None
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise MapFileError(f'map {path} does not say "format": "{FORMAT}"; is it a map.json of this project?')
        if content.get("version") != VERSION:
            raise MapFileError(f"map {path} has version {content.get('version')!r}, this program reads {VERSION}")
        try:
            keyframes = _each(content, "keyframes", _keyframe)
            quadrics = _each(content, "quadrics", _quadric)
            camera = _text(content, "camera")
            ids = Counter(quadric.id for quadric in quadrics)
            if twice := [j for j, count in ids.items() if count > 1]:
                raise ValueError(f"quadrics: id {twice[0]} is there {ids[twice[0]]} times")
            priors = dict(_each(content, "quadrics", _own_prior))
            known = _in_order({j: prior for j, prior in priors.items() if prior is not None})
            prior = MapPrior(_frame(content), known)
            prior.check()
        except KeyError as error:
            raise _damaged(path, f"it has no {error}") from None
        except ValueError as error:
            raise _damaged(path, str(error)) from None
        return cls(
            tuple(stamp for stamp, _, _ in keyframes),
            np.reshape([pose for _, pose, _ in keyframes], (-1, 4, 4)),
            np.reshape([covariance for _, _, covariance in keyframes], (-1, 6, 6)),
            tuple(quadrics),
            camera,
            prior,
        )


def _damaged(path: str, why: str) -> MapFileError:
    return MapFileError(f"map {path} is damaged: {why}; correct that, or use a map that was saved before")


def tum_lines(stamps: tuple[int, ...] | list[int], poses: Array) -> str:
    """A trajectory in TUM format: seconds, x y z, quaternion x y z w. Seconds are exact decimals of the stamps."""
    lines = []
    for stamp, T in zip(stamps, poses, strict=True):
        seconds, nanoseconds = divmod(stamp, 1_000_000_000)
        numbers = np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)])
        lines.append(f"{seconds}.{nanoseconds:09d} " + " ".join(f"{number:.9f}" for number in numbers))
    return "\n".join(lines) + "\n"


def _pose(T: Array) -> dict[str, Any]:
    orientation = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
    return {"position": T[:3, 3].tolist(), "orientation": orientation.tolist()}


def _each(content: dict[str, Any], name: str, read: Callable[[dict[str, Any]], Entry]) -> list[Entry]:
    """What `read` makes of the entries of a list; ValueError names the entry that it refuses."""
    if not isinstance(content[name], list):
        raise ValueError(f"{name} is no list")
    result = []
    for n, entry in enumerate(content[name]):
        if not isinstance(entry, dict):
            raise ValueError(f"{name}[{n}] is no object of JSON")
        try:
            result.append(read(entry))
        except (KeyError, ValueError) as error:
            named = f" (id {entry['id']})" if isinstance(entry.get("id"), int) else ""
            why = f"it has no {error}" if isinstance(error, KeyError) else error
            raise ValueError(f"{name}[{n}]{named}: {why}") from None
    return result


def _keyframe(entry: dict[str, Any]) -> tuple[int, Array, Array]:
    """Stamp, pose and covariance.

    Nothing is weighted with this covariance, so it may be as good as singular: where odometry does not measure a
    direction, it tells that one apart from others that are known well.
    """
    covariance = _numbers(entry, "covariance", (6, 6))
    scale = np.sqrt(np.abs(np.diag(covariance)))
    asymmetry = np.abs(covariance - covariance.T)
    if (np.diag(covariance) < 0.0).any() or (asymmetry > SYMMETRY_TOLERANCE * np.outer(scale, scale)).any():
        raise ValueError("its covariance is not symmetric with variances of 0 or more")
    return _whole(entry, "stamp", 1 - LATEST, LATEST - 1), _matrix(entry), covariance


def _quadric(entry: dict[str, Any]) -> QuadricEstimate:
    covariance = _numbers(entry, "covariance", (9, 9))
    if not is_covariance(covariance):
        raise ValueError("its covariance is not symmetric and positive definite, of sensible size")
    return QuadricEstimate(
        _whole(entry, "id", 0, LARGEST_ID),
        _text(entry, "class_id"),
        _matrix(entry),
        _radii(entry),
        covariance,
        _whole(entry, "observations", 0, LARGEST_COUNT),
    )


def _frame(content: dict[str, Any]) -> Array:
    if "frame_covariance" not in content:
        return NOTHING_KNOWN.frame
    covariance = _numbers(content, "frame_covariance", (6, 6))
    largest = np.trace(covariance)
    if largest > LARGEST_VARIANCE or not np.allclose(covariance, covariance.T, atol=1e-9 * abs(largest)):
        raise ValueError("frame_covariance is not symmetric and of sensible size")
    if np.linalg.eigvalsh(covariance)[0] < -1e-9 * largest:
        raise ValueError("frame_covariance is not positive semidefinite")
    return covariance


def _prior(known: Known) -> dict[str, Any]:
    return {
        "vector": known.vector.tolist(),
        "covariance": known.covariance.ravel().tolist(),
        "parent": known.parent,
        "cross_covariance": known.cross.ravel().tolist(),
    }


def _own_prior(entry: dict[str, Any]) -> tuple[int, Known | None]:
    """Of a quadric: its id and prior."""
    j = _whole(entry, "id", 0, LARGEST_ID)
    if "prior" not in entry:
        return j, None
    prior = entry["prior"]
    if not isinstance(prior, dict):
        raise ValueError("its prior is no object of JSON")
    vector, covariance = _numbers(prior, "vector", (9,)), _numbers(prior, "covariance", (9, 9))
    if not np.allclose(vector, Ellipsoid(_matrix(entry), _radii(entry)).vector(), rtol=1e-6, atol=1e-6):
        raise ValueError("its prior is of another position or shape: leave it out where you change these")
    if not is_covariance(covariance):
        raise ValueError("the covariance of its prior is not symmetric and positive definite, of sensible size")
    parent = None if prior["parent"] is None else _whole(prior, "parent", 0, LARGEST_ID)
    return j, Known(vector, covariance, parent, _numbers(prior, "cross_covariance", (9, 9)))


def _in_order(priors: dict[int, Known]) -> dict[int, Known]:
    """Parents before those that depend on them; one whose parent has none is known by itself."""
    result: dict[int, Known] = {}
    left = {
        j: known if known.parent is None or known.parent in priors else Known(known.vector, known.covariance)
        for j, known in priors.items()
    }
    while left:
        ready = [j for j, known in left.items() if known.parent is None or known.parent in result]
        if not ready:
            raise ValueError(f"the prior of quadric {next(iter(left))} depends on itself")
        result.update({j: left.pop(j) for j in ready})
    return result


def _matrix(entry: dict[str, Any]) -> Array:
    orientation = _numbers(entry, "orientation", (4,))
    if abs(np.linalg.norm(orientation) - 1.0) > 1e-6:
        raise ValueError(f"orientation {entry['orientation']} is no unit quaternion")
    position = _numbers(entry, "position", (3,))
    if np.abs(position).max() > LARGEST_POSITION:
        raise ValueError(f"position {entry['position']} is farther than {LARGEST_POSITION:g} m")
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(orientation).as_matrix()
    T[:3, 3] = position
    return T


def _radii(entry: dict[str, Any]) -> Array:
    radii = _numbers(entry, "radii", (3,))
    if not ((radii >= SMALLEST_RADIUS) & (radii <= LARGEST_RADIUS)).all():
        raise ValueError(f"radii {entry['radii']} are not from {SMALLEST_RADIUS:g} to {LARGEST_RADIUS:g} m")
    return radii


def _numbers(entry: dict[str, Any], what: str, shape: tuple[int, ...]) -> Array:
    values = entry[what]
    try:
        numbers = np.asarray(values, dtype=np.float64).reshape(shape)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{what} does not consist of {np.prod(shape)} numbers") from None
    if not np.isfinite(numbers).all():
        raise ValueError(f"a number of {what} is not finite")
    return numbers


def _whole(entry: dict[str, Any], what: str, low: int, high: int) -> int:
    value = entry[what]
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise ValueError(f"{what} {value!r} is no whole number from {low} to {high}")
    return value


def _text(entry: dict[str, Any], what: str) -> str:
    text = str(entry[what])
    try:
        text.encode()
    except UnicodeEncodeError:  # JSON can hold half of a character, messages cannot
        raise ValueError(f"{what} {text!r} is no text") from None
    return text
