"""Visual odometry: what it finds in images of a known wall, how sure it says to be, and what it does when lost."""

from __future__ import annotations

import gtsam
import numpy as np
import plane_scene
import pytest
from plane_scene import CAMERA

from calibslam_backend.output.metrics import Trajectory
from calibslam_msgs_py.measurements import SECOND, InvalidMeasurement, RelativeMotion
from calibslam_sim.accuracy.motions import motion_accuracy, truth_noise
from calibslam_sim.visual_odometry import point_pose as module
from calibslam_sim.visual_odometry.frame_odometry import Step, VisualOdometry, VisualOdometrySettings
from calibslam_sim.visual_odometry.point_pose import Undetermined, moved, point_pose

PERIOD = SECOND // 15
VELOCITY = np.array([0.3, -0.2, 0.1, 0.1, 0.2, -0.1])


def cloud(n: int = 200, seed: int = 0) -> np.ndarray:
    random = np.random.default_rng(seed)
    return random.uniform([-1.0, -0.8, 1.0], [1.0, 0.8, 3.0], (n, 3))


def see(points: np.ndarray, T: np.ndarray, velocity: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """Normalised coordinates of points, each at the time of its row, exactly."""
    seen = [gtsam.Pose3(T) * gtsam.Pose3.Expmap(velocity * lag) for lag in lags]
    in_camera = np.array([pose.transformTo(point) for pose, point in zip(seen, points, strict=True)])
    return in_camera[:, :2] / in_camera[:, 2:]


# -- point_pose -----------------------------------------------------------------------------------------------------


def test_a_pose_is_found_exactly_and_outliers_are_told() -> None:
    points = cloud()
    truth = gtsam.Pose3.Expmap(np.array([0.05, -0.04, 0.1, 0.1, -0.05, 0.1])).matrix()
    seen = see(points, truth, np.zeros(6), np.zeros(200))
    seen[:40] += 0.2
    found = point_pose(points, seen, np.eye(4), 500.0, np.zeros(6), np.zeros(200))
    np.testing.assert_allclose(found.T, truth, atol=1e-6)
    assert not found.inliers[:40].any() and found.inliers[40:].all()


def test_rows_that_come_late_are_seen_from_where_the_camera_is_then() -> None:
    points, truth = cloud(), gtsam.Pose3.Expmap(np.array([0.02, 0.01, 0.0, 0.05, 0.0, 0.02])).matrix()
    lags = np.linspace(-0.015, 0.015, 200)
    seen = see(points, truth, VELOCITY, lags)
    found = point_pose(points, seen, np.eye(4), 500.0, VELOCITY, lags)
    np.testing.assert_allclose(found.T, truth, atol=3e-5)  # the motion within an image is taken to first order
    ignorant = point_pose(points, seen, np.eye(4), 500.0, np.zeros(6), lags)
    assert np.abs(ignorant.T - truth).max() > 1e-4
    # `moved` turns to another time and back.
    np.testing.assert_allclose(moved(moved(points, VELOCITY, lags), -VELOCITY, lags), points, atol=1e-4)


def test_derivatives_are_those_of_the_residuals() -> None:
    points, seen = cloud(5), np.zeros((5, 2))
    _, J = module._residuals(points, points, seen, 500.0)
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-6
        both = []
        for sign in (1.0, -1.0):
            pose = gtsam.Pose3.Expmap(sign * step)
            there = np.array([pose.transformTo(point) for point in points])
            both.append(module._residuals(there, there, seen, 500.0)[0])
        np.testing.assert_allclose(J[:, :, axis], (both[0] - both[1]) / 2e-6, atol=1e-3)


def test_covariances_are_those_of_the_errors() -> None:
    """NEES over 300 draws of pixel noise of 0.5 px and velocity errors: chi-squared with 6 degrees has mean 6, and the
    mean of 300 lies within 0.6 of it in all but 0.3 % of cases. The robust weights make it a little less."""
    random = np.random.default_rng(1)
    points, lags = cloud(150), random.uniform(-0.015, 0.015, 150)
    velocity_sigma = np.repeat([0.2, 0.1], 3)
    squares: dict[str, list[float]] = {"stated": [], "without shutter": []}
    for _ in range(300):
        velocity = velocity_sigma * random.standard_normal(6)
        seen = see(points, np.eye(4), velocity, lags) + 0.5 / 500.0 * random.standard_normal((150, 2))
        found = point_pose(points, seen, np.eye(4), 500.0, np.zeros(6), lags)
        error = gtsam.Pose3.Logmap(gtsam.Pose3(found.T))
        for name, sigmas in (("stated", velocity_sigma), ("without shutter", np.zeros(6))):
            squares[name].append(error @ np.linalg.solve(found.covariance(0.5, sigmas), error))
    assert 4.6 < np.mean(squares["stated"]) < 6.6
    assert np.mean(squares["without shutter"]) > 8.0


def test_points_on_a_line_tell_no_pose() -> None:
    points = np.outer(np.linspace(1.0, 2.0, 50), [0.0, 0.0, 1.0])
    with pytest.raises(Undetermined):
        point_pose(points, np.zeros((50, 2)), np.eye(4), 500.0, np.zeros(6), np.zeros(50))


# -- on images ------------------------------------------------------------------------------------------------------


def images(count: int, readout: float) -> list[tuple[int, np.ndarray, np.ndarray]]:
    picture = plane_scene.texture()
    return [
        (k * PERIOD, *plane_scene.take(picture, plane_scene.shaking, k * PERIOD / SECOND, readout))
        for k in range(count)
    ]


def truth(count: int) -> Trajectory:
    poses = np.stack([plane_scene.shaking(k * PERIOD / SECOND).matrix() for k in range(count)])
    return Trajectory(np.arange(count) * PERIOD, poses)


def dense_truth(seconds: float) -> Trajectory:
    stamps = np.arange(int(seconds * 200)) * (SECOND // 200)
    return Trajectory(stamps, np.stack([plane_scene.shaking(t / SECOND).matrix() for t in stamps]))


def follow(frames: list[tuple[int, np.ndarray, np.ndarray]], **settings: float) -> list[Step]:
    odometry = VisualOdometry(CAMERA, VisualOdometrySettings(**settings))
    steps = [odometry.add(*frame) for frame in frames]
    return [step for step in steps if step is not None]


@pytest.fixture(scope="module")
def rolling() -> list[tuple[int, np.ndarray, np.ndarray]]:
    return images(40, 0.03)


def test_global_shutter() -> None:
    steps = follow(images(40, 0.0), readout=0.0)
    assert len(steps) == 39 and not any(step.bridged for step in steps)
    found = motion_accuracy([step.motion for step in steps], dense_truth(3.0), 1)
    assert found is not None and found.count == 39
    assert found.translation_rms < 0.004 and found.rotation_rms < 0.003
    # Stated for a real camera's errors, which a rendered image does not have: never overconfident here.
    assert found.nees < 6.0


def test_rolling_shutter_is_made_up_for(rolling: list[tuple[int, np.ndarray, np.ndarray]]) -> None:
    accuracies = {}
    for readout in (0.0, 0.03):
        steps = follow(rolling, readout=readout)
        accuracies[readout] = motion_accuracy([step.motion for step in steps], dense_truth(3.0), 1)
    assert accuracies[0.03].translation_rms < 0.6 * accuracies[0.0].translation_rms
    # What is left of it is stated: not more than 90 % + of the errors lie inside the 90 % ellipsoids, nor much fewer.
    assert accuracies[0.03].covered_90 > 0.8
    assert accuracies[0.0].covered_90 < 0.8


def test_motions_join_and_name_the_camera(rolling: list[tuple[int, np.ndarray, np.ndarray]]) -> None:
    motions = [step.motion for step in follow(rolling[:10])]
    assert [m.end for m in motions[:-1]] == [m.start for m in motions[1:]]
    for motion in motions:
        assert motion.frame_id == "camera"
        assert motion.covariance is not None and np.linalg.eigvalsh(motion.covariance)[0] > 0.0


def test_a_dark_image_is_skipped(rolling: list[tuple[int, np.ndarray, np.ndarray]]) -> None:
    frames = rolling[:12]
    frames = [*frames[:5], (frames[5][0], np.zeros_like(frames[5][1]), frames[5][2]), *frames[6:]]
    steps = follow(frames, readout=0.03)
    spanning = [step for step in steps if step.motion.end - step.motion.start == 2 * PERIOD]
    assert len(steps) == 10 and len(spanning) == 1 and not any(step.bridged for step in steps)
    expected = np.linalg.inv(truth(12).poses[4]) @ truth(12).poses[6]
    assert np.abs(spanning[0].motion.T_start_end - expected).max() < 0.03


@pytest.mark.parametrize("what", ["dark", "no depth"])
def test_lost_and_found(rolling: list[tuple[int, np.ndarray, np.ndarray]], what: str) -> None:
    frames = list(rolling[:25])
    for k in range(5, 15):
        stamp, grey, depth = frames[k]
        frames[k] = (
            (stamp, np.zeros_like(grey), depth) if what == "dark" else (stamp, grey, np.full_like(depth, np.nan))
        )
    # Corners of before can be followed without depth until a new reference is needed.
    steps = follow(frames, readout=0.03, reference_images=1 if what == "no depth" else 10)
    motions = [step.motion for step in steps]
    assert [m.end for m in motions[:-1]] == [m.start for m in motions[1:]]
    bridges = [step for step in steps if step.bridged]
    assert bridges and steps[-1].corners > 30
    for step in bridges:
        seconds = (step.motion.end - step.motion.start) / SECOND
        np.testing.assert_allclose(step.motion.covariance, np.eye(6) * seconds**2)
        first, last = (round(t / PERIOD) for t in (step.motion.start, step.motion.end))
        expected = np.linalg.inv(truth(25).poses[first]) @ truth(25).poses[last]
        error = gtsam.Pose3.Logmap(gtsam.Pose3(np.linalg.inv(expected) @ step.motion.T_start_end))
        assert np.abs(error).max() < 3.0 * seconds


def test_what_cannot_be_used_is_refused(rolling: list[tuple[int, np.ndarray, np.ndarray]]) -> None:
    odometry = VisualOdometry(CAMERA, VisualOdometrySettings())
    stamp, grey, depth = rolling[1]
    for reason, frame in (
        ("image_size", (stamp, grey[:100], depth)),
        ("depth_size", (stamp, grey, depth[:, :100])),
    ):
        with pytest.raises(InvalidMeasurement) as refused:
            odometry.add(*frame)
        assert refused.value.reason == reason
    assert odometry.add(stamp, grey, depth) is None
    for reason, frame in (("duplicate", (stamp, grey, depth)), ("time_backwards", rolling[0])):
        with pytest.raises(InvalidMeasurement) as refused:
            odometry.add(*frame)
        assert refused.value.reason == reason
    step = odometry.add(*rolling[1])  # it has begun anew at the time it jumped to
    assert step is not None and (step.motion.start, step.motion.end) == (rolling[0][0], stamp)


# -- motion_accuracy ------------------------------------------------------------------------------------------------


def test_accuracy_by_hand() -> None:
    """Three steps of 1 m along x, the truth 1.1 m; sigma 0.1 m in x, 1 in all else: each step's NEES is 1, of two
    steps 0.2^2 / 0.02 = 2, of three 0.3^2 / 0.03 = 3."""
    step = np.eye(4)
    step[0, 3] = 1.0
    covariance = np.diag([1.0, 1.0, 1.0, 0.01, 1.0, 1.0])
    motions = [RelativeMotion(k * 10_000_000, (k + 1) * 10_000_000, step, covariance) for k in range(3)]
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = 1.1 * np.arange(4)
    true = Trajectory(np.arange(4) * 10_000_000, poses)
    for steps, nees in ((1, 1.0), (2, 2.0), (3, 3.0)):
        found = motion_accuracy(motions, true, steps)
        assert found is not None and found.count == 4 - steps
        np.testing.assert_allclose([found.translation_rms, found.rotation_rms, found.nees], [0.1 * steps, 0.0, nees])
        # chi-squared with 6 degrees: half of it lies below 5.35
        assert (found.covered_50, found.covered_90) == (1.0, 1.0)
    assert motion_accuracy(motions, true, 4) is None
    # A truth of 0.1 m at each end makes a variance of 0.01 one of 0.03.
    noisy = motion_accuracy(motions, true, 1, np.full(6, 0.1))
    assert noisy is not None and noisy.nees == pytest.approx(1.0 / 3.0)


def test_noise_of_the_truth() -> None:
    random = np.random.default_rng(2)
    sigma = np.array([1e-3, 2e-3, 3e-3, 1e-4, 2e-4, 3e-4])
    stamps = np.arange(1000) * 10_000_000
    poses = [plane_scene.shaking(t / SECOND) for t in stamps]
    assert truth_noise(Trajectory(stamps, np.stack([p.matrix() for p in poses]))).max() < 1e-4
    noisy = [p * gtsam.Pose3.Expmap(sigma * random.standard_normal(6)) for p in poses]
    found = truth_noise(Trajectory(stamps, np.stack([p.matrix() for p in noisy])))
    np.testing.assert_allclose(found, sigma, rtol=0.25)
