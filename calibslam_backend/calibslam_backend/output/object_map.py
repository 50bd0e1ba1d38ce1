"""What the back end knows, as a file: objects and trajectory, with covariances."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calibslam_msgs_py.measurements import Array, QuadricEstimate

FORMAT, VERSION = "calibslam-map", 1


class MapFileError(ValueError):
    """A map file that cannot be read; the text names it and what is wrong."""


@dataclass(frozen=True)
class ObjectMap:
    """Objects and trajectory.

    Attributes:
        stamps: of the N keyframes [ns].
        poses: (N, 4, 4) T_map_camera.
        covariances: (N, 6, 6) of the poses, [rotation, translation] in the camera frame.
        quadrics: the objects, in the frame `map`.
        camera: name of the camera frame.
    """

    stamps: tuple[int, ...]
    poses: Array
    covariances: Array
    quadrics: tuple[QuadricEstimate, ...]
    camera: str = "camera"

    def save(self, path: Path) -> None:
        """Write it as JSON; the same map gives the same bytes. An existing file is replaced in one step."""
        partial = path.with_name(path.name + ".part")
        try:
            partial.write_text(self.to_json(), encoding="utf-8")
            partial.replace(path)
        except OSError:
            partial.unlink(missing_ok=True)
            raise

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
            }
            for q in self.quadrics
        ]
        content = {
            "format": FORMAT,
            "version": VERSION,
            "frame_id": "map",
            "camera": self.camera,
            "units": "m, rad, ns; orientation x y z w; covariances row-major: rotation, translation (body), radii",
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
            raise MapFileError(f"map {path} has version {content.get('version')}, this program reads {VERSION}")
        try:
            keyframes, quadrics = content["keyframes"], content["quadrics"]
            return cls(
                tuple(int(k["stamp"]) for k in keyframes),
                np.reshape([_matrix(k) for k in keyframes], (-1, 4, 4)),
                np.reshape([_numbers(k["covariance"], (6, 6)) for k in keyframes], (-1, 6, 6)),
                tuple(
                    QuadricEstimate(
                        int(q["id"]),
                        str(q["class_id"]),
                        _matrix(q),
                        _radii(q["radii"]),
                        _numbers(q["covariance"], (9, 9)),
                        int(q["observations"]),
                    )
                    for q in quadrics
                ),
                str(content["camera"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise MapFileError(f"map {path} is damaged: {error!r}") from None


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


def _matrix(entry: dict[str, Any]) -> Array:
    orientation = _numbers(entry["orientation"], (4,))
    if abs(np.linalg.norm(orientation) - 1.0) > 1e-6:
        raise ValueError(f"orientation {entry['orientation']} is no unit quaternion")
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(orientation).as_matrix()
    T[:3, 3] = _numbers(entry["position"], (3,))
    return T


def _radii(values: Any) -> Array:
    radii = _numbers(values, (3,))
    if not (radii > 0.0).all():
        raise ValueError(f"radii {values} are not positive")
    return radii


def _numbers(values: Any, shape: tuple[int, ...]) -> Array:
    numbers = np.asarray(values, dtype=np.float64).reshape(shape)
    if not np.isfinite(numbers).all():
        raise ValueError("a number is not finite")
    return numbers
