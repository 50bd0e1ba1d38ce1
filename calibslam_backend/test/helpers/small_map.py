"""A map whose poses are right, with the books of association kept by hand: cups before a camera that moves sideways."""

from __future__ import annotations

from collections import Counter

import numpy as np

from calibslam_backend.association.assignments import Assignments, Frame
from calibslam_backend.association.data_association import DataAssociation
from calibslam_backend.estimator_settings import EstimatorSettings
from calibslam_backend.geometry.box_measurement import prepare
from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.geometry.visible_box import ALL_EDGES, box_of_visible_part, image_bounds
from calibslam_backend.graph.measured import Motion
from calibslam_backend.graph.object_graph import ObjectGraph
from calibslam_backend.kernels import load_kernels
from calibslam_backend.objects.new_quadrics import NewQuadrics
from calibslam_backend.objects.upkeep import Upkeep
from calibslam_msgs_py.measurements import Array, Boxes, Camera

CAMERA = Camera(640, 480, np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]), np.zeros(5))
LEFT, RIGHT = (-0.3, 0.0, 2.0), (0.3, 0.0, 2.0)  # [m] in the first camera
FRAMES = 12


class World:
    """A map whose poses are right, with the books and the upkeep of it."""

    def __init__(self, **settings: str) -> None:
        load_kernels()
        s = EstimatorSettings(**settings)  # type: ignore[arg-type]
        self.graph = ObjectGraph(CAMERA.K, s, s, s)
        self.books = Assignments(self.graph)
        self.counts: Counter[str] = Counter()
        self.upkeep = Upkeep(self.books, CAMERA, s, self.counts)
        self.objects = DataAssociation(self.books, CAMERA, s, self.counts)
        self.new = NewQuadrics(self.books, CAMERA, s, self.objects.bind, self.counts)
        self.graph.add_origin()
        step = np.eye(4)
        step[0, 3] = 0.05
        for _ in range(FRAMES - 1):
            motion = Motion(step, np.eye(6) * 1e-8, 0.0, step)
            self.graph.add_pose(motion, self.graph.predict(motion))

    def cup(self, place: tuple[float, float, float], radius: float = 0.06) -> Array:
        """(9,) a quadric there."""
        T = np.eye(4)
        T[:3, 3] = place
        return Ellipsoid(self.graph.pose(0) @ T, np.full(3, radius)).vector()

    def show(self, *seen: tuple[tuple[float, float, float], int], seen_from: Array | None = None) -> None:
        """The next keyframe shows cups at these places, of these tracks, from where it is, or from this pose (4, 4)."""
        k = len(self.books.frames)
        T = self.graph.pose(k) if seen_from is None else seen_from
        corners = [
            box_of_visible_part(T, self.cup(place), CAMERA.K, image_bounds(640, 480), ALL_EDGES)[1] for place, _ in seen
        ]
        n, tracks = len(seen), [track for _, track in seen]
        boxes = Boxes(k, 640, 480, np.reshape(corners, (n, 4)), np.tile(np.eye(4) * 4.0, (n, 1, 1)),
                      ("cup",) * n, np.ones(n), ("",) * n)  # fmt: skip
        self.books.see(tracks, boxes.class_ids)
        measured = prepare(boxes, boxes.covariances, CAMERA)
        self.books.frames.append(Frame(measured, tracks, boxes.class_ids, boxes.object_ids, [None] * n))
        for row, track in enumerate(tracks):
            self.books.tracks[track].seen.append((k, row))

    def keyframes(self, j: int) -> list[int]:
        return sorted(self.graph.landmarks[j].boxes)
