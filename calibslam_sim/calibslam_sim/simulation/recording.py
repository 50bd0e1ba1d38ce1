"""A recording of the simulated desk: what was measured, and the truth behind it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibslam_msgs_py.measurements import Array, Boxes, Camera, RelativeMotion
from calibslam_msgs_py.settings import Settings, setting
from calibslam_sim.simulation.camera_path import camera_path, stamps
from calibslam_sim.simulation.detections import Detector
from calibslam_sim.simulation.odometry_noise import OdometryNoise
from calibslam_sim.simulation.random_streams import stream
from calibslam_sim.simulation.world import WorldObject, desk_world

# An undistorted camera like that of TUM fr3.
CAMERA = Camera(
    width=640,
    height=480,
    K=np.array([[535.0, 0.0, 320.0], [0.0, 535.0, 240.0], [0.0, 0.0, 1.0]]),
    distortion=np.zeros(5),
)


@dataclass(frozen=True)
class SimulationSettings(Settings):
    """What is simulated."""

    seed: int = setting(0, "the same seed gives the same recording, bit for bit", low=0)
    duration: float = setting(60.0, "length of the recording", unit="s", low=0.1)
    frame_rate: float = setting(30.0, "images per second", unit="Hz", low=1.0)
    pace: float = setting(1.0, "speed of the camera; 1: as TUM fr3_office, 2: as fr1_desk", low=0.01)
    odometry_rotation: float = setting(
        0.004, "standard deviation of the odometry's error per image, about each axis", unit="rad", low=1e-6
    )
    odometry_translation: float = setting(
        0.006, "standard deviation of the odometry's error per image, along each axis", unit="m", low=1e-6
    )
    error_memory: float = setting(
        0.0,
        "time in which the errors of an object's boxes become unlike by a factor of e; 0: independent",
        unit="s",
        low=0.0,
    )
    odometry_outliers: float = setting(
        0.0, "share of odometry steps that fail, with ten times the stated error", low=0.0, high=1.0
    )
    outliers: float = setting(
        0.0, "share of boxes with a gross error: size, place, class or identity", low=0.0, high=1.0
    )


# What differs from the defaults.
SCENARIOS: dict[str, dict[str, float]] = {
    "desk": {},
    "desk_fast": {"pace": 2.0, "odometry_outliers": 0.01},
    "desk_outliers": {"outliers": 0.05},
}


@dataclass(frozen=True)
class Simulation:
    """A simulated recording of F images.

    Attributes:
        camera: the camera.
        world: the objects.
        times: (F,) stamps of the images [ns].
        T_world_camera: (F, 4, 4) true poses.
        odometry: F - 1 measured motions between neighbouring images.
        boxes: F images' boxes.
    """

    camera: Camera
    world: tuple[WorldObject, ...]
    times: np.ndarray
    T_world_camera: Array
    odometry: list[RelativeMotion]
    boxes: list[Boxes]


def simulate(settings: SimulationSettings) -> Simulation:
    """The recording that these settings describe."""
    world = desk_world(settings.seed)
    times = stamps(settings.duration, settings.frame_rate)
    T_world_camera = camera_path(times, settings.pace, settings.seed)
    noise = OdometryNoise(
        settings.odometry_rotation, settings.odometry_translation, gross_share=settings.odometry_outliers
    )
    detector = Detector(gross_share=settings.outliers, error_memory=settings.error_memory)
    return Simulation(
        camera=CAMERA,
        world=world,
        times=times,
        T_world_camera=T_world_camera,
        odometry=measure_motions(times, T_world_camera, noise, settings.seed, CAMERA.frame_id),
        boxes=detector.detect(CAMERA, world, times, T_world_camera, settings.seed),
    )


def measure_motions(
    times: np.ndarray, T_world_camera: Array, noise: OdometryNoise, seed: int, frame_id: str
) -> list[RelativeMotion]:
    """The motions between neighbouring poses (F, 4, 4) as a noisy odometry measures them."""
    rng = stream(seed, "odometry noise")
    motions = []
    for k in range(1, len(times)):
        T_start_end = np.linalg.inv(T_world_camera[k - 1]) @ T_world_camera[k]
        motions.append(
            RelativeMotion(
                int(times[k - 1]), int(times[k]), noise.perturb(T_start_end, rng), noise.covariance, frame_id
            )
        )
    return motions
