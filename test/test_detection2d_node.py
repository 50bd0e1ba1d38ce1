"""The node for detectors that publish vision_msgs, where that package is missing."""

from __future__ import annotations

from importlib.util import find_spec

import pytest
from live import Process, random_domain

from calibslam_msgs_py.node import BAD_SETTINGS


@pytest.mark.skipif(find_spec("vision_msgs") is not None, reason="vision_msgs is installed")
def test_without_vision_msgs_it_says_what_to_install() -> None:
    with Process(random_domain(), "calibslam_detector", "detection2d") as process:
        assert process.wait() == BAD_SETTINGS
        assert "sudo apt-get install ros-jazzy-vision-msgs" in process.output
