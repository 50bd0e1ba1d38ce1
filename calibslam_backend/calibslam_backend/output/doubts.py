"""What a run gives away of its input: other units, another body or another camera break no rule and spoil the map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibslam_msgs_py.measurements import SECOND

HELP = "docs/troubleshooting.md"
# Shares. fr1_desk and fr3_office have up to 5 % of implausible motions, and 91 and 98 % of the boxes in their keyframes
# are used, in simulations all, with two images a second 83 %; with T_cw 8 %, with poses of a body 36 %.
IMPLAUSIBLE, REJECTED, USED = 0.2, 0.2, 0.5
FEW_BOXES = 50  # in keyframes; of fewer, the share says little
GAP, MANY_STEPS = 2.0, 10.0  # [s] without odometry, and how many of its usual steps, that are a gap


@dataclass(frozen=True)
class Course:
    """How a run went.

    Attributes:
        keyframes, objects: how many there are.
        boxes: in keyframes, valid ones.
        used: of these, by objects.
        valid: boxes of all images.
        rejected: what was left out, by reason.
        counts: of what else happened.
        beyond: what is wrong with boxes that go beyond the image; "" if nothing.
        motions: when the steps of odometry ended [ns].
    """

    keyframes: int
    objects: int
    boxes: int
    used: int
    valid: int
    rejected: Mapping[str, int]
    counts: Mapping[str, int]
    beyond: str
    motions: Sequence[int]


def doubts(course: Course) -> list[str]:
    """What a person should look at, the worst first, each with the next step; empty after a good run."""
    if not course.keyframes:
        return _why_nothing(course)
    found = []
    motions, implausible = course.counts.get("motions", 0), course.counts.get("odometry_implausible", 0)
    if errors := course.counts.get("errors", 0):
        found.append(f"the estimator failed {errors} times; what it worked on then is missing")
    if implausible > IMPLAUSIBLE * motions:
        found.append(
            f"{implausible} of {motions} motions are implausible: is odometry in metres, and are its poses those of "
            f"the camera in the world (T_wc), not of the world in the camera (T_cw)? {HELP}"
        )
    reasons = {name: n for name, n in course.rejected.items() if name.startswith("box_") and n}
    rejected = sum(reasons.values())
    if rejected > REJECTED * (course.valid + rejected):
        top = ", ".join(f"{n} {name.removeprefix('box_')}" for name, n in _largest(reasons))
        found.append(f"{rejected} of {course.valid + rejected} boxes are rejected ({top}): {HELP}")
    if course.beyond:
        found.append(course.beyond)
    if not course.objects and course.boxes:
        found.append(
            f"no objects, though {course.valid} boxes came: are corners in pixels and odometry in metres, does "
            f"camera_info belong to these images, and does the camera move? {HELP}"
        )
    elif course.boxes >= FEW_BOXES and course.used < USED * course.boxes:
        found.append(
            f"only {course.used} of {course.boxes} boxes in keyframes fit an object: do odometry (units, T_wc and not "
            f"T_cw, qx qy qz qw, pose of the camera and not of a body) and camera_info fit the boxes? {HELP}"
        )
    found = found[:2]
    if gap := _gap(course.motions):
        found.append(gap)
    return found


def _why_nothing(course: Course) -> list[str]:
    """Why there is no keyframe, if that can be told."""
    if not course.counts.get("motions", 0):
        return [f"odometry needs at least two poses that can be used{_left_out(course.rejected)}"]
    if not course.counts.get("images", 0):
        return [f"no image can be used{_left_out(course.rejected)}"]
    return []


def _left_out(rejected: Mapping[str, int]) -> str:
    top = ", ".join(f"{n} {name}" for name, n in _largest(rejected) if n)
    return f"; left out: {top}" if top else ""


def _largest(reasons: Mapping[str, int]) -> list[tuple[str, int]]:
    return sorted(reasons.items(), key=lambda pair: -pair[1])[:3]


def _gap(motions: Sequence[int]) -> str:
    """The longest time without odometry."""
    steps = np.diff(motions) / SECOND
    if not len(steps) or steps.max() < max(GAP, MANY_STEPS * float(np.median(steps))):
        return ""
    longest = int(steps.argmax())
    return (
        f"{steps[longest]:.1f} s without odometry at t = {motions[longest] / SECOND:.2f}: what follows may be misplaced"
    )
