"""A few ellipsoids on a table and a camera that goes around them: measurements by hand, without the simulator."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np

from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.geometry.visible_box import image_bounds, project
from calibslam_backend.output.metrics import Trajectory
from calibslam_msgs_py.measurements import Array, Boxes, Camera, RelativeMotion

SECOND = 1_000_000_000
CAMERA = Camera(640, 480, np.array([[535.0, 0.0, 320.0], [0.0, 535.0, 240.0], [0.0, 0.0, 1.0]]), np.zeros(5))
SMALLEST_BOX = 8.0  # [px] of a part that a detector sees


def looking_at(position: Array, target: Array) -> Array:
    """(4, 4) T_world_camera of an upright camera; the world's z is up."""
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T[:3, 3] = position
    return T


def objects(n: int = 9) -> list[Ellipsoid]:
    """n ellipsoids on a grid of 45 cm, of different sizes and turned differently."""
    rng = np.random.default_rng(7)
    result = []
    for i in range(n):
        T = gtsam.Pose3(gtsam.Rot3.Yaw(0.7 * i), np.array([0.45 * (i % 3 - 1), 0.45 * (i // 3 - 1), 0.1])).matrix()
        result.append(Ellipsoid(T, np.sort(rng.uniform(0.05, 0.14, size=3))))
    return result


def around(n: int, turn: float = np.pi, radius: float = 1.6, height: float = 0.9) -> Array:
    """(n, 4, 4) T_world_camera on an arc around the table, looking at its middle."""
    angles = np.linspace(0.0, turn, n)
    positions = np.stack(
        [radius * np.cos(angles), radius * np.sin(angles), height + 0.15 * np.sin(3.0 * angles)], axis=1
    )
    return np.stack([looking_at(p, np.array([0.0, 0.0, 0.05])) for p in positions])


@dataclass(frozen=True)
class SmallWorld:
    """What is there and how it is measured; the same seed gives the same measurements.

    Attributes:
        poses: (N, 4, 4) T_world_camera of the images.
        objects: what they see.
        rate: images per second.
        box_sigma: standard deviation of an edge [px].
        box_memory: correlation of its error with that of the same object in the image before.
        rotation_sigma, translation_sigma: of a step of odometry, about and along each axis [rad, m].
        seed: of the noise.
    """

    poses: Array
    objects: list[Ellipsoid]
    rate: float = 30.0
    box_sigma: float = 1.5
    rotation_sigma: float = 0.002
    translation_sigma: float = 0.003
    seed: int = 0
    identities: bool = True
    box_memory: float = 0.0

    @property
    def stamps(self) -> list[int]:
        """Of the images [ns]."""
        return [SECOND + round(k * SECOND / self.rate) for k in range(len(self.poses))]

    def truth(self) -> Trajectory:
        """The true trajectory."""
        return Trajectory(np.array(self.stamps), self.poses)

    def boxes(self) -> list[Boxes]:
        """Of each image."""
        rng = np.random.default_rng([self.seed, 1])
        error = rng.normal(size=(len(self.objects), 4))
        result = []
        for stamp, T in zip(self.stamps, self.poses, strict=True):
            T_camera_object = np.linalg.inv(T) @ np.stack([o.T_world_object for o in self.objects])
            radii = np.stack([o.radii for o in self.objects])
            exact = project(T_camera_object, radii, CAMERA.K, image_bounds(CAMERA.width, CAMERA.height))
            noisy = exact + self.box_sigma * error
            fresh = rng.normal(size=exact.shape)
            error = self.box_memory * error + np.sqrt(1.0 - self.box_memory**2) * fresh
            on_border = (exact == 0.0) | (exact == [640.0, 480.0, 640.0, 480.0])
            noisy = np.where(on_border, exact, np.clip(noisy, 0.0, [640.0, 480.0, 640.0, 480.0]))
            size = noisy[:, 2:] - noisy[:, :2]
            seen = np.flatnonzero(np.isfinite(exact).all(axis=1) & (size > SMALLEST_BOX).all(axis=1))
            result.append(
                Boxes(
                    stamp,
                    CAMERA.width,
                    CAMERA.height,
                    noisy[seen],
                    np.tile(np.eye(4) * max(self.box_sigma, 0.1) ** 2, (len(seen), 1, 1)),
                    tuple(f"class {i % 3}" for i in seen),
                    np.full(len(seen), 0.9),
                    tuple(f"object {i}" if self.identities else "" for i in seen),
                )
            )
        return result

    def motions(self) -> list[RelativeMotion]:
        """Between neighbouring images, with their covariance."""
        rng = np.random.default_rng([self.seed, 2])
        sigmas = np.repeat([self.rotation_sigma, self.translation_sigma], 3)
        result = []
        for k in range(1, len(self.poses)):
            exact = gtsam.Pose3(np.linalg.inv(self.poses[k - 1]) @ self.poses[k])
            noisy = exact.retract(sigmas * rng.normal(size=6)).matrix()
            covariance = np.diag(np.maximum(sigmas, 1e-5) ** 2)
            result.append(RelativeMotion(self.stamps[k - 1], self.stamps[k], noisy, covariance))
        return result

    def measurements(self) -> Iterator[Boxes | RelativeMotion]:
        """In the order of their times."""
        motions = self.motions()
        for k, boxes in enumerate(self.boxes()):
            if k:
                yield motions[k - 1]
            yield boxes
