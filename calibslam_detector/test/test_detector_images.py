"""Images in, pictures out: encodings, overlay, matching and the numbers of an evaluation, against known ones."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from calibslam_detector.evaluate_detector import (
    SUM,
    Errors,
    calibration_metrics,
    detect_all,
    errors_of_whole_objects,
    precision,
)
from calibslam_detector.images.coco_data import CocoData, ImageTruth, read_image
from calibslam_detector.images.image_conversion import ENCODINGS, decode_compressed, decode_raw, encode_jpeg
from calibslam_detector.images.overlay import class_colour, draw_overlay, ellipse_axes
from calibslam_detector.training.matching import free_of_border, match, overlaps
from calibslam_msgs_py.measurements import Boxes, InvalidMeasurement

RED = np.array([200, 30, 10], np.uint8)


def boxes_of(corners: list[list[float]], covariance: np.ndarray, scores: list[float] | None = None) -> Boxes:
    n = len(corners)
    return Boxes(
        stamp=0,
        width=100,
        height=80,
        corners=np.array(corners, float).reshape(-1, 4),
        covariances=np.tile(covariance, (n, 1, 1)),
        class_ids=("cup",) * n,
        scores=np.array(scores or [0.9] * n),
        object_ids=("",) * n,
    )


# -- encodings ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("encoding", "pixel", "expected"),
    [
        ("rgb8", [200, 30, 10], RED),
        ("bgr8", [10, 30, 200], RED),
        ("rgba8", [200, 30, 10, 0], RED),
        ("bgra8", [10, 30, 200, 7], RED),
        ("mono8", [77], [77, 77, 77]),
        ("8UC3", [10, 30, 200], RED),
        ("8UC1", [77], [77, 77, 77]),
    ],
)
def test_encodings_become_rgb(encoding: str, pixel: list[int], expected: np.ndarray) -> None:
    row = np.array(pixel * 4 + [99, 99], np.uint8)  # 4 pixels and 2 bytes that belong to none
    image = decode_raw(np.tile(row, 3), 3, 4, len(row), encoding)
    assert image.shape == (3, 4, 3) and (image == expected).all()


def test_colour_patterns_are_told_apart() -> None:
    """A red scene: only the red cells of the pattern are bright."""
    for encoding, place in {"rggb": (0, 0), "bggr": (1, 1), "gbrg": (1, 0), "grbg": (0, 1)}.items():
        cells = np.zeros((8, 8), np.uint8)
        cells[place[0] :: 2, place[1] :: 2] = 240
        image = decode_raw(cells.ravel(), 8, 8, 8, f"bayer_{encoding}8")
        assert image[2:6, 2:6].mean(axis=(0, 1)).argmax() == 0, encoding


def test_yuv_becomes_rgb() -> None:
    grey = np.tile(np.array([128, 100], np.uint8), 8)  # u y v y: no colour
    image = decode_raw(grey, 2, 4, 8, "yuv422")
    assert (np.ptp(image.astype(int), axis=2) <= 2).all() and abs(int(image.mean()) - 98) < 4


@pytest.mark.parametrize(
    ("size", "encoding", "reason"),
    [((3, 4, 12), "16UC1", "encoding"), ((3, 4, 11), "rgb8", "image_size"), ((9, 4, 12), "rgb8", "image_size"),
     ((0, 4, 12), "rgb8", "image_size"), ((4, 3, 6), "yuv422", "image_size"), ((1, 1, 2), "yuv422_yuy2", "image_size")],
)  # fmt: skip
def test_an_image_that_is_none_is_refused(size: tuple[int, int, int], encoding: str, reason: str) -> None:
    with pytest.raises(InvalidMeasurement) as error:
        decode_raw(np.zeros(36, np.uint8), *size, encoding)
    assert error.value.reason == reason
    assert "rgb8" in str(error.value) or "pixels" in str(error.value)
    assert len(ENCODINGS) > 8


def test_files_are_decoded_or_refused() -> None:
    image = np.full((16, 24, 3), RED[::-1], np.uint8)
    decoded = decode_compressed(np.frombuffer(encode_jpeg(image, 95), np.uint8))
    assert decoded.shape == image.shape and abs(decoded.astype(int) - RED).max() < 6
    for data in (b"", b"no image", encode_jpeg(image, 95)[:20]):
        with pytest.raises(InvalidMeasurement, match="no image that can be decoded"):
            decode_compressed(np.frombuffer(data, np.uint8))


def test_images_are_as_they_are_stored(tmp_path: Path) -> None:
    """COCO's boxes and a camera's calibration are of the stored rows, whichever side EXIF calls up."""
    jpeg = encode_jpeg(np.full((16, 24, 3), RED[::-1], np.uint8), 95)
    quarter_turn = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    exif = b"Exif\0\0" + quarter_turn
    turned = jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + jpeg[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR).shape == (24, 16, 3)  # it can be seen
    (tmp_path / "turned.jpg").write_bytes(turned)
    image = read_image(tmp_path / "turned.jpg")
    assert image is not None and image.shape == (16, 24, 3)
    assert decode_compressed(np.frombuffer(turned, np.uint8)).shape == (16, 24, 3)


# -- overlay ------------------------------------------------------------------------------------------------------


def test_an_ellipse_is_two_sigma_along_the_axes_of_the_covariance() -> None:
    axes, angle = ellipse_axes(np.diag([9.0, 4.0]))
    np.testing.assert_allclose(axes, [6.0, 4.0])
    assert abs(np.sin(angle)) < 1e-12
    turned = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    axes, angle = ellipse_axes(turned @ np.diag([9.0, 4.0]) @ turned.T)
    np.testing.assert_allclose(axes, [6.0, 4.0])
    assert np.tan(angle) == pytest.approx(np.tan(0.5))


def test_overlay_draws_box_and_ellipses_and_leaves_the_image_alone() -> None:
    image = np.zeros((80, 100, 3), np.uint8)
    covariance = np.diag([9.0, 4.0, 25.0, 1.0])
    drawn = draw_overlay(image, boxes_of([[30, 30, 70, 60]], covariance))
    colour = np.array(class_colour("cup"))
    assert (image == 0).all()
    for x, y in [(50, 30), (50, 60), (30, 45), (70, 45)]:  # edges
        np.testing.assert_allclose(drawn[y, x], colour, atol=40)
    for x, y in [(24, 30), (36, 30), (30, 34), (60, 60), (80, 60), (70, 62), (70, 58)]:  # 2 sigma from the corners
        assert drawn[y, x].max() > 80, (x, y)
    assert (drawn[66:, :] == 0).all()
    without = draw_overlay(image, boxes_of([[30, 30, 70, 60]], np.full((4, 4), np.nan)))
    assert (without[60, 75:] == 0).all() and without[45, 30].any()


def test_overlay_bears_boxes_and_ellipses_beyond_the_image() -> None:
    huge = boxes_of([[-50, -900, 5000, 20], [2, 1, 99, 79]], 1e10 * np.eye(4))
    assert draw_overlay(np.zeros((80, 100, 3), np.uint8), huge).any()
    assert (draw_overlay(np.full((80, 100, 3), 7, np.uint8), boxes_of([], np.eye(4))) == 7).all()
    assert class_colour("cup") == class_colour("cup") != class_colour("book")


# -- matching and metrics -----------------------------------------------------------------------------------------


def test_overlap_of_boxes() -> None:
    a = np.array([[0.0, 0.0, 2.0, 2.0]])
    b = np.array([[1.0, 0.0, 3.0, 2.0], [0.0, 0.0, 2.0, 2.0], [5.0, 5.0, 6.0, 6.0]])
    np.testing.assert_allclose(overlaps(a, b), [[1 / 3, 1.0, 0.0]])


def test_the_best_detection_takes_the_object_and_none_is_taken_twice() -> None:
    true = np.array([[0.0, 0.0, 10.0, 10.0], [20.0, 0.0, 30.0, 10.0]])
    found = np.array([[0.0, 0.0, 10.0, 8.0], [0.0, 0.0, 10.0, 10.0], [20.0, 0.0, 30.0, 9.0], [20.0, 0.0, 30.0, 10.0]])
    detected, objects = match(found, np.array([1, 1, 1, 2]), true, np.array([1, 2]))
    # The first is the surest; the third has the wrong class.
    assert detected.tolist() == [0, 3] and objects.tolist() == [0, 1]
    assert match(np.empty((0, 4)), np.empty(0), true, np.array([1, 2]))[0].size == 0
    assert match(found, np.ones(4), np.empty((0, 4)), np.empty(0))[0].size == 0


def test_edges_on_the_border_are_found() -> None:
    free = free_of_border(np.array([[0.0, 5.0, 40.0, 80.0]]), 100, 80)
    assert free.tolist() == [[False, True, True, False]]


def truth(boxes: list[list[float]], crowd: list[bool]) -> CocoData:
    labels = np.ones(len(boxes), np.int64)
    image = ImageTruth(1, Path("1.png"), np.array(boxes), labels, np.array(crowd))
    return CocoData(Path("a.json"), ("cup",), (image,))


def test_an_image_that_the_detector_refuses_is_left_out(tmp_path: Path) -> None:
    def refuse(image: np.ndarray) -> tuple[Boxes, float]:
        raise InvalidMeasurement("image_size", str(image.shape))

    cv2.imwrite(str(tmp_path / "narrow.png"), np.zeros((500, 2, 3), np.uint8))
    image = ImageTruth(1, tmp_path / "narrow.png", np.empty((0, 4)), np.empty(0, np.int64), np.empty(0, bool))
    assert detect_all(refuse, CocoData(Path("a.json"), ("cup",), (image,))) == ([None], 0.0)


def test_precision_of_known_boxes() -> None:
    data = truth([[10, 10, 30, 30], [50, 10, 70, 30], [10, 50, 30, 70]], [False, False, True])
    perfect = boxes_of([[10, 10, 30, 30], [50, 10, 70, 30]], np.eye(4), [0.9, 0.8])
    assert precision([perfect], data) == {"map": pytest.approx(1.0), "map_50": pytest.approx(1.0)}
    # Half the objects found: precision 1 up to recall 0.5, that is at 51 of COCO's 101 recalls.
    half = perfect.select(np.array([0]))
    assert precision([half], data)["map_50"] == pytest.approx(51 / 101)
    # Overlap 16/20 = 0.8: right at thresholds 0.5 to 0.8, 7 of 10.
    narrow = boxes_of([[10, 10, 30, 26], [50, 10, 70, 26]], np.eye(4), [0.9, 0.8])
    assert precision([narrow], data)["map"] == pytest.approx(0.7)
    # What is hardly to be seen is neither wanted nor wrong.
    crowd = boxes_of([[10, 50, 30, 70], [10, 10, 30, 30], [50, 10, 70, 30]], np.eye(4), [0.95, 0.9, 0.8])
    assert precision([crowd], data)["map_50"] == pytest.approx(1.0)
    assert precision([None], data) == {"map": 0.0, "map_50": 0.0}


def test_errors_are_of_objects_wholly_inside() -> None:
    data = truth([[10, 10, 30, 30], [60, 10, 100, 30]], [False, False])
    found = boxes_of([[11, 10, 30, 28], [61, 10, 100, 30]], 2.0 * np.eye(4), [0.9, 0.4])
    sample = errors_of_whole_objects([found], data, 0.3)
    np.testing.assert_array_equal(sample.errors, [[-1.0, 0.0, 0.0, 2.0]])
    np.testing.assert_array_equal(sample.covariances, [2.0 * np.eye(4)])
    assert len(errors_of_whole_objects([found, None][:1], data, 0.95).errors) == 0


def test_metrics_of_true_covariances() -> None:
    rng = np.random.default_rng(1)
    sigma = np.exp(rng.normal(0.5, 0.5, (20_000, 4)))
    errors = sigma * rng.standard_normal(sigma.shape)
    covariances = np.einsum("ni,ij->nij", sigma**2, np.eye(4))
    honest = calibration_metrics(Errors(errors, covariances))
    # 95 % of such samples lie within 0.7 points.
    assert honest["coverage_50"] == pytest.approx(0.5, abs=0.011)
    assert honest["coverage_90"] == pytest.approx(0.9, abs=0.007)
    assert honest["ece_z"] < 0.005 and honest["ece_q"] < 0.03
    bold = calibration_metrics(Errors(errors, covariances / 4.0))
    assert bold["ece_z"] > 0.15 and bold["coverage_90"] < 0.5 and bold["nll"] > honest["nll"]
    assert bold["sharpness_px"] == pytest.approx(honest["sharpness_px"] / 2.0)
    assert calibration_metrics(Errors(errors[: SUM // 4 - 1], covariances[: SUM // 4 - 1])) == {"boxes": SUM / 4 - 1}


def test_pictures_can_be_looked_at(tmp_path: Path) -> None:
    """What JPEG makes of an overlay is still a picture of that size."""
    drawn = draw_overlay(np.full((80, 100, 3), 90, np.uint8), boxes_of([[30, 30, 70, 60]], 9.0 * np.eye(4)))
    (tmp_path / "overlay.jpg").write_bytes(encode_jpeg(drawn, 90))
    assert cv2.imread(str(tmp_path / "overlay.jpg")).shape == (80, 100, 3)
