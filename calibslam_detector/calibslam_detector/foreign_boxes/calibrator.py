"""Covariances for the boxes of somebody else's detector.

The default is the simplest honest model: an edge is wrong by a few pixels whatever the box, and by a share of the
box's width or height; edges err independently. Its numbers are assumptions, not fitted to a detector.
`fit_calibrator` fits a model to a detector and writes it to a file (docs/calibrator.md).
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibslam_detector.foreign_boxes.log_linear import LogLinearCalibrator
from calibslam_msgs_py.measurements import Array, Boxes
from calibslam_msgs_py.settings import Settings, SettingsError, from_mapping, setting

FILE_VERSION = 1


class CalibratorError(ValueError):
    """A calibrator file that cannot be used."""


@dataclass(frozen=True)
class PerSizeCalibrator(Settings):
    """Diagonal covariances: sigma^2 = floor^2 + (relative * extent)^2, extent the width for xmin and xmax,
    the height for ymin and ymax.

    Boxes that have a covariance keep it.
    """

    floor: float = setting(2.0, "standard deviation of an edge of a tiny box", unit="px", low=1e-3)
    relative: float = setting(0.04, "standard deviation of an edge as a share of the box's extent", low=0.0)

    def covariances(self, corners: Array) -> Array:
        """Covariances (N, 4, 4) [px^2] of boxes (N, 4) [px]."""
        extents = np.tile(corners[:, 2:] - corners[:, :2], 2)
        return np.asarray(np.eye(4) * (self.floor**2 + (self.relative * extents) ** 2)[:, None, :])

    def __call__(self, boxes: Boxes) -> Boxes:
        known = boxes.has_covariance[:, None, None]
        return replace(boxes, covariances=np.where(known, boxes.covariances, self.covariances(boxes.corners)))


# What a calibrator file may hold: the class by the file's `kind`.
KINDS: dict[str, type[PerSizeCalibrator] | type[LogLinearCalibrator]] = {
    "per_size": PerSizeCalibrator,
    "log_linear": LogLinearCalibrator,
}


def load(path: str | None = None) -> PerSizeCalibrator | LogLinearCalibrator:
    """The calibrator of a file, or the one with default numbers.

    A file is JSON: `{"version": 1, "kind": "per_size", "parameters": {"floor": 2.0, "relative": 0.04}}`;
    parameters left out keep their defaults. `fitted_on`, an object, may say where the numbers come from.

    Raises:
        CalibratorError: naming the file and what is wrong with it.
    """
    if path is None:
        return PerSizeCalibrator()
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise CalibratorError(f"calibrator file {path} cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise CalibratorError(f"calibrator file {path} is not JSON: {error}") from None
    if not isinstance(content, dict) or content.get("version") != FILE_VERSION:
        raise CalibratorError(f'calibrator file {path} does not say "version": {FILE_VERSION}')
    unknown = sorted(set(content) - {"version", "kind", "parameters", "fitted_on"})
    if unknown:
        raise CalibratorError(f"calibrator file {path}: unknown key {', '.join(unknown)}")
    kind = content.get("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        raise CalibratorError(f"calibrator file {path}: unknown kind {kind!r}; known: {', '.join(KINDS)}")
    parameters = content.get("parameters", {})
    if not isinstance(parameters, dict):
        raise CalibratorError(f"calibrator file {path}: parameters must be an object, not {parameters!r}")
    try:
        return from_mapping(KINDS[kind], parameters)
    except SettingsError as error:
        raise CalibratorError(f"calibrator file {path}: {error}") from None
