"""Which box is of which quadric: the books of association, which the graph follows.

Boxes belong to tracks. A track is open until it is bound to a quadric; then its boxes are given to that quadric, those
so far and those to come. Single boxes may be given to another one when they are judged anew.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Iterable, Set
from dataclasses import dataclass, field

import numpy as np

from calibslam_backend.association.revision import Evidence
from calibslam_backend.geometry.box_measurement import BoxMeasurement, stacked
from calibslam_backend.graph.known import Known
from calibslam_backend.graph.object_graph import ObjectGraph
from calibslam_msgs_py.measurements import Array


@dataclass
class Frame:
    """The boxes of a keyframe.

    Attributes:
        boxes: what was measured.
        tracks: that they belong to.
        classes: that they carry.
        names: their true identities, "" where unknown.
        quadrics: that they are given to; None: none so far.
    """

    boxes: list[BoxMeasurement]
    tracks: list[int]
    classes: tuple[str, ...]
    names: tuple[str, ...]
    quadrics: list[int | None]

    @functools.cached_property
    def arrays(self) -> list[Array]:
        """(N, ...) corners, covariances, bounds and clip of the boxes."""
        corners, _, bounds, clip = stacked(self.boxes)
        return [corners, np.stack([box.covariance for box in self.boxes]), bounds, clip]


@dataclass
class Candidate:
    """What is known of a track.

    Attributes:
        seen: its boxes, (keyframe, row).
        classes: of its boxes in all images.
        quadric: that it is bound to; None: it is open.
        misfits: boxes in a row that missed that quadric.
        evidence: whose its boxes are, judged anew.
    """

    seen: list[tuple[int, int]] = field(default_factory=list)
    classes: Counter[str] = field(default_factory=Counter)
    quadric: int | None = None
    misfits: int = 0
    evidence: Evidence = field(default_factory=Evidence)

    @property
    def class_id(self) -> str:
        """The class most of its boxes carry."""
        return self.classes.most_common(1)[0][0]


class Assignments:
    """Boxes, their tracks and their quadrics.

    Attributes:
        graph: gets quadrics and boxes.
        frames: the boxes of every keyframe and what became of them.
        tracks: by number.
        classes: for each quadric, how many of its boxes have which class.
        known: quadrics of a loaded map.
        same: pairs (quadric, older one) that were found to be one object, to be united.
    """

    # Keyframes after which a quadric has settled; before, it may turn out to be one that was known already.
    YOUNG = 30

    def __init__(self, graph: ObjectGraph) -> None:
        self.graph = graph
        self.frames: list[Frame] = []
        self.tracks: dict[int, Candidate] = {}
        self.classes: dict[int, Counter[str]] = {}
        self.known: set[int] = set()
        self.same: list[tuple[int, int]] = []
        self._next_quadric = 0

    # -- tracks and quadrics ------------------------------------------------------------------------------------

    def see(self, tracks: Iterable[int], class_ids: Iterable[str]) -> None:
        """The tracks of an image and the classes of their boxes."""
        for track, class_id in zip(tracks, class_ids, strict=True):
            self.tracks.setdefault(track, Candidate()).classes[class_id] += 1

    def know(self, j: int, known: Known, classes: Counter[str]) -> None:
        """A quadric of a loaded map."""
        self.graph.add_known_quadric(j, known)
        self.known.add(j)
        self.classes[j] = classes
        self._next_quadric = max(self._next_quadric, j + 1)

    def begin(self, vector: Array) -> int:
        """A new quadric (9,); returns its id."""
        j = self._next_quadric
        self._next_quadric += 1
        self.graph.add_quadric(j, vector)
        self.classes[j] = Counter()
        return j

    def age(self, j: int) -> int:
        """Keyframes since a quadric was begun."""
        return len(self.frames) - 1 - self.graph.landmarks[j].born

    def class_of_quadric(self, j: int) -> str:
        """The class most of its boxes carry."""
        return self.classes[j].most_common(1)[0][0]

    def class_of_track(self, track: int) -> str:
        """The class most boxes of a track, or of the quadric it is bound to, carry."""
        candidate = self.tracks[track]
        return candidate.class_id if candidate.quadric is None else self.class_of_quadric(candidate.quadric)

    def bound(self, frame: Frame) -> list[tuple[int, BoxMeasurement]]:
        """The boxes of bound tracks, each with its quadric."""
        quadrics = [self.tracks[track].quadric for track in frame.tracks]
        return [(j, box) for j, box in zip(quadrics, frame.boxes, strict=True) if j is not None]

    def boxes_of_object(self, track: int) -> list[BoxMeasurement]:
        """Those of the quadric that a track is bound to, or its own as long as it is open."""
        candidate = self.tracks[track]
        if candidate.quadric is None:
            return [self.frames[k].boxes[n] for k, n in candidate.seen]
        return list(self.graph.landmarks[candidate.quadric].boxes.values())

    def open_rows(self, candidate: Candidate) -> list[tuple[int, int]]:
        """Boxes of a track, (keyframe, row), that are given to no quadric."""
        return [(k, n) for k, n in candidate.seen if self.frames[k].quadrics[n] is None]

    def seen_apart(self, candidate: Candidate, j: int) -> bool:
        """Whether images show both the track and the quadric, as two boxes."""
        return _apart({k for k, _ in self.open_rows(candidate)}, self.graph.landmarks[j].boxes.keys())

    def seen_beside(self, j: int, other: int) -> bool:
        """Whether images show both quadrics, as two boxes."""
        return _apart(*(self.graph.landmarks[i].boxes.keys() for i in (j, other)))

    # -- boxes --------------------------------------------------------------------------------------------------

    def give(self, k: int, n: int, j: int) -> bool:
        """Box n of keyframe k is of quadric j; False if that has another box there."""
        frame = self.frames[k]
        if k in self.graph.landmarks[j].boxes:
            return False
        frame.quadrics[n] = j
        self.graph.add_box(k, j, frame.boxes[n])
        self.classes[j][frame.classes[n]] += 1
        return True

    def take(self, k: int, n: int) -> None:
        """Box n of keyframe k is open again."""
        frame = self.frames[k]
        j = frame.quadrics[n]
        if j is not None:
            frame.quadrics[n] = None
            self.graph.remove_box(k, j)
            self.classes[j][frame.classes[n]] -= 1

    def row(self, k: int, j: int) -> int:
        """Of the box of quadric j in keyframe k."""
        return self.frames[k].quadrics.index(j)

    # -- bindings -----------------------------------------------------------------------------------------------

    def bind(self, track: int, j: int) -> None:
        """The track's boxes are of this quadric: those that are open and those to come."""
        candidate = self.tracks[track]
        for k, n in self.open_rows(candidate):
            self.give(k, n, j)
        candidate.quadric, candidate.misfits = j, 0

    def move(self, tracks: dict[int, int]) -> None:
        """These tracks are of other quadrics than they were bound to: all of their boxes go there, at once, since one
        may have to make room for the next."""
        for track in tracks:
            for k, n in self.tracks[track].seen:
                self.take(k, n)
        for track, j in tracks.items():
            self.bind(track, j)

    def rebind(self, track: int, least: int) -> None:
        """The track belongs to the quadric that most of its boxes are given to, if they are so many at least."""
        candidate = self.tracks[track]
        given = Counter(j for k, n in candidate.seen if (j := self.frames[k].quadrics[n]) is not None)
        if given:
            j, number = given.most_common(1)[0]
            if number >= least and 2 * number > len(candidate.seen):
                candidate.quadric = j

    def unite(self, j: int, target: int) -> None:
        """Quadric j is the same object as another, which gets its boxes."""
        for k in list(self.graph.landmarks[j].boxes):
            n = self.row(k, j)
            self.take(k, n)
            self.give(k, n, target)
        for candidate in self.tracks.values():
            if candidate.quadric == j:
                candidate.quadric = target
        self.graph.remove_quadric(j)
        del self.classes[j]

    def dissolve(self, j: int, others: dict[int, int | None], least: int) -> None:
        """Quadric j is no object: by keyframe, its boxes go to these others; `least` as in `rebind`."""
        tracks = set()
        for k, other in others.items():
            n = self.row(k, j)
            tracks.add(self.frames[k].tracks[n])
            self.take(k, n)
            if other is not None:
                self.give(k, n, other)
        self.graph.remove_quadric(j)
        self.forget(j)
        for track in sorted(tracks):
            self.rebind(track, least)

    def forget(self, j: int) -> None:
        """A quadric is no more in the graph: its boxes and tracks are open again."""
        del self.classes[j]
        for frame in self.frames:
            frame.quadrics = [None if quadric == j else quadric for quadric in frame.quadrics]
        for candidate in self.tracks.values():
            if candidate.quadric == j:
                candidate.quadric = None


def _apart(a: Set[int], b: Set[int]) -> bool:
    """Whether two objects share more than a tenth of the keyframes of the shorter: then they are two."""
    return len(a & b) > 0.1 * min(len(a), len(b))
