"""Reference boxes without labels: the errors they show are those that were made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_bag import messages, write
from small_world import CAMERA, SmallWorld, around, objects

from calibslam_backend.output.metrics import Trajectory
from calibslam_backend.reference_boxes import NONE, Referenced, ReferenceSettings, of_recording, reference
from calibslam_msgs_py.bags import BagError
from calibslam_msgs_py.measurements import SECOND, Array, Boxes

SIGMA = 2.0
WORLD = SmallWorld(around(240), objects(), box_sigma=SIGMA)
SETTINGS = ReferenceSettings()


def unlabelled(images: list[Boxes]) -> list[Boxes]:
    return [replace(image, object_ids=("",) * len(image)) for image in images]


def errors_of(found: list[Referenced]) -> Array:
    errors = np.concatenate([image.errors for image in found])
    return errors[np.isfinite(errors)]


def identities(found: list[Referenced], labelled: list[Boxes]) -> list[tuple[int, str]]:
    """Number and true identity of every box that has a reference."""
    true = {image.stamp: image.object_ids for image in labelled}
    pairs = [pair for image in found for pair in zip(image.objects.tolist(), true[image.boxes.stamp], strict=True)]
    return [pair for pair in pairs if pair[0] != NONE]


def test_errors_are_those_of_the_boxes() -> None:
    labelled = WORLD.boxes()
    found = reference(unlabelled(labelled), CAMERA, WORLD.truth(), SETTINGS)
    errors = errors_of(found)
    assert len(errors) > 3000
    # Nine parameters per quadric take a little of the scatter of 240 boxes with four edges each: 1 %.
    assert errors.std() == pytest.approx(SIGMA, rel=0.05)
    assert abs(errors.mean()) < 0.1


def test_tracks_of_one_object_are_united() -> None:
    """Nothing is seen for a second in the middle: longer than a track lasts."""
    labelled = [image for k, image in enumerate(WORLD.boxes()) if not 100 <= k < 130]
    pairs = identities(reference(unlabelled(labelled), CAMERA, WORLD.truth(), SETTINGS), labelled)
    assert len(pairs) > 0.9 * sum(map(len, labelled))
    assert len(set(pairs)) == len({number for number, _ in pairs}) == len({name for _, name in pairs}) == 9


def test_gross_errors_stay_visible_and_spoil_nothing() -> None:
    rng = np.random.default_rng(1)
    images = unlabelled(WORLD.boxes())
    for image in images:
        gross = rng.random(len(image)) < 0.1
        image.corners[gross, 2] += 40.0
    images = [replace(image, corners=np.clip(image.corners, 0, [640, 480, 640, 480])) for image in images]
    errors = errors_of(reference(images, CAMERA, WORLD.truth(), SETTINGS))
    assert 1.4826 * np.median(np.abs(errors)) == pytest.approx(SIGMA, rel=0.1)
    assert np.mean(errors > 30.0) == pytest.approx(0.1 / 4, abs=0.01)


def test_edges_at_the_border_have_no_reference() -> None:
    found = reference(unlabelled(WORLD.boxes()), CAMERA, WORLD.truth(), SETTINGS)
    for image in found:
        at_border = np.concatenate([image.boxes.corners[:, :2] <= 0, image.boxes.corners[:, 2:] >= [640, 480]], axis=1)
        assert np.isnan(image.errors[at_border]).all()


def test_a_recording_is_read(tmp_path: Path) -> None:
    found = of_recording(write(tmp_path / "bag", messages()))
    assert len(found) == 110
    assert errors_of(found).std() == pytest.approx(1.5, rel=0.1)


def test_without_ground_truth_there_is_no_reference(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag", (m for m in messages() if m[0] != "/ground_truth"))
    with pytest.raises(BagError, match="no ground truth"):
        of_recording(bag)


def test_ground_truth_of_another_time_is_refused() -> None:
    truth = Trajectory(WORLD.truth().stamps + 1000 * SECOND, WORLD.poses)
    with pytest.raises(BagError, match="do their clocks agree"):
        reference(unlabelled(WORLD.boxes()), CAMERA, truth, SETTINGS)


def test_boxes_of_another_camera_are_refused() -> None:
    with pytest.raises(BagError, match="640x480 image, but the camera's is 320x240"):
        reference(unlabelled(WORLD.boxes()), replace(CAMERA, width=320, height=240), WORLD.truth(), SETTINGS)
