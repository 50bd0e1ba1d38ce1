"""Images that wait for odometry: what comes out depends on what was measured, not on when it arrived."""

from __future__ import annotations

from bisect import insort

from calibslam_msgs_py.measurements import Boxes, Camera, InvalidMeasurement


class WaitingImages:
    """The boxes of images in the order of time, each until odometry has reached it."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._images: list[Boxes] = []

    def __len__(self) -> int:
        return len(self._images)

    def add(self, boxes: Boxes, newest_used: int | None) -> None:
        """Boxes of an image that is later than the newest one that was used [ns]; None: none was.

        Raises:
            InvalidMeasurement: "image_size", "late" or "duplicate"; nothing is changed.
        """
        if (boxes.width, boxes.height) != (self._camera.width, self._camera.height):
            raise InvalidMeasurement(
                "image_size",
                f"boxes of a {boxes.width}x{boxes.height} image, but the camera's is "
                f"{self._camera.width}x{self._camera.height}: do detector and camera_info belong together?",
            )
        if newest_used is not None and boxes.stamp <= newest_used:
            reason = "duplicate" if boxes.stamp == newest_used else "late"
            raise InvalidMeasurement(reason, f"boxes of {boxes.stamp} ns after those of {newest_used} ns")
        if any(image.stamp == boxes.stamp for image in self._images):
            raise InvalidMeasurement("duplicate", f"boxes of {boxes.stamp} ns came twice")
        insort(self._images, boxes, key=lambda image: image.stamp)

    def take(self, until: int) -> Boxes | None:
        """The earliest, if it is not later than this time [ns]."""
        return self._images.pop(0) if self._images and self._images[0].stamp <= until else None

    def limit(self, most: int) -> int:
        """Leave out the latest beyond so many; returns how many."""
        dropped = max(len(self._images) - most, 0)
        del self._images[most:]
        return dropped
