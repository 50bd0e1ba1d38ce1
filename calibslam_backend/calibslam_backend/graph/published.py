"""How sure the graph is, as it is published: more than the tree says, which takes the errors of boxes for independent
and knows nothing of what a loaded map errs by as a whole. Gates go by the tree's own covariances (see `ObjectGraph`).
"""

from __future__ import annotations

import logging

import gtsam
import numpy as np

from calibslam_backend.graph.known import Known, MapPrior, moved_with_map, prior_of
from calibslam_backend.graph.object_graph import ObjectGraph
from calibslam_msgs_py.measurements import Array

log = logging.getLogger(__name__)


class PublishedCovariances:
    """Of poses, motions and quadrics of a graph, as it is now."""

    def __init__(self, graph: ObjectGraph) -> None:
        self._graph = graph

    def pose(self, k: int) -> Array:
        """(6, 6) [rotation, translation] of keyframe k in its body."""
        graph = self._graph
        by_frame = gtsam.Pose3(graph.pose(k)).inverse().AdjointMap()
        own = graph.correlation.understated() * graph.pose_covariance(k)
        return np.asarray(own + by_frame @ graph.frame @ by_frame.T)

    def motion(self, first: int, last: int) -> Array:
        """(6, 6) [rotation, translation] of the motion between two keyframes, in the body at the last one.

        What is not known of the whole map takes no part in it.
        """
        graph = self._graph
        undone = gtsam.Pose3(graph.pose(last)).between(gtsam.Pose3(graph.pose(first)))
        A = np.hstack([-undone.AdjointMap(), np.eye(6)])
        own = A @ graph.joint_of_poses(first, last) @ A.T
        return np.asarray(graph.correlation.understated(last - first) * own)

    def quadrics(self) -> dict[int, Array]:
        """For each quadric (9, 9) of its vector; its prior's where no update has been done yet."""
        graph, understated = self._graph, self._graph.correlation.understated()
        covariances = {j: landmark.prior.covariance for j, landmark in graph.landmarks.items()}
        covariances.update({j: understated * own for j, own in graph.quadric_covariances().items()})
        by_frame = {j: moved_with_map(graph.quadric(j)) for j in covariances}
        return {j: covariances[j] + G @ graph.frame @ G.T for j, G in by_frame.items()}

    def known(self) -> MapPrior:
        """What is known of all quadrics, to begin with again. In a large map that takes time: two seconds for 200."""
        graph = self._graph
        solved = graph.solved()
        new = {j: landmark.prior for j, landmark in graph.landmarks.items() if j not in solved}
        if not solved:
            return MapPrior(graph.frame, new)
        blocks = graph.correlation.understated() * graph.joint_of_quadrics(solved)
        vectors = [graph.quadric(j) for j in solved]
        try:
            found = prior_of(solved, vectors, blocks)
        except np.linalg.LinAlgError as error:  # a map that is too sure is better than none to go on with
            log.warning("what the quadrics of the map err by together is not kept: %s", error)
            alone = {j: Known(vectors[n], blocks[n, n]) for n, j in enumerate(solved)}
            found = MapPrior(np.zeros((6, 6)), alone)
        return MapPrior(graph.frame + found.frame, {**found.quadrics, **new})
