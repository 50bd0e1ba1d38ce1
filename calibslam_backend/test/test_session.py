"""A live session: after it was killed, another one ends where it would have ended; what cannot be used is counted."""

from __future__ import annotations

import json
import pickle
import threading
import weakref
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest
from small_world import CAMERA, SmallWorld, around, objects

from calibslam_backend.estimator import EstimatorSettings
from calibslam_backend.graph.known import NOTHING_KNOWN
from calibslam_backend.output.metrics import Trajectory, ate
from calibslam_backend.output.object_map import ObjectMap
from calibslam_backend.ros.diagnostics import state
from calibslam_backend.ros.map_services_node import MapServices
from calibslam_backend.session.intake import Event, Kind
from calibslam_backend.session.journal import Journal, Record
from calibslam_backend.session.session import NotReady, Session
from calibslam_backend.session.settings import SessionSettings
from calibslam_msgs_py.measurements import Array, Boxes, InvalidMeasurement, RelativeMotion, StampedPose

WORLD = SmallWorld(around(120), objects())
NEVER = SessionSettings(refine_after=1e6)
KINDS = {Boxes: Kind.BOXES, RelativeMotion: Kind.MOTION, StampedPose: Kind.START}


def event(content: Boxes | RelativeMotion | StampedPose) -> Event:
    return Event(KINDS[type(content)], content, pickle.dumps(content), 1.0)


CAMERA_EVENT = Event(Kind.CAMERA, CAMERA, pickle.dumps(CAMERA))


def decode(record: Record) -> Event:
    if record.kind == 99:
        raise ValueError("a record of tomorrow")
    content = pickle.loads(record.payload) if record.payload else None
    return Event(Kind(record.kind), content, record.payload)


class Live(Session):
    """A session that is used by one thread, and what it reported."""

    def __init__(self, journal: Path | None = None, settings: SessionSettings = NEVER) -> None:
        self.counts: Counter[str] = Counter()
        self.said: list[str] = []
        opened = Journal(journal) if journal else None
        super().__init__(np.eye(4), settings, EstimatorSettings(), self, opened)
        for _ in self.resume(decode):
            pass

    def count(self, name: str, by: int = 1) -> None:
        self.counts[name] += by

    def reject(self, error: InvalidMeasurement, count: int = 1) -> None:
        self.counts[f"rejected_{error.reason}"] += count

    def say(self, text: str) -> None:
        self.said.append(text)

    def use(self, measurements: Sequence[Boxes | RelativeMotion | StampedPose]) -> Live:
        for measurement in measurements:
            self.intake.offer(event(measurement))
        while len(self.intake):
            self.step(0.0)
        return self

    def trajectory(self) -> Array:
        assert self.estimator is not None
        return self.estimator.trajectory()

    def error(self, world: SmallWorld = WORLD) -> float:
        assert self.estimator is not None
        return ate(Trajectory(np.array(self.estimator.stamps), self.trajectory()), world.truth())


def live(journal: Path | None = None, settings: SessionSettings = NEVER) -> Live:
    session = Live(journal, settings)
    session.offer_camera(CAMERA_EVENT)
    session.step(0.0)
    return session


MEASUREMENTS = list(WORLD.measurements())


@pytest.mark.parametrize("moments", [[60], [1, 2, 130, 131, 200]])
def test_a_killed_session_is_gone_on_with(tmp_path: Path, moments: list[int]) -> None:
    """The same numbers, to the last bit, as without interruption, although much is sent twice."""
    undisturbed = live().use(MEASUREMENTS[:100])
    undisturbed._refine()
    undisturbed.use(MEASUREMENTS[100:])
    done, sessions = 0, []
    for moment in [*moments, len(MEASUREMENTS)]:
        session = live(tmp_path / "journal")
        sessions.append(session)
        for begin, end in ((max(done - 30, 0), min(moment, 100)), (max(done - 30, 100), moment)):
            if begin < end:
                session.use(MEASUREMENTS[begin:end])
            if moment > 100 > done and end == 100:
                session._refine()
        done = moment
        assert session.intake.journal is not None
        session.intake.journal.close()  # as the end of its process does
    assert (session.trajectory() == undisturbed.trajectory()).all()
    assert session.counts["keyframes"] == undisturbed.counts["keyframes"] > 15
    assert session.counts["rejected_repeated"] > 0
    assert not session.counts["errors"] and session.error() < 0.05


