"""All settings of the estimator together; each part stands with what it is of."""

from __future__ import annotations

from dataclasses import dataclass

from calibslam_backend.association.matching import AssociationSettings
from calibslam_backend.association.relocalisation import RelocalisationSettings
from calibslam_backend.association.tracking import TrackingSettings
from calibslam_backend.graph.noise import NoiseSettings
from calibslam_backend.graph.object_graph import GraphSettings
from calibslam_backend.objects.initialisation import InitialisationSettings
from calibslam_backend.odometry.motion_noise import MotionNoise
from calibslam_msgs_py.settings import Settings, setting


@dataclass(frozen=True)
class KeyframeSettings(Settings):
    keyframe_rotation: float = setting(0.15, "rotation that makes a keyframe", unit="rad", low=0.0)
    keyframe_translation: float = setting(0.15, "translation that makes a keyframe", unit="m", low=0.0)
    keyframe_interval: float = setting(1.0, "time that makes a keyframe", unit="s", low=0.0)


@dataclass(frozen=True)
class EstimatorSettings(
    NoiseSettings,
    AssociationSettings,
    KeyframeSettings,
    TrackingSettings,
    InitialisationSettings,
    RelocalisationSettings,
    GraphSettings,
    MotionNoise,
):
    """Everything that can be set of the back end."""
