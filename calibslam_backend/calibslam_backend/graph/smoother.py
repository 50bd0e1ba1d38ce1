"""Incremental smoothing by ISAM2, with factors that have names.

ISAM2 knows a factor by the slot it was given. Here every factor has a name, under which it can be taken out again, and
is kept: the tree can be built anew from all of them, or handed to Levenberg-Marquardt, at any time.

The tree holds tangents: a factor is linearised once, at the newest estimate of its variables, and again when it is
renewed. ISAM2 would relinearise variables, each with all of its factors, and a variable with hundreds of factors drags
most of the tree along; tangents can be renewed a few at a time. All of a factor's variables stand at their newest
estimates when that is done. (Were one of them held where it was long ago, residuals would be those of a
state that never was, and robust weights with them.) ISAM2 still moves the base of the coordinates of poses that have
gone far, since the tangent of a rotation is that of a vector space only nearby.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable

import gtsam
import numpy as np

from calibslam_msgs_py.measurements import Array

Name = Hashable
Linearise = Callable[[Iterable[Name], gtsam.Values], dict[Name, gtsam.JacobianFactor]]


class Smoother:
    """Factors by name, values by key, and the Bayes tree that joins them.

    Changes wait for the next `update`; `values` has new variables at once.
    """

    BATCH_ITERATIONS = 100
    CONVERGED = 1e-5  # share by which an iteration of the batch optimiser has to lower the error

    def __init__(self, thresholds: dict[str, tuple[int, float]], linearise: Linearise | None = None) -> None:
        """A smoother of nothing.

        Args:
            thresholds: for each letter of keys the dimension of its variables and the change that moves their base.
            linearise: the tangents of some factors, by name, at these values, where that is faster than one by one.
        """
        self._thresholds = thresholds
        self._linearise = linearise
        self.values = gtsam.Values()
        self._factors: dict[Name, gtsam.NonlinearFactor] = {}
        self._slots: dict[Name, int] = {}  # of the factors in the tree
        # QR takes longer, but copes with directions whose certainties differ by more than GTSAM's Cholesky allows
        # (a factor of 4096 in standard deviations), as where odometry leaves some directions open.
        self._by_qr = False
        self._isam = self._new_isam()
        self._new: list[Name]
        self._to_remove: list[int]
        self._begin()

    # -- changes ------------------------------------------------------------------------------------------------

    def insert(self, key: int, value: gtsam.Pose3 | Array) -> None:
        """A new variable."""
        for values in (self._new_values, self.values):
            values.insert(key, value)

    def forget(self, key: int) -> None:
        """A variable that no factor is left of; it goes with the next update."""
        self.values.erase(key)
        if self._new_values.exists(key):
            self._new_values.erase(key)

    def add(self, name: Name, factor: gtsam.NonlinearFactor) -> None:
        """A new factor."""
        if name in self._factors:
            raise ValueError(f"there is a factor {name} already")
        self._factors[name] = factor
        self._new.append(name)

    def remove(self, name: Name) -> None:
        """Take a factor out."""
        del self._factors[name]
        if name in self._slots:
            self._to_remove.append(self._slots.pop(name))
        else:
            self._new.remove(name)

    def renew(self, name: Name) -> None:
        """Linearise a factor anew with the next update."""
        if name in self._slots:
            self._to_remove.append(self._slots.pop(name))
            self._new.append(name)

    def has(self, name: Name) -> bool:
        """Whether a factor is in the tree, updates done."""
        return name in self._slots

    def is_solved(self, key: int) -> bool:
        """Whether a variable is in the tree, updates done."""
        return bool(self.values.exists(key)) and not self._new_values.exists(key)

    # -- solving ------------------------------------------------------------------------------------------------

    def update(self, last: Iterable[int], held: Iterable[int]) -> None:
        """One step of ISAM2.

        Args:
            last: keys to eliminate last.
            held: keys that keep their base whatever they have moved.

        Raises:
            RuntimeError: GTSAM's, for example of an indeterminate system; the tree is then no longer usable.
        """
        changes = gtsam.ISAM2UpdateParams()
        changes.removeFactorIndices = self._to_remove
        changes.force_relinearize = True
        groups = gtsam.KeyGroupMap()
        for key in last:
            groups.insert2(key, 1)
        changes.constrainedKeys = groups
        kept = gtsam.KeyList()
        for key in held:
            kept.push_back(key)
        changes.noRelinKeys = kept
        result = self._isam.update(self._tangents(self._new), self._new_values, changes)
        self._slots.update(zip(self._new, result.getNewFactorsIndices(), strict=True))
        self._begin()
        self.values = self._isam.calculateEstimate()

    def optimise(self, values: gtsam.Values, iterations: int = BATCH_ITERATIONS) -> gtsam.Values:
        """The optimum of all factors by Levenberg-Marquardt, from these values; the tree stays as it is."""
        graph = self._graph(self._factors)
        parameters = gtsam.LevenbergMarquardtParams()
        if self._by_qr:
            parameters.setLinearSolverType("MULTIFRONTAL_QR")
        optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
        error = optimiser.error()
        for _ in range(iterations):  # one at a time, so that other threads of the process are served in between
            optimiser.iterate()
            if error - optimiser.error() < self.CONVERGED * error:
                break
            error = optimiser.error()
        return optimiser.values()

    def rebuild(self, values: gtsam.Values, last: Iterable[int]) -> None:
        """A new tree of all factors, linearised at these values.

        Where Cholesky takes it for indeterminate it is made by QR, as is every later one.

        Raises:
            RuntimeError: GTSAM's; the tree is then no longer usable.
        """
        try:
            self._rebuild(values, last)
        except RuntimeError:
            if self._by_qr:
                raise
            self._by_qr = True
            self._rebuild(values, last)

    def _rebuild(self, values: gtsam.Values, last: Iterable[int]) -> None:
        self._isam = self._new_isam()
        self._begin()
        self._slots.clear()
        self._new = list(self._factors)
        self.values = self._new_values = values
        self.update(last, ())

    def marginal(self, key: int) -> Array:
        """Covariance of a variable."""
        return np.asarray(self._isam.marginalCovariance(key))

    def joint(self, keys: list[int]) -> gtsam.JointMarginal:
        """Covariances between variables. One call for many costs little more than for one: each is a solve over the
        tree between them."""
        return self._isam.jointMarginalCovariance(keys)

    def _begin(self) -> None:
        """Nothing waits for an update."""
        self._new = []
        self._new_values = gtsam.Values()
        self._to_remove = []

    def _tangents(self, names: list[Name]) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        known = self._linearise(names, self.values) if self._linearise else {}
        for name in names:
            tangent = known.get(name) or self._factors[name].linearize(self.values)
            graph.push_back(gtsam.LinearContainerFactor(tangent, self.values))
        return graph

    def _graph(self, names: Iterable[Name]) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        for name in names:
            graph.push_back(self._factors[name])
        return graph

    def _new_isam(self) -> gtsam.ISAM2:
        parameters = gtsam.ISAM2Params()
        if self._by_qr:
            parameters.setFactorization("QR")
        parameters.relinearizeSkip = 1  # `update` is told what may be relinearised
        thresholds = gtsam.ISAM2ThresholdMap()
        for letter, (size, threshold) in self._thresholds.items():
            thresholds.insert((letter, np.full(size, threshold)))
        parameters.setRelinearizeThreshold(thresholds)
        return gtsam.ISAM2(parameters)