def test_refinements_are_in_the_journal(tmp_path: Path) -> None:
    """A rest refines, and what is in the journal says so."""
    first = live(tmp_path / "journal", SessionSettings(refine_after=0.1)).use(MEASUREMENTS)
    first._used -= 1.0  # a second ago
    first.step(0.0)
    assert first.refined
    assert first.intake.journal is not None
    first.intake.journal.close()
    assert (live(tmp_path / "journal").trajectory() == first.trajectory()).all()


def test_who_outlives_the_journal_writes_into_no_other_file(tmp_path: Path) -> None:
    """The worker is not waited for forever, and the number of the journal's file is given to the next file."""
    session = live(tmp_path / "journal").use(MEASUREMENTS[:40])
    size = (tmp_path / "journal").stat().st_size
    session.intake.close()
    with (tmp_path / "map.json").open("w"):
        session._refine()
        session.intake.write(CAMERA_EVENT)
    assert (tmp_path / "map.json").stat().st_size == 0
    assert (tmp_path / "journal").stat().st_size == size
    assert not session.counts["errors_journal"]


def test_reading_a_journal_can_be_ended_at_each_record(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal")
    for _ in range(3):
        journal.append(Record(99, b"?"))
    journal.close()
    session = Session(np.eye(4), NEVER, EstimatorSettings(), live(), Journal(tmp_path / "journal"))
    assert len(list(session.resume(decode))) == 3


def test_unreadable_records_are_counted(tmp_path: Path) -> None:
    session = live(tmp_path / "journal").use(MEASUREMENTS[:10])
    assert session.intake.journal is not None
    session.intake.journal.append(Record(99, b"?"))
    session.use(MEASUREMENTS[10:40])
    session.intake.journal.close()
    again = live(tmp_path / "journal")
    assert again.counts["errors_journal"] == 1 and "a record of tomorrow" in again.said[0]
    assert (again.trajectory() == session.trajectory()).all()


def test_loaded_maps_and_resets_are_in_the_journal(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    first = live(path).use(MEASUREMENTS)
    first.save(tmp_path / "map.json")
    assert first.estimator is not None and first.intake.journal is not None
    known = first.estimator.object_map()
    size = path.stat().st_size
    first.reset()
    assert path.stat().st_size < 0.01 * size
    first.use(MEASUREMENTS[:20])
    first.load(known)
    first.intake.journal.close()

    def decode_map(record: Record) -> Event:
        if record.kind == Kind.MAP:
            return Event(Kind.MAP, type(known).from_json(record.payload.decode(), "journal"), record.payload)
        return decode(record)

    journal = Journal(path)
    again = Session(np.eye(4), NEVER, EstimatorSettings(), first, journal)
    for _ in again.resume(decode_map):
        pass
    assert again.estimator is not None
    assert (again.estimator.objects, again.estimator.stamps) == (len(known.quadrics), [])
    assert state(again) == "looking for the camera in the map"


def same_id(known: ObjectMap) -> ObjectMap:
    return replace(known, quadrics=(*known.quadrics, known.quadrics[0]))


def no_covariance(known: ObjectMap) -> ObjectMap:
    return replace(known, quadrics=(replace(known.quadrics[0], covariance=-0.01 * np.eye(9)),), prior=NOTHING_KNOWN)


@pytest.mark.parametrize("damage", [same_id, no_covariance])
def test_a_map_that_cannot_be_used_leaves_the_one_there_is(
    damage: Callable[[ObjectMap], ObjectMap], tmp_path: Path
) -> None:
    session = live(tmp_path / "journal").use(MEASUREMENTS[:60])
    assert session.estimator is not None
    before, quadrics, size = session.trajectory(), session.estimator.quadrics(), (tmp_path / "journal").stat().st_size
    with pytest.raises(ValueError):
        session.load(damage(session.estimator.object_map()))
    assert (session.trajectory() == before).all() and len(before) > 5
    assert [q.id for q in session.estimator.quadrics()] == [q.id for q in quadrics] != []
    assert (tmp_path / "journal").stat().st_size == size


class NoNode:
    """Takes services, and offers them to nobody."""

    def create_service(self, *_: object) -> None:
        pass


def refused(session: Session, folder: Path) -> str:
    """The answer of the service `load_map` to a file that it does not load."""
    services = MapServices(NoNode(), session, folder, "found")  # type: ignore[arg-type]
    response = services._load(SimpleNamespace(path="map.json"), SimpleNamespace(success=None, message=""))
    assert response.success is False
    return str(response.message)


def test_the_service_tells_what_is_wrong_with_a_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session = live().use(MEASUREMENTS[:60])
    assert session.estimator is not None
    count = session.estimator.objects
    session.estimator.object_map().save(tmp_path / "map.json")
    content = json.loads((tmp_path / "map.json").read_text())
    content["quadrics"] *= 2
    (tmp_path / "map.json").write_text(json.dumps(content))
    assert "is there 2 times" in refused(session, tmp_path)

    def no_memory(path: Path) -> ObjectMap:
        raise MemoryError("too large")

    monkeypatch.setattr(ObjectMap, "load", no_memory)
    assert refused(session, tmp_path) == "map.json cannot be loaded: MemoryError: too large"
    assert session.estimator.objects == count and len(session.estimator.stamps) > 5


def test_nothing_is_done_while_the_journal_is_read(tmp_path: Path) -> None:
    first = live(tmp_path / "journal").use(MEASUREMENTS[:10])
    assert first.intake.journal is not None
    first.intake.journal.close()
    second = Session(np.eye(4), NEVER, EstimatorSettings(), first, Journal(tmp_path / "journal"))
    steps = second.resume(decode)
    next(steps)
    assert state(second).startswith("reading the journal")
    for call in (second.reset, lambda: second.save(tmp_path / "map.json")):
        with pytest.raises(NotReady, match="still being read"):
            call()


def test_what_comes_does_not_wait_for_the_estimator() -> None:
    session = Live()

    def take_in() -> None:
        session.offer_camera(CAMERA_EVENT)
        session.intake.offer(event(MEASUREMENTS[0]))

    taking_in = threading.Thread(target=take_in, daemon=True)
    with session.lock:  # as during an update
        taking_in.start()
        taking_in.join(timeout=10.0)
        assert not taking_in.is_alive() and len(session.intake) == 1
    session.step(0.0)
    assert session.camera is CAMERA


def test_another_camera_that_came_while_the_journal_was_read(tmp_path: Path) -> None:
    first = live(tmp_path / "journal").use(MEASUREMENTS[:10])
    first.intake.close()
    second = Session(np.eye(4), NEVER, EstimatorSettings(), first, Journal(tmp_path / "journal"))
    steps = second.resume(decode)
    other = Event(Kind.CAMERA, replace(CAMERA, K=np.diag([1.1, 1.1, 1.0]) @ CAMERA.K))
    assert not second.offer_camera(other)  # the journal's may be the same
    assert first.counts["rejected_camera_changed"] == 0
    for _ in steps:
        pass
    assert first.counts["rejected_camera_changed"] == 1
    with pytest.raises(InvalidMeasurement, match="camera_info changed"):
        second.offer_camera(other)
    assert second.offer_camera(CAMERA_EVENT)


def test_the_camera_of_a_journal_without_one_is_that_which_came(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    Journal(path).close()
    first = Live(path)
    for measurement in MEASUREMENTS[:40]:
        first.intake.offer(event(measurement))
    first.intake.close()
    second = live(path)
    assert second.counts["images"] == 20 and second.camera is CAMERA
    second.intake.close()
    assert live(path).counts["images"] == 20


def test_what_came_before_the_camera_and_comes_again_is_known(tmp_path: Path) -> None:
    """A session ends before its camera comes, and so does the next one; publishers send everything to each of them.
    Whoever reads the journal tells it the same way."""
    sessions = []
    for end in (40, 50):
        sessions.append(Live(tmp_path / "journal"))
        for measurement in MEASUREMENTS[:end]:
            sessions[-1].intake.offer(event(measurement))
        sessions[-1].intake.close()
    for again in (MEASUREMENTS[:60], []):
        sessions.append(live(tmp_path / "journal").use(again))
        rejected = {name: n for name, n in sessions[-1].counts.items() if name.startswith("rejected_")}
        assert rejected == {"rejected_repeated": 40 + 50}
        np.testing.assert_array_equal(sessions[-1].trajectory(), live().use(MEASUREMENTS[:60]).trajectory())
        sessions[-1].intake.close()


def test_a_start_pose_is_where_the_trajectory_begins(tmp_path: Path) -> None:
    """Half a metre and 10 degrees wrong; boxes then say it better."""
    world = replace(WORLD, seed=3)
    first = live().use(MEASUREMENTS)
    assert first.estimator is not None
    known = first.estimator.object_map()
    later = live()
    later.load(known)
    true = first.trajectory()[0] @ np.linalg.inv(WORLD.poses[0]) @ world.poses[30]
    wrong = gtsam.Pose3(true).retract(np.array([0.1, 0.1, 0.1, 0.3, 0.3, 0.2])).matrix()
    content = [m for m in world.measurements() if (m.stamp if isinstance(m, Boxes) else m.start) >= world.stamps[30]]
    later.use([StampedPose(0, wrong), *content])
    assert later.estimator is not None and later.estimator.stamps[0] == world.stamps[30]
    ends = [later.trajectory()[-1], first.trajectory()[-1]]
    assert np.linalg.norm(ends[0][:3, 3] - ends[1][:3, 3]) < 0.1


def test_a_start_pose_without_a_map_is_rejected() -> None:
    session = live().use([StampedPose(0, np.eye(4))])
    assert session.counts["rejected_start_pose"] == 1


def test_a_start_pose_during_a_trajectory_begins_a_new_one_in_the_same_map() -> None:
    session = live().use(MEASUREMENTS)
    assert session.estimator is not None
    number, last = session.estimator.objects, session.trajectory()[-1]
    session.use([StampedPose(0, last)])
    assert (session.estimator.objects, session.estimator.stamps) == (number, [])
    assert session.counts["images"] == 120
    back = [replace(m, stamp=t + 10**10) for m, t in zip(WORLD.boxes()[::-1], WORLD.stamps, strict=True)]
    ways = [
        RelativeMotion(a.stamp, b.stamp, np.linalg.inv(WORLD.poses[119 - k]) @ WORLD.poses[118 - k], np.eye(6) * 1e-6)
        for k, (a, b) in enumerate(pairwise(back))
    ]
    session.use([m for pair in zip(back, ways, strict=False) for m in pair])
    assert session.estimator.stamps[0] == back[0].stamp and len(session.estimator.stamps) > 15
    assert session.counts["images"] == 120 + 119
    first = WORLD.poses[119] @ np.linalg.inv(last) @ session.trajectory()
    assert np.linalg.norm(first[0, :3, 3] - WORLD.poses[119][:3, 3]) < 0.1


@pytest.mark.parametrize(("time_jump", "objects_kept"), [("reset", False), ("keep_map", True)])
def test_a_looping_bag(time_jump: str, objects_kept: bool) -> None:
    session = live(settings=SessionSettings(refine_after=1e6, time_jump=time_jump)).use(MEASUREMENTS)
    assert session.estimator is not None
    before = session.estimator.objects
    session.use(MEASUREMENTS[:12])
    assert session.counts["time_jumps"] == 1
    assert session.estimator.objects == (before if objects_kept else 0)
    session.use(MEASUREMENTS[12:])
    # The first image of all came before the motions that tell of the jump.
    assert (session.counts["images"], session.counts["rejected_late"]) == (239, 1)
    assert session.error() < 0.05 and not session.counts["errors"]


LIMITED = SessionSettings(refine_after=1e6, max_keyframes=12)
THERE_AND_BACK = SmallWorld(np.concatenate([around(120), around(120)[::-1], around(120)]), objects())


def test_a_trajectory_that_is_too_long_is_followed_by_another_one() -> None:
    """All objects stay, each measurement is used, and the pose goes on."""
    session, poses, objects_before = live(settings=LIMITED), [], 0
    for measurement in THERE_AND_BACK.measurements():
        session.use([measurement])
        assert session.estimator is not None and len(session.estimator.stamps) <= 12
        assert session.estimator.objects >= objects_before - 1  # two may turn out to be one
        objects_before = session.estimator.objects
        if session.pose_is_new:
            session.pose_is_new = False
            poses.append((session.estimator.stamps[-1], session.trajectory()[-1]))
    assert session.counts["trajectories_ended"] == (len(poses) - 1) // 12 > 4
    assert session.counts["keyframes"] == len(poses)
    assert (session.counts["images"], session.counts["motions"]) == (360, 359)
    assert not any(name.startswith(("rejected_no", "rejected_before", "errors")) for name in session.counts)
    stamps, T = zip(*poses, strict=True)
    assert ate(Trajectory(np.array(stamps), np.array(T)), THERE_AND_BACK.truth()) < 0.05
    steps = np.linalg.norm(np.diff(np.array(T)[:, :3, 3], axis=0), axis=1)
    assert steps.max() < 0.3


def test_where_the_body_is_stays_known_when_a_trajectory_has_become_too_long() -> None:
    """And only then: map -> odom is published meanwhile."""
    session, ended = live(settings=LIMITED), 0
    assert not session.is_located
    for measurement in THERE_AND_BACK.measurements():
        session.use([measurement])
        assert session.estimator is not None
        if not session.estimator.stamps and session.counts["trajectories_ended"]:
            assert session.is_located
            ended += 1
    assert ended
    session.use([StampedPose(0, session.trajectory()[-1])])
    assert not session.is_located
    session = live(settings=LIMITED).use(list(THERE_AND_BACK.measurements()))
    assert session.estimator is not None and session.is_located
    session.load(session.estimator.object_map())
    assert not session.is_located
    session = live(settings=LIMITED).use(list(THERE_AND_BACK.measurements()))
    session.reset()
    assert not session.is_located


def test_a_trajectory_that_is_too_long_without_any_object() -> None:
    """There is no map in which it could go on: it begins anew at the origin, and images go on being used."""
    seeing_nothing = [
        replace(
            m, corners=m.corners[:0], covariances=m.covariances[:0], class_ids=(), scores=m.scores[:0], object_ids=()
        )
        if isinstance(m, Boxes)
        else m
        for m in MEASUREMENTS
    ]
    session = live(settings=LIMITED).use(seeing_nothing)
    assert session.counts["trajectories_ended"] >= 1 and session.counts["images"] == 120
    assert session.estimator is not None and 0 < len(session.estimator.stamps) <= 12


def test_trajectories_that_are_ended_are_freed() -> None:
    session = live(settings=LIMITED)
    graphs = []
    for measurement in THERE_AND_BACK.measurements():
        session.use([measurement])
        assert session.estimator is not None
        if not graphs or graphs[-1]() is not session.estimator._graph:
            graphs.append(weakref.ref(session.estimator._graph))
            assert sum(graph() is not None for graph in graphs) == 1
    assert len(graphs) > 4


def test_a_killed_session_ends_its_trajectories_where_it_did(tmp_path: Path) -> None:
    first = live(tmp_path / "journal", LIMITED).use(list(THERE_AND_BACK.measurements()))
    assert first.intake.journal is not None
    first.intake.journal.close()
    again = live(tmp_path / "journal", LIMITED)
    assert again.counts["trajectories_ended"] == first.counts["trajectories_ended"] > 4
    assert (again.trajectory() == first.trajectory()).all()


def test_images_that_wait_when_a_new_trajectory_begins_are_counted() -> None:
    session = live().use(MEASUREMENTS)
    assert session.estimator is not None
    session.use([replace(WORLD.boxes()[-1], stamp=WORLD.stamps[-1] + n) for n in (1, 2, 3)])
    assert session.estimator.waiting == 3
    session.use([StampedPose(0, session.trajectory()[-1])])
    assert (session.estimator.waiting, session.counts["rejected_no_odometry"]) == (0, 3)
    early = live().use([WORLD.boxes()[0], StampedPose(0, np.eye(4))])  # refused: there is no map
    assert early.estimator is not None
    assert (early.estimator.waiting, early.counts["rejected_no_odometry"]) == (1, 0)


def test_what_the_estimator_leaves_out_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """Images from before the first motion shorten a trajectory without a trace otherwise."""
    session, said = live(), list[tuple[str, str, int]]()
    monkeypatch.setattr(session, "reject", lambda error, count: said.append((error.reason, str(error), count)))
    early = [replace(boxes, stamp=boxes.stamp - 60 * 10**9) for boxes in WORLD.boxes()[:3]]
    session.use([*early, *WORLD.motions()[:5], *WORLD.boxes()[:5]])
    assert said == [("before_odometry", "images from before the first motion", 3)]


def test_images_without_odometry_are_bounded() -> None:
    session = live(settings=SessionSettings(images_without_odometry=50))
    session.use(WORLD.boxes())
    assert session.estimator is not None and session.estimator.waiting == 50
    assert session.counts["rejected_no_odometry"] == 70
    session.use(WORLD.motions())
    assert session.estimator.waiting == 0 and len(session.estimator.stamps) > 5


def test_a_full_queue_drops_images_before_motions() -> None:
    session = live(settings=SessionSettings(queue_size=10))
    for boxes in WORLD.boxes()[:10]:
        session.intake.offer(event(boxes))
    with pytest.raises(InvalidMeasurement, match="faster than they can be used"):
        session.intake.offer(event(WORLD.boxes()[11]))
    for k in range(10):
        session.intake.offer(event(WORLD.motions()[k]))
    with pytest.raises(InvalidMeasurement, match="faster than they can be used"):
        session.intake.offer(event(WORLD.motions()[10]))


@pytest.mark.parametrize("share", [7, 1 / 7])
def test_odometry_slower_or_faster_than_detections(share: float) -> None:
    """Every image gets its pose: one motion for seven images, and seven motions for one image."""
    boxes, motions = WORLD.boxes(), WORLD.motions()
    if share > 1:
        joined = []
        for k in range(0, 119 - 6, 7):
            T = np.linalg.multi_dot([m.T_start_end for m in motions[k : k + 7]])
            covariance = np.sum([m.covariance for m in motions[k : k + 7]], axis=0)
            joined.append(RelativeMotion(motions[k].start, motions[k + 6].end, T, covariance))
        motions = joined
    else:
        boxes = boxes[::7]
    content = sorted([*boxes, *motions], key=lambda m: m.stamp if isinstance(m, Boxes) else m.end)
    session = live().use(content)
    assert session.estimator is not None
    assert session.estimator.waiting <= 7 and session.counts["images"] == len(boxes)
    assert not any(name.startswith("rejected") for name in session.counts) and session.error() < 0.06


def test_boxes_of_another_camera_are_rejected() -> None:
    session = live()
    other = [
        replace(m, frame_id="rear") if isinstance(m, Boxes) and i % 4 == 0 else m for i, m in enumerate(MEASUREMENTS)
    ]
    session.use(other)
    assert session.counts["rejected_frame"] == sum(m.frame_id == "rear" for m in other) > 20
    assert session.error() < 0.05


def test_innovations_of_a_true_world_are_what_they_should_be() -> None:
    """A quarter of chi-squared with 4 degrees of freedom has a mean of 1; a factor of two is seen with few boxes."""
    nis: list[float] = []
    for seed in range(4):
        session = live().use(list(replace(WORLD, seed=seed).measurements()))
        nis += session.tally.nis
    assert len(nis) > 40 and 0.5 < np.mean(nis) < 2.0
