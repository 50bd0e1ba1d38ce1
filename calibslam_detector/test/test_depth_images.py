"""Depth images as cameras publish them -> metres."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calibslam_detector.images.image_conversion import decode_compressed_depth, decode_depth
from calibslam_msgs_py.measurements import InvalidMeasurement

DEPTH = np.array([[0, 1000, 2500], [65535, 1, 4000]], np.uint16)  # [mm]


@pytest.mark.parametrize(
    ("kind", "encoding", "bigendian"),
    [("<u2", "16UC1", False), (">u2", "16UC1", True), ("<u2", "mono16", False), ("<f4", "32FC1", False)],
)
@pytest.mark.parametrize("padding", [0, 4])
def test_depth_is_in_metres(kind: str, encoding: str, bigendian: bool, padding: int) -> None:
    values = DEPTH.astype(kind) if "u2" in kind else (DEPTH / 1000.0).astype(kind)
    rows = np.zeros((2, values[0].nbytes + padding), np.uint8)
    rows[:, : values[0].nbytes] = values.view(np.uint8).reshape(2, -1)
    found = decode_depth(rows.ravel(), 2, 3, rows.shape[1], encoding, bigendian)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, DEPTH / 1000.0, rtol=1e-6)


def test_compressed_depth_is_in_metres() -> None:
    png = cv2.imencode(".png", DEPTH)[1]
    for data, text in ((np.r_[np.zeros(12, np.uint8), png], "16UC1; compressedDepth png"), (png, "16UC1; png")):
        np.testing.assert_allclose(decode_compressed_depth(data, text), DEPTH / 1000.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("reason", "arguments"),
    [
        ("depth_encoding", (np.zeros(100, np.uint8), 2, 3, 9, "rgb8")),
        ("depth_size", (np.zeros(100, np.uint8), 2, 3, 5, "16UC1")),
        ("depth_size", (np.zeros(11, np.uint8), 2, 3, 6, "16UC1")),
        ("depth_size", (np.zeros(0, np.uint8), 0, 0, 0, "16UC1")),
    ],
)
def test_depth_that_is_none(reason: str, arguments: tuple[np.ndarray, int, int, int, str]) -> None:
    with pytest.raises(InvalidMeasurement) as refused:
        decode_depth(*arguments)
    assert refused.value.reason == reason


@pytest.mark.parametrize(
    ("reason", "data", "text"),
    [
        ("depth_encoding", np.zeros(50, np.uint8), "32FC1; compressedDepth png"),
        ("corrupt_depth", np.zeros(50, np.uint8), "16UC1; compressedDepth png"),
        ("corrupt_depth", np.zeros(5, np.uint8), "16UC1; compressedDepth png"),
        ("corrupt_depth", cv2.imencode(".png", DEPTH.astype(np.uint8))[1], "png"),
    ],
)
def test_compressed_depth_that_is_none(reason: str, data: np.ndarray, text: str) -> None:
    with pytest.raises(InvalidMeasurement) as refused:
        decode_compressed_depth(data, text)
    assert refused.value.reason == reason
