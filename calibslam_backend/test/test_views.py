"""The views of RViz and Foxglove: they show topics that exist, with the types and the QoS they are published with."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from calibslam_backend.output.published import MAP, MARKERS, POSE, QUADRICS, TOPICS, TRAJECTORY

PACKAGE = Path(__file__).resolve().parents[1]
OVERLAY, DIAGNOSTICS, INITIAL_POSE = "detector/overlay/compressed", "diagnostics", "initialpose"
DISPLAYED = {  # RViz: message type of a display
    "rviz_default_plugins/Path": "nav_msgs/msg/Path",
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
    "rviz_default_plugins/PoseWithCovariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
}


def test_rviz() -> None:
    manager = yaml.safe_load((PACKAGE / "rviz" / "calibslam.rviz").read_text())["Visualization Manager"]
    assert manager["Global Options"]["Fixed Frame"] == MAP
    shown = {}
    for display in manager["Displays"]:
        assert display["Class"].startswith("rviz_default_plugins/") and display["Enabled"]
        if display["Class"] in DISPLAYED:
            topic = display["Topic"]
            shown[topic["Value"]] = DISPLAYED[display["Class"]]
            # As published: the last map also for who joins late.
            assert (topic["Durability Policy"], topic["Reliability Policy"]) == ("Transient Local", "Reliable")
        elif "Topic" in display:
            assert (display["Topic"]["Value"], display["Topic"]["Reliability Policy"]) == (OVERLAY, "Best Effort")
    assert shown == {topic: TOPICS[topic] for topic in (TRAJECTORY, MARKERS, POSE)}
    (initial,) = [tool for tool in manager["Tools"] if tool["Class"].endswith("SetInitialPose")]
    assert initial["Topic"]["Value"] == INITIAL_POSE


def panels(layout: Any) -> Iterator[str]:
    if isinstance(layout, str):
        yield layout
        return
    assert layout["direction"] in ("row", "column") and 0 < layout["splitPercentage"] < 100
    yield from panels(layout["first"])
    yield from panels(layout["second"])


def test_foxglove() -> None:
    layout = json.loads((PACKAGE / "foxglove" / "calibslam.json").read_text())
    configs = layout["configById"]
    assert sorted(panels(layout["layout"])) == sorted(configs)
    scene = configs["3D!map"]
    assert scene["followTf"] == MAP
    assert {topic for topic, shown in scene["topics"].items() if shown["visible"]} == {
        f"/{topic}" for topic in (TRAJECTORY, MARKERS, POSE)
    }
    assert configs["Image!boxes"]["imageMode"]["imageTopic"] == f"/{OVERLAY}"
    assert {path["value"].split(".")[0] for path in configs["Plot!position"]["paths"]} == {f"/{POSE}"}
    assert configs["RawMessages!objects"]["topicPath"].split(".") == [f"/{QUADRICS}", "quadrics"]
    assert configs["DiagnosticSummary!nodes"]["topicToRender"] == f"/{DIAGNOSTICS}"
