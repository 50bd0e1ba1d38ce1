"""The factor graph of camera poses and quadrics, solved incrementally by ISAM2 (document, eq. 2.3.5 and 4.3.3).

Keys: x(k) pose of keyframe k; q(j) quadric j, a vector of centre and logarithmic shape (see `ellipsoid`); d(0) the
drift of odometry (see `odometry_factor`), where its covariance is unknown.

A graph never stays broken. A quadric that runs away is taken out, an update that fails is repaired by building
the tree anew without the quadric at fault, and both are reported.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass

import gtsam
import numpy as np

from calibslam_backend.geometry.box_measurement import BoxMeasurement
from calibslam_backend.graph.box_correlation import LAGS, BoxCorrelation
from calibslam_backend.graph.box_factor import box_factor, box_tangents, pose_information
from calibslam_backend.graph.found_factor import found_factor
from calibslam_backend.graph.keys import D, poses_of, q, x
from calibslam_backend.graph.known import Known, MapPrior, conditional_factor
from calibslam_backend.graph.measured import Landmark, Motion
from calibslam_backend.graph.odometry_factor import DRIFT, motion_factor
from calibslam_backend.graph.plausible import is_object, leapt
from calibslam_backend.graph.prior import PriorSettings
from calibslam_backend.graph.relinearisation import Relinearisation, RelinearisationSettings
from calibslam_backend.graph.smoother import Smoother
from calibslam_backend.odometry.motion_chain import dead_reckoning
from calibslam_backend.odometry.motion_noise import MotionNoise
from calibslam_msgs_py.measurements import Array
from calibslam_msgs_py.settings import setting

log = logging.getLogger(__name__)


# The first keyframe is the origin of the map, whose axes are those of REP 103: x forward, y left, z up, while a
# camera's are z forward, x right, y down.
T_MAP_FIRST_CAMERA = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


@dataclass(frozen=True)
class GraphSettings(RelinearisationSettings):
    robust_scale: float = setting(2.0, "Mahalanobis distance beyond which a box is doubted", low=0.1, high=1e6)
    box_correlation: bool = setting(
        True, "whether boxes count less where the errors of an object's boxes in consecutive keyframes are alike"
    )
    robust_odometry: float = setting(3.5, "Mahalanobis distance beyond which a motion is doubted", low=0.1, high=1e6)
    prior_sigma: float = setting(
        0.001, "of the first pose, which is the origin of the map: standard deviation", unit="rad and m", low=1e-6
    )


@dataclass(frozen=True)
class UpdateReport:
    """What an update did: quadrics that ran away and are taken out with the next, and why the tree was built anew."""

    removed: list[int]
    repaired: str = ""


class ObjectGraph:
    """Poses x(0..n-1) in order, quadrics by id."""

    REPAIR_ITERATIONS = 15
    NEW_POSES = 5  # that are relinearised at once
    IN_SIGHT = 10  # keyframes for which a quadric that was seen counts as one that will be seen again soon
    FAR = 0.05  # [rad, m] that a pose may be from the base of its coordinates
    AT_ONCE = 30  # quadrics whose covariances are computed together: one by one and all at once take longer
    FOUND_SIGMA = 0.5  # [rad, m] of a pose found in a known map: its boxes say it better

    def __init__(self, K: Array, settings: GraphSettings, priors: PriorSettings, noise: MotionNoise) -> None:
        self._K = np.ascontiguousarray(K, float)
        self._settings = settings
        self._prior = priors.prior_covariance()
        self._drift_covariance = noise.drift_covariance()
        self._drifts = False
        self._has_origin = False
        self._motions: list[Motion] = []
        self.landmarks: dict[int, Landmark] = {}
        self.correlation = BoxCorrelation(settings.box_correlation)
        self._origin, self._origin_sigma = T_MAP_FIRST_CAMERA, settings.prior_sigma
        thresholds = {"x": (6, self.FAR), "q": (9, np.inf), "d": (DRIFT, np.inf)}
        self.frame = np.zeros((6, 6))  # covariance of a motion of the whole map, see `MapPrior`
        self._beside: int | None = None  # of which known quadric the first pose was found
        self._smoother = Smoother(thresholds, self._linearise_boxes)
        self._relinearisation = Relinearisation(settings)
        self._extracted = self._smoother.values, np.zeros((0, 4, 4))  # an estimate and its poses

    # -- what is in it ------------------------------------------------------------------------------------------

    @property
    def size(self) -> int:
        """Number of poses, those still to be updated included."""
        return len(self._motions) + (1 if self._has_origin else 0)

    def pose(self, k: int) -> Array:
        """(4, 4) T_map_camera of keyframe k."""
        return self._poses(self._smoother.values)[k].copy()

    def poses(self) -> Array:
        """(N, 4, 4) of all keyframes."""
        return self._poses(self._smoother.values).copy()

    def _poses(self, values: gtsam.Values) -> Array:
        """(N, 4, 4) of all poses in their order, extracted once from each estimate."""
        known, poses = self._extracted
        if known is not values or len(poses) != self.size:
            poses = poses_of(values)
            self._extracted = values, poses
        return poses

    def odometry(self) -> tuple[Array, Array]:
        """What odometry alone says: poses (N, 4, 4) and their covariances (N, 6, 6), from the same origin."""
        steps = [(motion.measured, motion.covariance) for motion in self._motions]
        return dead_reckoning(self._origin, np.eye(6) * self._origin_sigma**2, steps)

    def drift(self) -> Array:
        """(6,) velocity [rad/s, m/s] that odometry misses; zero while nothing is known of it."""
        return np.asarray(self._smoother.values.atVector(D)) if self._drifts else np.zeros(DRIFT)

    def predict(self, motion: Motion) -> Array:
        """(4, 4) T_map_camera after a motion from the newest pose."""
        correction = gtsam.Pose3.Expmap(motion.drifts * self.drift())
        return np.asarray(self.pose(self.size - 1) @ motion.T @ correction.matrix())

    def quadric(self, j: int) -> Array:
        """(9,) centre and logarithmic shape."""
        return np.asarray(self._smoother.values.atVector(q(j)))

    def quadrics(self) -> tuple[list[int], Array]:
        """Ids of all quadrics, in their order, and (M, 9) vectors."""
        return self._quadrics(self._smoother.values)

    def _quadrics(self, values: gtsam.Values) -> tuple[list[int], Array]:
        ids = sorted(self.landmarks)
        rows = np.reshape(gtsam.utilities.extractVectors(values, "q"), (-1, 9))
        if len(rows) != len(ids):
            raise RuntimeError(f"{len(rows)} quadrics in the tree, {len(ids)} in the graph")
        return ids, np.ascontiguousarray(rows)  # GTSAM's are by columns

    def is_solved(self, j: int) -> bool:
        """Whether a quadric has gone through an update, and so has covariances."""
        return self._smoother.is_solved(q(j))

    def solved(self) -> list[int]:
        """The quadrics that have covariances."""
        return [j for j in self.landmarks if self.is_solved(j)]

    # -- how sure it is, by the tree alone: for gates; what is published of it: see `published` ---------------------

    def pose_covariance(self, k: int) -> Array:
        """(6, 6) [rotation, translation] of keyframe k in its body."""
        return self._smoother.marginal(x(k))

    def joint_of_poses(self, first: int, last: int) -> Array:
        """(12, 12) of two keyframes, each in its body."""
        keys = x(first), x(last)
        return _together(self._smoother.joint([*keys]), keys)

    def quadric_covariances(self) -> dict[int, Array]:
        """For each solved quadric (9, 9) of its vector."""
        covariances, solved = {}, self.solved()
        for some in (solved[n : n + self.AT_ONCE] for n in range(0, len(solved), self.AT_ONCE)):
            joint = self._smoother.joint([q(j) for j in some])
            covariances.update({j: joint.at(q(j), q(j)) for j in some})
        return covariances

    def joint_of_quadrics(self, quadrics: list[int]) -> Array:
        """(M, M, 9, 9) of these quadrics, all of which are solved."""
        joint = self._smoother.joint([q(j) for j in quadrics])
        return np.array([[joint.at(q(i), q(j)) for j in quadrics] for i in quadrics])

    def joint_covariances(self, k: int, quadrics: list[int]) -> dict[int, Array]:
        """For each of these quadrics (15, 15) of pose k and the quadric: columns of `box_of_visible_part`."""
        if not quadrics:
            return {}
        joint = self._smoother.joint([x(k), *map(q, quadrics)])
        return {j: _together(joint, (x(k), q(j))) for j in quadrics}

    def distance(self, k: int, T_map_camera: Array) -> float:
        """Mahalanobis distance of keyframe k from where it is estimated to be, if it were at this pose (4, 4)."""
        difference = gtsam.Pose3(self.pose(k)).localCoordinates(gtsam.Pose3(T_map_camera))
        return float(np.sqrt(difference @ np.linalg.solve(self.pose_covariance(k), difference)))

    # -- changes, which take effect with the next update --------------------------------------------------------

    def add_origin(self, found: Array | None = None) -> None:
        """The first pose: the origin of the map, or (4, 4) T_map_camera as found in a known map."""
        self._has_origin = True
        if found is not None:
            self._origin, self._origin_sigma = found, self.FOUND_SIGMA
        origin, sigma = gtsam.Pose3(self._origin), self._origin_sigma
        self._smoother.insert(x(0), origin)
        self._relinearisation.add_pose(self._origin)
        if found is None:
            noise = gtsam.noiseModel.Isotropic.Sigma(6, sigma)
            self._smoother.add("origin", gtsam.PriorFactorPose3(x(0), origin, noise))
            self._take_frame_back()
        else:
            noise = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
            self._smoother.add("origin", gtsam.PoseRotationPrior3D(x(0), origin, noise))
            self._find_beside()

    def _take_frame_back(self) -> None:
        """A camera at the map's origin does tell a motion of the whole map: it is an error of the quadrics again."""
        known = {j: landmark.prior for j, landmark in self.landmarks.items()}
        for j, prior in MapPrior(self.frame, known).with_frame().items():
            self.landmarks[j].prior = prior
        if self.frame.any():
            for j in known:
                self._renew_prior(j)
        self.frame = np.zeros((6, 6))

    def _find_beside(self) -> None:
        """The first pose is where it was found, seen from the nearest quadric that there was."""
        known = {j: each.prior for j, each in self.landmarks.items() if each.born == 0}
        place, sigma = self._origin[:3, 3], self._origin_sigma
        if known:
            j = self._beside = min(known, key=lambda j: float(np.linalg.norm(known[j].vector[:3] - place)))
            self._smoother.add("beside", found_factor(x(0), q(j), self._origin, known[j], sigma))
        else:
            self._beside, noise = None, gtsam.noiseModel.Isotropic.Sigma(3, sigma)
            self._smoother.add("beside", gtsam.PoseTranslationPrior3D(x(0), gtsam.Pose3(self._origin), noise))

    def add_pose(self, motion: Motion, guess: Array) -> int:
        """The next pose, after a motion from the last one; returns its number.

        The optimisation starts from `guess` (4, 4), its pose in the map.
        """
        k = self.size
        factor = motion_factor(
            x(k - 1), x(k), D, motion.T, motion.covariance, motion.drifts, self._settings.robust_odometry
        )
        self._motions.append(motion)
        if motion.drifts and not self._drifts:
            self._drifts = True
            noise = gtsam.noiseModel.Gaussian.Covariance(self._drift_covariance)
            self._smoother.insert(D, np.zeros(DRIFT))
            self._smoother.add("drift", gtsam.PriorFactorVector(D, np.zeros(DRIFT), noise))
        self._smoother.insert(x(k), gtsam.Pose3(guess))
        self._relinearisation.add_pose(guess)
        self._smoother.add(("motion", k), factor)
        if k > self.NEW_POSES:
            self._learn_motion(k - self.NEW_POSES)
        return k

    def add_quadric(self, j: int, vector: Array) -> None:
        """A new quadric, first seen as this vector (9,)."""
        self.add_known_quadric(j, Known(vector, self._prior))

    def add_known_quadric(self, j: int, known: Known) -> None:
        """A quadric that is known; the one that it depends on must be there.

        Raises:
            ValueError: see `conditional`; nothing is changed.
        """
        factor = self._prior_factor(j, known)
        self.landmarks[j] = Landmark(self.size, known)
        self._smoother.insert(q(j), known.vector)
        self._smoother.add(("prior", j), factor)

    def _renew_prior(self, j: int) -> None:
        self._smoother.remove(("prior", j))
        self._smoother.add(("prior", j), self._prior_factor(j, self.landmarks[j].prior))

    def _prior_factor(self, j: int, known: Known) -> gtsam.NonlinearFactor:
        if known.parent is not None:
            return conditional_factor(q(j), known, q(known.parent), self.landmarks[known.parent].prior)
        noise = gtsam.noiseModel.Gaussian.Covariance(known.covariance)
        return gtsam.PriorFactorVector(q(j), known.vector, noise)

    def add_box(self, k: int, j: int, box: BoxMeasurement) -> None:
        """A box of quadric j in keyframe k, which must be its only one there."""
        factor = box_factor(x(k), q(j), box, self._K, self._settings.robust_scale, self.correlation)
        self._smoother.add(("box", k, j), factor)
        self.landmarks[j].boxes[k] = box
        self.landmarks[j].linearised[k] = self.quadric(j), self.correlation.worth

    def remove_box(self, k: int, j: int) -> None:
        """The box of quadric j in keyframe k is of something else."""
        known = self.landmarks[j]
        del known.boxes[k], known.linearised[k]
        known.residuals.pop(k, None)
        self._smoother.remove(("box", k, j))

    def remove_quadric(self, j: int) -> None:
        """Take a quadric out, with all that was measured of it; what depends on it is then known by itself."""
        for k in self.landmarks.pop(j).boxes:
            self._smoother.remove(("box", k, j))
        self._smoother.remove(("prior", j))
        for child, landmark in self.landmarks.items():
            if landmark.prior.parent == j:
                landmark.prior = Known(landmark.prior.vector, landmark.prior.covariance)
                self._renew_prior(child)
        if self._beside == j:
            self._smoother.remove("beside")
            self._find_beside()
        self._smoother.forget(q(j))

    # -- solving ------------------------------------------------------------------------------------------------

    def update(self, turn: range = range(0)) -> UpdateReport:
        """One step of ISAM2 with what is new; the keyframes of `turn` may be relinearised with it."""
        self._relinearise(range(max(self.size - self.NEW_POSES, 0), self.size))
        held = [x(k) for k in range(self.size - self.NEW_POSES) if k not in turn]
        return self._step(lambda: self._smoother.update(self._last(), held))

    def settle(self) -> UpdateReport | None:
        """Relinearise those of the earlier keyframes whose turn it is; None if nothing has moved there."""
        turn = self._relinearisation.turn(self.size - self.NEW_POSES)
        return self.update(turn) if self._relinearise(turn) else None

    def iterate(self) -> UpdateReport:
        """One step of Gauss-Newton with everything linearised anew."""
        return self._step(lambda: self._rebuild(self._smoother.values))

    def _step(self, solve: Callable[[], None]) -> UpdateReport:
        """Solve; what goes wrong is repaired and reported."""
        before = self._smoother.values
        poses = self._poses(before)
        reason = ""
        try:
            solve()
            if leapt(poses, self._poses(self._smoother.values)):
                reason = "the trajectory jumped"
        except RuntimeError as error:
            reason = _first_sentence(error)
        if reason:
            log.warning("%s; optimising the whole graph from the estimate before", reason)
            self._repair(before)
        ids, vectors = self.quadrics()
        plausible = is_object(vectors, self._seen_from(ids))
        removed = [j for j, fine in zip(ids, plausible, strict=True) if not fine]
        for j in removed:
            log.warning("quadric %d ran away and is taken out", j)
            self.remove_quadric(j)
        return UpdateReport(removed, reason)

    def _seen_from(self, quadrics: list[int]) -> Array:
        """(M, 3) where a camera was that saw each of these quadrics [m]; NaN where none has."""
        places = np.vstack([self._poses(self._smoother.values)[:, :3, 3], np.full(3, np.nan)])
        return places[[next(reversed(self.landmarks[j].boxes), -1) for j in quadrics]]

    def optimise(self) -> None:
        """The batch optimum by Levenberg-Marquardt, from which the tree is built anew."""
        self._rebuild(self._smoother.optimise(self._smoother.values))

    def _rebuild(self, values: gtsam.Values) -> None:
        """The tree anew, all of it linearised at these values."""
        poses, quadrics, worth = self._poses(values), self._quadrics(values), self.correlation.worth
        self._smoother.rebuild(values, self._last())
        # There, and not where the solution is.
        self._relinearisation.all_done(poses, quadrics, self.landmarks, worth)

    def _linearise_boxes(self, names: Iterable[Hashable], values: gtsam.Values) -> dict[Hashable, gtsam.JacobianFactor]:
        """The tangents of those of these factors that are boxes."""
        ids, vectors = self._quadrics(values)
        rows = {j: row for row, j in enumerate(ids)}
        boxes = [name for name in names if isinstance(name, tuple) and name[0] == "box"]
        tangents, residuals = box_tangents(
            [(x(k), q(j)) for _, k, j in boxes],
            self._poses(values)[[k for _, k, _ in boxes]],
            vectors[[rows[j] for _, _, j in boxes]],
            [self.landmarks[j].boxes[k] for _, k, j in boxes],
            self._K,
            self._settings.robust_scale,
            self.correlation.worth,
        )
        self._learn_correlation(boxes, residuals)
        return dict(zip(boxes, tangents, strict=True))

    def _learn_correlation(self, boxes: list[tuple[str, int, int]], residuals: Array) -> None:
        """From the residuals (N, 4) of these boxes and of those of the same quadrics in keyframes before."""
        for (_, k, j), residual in zip(boxes, residuals, strict=True):
            self.landmarks[j].residuals[k] = residual.copy()  # a view would keep those of all alive
        for lag in LAGS:
            rows = [n for n, (_, k, j) in enumerate(boxes) if k - lag in self.landmarks[j].residuals]
            if rows:
                before = np.stack([self.landmarks[j].residuals[k - lag] for _, k, j in (boxes[n] for n in rows)])
                self.correlation.learn(before, residuals[rows], lag)

    def _learn_motion(self, k: int) -> None:
        """What boxes and odometry say of the motion to keyframe k, which is old enough for its boxes to be known."""
        seen = [j for j, known in self.landmarks.items() if k in known.boxes]
        information = pose_information(
            self.pose(k), [self.quadric(j) for j in seen], [self.landmarks[j].boxes[k] for j in seen], self._K
        )
        self.correlation.learn_motion(information, self._motions[k - 1].covariance)

    def _last(self) -> list[int]:
        """Quadrics in sight, the newest pose and the drift are eliminated last: the next update will touch them again.

        All quadrics would make the root of the tree grow with the map, and with it the cost of every update.
        """
        drift = [D] if self._drifts else []
        recent = range(max(self.size - self.IN_SIGHT, 0), self.size)
        in_sight = [j for j, known in self.landmarks.items() if any(k in known.boxes for k in recent)]
        return [*map(q, in_sight), x(self.size - 1), *drift]

    def _relinearise(self, turn: range) -> int:
        """Linearise anew what has moved of these keyframes' factors and of young quadrics' boxes; returns how many."""
        poses = self._poses(self._smoother.values)
        names = self._relinearisation.due(turn, poses, self.quadrics(), self.landmarks, self.correlation.worth)
        for name in names:
            self._smoother.renew(name)
        return len(names)

    def _repair(self, before: gtsam.Values) -> None:
        """Optimise the whole graph with damping from an estimate that was good, and build the tree anew.

        If even that fails, quadrics are given up, the youngest first.
        """
        before = gtsam.Values(before)
        while True:
            try:
                values = self._smoother.optimise(before, self.REPAIR_ITERATIONS)
                self._rebuild(values)
                return
            except RuntimeError as error:
                if not self.landmarks:
                    raise
                youngest = max(self.landmarks, key=lambda j: self.landmarks[j].born)
                log.warning("%s; giving up quadric %d", _first_sentence(error), youngest)
                self.remove_quadric(youngest)
                before.erase(q(youngest))


def _together(joint: gtsam.JointMarginal, keys: tuple[int, ...]) -> Array:
    """The covariance of some variables, in this order."""
    return np.block([[joint.at(a, b) for b in keys] for a in keys])


def _first_sentence(error: RuntimeError) -> str:
    """GTSAM's messages are pages long."""
    return " ".join(str(error).split("Thrown when")[0].split())
