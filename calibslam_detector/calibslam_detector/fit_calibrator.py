"""`fit_calibrator BAG --out FILE.json`: covariances for a detector's boxes, from a recording with true poses.

Labels are not needed: reference boxes are reprojections of quadrics that were fitted with those poses.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calibslam_detector.calibration.metrics import coverage
from calibslam_detector.foreign_boxes.calibrator import FILE_VERSION, CalibratorError
from calibslam_detector.foreign_boxes.edge_mixture import EdgeMixture, fit_mixture
from calibslam_detector.foreign_boxes.features import FEATURES, edge_features
from calibslam_detector.foreign_boxes.log_linear import LogLinearCalibrator
from calibslam_msgs_py.bags import BagError, refuse_to_replace
from calibslam_msgs_py.command import ArgumentParser, command
from calibslam_msgs_py.files import write_whole
from calibslam_msgs_py.measurements import Array, Boxes
from calibslam_msgs_py.progress import followed
from calibslam_msgs_py.settings import SettingsError, settings_fields

MIN_OBJECTS = 5
MIN_EDGES = 400
FOLDS = 5
EXTENTS_SEEN = (1.0, 99.0)  # [%] of the extents of a recording that count as seen
LEVELS = np.array([0.5, 0.9])
# Of the intercept and the coefficients, that a file may hold.
BOUNDS = {field.name: field.metadata["high"] for field in settings_fields(LogLinearCalibrator)}
LARGEST = np.array([BOUNDS[name] for name in ("intercept", *FEATURES)])


class ReferencedImage(Protocol):
    """What `calibslam.reference_boxes` gives for an image: its boxes, the errors (N, 4) [px] of their edges, NaN where
    unknown, and the number of their object (N,), -1 where unknown."""

    @property
    def boxes(self) -> Boxes: ...
    @property
    def errors(self) -> Array: ...
    @property
    def objects(self) -> Array: ...


@dataclass(frozen=True)
class Edges:
    """The edges that have a reference.

    Attributes:
        errors: (N,) [px].
        features: (N, F).
        objects: (N,) number of the object.
        boxes: of the recording, also those without reference.
        extents: smallest and largest [px].
    """

    errors: Array
    features: Array
    objects: Array
    boxes: int
    extents: tuple[float, float]

    @classmethod
    def of(cls, images: Sequence[ReferencedImage], extents: tuple[float, float] | None = None) -> Edges:
        """The edges of a recording.

        Args:
            images: of the recording.
            extents: beyond which features do not grow; None: those of the recording.

        Raises:
            CalibratorError: too few for a fit.
        """
        errors = np.concatenate([np.reshape(image.errors, (-1, 4)) for image in images])
        known = np.isfinite(errors)
        objects = np.repeat(np.concatenate([image.objects for image in images]), 4).reshape(-1, 4)[known]
        found = len(np.unique(objects))
        if found < MIN_OBJECTS or known.sum() < MIN_EDGES:
            raise CalibratorError(
                f"too little to fit to: {known.sum()} edges of {found} objects have a reference box, {MIN_EDGES} edges "
                f"of {MIN_OBJECTS} objects are needed; record longer, from more sides, and with more objects"
            )
        if extents is None:
            corners = np.concatenate([image.boxes.corners for image in images])[known.any(axis=1)]
            low, high = np.percentile(corners[:, 2:] - corners[:, :2], EXTENTS_SEEN)
            extents = (float(low), float(high))
        features = np.concatenate([edge_features(image.boxes, *extents) for image in images])[known]
        return cls(errors[known], features, objects, len(known), extents)

    def select(self, chosen: NDArray[np.bool_]) -> Edges:
        """Those of a mask (N,)."""
        return Edges(self.errors[chosen], self.features[chosen], self.objects[chosen], self.boxes, self.extents)


@dataclass(frozen=True)
class Judgement:
    """How a model does on edges it was not fitted to.

    Attributes:
        edges: number.
        inliers: share that is more likely of the core than outliers.
        coverage_50, coverage_90: share of the inliers within the central interval of that probability.
        nll: mean negative log-likelihood of all edges [log px].
        nll_constant: the same of the best model with one sigma for all, fitted to what the model was fitted to.
    """

    edges: int
    inliers: float
    coverage_50: float
    coverage_90: float
    nll: float
    nll_constant: float


def judge(model: EdgeMixture, constant: EdgeMixture, edges: Edges) -> Judgement:
    """A model and the best constant on edges."""
    return _judgement([_Predicted.of(model, constant, edges)])


@dataclass(frozen=True)
class _Predicted:
    """Of each edge (N,): standardised error, whether it is an inlier, and negative log-likelihoods."""

    z: Array
    inlier: NDArray[np.bool_]
    nll: Array
    nll_constant: Array

    @classmethod
    def of(cls, model: EdgeMixture, constant: EdgeMixture, edges: Edges) -> _Predicted:
        errors, features = edges.errors, edges.features
        return cls(
            errors / model.sigmas(features),
            model.inliers(errors, features) > 0.5,
            model.negative_log_likelihoods(errors, features),
            constant.negative_log_likelihoods(errors, features[:, :0]),
        )


def _judgement(parts: Sequence[_Predicted]) -> Judgement:
    z, inlier, nll, constant = (
        np.concatenate([getattr(p, n) for p in parts]) for n in ("z", "inlier", "nll", "nll_constant")
    )
    covered = coverage(z[inlier][:, None], LEVELS)
    return Judgement(
        len(z), float(inlier.mean()), float(covered[0]), float(covered[1]), float(nll.mean()), float(constant.mean())
    )


def fit(edges: Edges) -> tuple[EdgeMixture, EdgeMixture]:
    """The model and the best constant."""
    return fit_mixture(edges.errors, edges.features, LARGEST), fit_mixture(edges.errors, edges.features[:, :0])


def held_out(edges: Edges, folds: int = FOLDS) -> Judgement:
    """Cross-validation over objects: the edges of one object are never on both sides."""
    numbers, counts = np.unique(edges.objects, return_counts=True)
    dealt = numbers[np.argsort(-counts, kind="stable")]  # large and small objects in every fold
    parts = []
    for fold in followed(range(folds), "hold-out"):
        outside = np.isin(edges.objects, dealt[fold::folds])
        parts.append(_Predicted.of(*fit(edges.select(~outside)), edges.select(outside)))
    return _judgement(parts)


def calibrator(model: EdgeMixture, extents: tuple[float, float]) -> LogLinearCalibrator:
    """What a file holds of a fitted model: the core; outliers are the business of who uses the boxes.

    Raises:
        CalibratorError: no file can hold it.
    """
    coefficients = {name: float(c) for name, c in zip(FEATURES, model.coefficients, strict=True)}
    try:
        return LogLinearCalibrator(
            intercept=model.intercept, **coefficients, least_extent=extents[0], most_extent=extents[1]
        )
    except SettingsError as error:
        raise CalibratorError(
            f"what was fitted is no calibrator ({error}); record longer, with boxes of more different sizes and scores"
        ) from None


def references(bag: str) -> Sequence[ReferencedImage]:
    """The images of a bag, with reference boxes.

    Raises:
        BagError: it cannot be read, or misses something.
        CalibratorError: no package makes reference boxes.
    """
    found = list(entry_points(group="calibslam.reference_boxes", name="default"))
    if not found:
        raise CalibratorError("nothing makes reference boxes: build calibslam_backend")
    images: Sequence[ReferencedImage] = found[0].load()(bag)
    return images


@command
def main(arguments: Sequence[str] | None = None) -> int:
    """Entry of the executable; returns the exit code."""
    parser = ArgumentParser(prog="fit_calibrator", description=__doc__)
    parser.add_argument("bag", help="recording with boxes, camera_info, odometry and ground_truth")
    parser.add_argument("--out", required=True, type=Path, metavar="FILE", help="calibrator file to write (JSON)")
    parser.add_argument("--test", metavar="BAG", help="another recording, to judge the result on")
    parsed = parser.parse_args(arguments)
    try:
        refuse_to_replace(parsed.out, parsed.bag, *([parsed.test] if parsed.test else []))
        edges = Edges.of(references(parsed.bag))
        model, constant = fit(edges)
        result = calibrator(model, edges.extents)
        inside = held_out(edges)
        print(_line(f"{Path(parsed.bag).name}, objects held out", inside))
        fitted_on: dict[str, object] = {
            "bag": Path(parsed.bag).name,
            "boxes": edges.boxes,
            "edges": len(edges.errors),
            "objects": len(np.unique(edges.objects)),
            "outlier_share": model.outlier_share,
            "outlier_spread": model.outlier_spread,
            "held_out_objects": asdict(inside),
        }
        if parsed.test:
            other = judge(model, constant, Edges.of(references(parsed.test), edges.extents))
            print(_line(Path(parsed.test).name, other))
            fitted_on["test"] = {"bag": Path(parsed.test).name, **asdict(other)}
        content = {
            "version": FILE_VERSION,
            "kind": "log_linear",
            "parameters": asdict(result),
            "fitted_on": fitted_on,
        }
        write_whole(parsed.out, (json.dumps(content, indent=2) + "\n").encode())
    except (BagError, CalibratorError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"{len(edges.errors)} edges of {fitted_on['objects']} objects; calibrator: {parsed.out}")
    return 0


def _line(name: str, judgement: Judgement) -> str:
    return (
        f"{name}: inliers {judgement.inliers:.0%}, of these within 50 %: {judgement.coverage_50:.1%}, "
        f"within 90 %: {judgement.coverage_90:.1%}; NLL {judgement.nll:.3f}, best constant {judgement.nll_constant:.3f}"
    )


if __name__ == "__main__":
    sys.exit(main())
