"""A first quadric from boxes: exact where they are exact, honest about its error, silent where they do not tell."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, ttest_1samp
from small_world import CAMERA, around, looking_at, objects

from calibslam_backend.geometry import box_measurement
from calibslam_backend.geometry.box_measurement import BoxMeasurement, prepare
from calibslam_backend.geometry.ellipsoid import Ellipsoid, matrix_from_vector, vector_from_matrix
from calibslam_backend.geometry.visible_box import ALL_EDGES, box_of_visible_part, image_bounds
from calibslam_backend.objects.initialisation import (
    InitialisationSettings,
    Initialised,
    initialise,
    initialise_by_newest,
)
from calibslam_msgs_py.measurements import Array, Boxes

BOUNDS = image_bounds(CAMERA.width, CAMERA.height)
LINEAR = 1e6  # robust scale of a loss that is not robust
# A prior that hardly counts: what is tested is what the boxes say.
LOOSE = InitialisationSettings(prior_centre=1e3, prior_shape=1e2)


def measured(ellipsoid: Ellipsoid, poses: Array, sigma: float = 1.0, rng: np.random.Generator | None = None) -> list:
    boxes = []
    for pose in poses:
        visible, corners, _ = box_of_visible_part(pose, ellipsoid.vector(), CAMERA.K, BOUNDS, ALL_EDGES)
        assert visible
        clip = (corners == BOUNDS) if rng is None else np.zeros(4, bool)
        noise = sigma * rng.normal(size=4) if rng else 0.0
        boxes.append(BoxMeasurement(corners + noise, np.eye(4) / sigma, BOUNDS, np.asarray(clip)))
    return boxes


def start(poses: Array, boxes: list, settings: InitialisationSettings = LOOSE) -> Initialised | None:
    return initialise(poses, boxes, CAMERA.K, LINEAR, settings)


@pytest.mark.parametrize("index", range(9))
def test_exact_boxes_give_the_exact_ellipsoid(index: int) -> None:
    truth, poses = objects()[index], around(12)
    found = start(poses, measured(truth, poses))
    assert found is not None
    np.testing.assert_allclose(found.vector, truth.vector(), atol=2e-3)
    assert found.distances.max() < 0.01


def aside_of_every_second(poses: Array) -> Array:
    """The same views, half of them turned aside so that the image cuts the object."""
    poses = poses.copy()
    for k in range(0, len(poses), 2):
        position = poses[k, :3, 3]
        aside = np.cross(-position, [0.0, 0.0, 1.0])
        poses[k] = looking_at(position, 1.05 * aside / np.linalg.norm(aside) + [0.0, 0.0, 0.1])
    return poses


def test_boxes_cut_by_the_image_are_no_smaller_objects() -> None:
    """Half of the views show the object at the border; taking those edges as its own would shrink it."""
    truth, poses = objects()[4], aside_of_every_second(around(12))
    boxes = measured(truth, poses)
    assert sum(box.clip.any() for box in boxes) == 6
    found = start(poses, boxes)
    assert found is not None
    np.testing.assert_allclose(found.vector, truth.vector(), atol=5e-3)


def test_borders_that_are_seen_inaccurately_make_no_smaller_objects(monkeypatch: pytest.MonkeyPatch) -> None:
    """A detector draws the border that cuts an object as inaccurately as its other edges, and never beyond. The mean
    error of log sizes over 40 seeds is then nearer to 0 (paired t-test) than if only edges on the border count as such,
    whose objects are too small beyond doubt."""
    truth, poses, sigma = objects()[4], aside_of_every_second(around(12)), 4.0
    exact = np.stack([box.corners for box in measured(truth, poses)])
    names = ("",) * len(exact)

    def size_errors() -> Array:
        found = []
        for seed in range(40):
            noisy = exact + sigma * np.random.default_rng(seed).normal(size=exact.shape)
            corners = np.clip(noisy, np.tile(BOUNDS[:2], 2), np.tile(BOUNDS[2:], 2))
            covariances = np.tile(sigma**2 * np.eye(4), (len(exact), 1, 1))
            boxes = Boxes(0, CAMERA.width, CAMERA.height, corners, covariances, names, np.ones(len(exact)), names)
            result = initialise(poses, prepare(boxes, covariances, CAMERA), CAMERA.K, 2.0, LOOSE)
            if result is not None:
                found.append(np.trace(matrix_from_vector((result.vector - truth.vector())[3:])) / 3.0)
        assert len(found) == 40
        return np.array(found)

    ours = size_errors()
    monkeypatch.setattr(box_measurement, "BORDER_SIGMAS", 0.0)
    exact_only = size_errors()
    assert ttest_1samp(exact_only, 0.0, alternative="less").pvalue < 1e-6
    assert ttest_1samp(np.abs(exact_only) - np.abs(ours), 0.0, alternative="greater").pvalue < 1e-3


def test_the_prior_knows_no_direction() -> None:
    """Turning the map does not change it: Q P Q^T = P, with Q the turn of (t, L)."""
    prior, rng = InitialisationSettings().prior_covariance(), np.random.default_rng(0)
    for _ in range(10):
        R = Rotation.random(rng=rng).as_matrix()
        Q = np.zeros((9, 9))
        Q[:3, :3] = R
        for n, unit in enumerate(np.eye(6)):
            Q[3:, 3 + n] = vector_from_matrix(R @ matrix_from_vector(unit) @ R.T)
        np.testing.assert_allclose(Q @ prior @ Q.T, prior, atol=1e-9)


def test_too_few_boxes() -> None:
    truth, poses = objects()[0], around(12)
    settings = InitialisationSettings(min_boxes=6)
    assert start(poses[:5], measured(truth, poses[:5]), settings) is None
    assert start(poses[::2], measured(truth, poses[::2]), settings) is not None


def test_parallel_rays_do_not_tell_the_distance() -> None:
    truth = objects()[4]
    still = np.repeat(around(1), 10, axis=0)
    still[:, :3, 3] += np.random.default_rng(0).normal(0.0, 1e-4, size=(10, 3))
    assert initialise(still, measured(truth, still), CAMERA.K, 2.0, InitialisationSettings()) is None


def test_an_object_behind_the_camera_is_none() -> None:
    """Boxes that move the wrong way while the camera moves aside: their rays meet behind it."""
    truth, first = objects()[4], around(1)[0]
    poses = np.repeat(first[None], 12, axis=0)
    aside = np.linspace(-0.3, 0.3, 12)
    poses[:, :3, 3] += aside[:, None] * first[:3, 0]
    boxes = measured(truth, poses)
    # Seen from one side only, its depth is known by the prior on its shape.
    assert start(poses, boxes, InitialisationSettings()) is not None
    assert start(poses[::-1].copy(), boxes, InitialisationSettings()) is None


@pytest.mark.parametrize("seed", range(5))
def test_poses_that_drift_contradict_all_boxes_of_an_object_but_not_the_newest(seed: int) -> None:
    """Motions with errors of 0.3 deg, 40 times: the newest boxes show where the object is from where the camera is."""
    rng = np.random.default_rng(seed)
    truth, poses = objects()[4], around(40, turn=3.0)
    boxes = measured(truth, poses, 2.0, rng)
    believed = [poses[0]]
    for before, now in pairwise(poses):
        error = np.eye(4)
        error[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, np.radians(0.3), 3)).as_matrix()
        believed.append(believed[-1] @ np.linalg.inv(before) @ now @ error)
    drifted, settings = np.stack(believed), InitialisationSettings()
    assert initialise(drifted, boxes, CAMERA.K, 2.0, settings) is None
    found = initialise_by_newest(drifted, boxes, CAMERA.K, 2.0, settings)
    assert found is not None
    seen = np.linalg.inv(drifted[-1]) @ np.append(found.vector[:3], 1.0)
    true = np.linalg.inv(poses[-1]) @ np.append(truth.vector()[:3], 1.0)
    assert np.linalg.norm(seen - true) < 0.15 * np.linalg.norm(true[:3])


def test_boxes_of_two_objects_are_refused() -> None:
    first, second, poses = objects()[0], objects()[8], around(12)
    mixed = [(a, b)[k % 2] for k, (a, b) in
             enumerate(zip(measured(first, poses), measured(second, poses), strict=True))]  # fmt: skip
    assert initialise(poses, mixed, CAMERA.K, 2.0, InitialisationSettings()) is None


def test_more_boxes_than_wanted_are_thinned() -> None:
    truth, poses = objects()[1], around(60)
    found = start(poses, measured(truth, poses), InitialisationSettings(max_boxes=10))
    assert found is not None and len(found.distances) == 10


def test_one_gross_box_does_no_harm() -> None:
    truth, poses = objects()[2], around(15)
    boxes = measured(truth, poses)
    boxes[7] = BoxMeasurement(boxes[7].corners + 150.0, boxes[7].whitener, BOUNDS, boxes[7].clip)
    robust = initialise(poses, boxes, CAMERA.K, 2.0, LOOSE)
    assert robust is not None
    np.testing.assert_allclose(robust.vector, truth.vector(), atol=0.02)
    linear = initialise(poses, boxes, CAMERA.K, LINEAR, InitialisationSettings(max_residual=1e3))
    assert linear is None or np.abs(linear.vector - truth.vector()).max() > 0.05


def test_covariance_is_honest() -> None:
    """Mean NEES of the 9-vector over 200 noisy objects lies in its 99.9 % interval, and so does its coverage.

    With the right covariance the sum of 200 squared distances is chi-squared with 1,800 degrees of freedom, if
    the model is linear within the noise (1 px on boxes of 60 px and more).
    """
    rng = np.random.default_rng(4)
    poses, squared = around(25), []
    for n in range(200):
        truth = objects()[n % 9]
        found = start(poses, measured(truth, poses, 1.0, rng))
        assert found is not None
        error = found.vector - truth.vector()
        squared.append(error @ np.linalg.solve(found.covariance, error))
    low, high = chi2.ppf([0.0005, 0.9995], 9 * 200) / 200
    assert low < np.mean(squared) < high
    inside = np.mean(np.array(squared) < chi2.ppf(0.9, 9))
    assert 0.83 < inside < 0.96  # 0.9 +- 3.3 standard deviations of a share of 200
