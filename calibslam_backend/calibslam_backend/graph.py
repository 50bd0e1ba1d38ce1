"""The factor graph of camera poses and quadrics, solved incrementally by ISAM2 (document, eq. 2.3.5 and 4.3.3).

Keys: x(k) pose of keyframe k; q(j) quadric j, a vector of centre and logarithmic shape (see `quadric`); d(0) the
drift of odometry (see `odometry_factor`), where its covariance is unknown.

A graph never stays broken. A quadric that runs away is taken out, an update that fails is repaired by building
the tree anew without the quadric at fault, and both are reported.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

import gtsam
import numpy as np
from gtsam import symbol

from calibslam_backend.box_factor import box_factor
from calibslam_backend.box_measurement import BoxMeasurement
from calibslam_backend.initialisation import InitialisationSettings
from calibslam_backend.odometry import MotionNoise, dead_reckoning
from calibslam_backend.odometry_factor import DRIFT, drifting_motion_factor
from calibslam_backend.quadric import matrix_from_vector
from calibslam_msgs_py.measurements import Array
from calibslam_msgs_py.settings import Settings, setting

log = logging.getLogger(__name__)

_DRIFT = symbol("d", 0)


# The first keyframe is the origin of the map, whose axes are those of REP 103: x forward, y left, z up, while a
# camera's are z forward, x right, y down.
T_MAP_FIRST_CAMERA = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


@dataclass(frozen=True)
class GraphSettings(Settings):
    robust_scale: float = setting(2.0, "Mahalanobis distance from which a box counts as doubtful", low=0.1, high=1e6)
    robust_odometry: float = setting(
        3.0, "Mahalanobis distance from which a motion counts as doubtful", low=0.1, high=1e6
    )
    prior_sigma: float = setting(0.001, "first pose: it is the map's origin", unit="rad and m", low=1e-6)
    relinearise_every: int = setting(3, "keyframes between relinearisations of the whole graph", low=1)
    relinearise_pose: float = setting(0.01, "change of a pose that asks for one", unit="rad and m", low=0.0)
    relinearise_quadric: float = setting(0.03, "change of a quadric that asks for one", unit="m and log m", low=0.0)
    young: int = setting(20, "keyframes during which a quadric is relinearised at once", low=0)


@dataclass(frozen=True)
class Motion:
    """Between consecutive poses: (4, 4) as measured, its covariance (6, 6), and the time [s] during which it drifts."""

    T: Array
    covariance: Array
    drifts: float


@dataclass
class Landmark:
    """What the graph knows of a quadric: its prior (vector and covariance), its boxes by keyframe, its factors."""

    prior: Array
    covariance: Array
    born: int
    boxes: list[tuple[int, BoxMeasurement]] = field(default_factory=list)
    factors: list[int] = field(default_factory=list)


@dataclass(frozen=True)
class UpdateReport:
    """What an update did: quadrics that run away and will be taken out by the next, and why the tree was built anew."""

    removed: list[int]
    repaired: str = ""


class ObjectGraph:
    """Poses x(0..n-1) in order, quadrics by id."""

    # A quadric beyond these is no object any more [m].
    LARGEST_RADIUS, LARGEST_DISTANCE, SMALLEST_RADIUS = 10.0, 200.0, 1e-4
    LARGEST_STEP = 0.5  # [rad, m] of a pose in one update; more is checked by a damped optimisation
    BATCH_ITERATIONS, REPAIR_ITERATIONS = 100, 15
    CONVERGED = 1e-4  # share by which an iteration has to lower the error

    def __init__(
        self, K: Array, settings: GraphSettings, priors: InitialisationSettings, noise: MotionNoise
    ) -> None:
        self._K = np.ascontiguousarray(K, float)
        self._settings = settings
        self._prior = priors.prior_covariance()
        self._drift_sigmas = np.repeat([noise.drift_rotation, noise.drift_translation], 3)
        self._drifts = False
        self._has_origin = False
        self._motions: list[Motion] = []
        self.landmarks: dict[int, Landmark] = {}
        self._origin = gtsam.Pose3(T_MAP_FIRST_CAMERA)
        self._isam = self._new_isam()
        self._begin_change()
        self._values = gtsam.Values()
        self._updates = 0

    # -- what is in it ------------------------------------------------------------------------------------------

    @property
    def size(self) -> int:
        """Number of poses, those still to be updated included."""
        return len(self._motions) + (1 if self._has_origin else 0)

    def pose(self, k: int) -> Array:
        """(4, 4) T_map_camera of keyframe k."""
        return np.asarray(self._values.atPose3(symbol("x", k)).matrix())

    def poses(self) -> Array:
        """(N, 4, 4) of all keyframes."""
        return np.stack([self.pose(k) for k in range(self.size)]) if self.size else np.empty((0, 4, 4))

    def odometry(self) -> tuple[Array, Array]:
        """What odometry alone says: poses (N, 4, 4) and their covariances (N, 6, 6), from the same origin."""
        steps = [(motion.T, motion.covariance) for motion in self._motions]
        return dead_reckoning(self._origin.matrix(), np.eye(6) * self._settings.prior_sigma**2, steps)

    def drift(self) -> Array:
        """(6,) velocity [rad/s, m/s] that odometry misses; zero while nothing is known of it."""
        return np.asarray(self._values.atVector(_DRIFT)) if self._drifts else np.zeros(DRIFT)

    def predict(self, motion: Motion) -> Array:
        """(4, 4) T_map_camera after a motion from the newest pose."""
        correction = gtsam.Pose3.Expmap(motion.drifts * self.drift())
        return np.asarray(self.pose(self.size - 1) @ motion.T @ correction.matrix())

    def quadric(self, j: int) -> Array:
        """(9,) centre and logarithmic shape."""
        return np.asarray(self._values.atVector(symbol("q", j)))

    def pose_covariance(self, k: int) -> Array:
        """(6, 6) [rotation, translation] of keyframe k in its body."""
        return np.asarray(self._isam.marginalCovariance(symbol("x", k)))

    def quadric_covariances(self) -> dict[int, Array]:
        """For each quadric (9, 9) of its vector."""
        keys = {j: symbol("q", j) for j in self.landmarks}
        if not keys:
            return {}
        # One call for all: each costs a solve over the tree between its variables.
        joint = self._isam.jointMarginalCovariance(list(keys.values()))
        return {j: np.asarray(joint.at(key, key)) for j, key in keys.items()}

    def joint_covariances(self, k: int, quadrics: list[int]) -> list[Array]:
        """For each of these quadrics (15, 15) of pose k and the quadric: columns of `quadric.box_of_visible_part`."""
        if not quadrics:
            return []
        keys = [symbol("x", k), *(symbol("q", j) for j in quadrics)]
        joint = self._isam.jointMarginalCovariance(keys)
        return [np.block([[joint.at(a, b) for b in (keys[0], q)] for a in (keys[0], q)]) for q in keys[1:]]

    # -- changes, which take effect with the next update --------------------------------------------------------

    def add_origin(self) -> None:
        """The first pose."""
        self._has_origin = True
        self._add_origin_factor()
        for values in (self._new_values, self._values):
            values.insert(symbol("x", 0), self._origin)

    def add_pose(self, motion: Motion, guess: Array) -> int:
        """The next pose, after a motion from the last one; returns its number.

        The optimisation starts from `guess` (4, 4), its pose in the map.
        """
        k = self.size
        self._motions.append(motion)
        if motion.drifts and not self._drifts:
            self._drifts = True
            self._add_drift_factor()
            for values in (self._new_values, self._values):
                values.insert(_DRIFT, np.zeros(DRIFT))
        self._add_motion_factor(k)
        for values in (self._new_values, self._values):
            values.insert(symbol("x", k), gtsam.Pose3(guess))
        return k

    def add_quadric(self, j: int, vector: Array) -> None:
        """A new quadric, first seen as this vector (9,)."""
        self.add_known_quadric(j, vector, self._prior)

    def add_known_quadric(self, j: int, vector: Array, covariance: Array) -> None:
        """A quadric that is known as well as this covariance (9, 9) says."""
        self.landmarks[j] = Landmark(vector, covariance, self.size)
        for values in (self._new_values, self._values):
            values.insert(symbol("q", j), vector)
        self._add_prior_factor(j)

    def add_box(self, k: int, j: int, box: BoxMeasurement) -> None:
        """A box of quadric j in keyframe k."""
        self.landmarks[j].boxes.append((k, box))
        self._add_box_factor(k, j, box)

    def remove_quadric(self, j: int) -> None:
        """Take a quadric out, with all that was measured of it.

        Raises:
            ValueError: something of it waits for the update.
        """
        if j in self._owners:
            raise ValueError(f"quadric {j} has factors that wait for the update")
        landmark = self.landmarks.pop(j)
        self._to_remove += landmark.factors
        self._values.erase(symbol("q", j))

    # -- solving ------------------------------------------------------------------------------------------------

    def update(self, everything: bool = False) -> UpdateReport:
        """One step of ISAM2; `everything` relinearises whatever has moved."""
        self._updates += 1
        before = gtsam.Values(self._values)
        reason = ""
        try:
            self._step(everything or self._updates % self._settings.relinearise_every == 0)
            if self._jumped(before):
                reason = "the trajectory jumped"
        except RuntimeError as error:
            reason = _first_sentence(error)
        if reason:
            log.warning("%s; optimising the whole graph from the estimate before", reason)
            self._repair(before)
        removed = [j for j in self.landmarks if not self._sane(j)]
        for j in removed:
            log.warning("quadric %d ran away and is taken out", j)
            self.remove_quadric(j)
        return UpdateReport(removed, reason)

    def optimise(self) -> None:
        """The batch optimum by Levenberg-Marquardt, from which the tree is built anew."""
        self._rebuild(self._levenberg_marquardt(self._values, self.BATCH_ITERATIONS))

    def _step(self, everything: bool) -> None:
        changes = gtsam.ISAM2UpdateParams()
        changes.removeFactorIndices = self._to_remove
        changes.constrainedKeys = self._order()
        changes.force_relinearize = True
        if not everything:
            changes.noRelinKeys = self._settled()
        result = self._isam.update(self._new_factors, self._new_values, changes)
        for owner, index in zip(self._owners, result.getNewFactorsIndices(), strict=True):
            if owner in self.landmarks:
                self.landmarks[owner].factors.append(index)
        self._begin_change()
        self._values = self._isam.calculateEstimate()

    def _order(self) -> gtsam.KeyGroupMap:
        """Quadrics, the drift and the newest pose are eliminated last: the next update will touch them again."""
        groups = gtsam.KeyGroupMap()
        for j in self.landmarks:
            groups.insert2(symbol("q", j), 1)
        groups.insert2(symbol("x", self.size - 1), 1)
        if self._drifts:
            groups.insert2(_DRIFT, 1)
        return groups

    def _settled(self) -> gtsam.KeyList:
        """Everything but young quadrics and the newest poses keeps its linearisation point for now."""
        keys = gtsam.KeyList()
        for k in range(self.size - 5):
            keys.push_back(symbol("x", k))
        for j, landmark in self.landmarks.items():
            if self.size - landmark.born > self._settings.young:
                keys.push_back(symbol("q", j))
        return keys

    def _sane(self, j: int) -> bool:
        vector = self.quadric(j)
        if not np.isfinite(vector).all():
            return False
        radii = np.exp(np.linalg.eigvalsh(matrix_from_vector(vector[3:])))
        return bool(
            radii.min() > self.SMALLEST_RADIUS
            and radii.max() < self.LARGEST_RADIUS
            and np.linalg.norm(vector[:3] - self.pose(self.size - 1)[:3, 3]) < self.LARGEST_DISTANCE
        )

    def _jumped(self, before: gtsam.Values) -> bool:
        """Whether a pose moved farther than an undamped step can be trusted with."""
        for k in range(self.size):
            step = gtsam.Pose3.Logmap(before.atPose3(symbol("x", k)).between(self._values.atPose3(symbol("x", k))))
            if not np.isfinite(step).all() or np.abs(step).max() > self.LARGEST_STEP:
                return True
        return False

    def _repair(self, before: gtsam.Values) -> None:
        """Optimise the whole graph with damping from an estimate that was good, and build the tree anew.

        If even that fails, quadrics are given up, the youngest first.
        """
        while True:
            try:
                self._rebuild(self._levenberg_marquardt(before, self.REPAIR_ITERATIONS))
                return
            except RuntimeError as error:
                if not self.landmarks:
                    raise
                youngest = max(self.landmarks, key=lambda j: self.landmarks[j].born)
                log.warning("%s; giving up quadric %d", _first_sentence(error), youngest)
                del self.landmarks[youngest]
                before.erase(symbol("q", youngest))

    def _levenberg_marquardt(self, values: gtsam.Values, iterations: int) -> gtsam.Values:
        self._begin_change()
        self._add_all_factors()
        optimiser = gtsam.LevenbergMarquardtOptimizer(self._new_factors, values, gtsam.LevenbergMarquardtParams())
        error = optimiser.error()
        for _ in range(iterations):  # one at a time, so that other threads of the process are served in between
            optimiser.iterate()
            if error - optimiser.error() < self.CONVERGED * error:
                break
            error = optimiser.error()
        return optimiser.values()

    def _rebuild(self, values: gtsam.Values) -> None:
        """A new tree of all factors, linearised at these values."""
        self._isam = self._new_isam()
        self._begin_change()
        self._add_all_factors()
        self._new_values = values
        for landmark in self.landmarks.values():
            landmark.factors = []
        self._step(True)

    def _add_all_factors(self) -> None:
        self._add_origin_factor()
        if self._drifts:
            self._add_drift_factor()
        for k in range(1, self.size):
            self._add_motion_factor(k)
        for j, landmark in self.landmarks.items():
            self._add_prior_factor(j)
            for k, box in landmark.boxes:
                self._add_box_factor(k, j, box)

    def _new_isam(self) -> gtsam.ISAM2:
        parameters = gtsam.ISAM2Params()
        parameters.relinearizeSkip = 1  # `update` says itself what may be relinearised
        thresholds = gtsam.ISAM2ThresholdMap()
        pose, quadric = self._settings.relinearise_pose, self._settings.relinearise_quadric
        # The factors are linear in the drift: there is nothing to relinearise.
        for name, size, threshold in (("x", 6, pose), ("q", 9, quadric), ("d", DRIFT, np.inf)):
            thresholds.insert((name, np.full(size, threshold)))
        parameters.setRelinearizeThreshold(thresholds)
        return gtsam.ISAM2(parameters)

    # -- factors ------------------------------------------------------------------------------------------------

    def _begin_change(self) -> None:
        self._new_factors = gtsam.NonlinearFactorGraph()
        self._new_values = gtsam.Values()
        self._owners: list[int] = []  # of each new factor: the quadric, or -1
        self._to_remove: list[int] = []

    def _add(self, factor: gtsam.NonlinearFactor, owner: int = -1) -> None:
        self._new_factors.push_back(factor)
        self._owners.append(owner)

    def _add_origin_factor(self) -> None:
        noise = gtsam.noiseModel.Isotropic.Sigma(6, self._settings.prior_sigma)
        self._add(gtsam.PriorFactorPose3(symbol("x", 0), self._origin, noise))

    def _add_motion_factor(self, k: int) -> None:
        motion = self._motions[k - 1]
        noise = gtsam.noiseModel.Robust.Create(
            gtsam.noiseModel.mEstimator.Cauchy.Create(self._settings.robust_odometry),
            gtsam.noiseModel.Gaussian.Covariance(motion.covariance),
        )
        start, end = symbol("x", k - 1), symbol("x", k)
        if motion.drifts:
            self._add(drifting_motion_factor(start, end, _DRIFT, motion.T, motion.drifts, noise))
        else:
            self._add(gtsam.BetweenFactorPose3(start, end, gtsam.Pose3(motion.T), noise))

    def _add_drift_factor(self) -> None:
        noise = gtsam.noiseModel.Diagonal.Sigmas(self._drift_sigmas)
        self._add(gtsam.PriorFactorVector(_DRIFT, np.zeros(DRIFT), noise))

    def _add_prior_factor(self, j: int) -> None:
        landmark = self.landmarks[j]
        noise = gtsam.noiseModel.Gaussian.Covariance(landmark.covariance)
        self._add(gtsam.PriorFactorVector(symbol("q", j), landmark.prior, noise), j)

    def _add_box_factor(self, k: int, j: int, box: BoxMeasurement) -> None:
        self._add(box_factor(symbol("x", k), symbol("q", j), box, self._K, self._settings.robust_scale), j)


def _first_sentence(error: RuntimeError) -> str:
    """GTSAM's messages are pages long."""
    return " ".join(str(error).split("Thrown when")[0].split())
