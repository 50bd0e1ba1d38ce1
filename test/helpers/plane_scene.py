"""Images and depth of a textured, slanted wall as a camera sees it that exposes its rows one after the other."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import gtsam
import numpy as np

from calibslam_msgs_py.measurements import Camera

CAMERA = Camera(320, 240, np.array([[260.0, 0.0, 160.0], [0.0, 260.0, 120.0], [0.0, 0.0, 1.0]]), np.zeros(5))
# The wall: points X with normal @ X = 1, in the frame in which poses are given; near 2 m in front of the origin.
NORMAL = np.array([0.15, 0.1, 0.5])
TEXELS = 250.0  # per metre


def texture(seed: int = 3) -> np.ndarray:
    """(2048, 2048) uint8, corners at all scales."""
    random = np.random.default_rng(seed)
    total = np.zeros((2048, 2048), np.float32)
    for size, weight in ((32, 1.0), (128, 1.0), (512, 0.7)):
        noise = random.random((size, size)).astype(np.float32)
        total += weight * cv2.resize(noise, (2048, 2048), interpolation=cv2.INTER_CUBIC)
    return np.clip(255.0 * (total - total.min()) / (total.max() - total.min()), 0, 255).astype(np.uint8)


def take(
    picture: np.ndarray, pose: Callable[[float], gtsam.Pose3], time: float, readout: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Grey image (H, W) uint8 and depth (H, W) float32 [m]; `pose(time [s])` is that of the camera."""
    height, width = CAMERA.height, CAMERA.width
    at = [pose(time + readout * (row / height - 0.5)) for row in range(height)]
    R = np.stack([p.rotation().matrix() for p in at])
    t = np.stack([p.translation() for p in at])
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([(u - CAMERA.K[0, 2]) / CAMERA.K[0, 0], (v - CAMERA.K[1, 2]) / CAMERA.K[1, 1], np.ones(u.shape)], 2)
    rays = np.einsum("hij,hwj->hwi", R, rays)
    depth = ((1.0 - t @ NORMAL)[:, None] / (rays @ NORMAL)).astype(np.float32)
    points = t[:, None] + rays * depth[..., None]
    x, y = (points[..., axis].astype(np.float32) * TEXELS + 1024.0 for axis in (0, 1))
    grey = cv2.remap(
        picture, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    return grey, depth


def shaking(time: float) -> gtsam.Pose3:
    """A hand that goes to and fro, 2 Hz at most, around the origin."""
    twist = np.array(
        [
            0.06 * np.sin(9.0 * time), 0.05 * np.sin(11.0 * time + 1.0), 0.04 * np.sin(7.0 * time + 2.0),
            0.06 * np.sin(5.0 * time), 0.05 * np.sin(6.0 * time + 1.0), 0.05 * np.sin(4.0 * time),
        ]
    )  # fmt: skip
    return gtsam.Pose3.Expmap(twist)
