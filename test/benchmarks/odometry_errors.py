"""How visual odometry errs: what `MotionNoise` believes of motions without covariance, against ground truth.

    ./calibslam shell -c 'python test/benchmarks/odometry_errors.py [FOLDER ...] [--images 10]'

FOLDER is in TUM format, with odometry.txt and groundtruth.txt (default: both recordings of the shared data). For
motions over some images: how errors about and along the camera's axes correlate, and the deviations and the depth of
the scene under which they are likeliest (Student's t with 4 degrees of freedom, a constant drift for each recording).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from live_graph import DATA
from scipy.optimize import minimize
from scipy.stats import multivariate_t

from calibslam_backend.metrics import Trajectory, interpolated
from calibslam_backend.odometry import MotionNoise
from calibslam_msgs_py.measurements import SECOND, Array
from calibslam_sim.tum_folder import read_trajectory

TAIL = 4  # degrees of freedom
DRIFT_UNIT = 0.01  # [rad/s, m/s], for the optimiser
# What is fitted, as logarithms, where the search begins, and its bounds.
FIELDS = ("rotation_floor", "rotation_share", "translation_floor", "translation_share", "scene_depth")
BEGIN = np.log([0.003, 0.04, 0.003, 0.02, 1.0])
BOUNDS = np.log([(2e-4, 0.02), (1e-3, 0.3), (2e-4, 0.02), (1e-3, 0.3), (0.1, 10.0)])


class Motions:
    """Motions (N, 4, 4) of a recording by odometry, their errors (N, 6) [rad, m] and durations (N,) [s]."""

    def __init__(self, folder: Path, images: int) -> None:
        truth, odometry = (Trajectory.of(read_trajectory(folder / f"{x}.txt")) for x in ("groundtruth", "odometry"))
        covered, true = interpolated(truth, odometry.stamps[::images])
        stamps, measured = odometry.stamps[::images][covered], odometry.poses[::images][covered]
        self.motions = np.stack([np.linalg.inv(a) @ b for a, b in pairwise(measured)])
        true_motions = [np.linalg.inv(a) @ b for a, b in pairwise(true)]
        self.errors = np.stack(
            [
                gtsam.Pose3.Logmap(gtsam.Pose3(np.linalg.inv(true_motion) @ motion))
                for true_motion, motion in zip(true_motions, self.motions, strict=True)
            ]
        )
        self.seconds = np.diff(stamps) / SECOND

    def log_likelihood(self, noise: MotionNoise, drift: Array) -> float:
        """Of the errors beside a drift (6,) [rad/s, m/s]."""
        beside = self.errors - self.seconds[:, None] * drift
        return sum(
            multivariate_t.logpdf(error, shape=noise.covariance(motion), df=TAIL)
            for error, motion in zip(beside, self.motions, strict=True)
        )


def fit(recordings: Sequence[Motions], **fixed: float) -> tuple[float, dict[str, float]]:
    """Greatest log-likelihood of a motion, and the settings that have it; those in `fixed` are not fitted."""
    free = [i for i, name in enumerate(FIELDS) if name not in fixed]
    count = sum(len(recording.errors) for recording in recordings)

    def cost(x: Array) -> float:
        noise = MotionNoise(**dict(zip((FIELDS[i] for i in free), np.exp(x[: len(free)]), strict=True)), **fixed)
        drifts = DRIFT_UNIT * x[len(free) :].reshape(-1, 6)
        found = [recording.log_likelihood(noise, drift) for recording, drift in zip(recordings, drifts, strict=True)]
        return -sum(found) / count

    begin = np.concatenate([BEGIN[free], np.zeros(6 * len(recordings))])
    bounds = [*BOUNDS[free], *[(None, None)] * (6 * len(recordings))]
    found = minimize(cost, begin, method="L-BFGS-B", bounds=bounds)
    return -float(found.fun), {FIELDS[i]: float(np.exp(value)) for i, value in zip(free, found.x, strict=False)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = [DATA / "fr3_office", DATA / "fr1_desk"]
    parser.add_argument("folders", nargs="*", type=Path, default=default, metavar="FOLDER")
    parser.add_argument("--images", type=int, default=10, help="between the ends of a motion (default: 10)")
    arguments = parser.parse_args()
    recordings = {folder.name: Motions(folder, arguments.images) for folder in arguments.folders}
    groups: dict[str, Any] = {name: [found] for name, found in recordings.items()}
    groups["together"] = list(recordings.values())
    for name, found in groups.items():
        errors = np.concatenate([recording.errors for recording in found])
        usual = np.abs(errors) < 4.0 * np.median(np.abs(errors), axis=0) / 0.6745  # without gross failures
        correlation = np.corrcoef(errors[usual.all(axis=1)].T)
        print(f"{name}: {len(errors)} motions over {arguments.images} images")
        print(f"  rotation about x with y {correlation[0, 4]:+.2f}, about y with x {correlation[1, 3]:+.2f}")
        for title, fixed in (("independent in the camera", {"scene_depth": 0.0}), ("about the scene", {})):
            value, settings = fit(found, **fixed)
            print(f"  {title}: {value:.2f}", *(f"{key} {setting:.4f}" for key, setting in settings.items()))
        value, _ = fit(found, **{name: getattr(MotionNoise(), name) for name in FIELDS})
        print(f"  as the settings are: {value:.2f}", flush=True)


if __name__ == "__main__":
    main()
