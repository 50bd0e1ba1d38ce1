"""A hand-held camera walked around the desk: smooth, closed, looking at the desk.

Speeds at `pace` 1 are those of TUM fr3_office (0.25 m/s, 14 deg/s on average), at 2 about those of fr1_desk
(0.45 m/s, 35 deg/s).
"""

from __future__ import annotations

import numpy as np

from calibslam_msgs_py.measurements import SECOND, Array
from calibslam_sim.simulation.random_streams import stream

START = 1_000_000_000_000  # [ns] far from 0, which many tools take for "no time"
LAP = 50.0  # [s] once around the desk at pace 1
ORBIT = np.array([1.9, 1.6])  # [m] half axes of the walk around the table
EYE_HEIGHT = 1.45  # [m]
LOOK_AT_HEIGHT = 0.8  # [m]

# The wandering of each quantity: its amplitude at these frequencies, from a slow drift to a hand's tremor.
FREQUENCIES = np.array([0.045, 0.11, 0.27, 1.1, 2.3])  # [Hz]
WANDERING = {
    "distance": np.array([0.10, 0.06, 0.03, 0.002, 0.0]),  # share of the orbit
    "height": np.array([0.10, 0.06, 0.03, 0.006, 0.001]),  # [m]
    "look_x": np.array([0.45, 0.25, 0.14, 0.006, 0.002]),  # [m]
    "look_y": np.array([0.35, 0.25, 0.14, 0.006, 0.002]),  # [m]
    "look_z": np.array([0.10, 0.10, 0.06, 0.006, 0.002]),  # [m]
    "roll": np.array([0.03, 0.03, 0.02, 0.004, 0.001]),  # [rad]
}


def stamps(duration: float, frame_rate: float) -> np.ndarray:
    """Times (F,) [ns] of the images of a recording of `duration` [s], its end included."""
    frames = round(duration * frame_rate) + 1
    return START + np.round(np.arange(frames) * (SECOND / frame_rate)).astype(np.int64)


def camera_path(times: np.ndarray, pace: float, seed: int) -> Array:
    """Poses T_world_camera (F, 4, 4) of the optical frame at these times [ns]."""
    rng = stream(seed, "camera path")
    t = (times - START) / SECOND * pace
    wander = {name: _wander(t, amplitudes, rng) for name, amplitudes in WANDERING.items()}
    angle = 2.0 * np.pi * t / LAP + rng.uniform(-np.pi, np.pi)
    eye = np.column_stack(
        [
            ORBIT[0] * (1.0 + wander["distance"]) * np.cos(angle),
            ORBIT[1] * (1.0 + wander["distance"]) * np.sin(angle),
            EYE_HEIGHT + wander["height"],
        ]
    )
    target = np.column_stack([wander["look_x"], wander["look_y"], LOOK_AT_HEIGHT + wander["look_z"]])
    return look_at(eye, target, wander["roll"])


def look_at(eye: Array, target: Array, roll: Array) -> Array:
    """Poses T_world_camera (F, 4, 4): at `eye` (F, 3) [m], optical axis towards `target` (F, 3) [m],
    turned about it by `roll` (F,) [rad] from upright."""
    forward = target - eye
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(forward, right)
    cos, sin = np.cos(roll)[:, None], np.sin(roll)[:, None]
    T = np.zeros((len(eye), 4, 4))
    T[:, :3, 0] = cos * right + sin * down
    T[:, :3, 1] = cos * down - sin * right
    T[:, :3, 2] = forward
    T[:, :3, 3] = eye
    T[:, 3, 3] = 1.0
    return T


def _wander(t: Array, amplitudes: Array, rng: np.random.Generator) -> Array:
    """A sum of slow and fast waves (F,) of random phases, of slightly varied frequencies: no lap repeats."""
    frequencies = FREQUENCIES * rng.uniform(0.8, 1.2, len(FREQUENCIES))
    phases = rng.uniform(0.0, 2.0 * np.pi, len(FREQUENCIES))
    return np.sin(2.0 * np.pi * np.outer(t, frequencies) + phases) @ amplitudes
