"""Compiles what numba compiles, or loads it from its cache, before the first measurement has to wait for it."""

from __future__ import annotations

import functools
import gc
import sys

import gtsam
import numpy as np
from numba.core.event import Event, Listener, install_listener

from calibslam_backend.association.localisation import localise
from calibslam_backend.association.relocalisation import overlaps_at, scores_at
from calibslam_backend.association.revision import squared_distances
from calibslam_backend.association.tracking import overlap
from calibslam_backend.geometry.box_measurement import BoxMeasurement
from calibslam_backend.geometry.ellipsoid import Ellipsoid
from calibslam_backend.geometry.shape import shapes
from calibslam_backend.geometry.visible_box import ALL_EDGES, box_of_visible_part
from calibslam_backend.graph.box_factor import box_factor, box_tangents
from calibslam_backend.graph.robust import robust_scales
from calibslam_backend.objects.initialisation import InitialisationSettings, initialise


class Announcement(Listener):
    """Says that something is being compiled, when it first is: what comes from the cache is not."""

    def __init__(self) -> None:
        self._said = False

    def on_start(self, event: Event) -> None:
        if not self._said:
            print("compiling, only this once: about 30 s ...", file=sys.stderr, flush=True)
        self._said = True

    def on_end(self, event: Event) -> None:
        """Of one function."""


@functools.cache
def load_kernels() -> None:
    """Call each compiled function once, with the argument types it will have; 0.7 s, or 30 s the first time."""
    with install_listener("numba:compile", Announcement()):
        _call_each()
    # What is loaded by now stays: a full collection that looks at all of it would hold up an update by 0.1 s.
    gc.collect()
    gc.freeze()


def _call_each() -> None:
    K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
    bounds = np.array([0.0, 0.0, 640.0, 480.0])
    vector = Ellipsoid(gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 2.0])).matrix(), np.full(3, 0.2)).vector()
    poses = [gtsam.Pose3(gtsam.Rot3(), np.array([0.1 * k, 0.0, 0.0])) for k in range(4)]
    boxes = []
    for pose in poses:
        _, corners, _ = box_of_visible_part(pose.matrix(), vector, K, bounds, ALL_EDGES)
        box_of_visible_part(np.ascontiguousarray(pose.matrix()), vector, K, bounds, ALL_EDGES)  # rows, not columns
        boxes.append(BoxMeasurement(corners, np.eye(4), bounds, ~ALL_EDGES))
    values = gtsam.Values()
    values.insert(0, poses[0])
    values.insert(1, vector)
    box_factor(0, 1, boxes[0], K, 1.0).linearize(values)
    box_tangents([(0, 1)], np.eye(4)[None], vector[None], boxes[:1], K, 1.0)
    initialise(np.stack([pose.matrix() for pose in poses]), boxes, K, 1.0, InitialisationSettings())
    everything = np.ones((1, 1), np.bool_)
    surfaces = shapes(vector[None])
    overlap(bounds[None], bounds[None])
    view = vector[None, :3].copy(), surfaces, K, bounds[2:].copy(), bounds[None].copy(), everything
    overlaps_at(np.eye(4), *view)
    scores_at(np.eye(4)[None], *view)
    robust_scales(1.0, 1.0)
    squared_distances(
        np.eye(4), vector[None], surfaces, K, bounds[2:].copy(), bounds[None].copy(), np.eye(4)[None],
        bounds[None].copy(), ~ALL_EDGES[None], 0.1
    )  # fmt: skip
    localise(poses[0].matrix(), np.eye(6), [values.atVector(1)], boxes[:1], K, 1.0, 1.0)
