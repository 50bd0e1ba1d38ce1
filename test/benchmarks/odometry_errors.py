"""How visual odometry errs: what `MotionNoise` believes of motions without covariance, against ground truth.

    ./calibslam shell -c 'python test/benchmarks/odometry_errors.py [FOLDER ...]'

FOLDER is in TUM format, with odometry.txt and groundtruth.txt (default: both recordings of the shared data). For
motions over 3, 6, 12 and 24 images: how large their errors at the scene are, how those in the camera about and along
its axes correlate, and under which settings all of them are likeliest (Student's t with 4 degrees of freedom, whose
standard deviation is printed; for each recording a constant drift; the truth itself has errors of its own, the same for
short and long motions, which are fitted beside):

    steps: the variance grows with each step, by floor^2 + (share * velocity)^2 in a second, as in `MotionNoise`;
    whole: it is that of the whole motion, floor^2 + (share * motion)^2, however long it took.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
from live_graph import DATA
from scipy.optimize import minimize

from calibslam_backend.odometry.motion_noise import MotionNoise
from calibslam_backend.output.metrics import Trajectory, interpolated
from calibslam_msgs_py.measurements import SECOND, Array
from calibslam_sim.tum_folder import read_trajectory

IMAGES = (3, 6, 12, 24)  # between the ends of a motion
TAIL = 4.0  # degrees of freedom
TO_DEVIATION = float(np.sqrt(TAIL / (TAIL - 2.0)))  # of the scale of that distribution
DRIFT_UNIT = 0.01  # [rad/s, m/s], for the optimiser
# What is fitted, as logarithms, and where the search begins.
DEVIATIONS = {
    "rotation_floor": 0.003,
    "rotation_share": 0.03,
    "translation_floor": 0.003,
    "translation_share": 0.013,
    "truth_rotation": 0.001,  # [rad]
    "truth_translation": 0.001,  # [m]
}
SHAPE = {"roll_share": 0.7, "scene_depth": 1.0}
BEGIN = DEVIATIONS | SHAPE
FARTHEST = 40.0  # times


@dataclass(frozen=True)
class Motions:
    """Motions (N) of a recording over the same number K of images.

    Attributes:
        errors: (N, 6) [rad, m] of odometry.
        velocities: (N, K, 2) of each step, of rotation and of translation [rad/s, m/s].
        durations: (N, K) of each step [s].
        to_end: (N, K, 6, 6) adjoint maps from the camera after each step to that at the end.
        lengths: (N, 2) rotation and translation of the whole motion [rad, m].
    """

    errors: Array
    velocities: Array
    durations: Array
    to_end: Array
    lengths: Array

    def covariances(self, p: dict[str, float], by_steps: bool) -> Array:
        """(N, 6, 6)."""
        floors = np.array([p["rotation_floor"], p["translation_floor"]])
        shares = np.array([p["rotation_share"], p["translation_share"]])
        if by_steps:
            to_end = self.to_end
            variances = self.durations[:, :, None] * (floors**2 + (shares * self.velocities) ** 2)
        else:
            to_end = np.broadcast_to(np.eye(6), (len(self.errors), 1, 6, 6))
            variances = (floors**2 + (shares * self.lengths) ** 2)[:, None]
        ratios = np.array([1.0, 1.0, p["roll_share"] ** 2, 1.0, 1.0, 1.0])
        at_scene = to_end @ about_scene(p["scene_depth"])
        odometry = np.einsum("nkij,nkj,nklj->nil", at_scene, np.repeat(variances, 3, axis=2) * ratios, at_scene)
        truth = np.repeat([p["truth_rotation"], p["truth_translation"]], 3)
        return np.asarray(odometry + np.diag(truth**2))

    def log_likelihood(self, p: dict[str, float], drift: Array, by_steps: bool) -> float:
        """Of the errors beside a drift (6,) [rad/s, m/s], but for a constant."""
        scales = self.covariances(p, by_steps)
        beside = self.errors - self.durations.sum(axis=1, keepdims=True) * drift
        squares = np.einsum("ni,ni->n", beside, np.linalg.solve(scales, beside[:, :, None])[:, :, 0])
        tails = 0.5 * (TAIL + 6.0) * np.log1p(squares / TAIL)
        return float(-np.sum(tails + 0.5 * np.linalg.slogdet(scales)[1]))


def about_scene(depth: float) -> Array:
    """(6, 6) adjoint map from the scene to the camera."""
    return np.asarray(gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, depth])).AdjointMap())


def read(folder: Path) -> list[Motions]:
    """The motions of a recording, for each number of images."""
    truth, odometry = (Trajectory.of(read_trajectory(folder / f"{x}.txt")) for x in ("groundtruth", "odometry"))
    covered, found = interpolated(truth, odometry.stamps)
    true, measured = ([gtsam.Pose3(T) for T in poses] for poses in (found, odometry.poses[covered]))
    durations = np.diff(odometry.stamps[covered]) / SECOND
    velocities = lengths([a.between(b) for a, b in pairwise(measured)]) / durations[:, None]
    result = []
    for images in IMAGES:
        starts = range(0, len(measured) - images, images)
        inside = np.array([np.arange(i, i + images) for i in starts])
        wholes = [measured[i].between(measured[i + images]) for i in starts]
        errors = [true[i].between(true[i + images]).between(whole) for i, whole in zip(starts, wholes, strict=True)]
        to_end = [[measured[row[-1] + 1].between(measured[k + 1]).AdjointMap() for k in row] for row in inside]
        result.append(
            Motions(
                np.array([gtsam.Pose3.Logmap(error) for error in errors]),
                velocities[inside],
                durations[inside],
                np.array(to_end),
                lengths(wholes),
            )
        )
    return result


def lengths(motions: Sequence[gtsam.Pose3]) -> Array:
    """(N, 2) rotation and translation [rad, m]."""
    logarithms = np.array([gtsam.Pose3.Logmap(motion) for motion in motions])
    return np.linalg.norm(logarithms.reshape(-1, 2, 3), axis=2)


Recording = Sequence[Motions]  # over several numbers of images


def fit(recordings: Sequence[Recording], by_steps: bool, fixed: dict[str, float]) -> tuple[float, dict[str, float]]:
    """Greatest log-likelihood of a motion, and the scales that have it; those in `fixed` are not fitted."""
    free = [name for name in BEGIN if name not in fixed]
    count = sum(len(motions.errors) for recording in recordings for motions in recording)
    begin = np.concatenate([np.log([BEGIN[name] for name in free]), np.zeros(6 * len(recordings))])

    def settings(x: Array) -> dict[str, float]:
        return {**fixed, **dict(zip(free, np.exp(x[: len(free)]).tolist(), strict=True))}

    def cost(x: Array) -> float:
        p, drifts = settings(x), DRIFT_UNIT * x[len(free) :].reshape(-1, 6)
        found = [
            motions.log_likelihood(p, drift, by_steps)
            for recording, drift in zip(recordings, drifts, strict=True)
            for motions in recording
        ]
        return -sum(found) / count

    reach = float(np.log(FARTHEST))
    bounds = [(x - reach, x + reach) for x in begin[: len(free)]] + [(None, None)] * (6 * len(recordings))
    found = minimize(cost, begin, method="L-BFGS-B", bounds=bounds)
    return -float(found.fun), settings(found.x)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = [DATA / "fr3_office", DATA / "fr1_desk"]
    parser.add_argument("folders", nargs="*", type=Path, default=default, metavar="FOLDER")
    recordings = {folder.name: read(folder) for folder in parser.parse_args().folders}
    to_scene = np.linalg.inv(about_scene(MotionNoise().scene_depth))
    for name, recording in recordings.items():
        print(
            f"{name}: median errors at the scene, rotation about x, y, z [mrad], translation [mm]; "
            "correlation of rotation about x with translation along y, about y with x, without gross failures"
        )
        for images, motions in zip(IMAGES, recording, strict=True):
            errors = motions.errors @ to_scene.T
            spread = 1e3 * np.median(np.abs(errors - np.median(errors, axis=0)), axis=0) / 0.6745
            usual = np.abs(motions.errors) < 4.0 * np.median(np.abs(motions.errors), axis=0) / 0.6745
            correlation = np.corrcoef(motions.errors[usual.all(axis=1)].T)
            print(
                f"  {images:2} images, {len(errors):3} motions:",
                *(f"{value:5.1f}" for value in spread),
                f"; {correlation[0, 4]:+.2f} {correlation[1, 3]:+.2f}",
            )
    noise = MotionNoise()
    as_set = {name: getattr(noise, name) / scale_of(name) for name in BEGIN if not name.startswith("truth")}
    groups = {**{name: [recording] for name, recording in recordings.items()}, "together": list(recordings.values())}
    for name, group in groups.items():
        print(name)
        for title, by_steps, fixed in (("whole", False, {}), ("steps", True, {}), ("steps, as set", True, as_set)):
            value, found = fit(group, by_steps, fixed)
            print(
                f"  {title}: {value:.2f}", *(f"{key} {p * scale_of(key):.4f}" for key, p in found.items()), flush=True
            )


def scale_of(name: str) -> float:
    """What turns a fitted parameter into a setting: deviations are those of the distribution, not its scales."""
    return TO_DEVIATION if name in DEVIATIONS else 1.0


if __name__ == "__main__":
    main()
