"""What boxes of a recording should have been, without labels: reprojected quadrics that were fitted with true poses.

Boxes are linked into tracks; the quadric of a long track is fitted with the poses of the ground truth, and takes in
every other track whose boxes lie where it is seen. It is then fitted anew to all its boxes, robustly, and its visible
part in each image is the reference of the box measured there. A reference is as good as the ellipsoid is a model of
the object: what is left of that in the residuals is an error that the back end sees as well.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibslam_backend.association.matching import median_overlap, predicted_corners
from calibslam_backend.association.tracking import Tracker, TrackingSettings, unique
from calibslam_backend.geometry.box_measurement import BoxMeasurement, prepare
from calibslam_backend.objects.initialisation import InitialisationSettings, initialise
from calibslam_backend.output.metrics import Trajectory, interpolated
from calibslam_backend.recording import Recording
from calibslam_msgs_py.bags import BagError
from calibslam_msgs_py.measurements import Array, Boxes, Camera
from calibslam_msgs_py.settings import setting

NONE = -1  # object of a box that belongs to none


@dataclass(frozen=True)
class ReferenceSettings(InitialisationSettings, TrackingSettings):
    """How quadrics are fitted; the weight of a box in that fit is stated, since it is what is sought."""

    min_boxes: int = setting(20, "boxes an object needs", low=3)
    max_boxes: int = setting(200, "boxes of an object that are looked at", low=3)
    stated_floor: float = setting(2.0, "standard deviation of an edge of a tiny box", unit="px", low=0.1)
    stated_share: float = setting(0.04, "standard deviation of an edge as a share of the box's extent", low=0.0)
    robust_scale: float = setting(2.0, "Mahalanobis distance beyond which a box is doubted", low=0.1)
    same_object: float = setting(
        0.5, "median intersection over union of a track's boxes and those of its object", low=0.0, high=1.0
    )

    def stated_variances(self, corners: Array) -> Array:
        """(N, 4) of the edges of boxes (N, 4) [px^2]."""
        extents = np.tile(corners[:, 2:] - corners[:, :2], 2)
        return np.asarray(self.stated_floor**2 + (self.stated_share * extents) ** 2)


@dataclass(frozen=True)
class Referenced:
    """The boxes of one image that can be compared with a reference.

    Attributes:
        boxes: all of the image, also those without reference.
        errors: (N, 4) measured minus reference [px], undistorted; NaN for an edge that has no reference, since the
            box belongs to no object or the edge may belong to the border of the image.
        objects: (N,) number of the object, NONE where unknown.
    """

    boxes: Boxes
    errors: Array
    objects: Array


@dataclass(frozen=True)
class _Sight:
    """A box of a track: the index of its image and its index there."""

    image: int
    box: int


def of_recording(path: str | Path) -> list[Referenced]:
    """The images of a bag with boxes, camera, odometry and ground truth; installed as `calibslam.reference_boxes`.

    Raises:
        BagError: it cannot be read, or misses something; the text says what.
    """
    recording = Recording.open(path)
    truth = recording.ground_truth()
    if truth is None:
        raise BagError(f"{path} has no ground truth: the reference boxes need the camera's true poses")
    images = [m for m in recording.measurements() if isinstance(m, Boxes) and len(m)]
    if not images:
        raise BagError(f"{path} has no boxes")
    return reference(images, recording.camera, truth, ReferenceSettings())


def reference(
    images: Sequence[Boxes], camera: Camera, truth: Trajectory, settings: ReferenceSettings
) -> list[Referenced]:
    """The images whose poses are known, in order of time.

    Raises:
        BagError: no image has a pose, or a box array is of another camera.
    """
    images = sorted(images, key=lambda image: image.stamp)
    for image in images:
        if (image.width, image.height) != (camera.width, camera.height):
            raise BagError(
                f"boxes of a {image.width}x{image.height} image, but the camera's is {camera.width}x{camera.height}"
            )
    covered, poses = interpolated(truth, np.array([image.stamp for image in images]))
    images = [image for image, known in zip(images, covered, strict=True) if known]
    if not images:
        raise BagError("no image lies within the time of the ground truth: do their clocks agree?")
    return _Fit(images, poses, camera, settings).result()


class _Fit:
    """The work on one recording."""

    def __init__(self, images: list[Boxes], poses: Array, camera: Camera, settings: ReferenceSettings) -> None:
        self._images, self._poses, self._K, self._settings = images, poses, camera.K, settings
        self._measured: list[list[BoxMeasurement]] = []
        for image in images:
            variances = settings.stated_variances(image.corners)
            self._measured.append(prepare(image, np.eye(4) * variances[:, None, :], camera))

    def result(self) -> list[Referenced]:
        errors = [np.full((len(image), 4), np.nan) for image in self._images]
        objects = [np.full(len(image), NONE) for image in self._images]
        for number, (quadric, sights) in enumerate(self._objects()):
            for sight in sights:
                box = self._measured[sight.image][sight.box]
                predicted = self._predicted(quadric, sight)
                if predicted is None:
                    continue
                objects[sight.image][sight.box] = number
                errors[sight.image][sight.box] = np.where(box.clip, np.nan, box.corners - predicted)
        return [Referenced(*each) for each in zip(self._images, errors, objects, strict=True)]

    def _tracks(self) -> list[list[_Sight]]:
        """Tracks, the longest first."""
        tracker = Tracker(self._settings, self._K)
        tracks: dict[int, list[_Sight]] = defaultdict(list)
        before = self._poses[0]
        for k, image in enumerate(self._images):
            kept = unique(image.corners, image.scores, self._settings.duplicate_overlap)
            corners = np.reshape([self._measured[k][i].corners for i in kept], (-1, 4))
            turned = self._poses[k][:3, :3].T @ before[:3, :3]
            linked = tracker.update(image.stamp, corners, tuple(image.class_ids[i] for i in kept), turned)
            before = self._poses[k]
            for track, i in zip(linked, kept, strict=True):
                tracks[track.id].append(_Sight(k, int(i)))
        return sorted(tracks.values(), key=len, reverse=True)

    def _objects(self) -> Iterator[tuple[Array, list[_Sight]]]:
        """Quadrics (9,) and their boxes."""
        open_tracks = self._tracks()
        while open_tracks and len(open_tracks[0]) >= self._settings.min_boxes:
            first, *open_tracks = open_tracks
            quadric = self._fitted(first)
            if quadric is None:
                continue
            own = [track for track in open_tracks if self._agreement(quadric, track) >= self._settings.same_object]
            sights = sorted([*first, *(s for track in own for s in track)], key=lambda sight: sight.image)
            refined = self._fitted(sights)
            if refined is None:
                continue
            open_tracks = [track for track in open_tracks if track not in own]
            yield refined, sights

    def _fitted(self, sights: list[_Sight]) -> Array | None:
        found = initialise(*self._seen(sights), self._K, self._settings.robust_scale, self._settings)
        return None if found is None else found.vector

    def _predicted(self, quadric: Array, sight: _Sight) -> Array | None:
        """(4,) box of the quadric where the measured one is; None if it is not in front of the camera."""
        box = self._measured[sight.image][sight.box]
        pose = np.ascontiguousarray(self._poses[sight.image])
        return predicted_corners(pose, quadric, self._K, box)

    def _agreement(self, quadric: Array, track: list[_Sight]) -> float:
        """Median intersection over union of the boxes of a track with those of a quadric."""
        return median_overlap(*self._seen(track), quadric, self._K)

    def _seen(self, sights: list[_Sight]) -> tuple[Array, list[BoxMeasurement]]:
        """Poses (N, 4, 4) and boxes."""
        return self._poses[[s.image for s in sights]], [self._measured[s.image][s.box] for s in sights]
