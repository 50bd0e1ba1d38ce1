"""Images as cameras publish them -> RGB or depth in metres, whatever the encoding; without ROS."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from calibslam_msgs_py.measurements import InvalidMeasurement

# Encodings of sensor_msgs/Image with 8 bits per channel: channels, and how OpenCV makes RGB of them.
ENCODINGS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
}

# Encodings of depth (REP 118): type of a pixel, and metres per unit.
DEPTH_ENCODINGS: dict[str, tuple[str, float]] = {
    "16UC1": ("u2", 0.001),
    "mono16": ("u2", 0.001),
    "32FC1": ("f4", 1.0),
}
# What compressed_depth_image_transport writes before the PNG: the format and the two numbers of its quantisation.
COMPRESSED_DEPTH_HEADER = 12  # bytes
# Colour, and the rows as the camera wrote them: boxes and calibration are of these, whichever side EXIF calls up.
AS_STORED = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
OVERLAY_QUALITY = 85  # of JPEG


def decode_raw(data: np.ndarray, height: int, width: int, step: int, encoding: str) -> np.ndarray:
    """(H, W, 3) uint8 RGB of the bytes of a sensor_msgs/Image.

    Raises:
        InvalidMeasurement: an encoding that is not of 8-bit colour or grey, or a size that does not fit the data or the
            encoding.
    """
    if encoding not in ENCODINGS:
        raise InvalidMeasurement("encoding", f"image encoding '{encoding}'; known: {', '.join(ENCODINGS)}")
    channels, conversion = ENCODINGS[encoding]
    if height < 1 or width < 1 or step < width * channels or data.size < height * step:
        raise InvalidMeasurement(
            "image_size", f"image of {width} x {height} pixels, {step} bytes a row, in {data.size} bytes"
        )
    rows = data[: height * step].reshape(height, step)[:, : width * channels]
    pixels = np.ascontiguousarray(rows.reshape(height, width, channels) if channels > 1 else rows)
    try:
        return pixels if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion))
    except cv2.error:  # two pixels of yuv422 share their colour
        raise InvalidMeasurement(
            "image_size", f"image of {width} x {height} pixels, which is none of encoding '{encoding}'"
        ) from None


def decode_compressed(data: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 RGB of a JPEG or PNG file in memory (bytes as uint8).

    Raises:
        InvalidMeasurement: it is none, or damaged.
    """
    try:
        image = cv2.imdecode(data, AS_STORED) if data.size else None
    except cv2.error:
        image = None
    if image is None:
        raise InvalidMeasurement("corrupt_image", f"{data.size} bytes that are no image that can be decoded")
    return np.ascontiguousarray(image[..., ::-1])


def decode_depth(
    data: np.ndarray, height: int, width: int, step: int, encoding: str, is_bigendian: bool = False
) -> np.ndarray:
    """(H, W) float32 [m] of the bytes of a sensor_msgs/Image with depth; 0 or not finite where unknown (REP 118).

    Raises:
        InvalidMeasurement: an encoding that is none of depth, or a size that does not fit the data.
    """
    if encoding not in DEPTH_ENCODINGS:
        raise InvalidMeasurement(
            "depth_encoding",
            f"depth encoding '{encoding}'; known: {', '.join(DEPTH_ENCODINGS)} (16 bit: mm, 32 bit: m)",
        )
    kind, metres = DEPTH_ENCODINGS[encoding]
    pixel = np.dtype((">" if is_bigendian else "<") + kind)
    if height < 1 or width < 1 or step < width * pixel.itemsize or data.size < height * step:
        raise InvalidMeasurement(
            "depth_size", f"depth of {width} x {height} pixels, {step} bytes a row, in {data.size} bytes"
        )
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, : width * pixel.itemsize])
    return rows.view(pixel).astype(np.float32) * np.float32(metres)


def decode_compressed_depth(data: np.ndarray, image_format: str) -> np.ndarray:
    """(H, W) float32 [m] of a sensor_msgs/CompressedImage with 16-bit depth, as compressed_depth_image_transport
    writes it, or a bare PNG (bytes as uint8).

    Raises:
        InvalidMeasurement: depth of another kind, or damaged.
    """
    if image_format.startswith("32FC1"):
        raise InvalidMeasurement(
            "depth_encoding", "compressed 32FC1 depth is not supported: publish it raw, or as 16UC1"
        )
    png = data[COMPRESSED_DEPTH_HEADER:] if "compressedDepth" in image_format else data
    try:
        depth = cv2.imdecode(png, cv2.IMREAD_UNCHANGED) if png.size else None
    except cv2.error:
        depth = None
    if depth is None or depth.dtype != np.uint16 or depth.ndim != 2:
        raise InvalidMeasurement("corrupt_depth", f"{data.size} bytes that are no 16-bit PNG of depth")
    return depth.astype(np.float32) * np.float32(DEPTH_ENCODINGS["16UC1"][1])


def encode_jpeg(image: np.ndarray, quality: int) -> bytes:
    """JPEG file of an image (H, W, 3) uint8 BGR."""
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise RuntimeError("OpenCV cannot encode JPEG")
    return bytes(data)


def decode_image(message: Any) -> np.ndarray:
    """(H, W, 3) RGB of a sensor_msgs/Image or CompressedImage, of rclpy or of a bag.

    Raises:
        InvalidMeasurement: it cannot be decoded.
    """
    data = np.frombuffer(message.data, np.uint8)
    if hasattr(message, "encoding"):
        return decode_raw(data, message.height, message.width, message.step, message.encoding)
    return decode_compressed(data)
