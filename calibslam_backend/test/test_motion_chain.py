"""Odometry as relative motions: differences, chains, interpolation, and covariances against sampling."""

from __future__ import annotations

from itertools import pairwise

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibslam_backend.odometry.motion_chain import MotionChain, OdometryDifferencer
from calibslam_backend.odometry.motion_noise import MotionNoise
from calibslam_msgs_py.measurements import SECOND, Array, InvalidMeasurement, RelativeMotion

T0 = 5 * SECOND
STEP = SECOND // 10
SIGMA = np.array([0.01, 0.02, 0.015, 0.03, 0.01, 0.02])
COVARIANCE = np.diag(SIGMA**2)
NEVER_FAILS = MotionNoise(failure_begins=0.0)
EXTRINSIC = gtsam.Pose3(gtsam.Rot3.RzRyRx(-1.5, 0.1, -1.4), np.array([0.3, -0.1, 0.5]))


def exp(tangent: Array) -> gtsam.Pose3:
    return gtsam.Pose3.Expmap(np.asarray(tangent, float))


def log(pose: gtsam.Pose3) -> Array:
    return np.asarray(gtsam.Pose3.Logmap(pose))


def steps(n: int, seed: int = 0) -> list[gtsam.Pose3]:
    return [exp(t) for t in np.random.default_rng(seed).normal(0.0, 0.3, size=(n, 6))]


def motion(k: int, T: gtsam.Pose3, covariance: Array | None = COVARIANCE) -> RelativeMotion:
    return RelativeMotion(T0 + k * STEP, T0 + (k + 1) * STEP, T.matrix(), covariance)


def chain_of(motions: list[RelativeMotion], extrinsic: gtsam.Pose3 | None = None) -> MotionChain:
    # The random steps are wild.
    chain = MotionChain(NEVER_FAILS, (extrinsic or gtsam.Pose3()).matrix())
    for each in motions:
        assert not chain.add(each)
    return chain


# -- differences ----------------------------------------------------------------------------------------------------


def test_differences_are_what_moves_the_body() -> None:
    differencer = OdometryDifferencer()
    first, second = steps(2)
    assert differencer.add(T0, first.matrix()) is None
    measured = differencer.add(T0 + STEP, first.compose(second).matrix(), np.eye(6), "base")
    assert measured is not None
    np.testing.assert_allclose(measured.T_start_end, second.matrix(), atol=1e-12)
    assert (measured.start, measured.end, measured.frame_id) == (T0, T0 + STEP, "base")
    # Covariance of a velocity times the square of the duration, 0.1 s.
    np.testing.assert_allclose(measured.covariance, 0.01 * np.eye(6))
    unknown = differencer.add(T0 + 2 * STEP, first.matrix())
    assert unknown is not None and unknown.covariance is None


def test_twice_the_same_time_and_time_backwards() -> None:
    differencer = OdometryDifferencer()
    a, b, c = (gtsam.Pose3(gtsam.Rot3(), np.array([x, 0.0, 0.0])).matrix() for x in (0.0, 10.0, 11.0))
    differencer.add(T0, a)
    with pytest.raises(InvalidMeasurement) as caught:
        differencer.add(T0, b)
    assert caught.value.reason == "duplicate"
    with pytest.raises(InvalidMeasurement) as caught:
        differencer.add(T0 - SECOND, b)
    assert caught.value.reason == "time_backwards"
    # It goes on from the new time, and never bridges the jump.
    after = differencer.add(T0 - SECOND + STEP, c)
    assert after is not None and after.start == T0 - SECOND
    np.testing.assert_allclose(after.T_start_end[:3, 3], [1.0, 0.0, 0.0])


# -- chains ---------------------------------------------------------------------------------------------------------


def test_composition_through_the_extrinsic() -> None:
    """Motion of the camera = X^-1 (product of the body's motions) X."""
    moves = steps(5)
    chain = chain_of([motion(k, T) for k, T in enumerate(moves)], EXTRINSIC)
    body = moves[1].compose(moves[2]).compose(moves[3])
    between, _ = chain.between(T0 + STEP, T0 + 4 * STEP)
    expected = EXTRINSIC.inverse().compose(body).compose(EXTRINSIC)
    np.testing.assert_allclose(between, expected.matrix(), atol=1e-12)
    assert (chain.start, chain.end) == (T0, T0 + 5 * STEP)
    np.testing.assert_allclose(chain.between(T0, T0)[0], np.eye(4), atol=1e-12)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(cuts=st.lists(st.integers(0, 5 * STEP), min_size=3, max_size=3).map(sorted), at_a_step=st.booleans())
def test_motions_compose_wherever_they_are_cut(cuts: list[int], at_a_step: bool) -> None:
    """a to b and b to c are a to c, inside of steps, too; their covariances add up exactly where b ends a step.

    Inside a step the noise of its first part is taken to act at the cut: that differs by the motion in between.
    """
    chain = chain_of([motion(k, T) for k, T in enumerate(steps(5))], EXTRINSIC)
    a, b, c = (T0 + cut for cut in cuts)
    if at_a_step:
        b = T0 + (b - T0) // STEP * STEP
        a = min(a, b)
    (ab, S_ab), (bc, S_bc), (ac, S_ac) = (chain.between(*pair) for pair in ((a, b), (b, c), (a, c)))
    np.testing.assert_allclose(ab @ bc, ac, atol=1e-9)
    back = gtsam.Pose3(bc).inverse().AdjointMap()
    added = back @ S_ab @ back.T + S_bc
    if at_a_step:
        np.testing.assert_allclose(added, S_ac, atol=1e-12)
    else:
        sigmas = np.sqrt(np.maximum(np.diag(S_ac), 1e-12))
        np.testing.assert_allclose(added / np.outer(sigmas, sigmas), S_ac / np.outer(sigmas, sigmas), atol=0.5)


def test_interpolation_follows_the_geodesic() -> None:
    """Constant velocity within a step: a quarter of the time is a quarter of the twist, and of the variance."""
    twist = np.array([0.1, -0.2, 0.3, 0.4, 0.5, -0.6])
    chain = chain_of([motion(0, exp(twist))])
    between, covariance = chain.between(T0, T0 + STEP // 4)
    np.testing.assert_allclose(between, exp(0.25 * twist).matrix(), atol=1e-9)
    np.testing.assert_allclose(covariance, 0.25 * COVARIANCE, atol=1e-12)


def test_covariance_against_sampling() -> None:
    """20,000 noisy chains of four motions, through an extrinsic: entries agree within 4 % of the two sigmas.

    The standard deviation of a sampled covariance entry is at most sqrt(2 / 20,000) = 1 % of the sigmas.
    """
    rng = np.random.default_rng(0)
    moves = steps(4, seed=1)
    small = COVARIANCE * 0.01
    chain = chain_of([motion(k, T, small) for k, T in enumerate(moves)], EXTRINSIC)
    exact, analytic = chain.between(T0, T0 + 4 * STEP)
    noise = rng.multivariate_normal(np.zeros(6), small, size=(20_000, 4))
    errors = np.empty((20_000, 6))
    for i in range(len(errors)):
        body = gtsam.Pose3()
        for T, n in zip(moves, noise[i], strict=True):
            body = body.compose(T).compose(exp(n))
        camera = EXTRINSIC.inverse().compose(body).compose(EXTRINSIC)
        errors[i] = gtsam.Pose3.Logmap(gtsam.Pose3(exact).between(camera))
    sampled = np.cov(errors.T)
    sigmas = np.sqrt(np.diag(sampled))
    np.testing.assert_allclose(analytic / np.outer(sigmas, sigmas), sampled / np.outer(sigmas, sigmas), atol=0.04)


def test_forgetting_changes_nothing_that_is_still_asked() -> None:
    motions = [motion(k, T) for k, T in enumerate(steps(6))]
    whole, cut = chain_of(motions), chain_of(motions)
    start, end = T0 + 2 * STEP + STEP // 3, T0 + 5 * STEP
    cut.forget_before(start)
    assert cut.start == T0 + 2 * STEP
    for a, b in zip(whole.between(start, end), cut.between(start, end), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


@pytest.mark.parametrize("known", [True, False])
def test_odometry_that_no_image_follows_is_joined(monkeypatch: pytest.MonkeyPatch, known: bool) -> None:
    """A camera that is off for hours costs no memory, and what happened in the meantime is known as well as ever."""
    rng = np.random.default_rng(5)
    motions = [motion(k, exp(rng.normal(0.0, 0.02, 6)), COVARIANCE if known or k % 3 else None) for k in range(1000)]
    motions[300:310] = []  # and a gap
    whole, joined = (MotionChain(NEVER_FAILS, EXTRINSIC.matrix()) for _ in range(2))
    monkeypatch.setattr(joined, "MOST", 100)
    for each in motions:
        assert whole.add(each) == joined.add(each)
    assert len(joined._steps) <= 100 < len(whole._steps)
    kept = [step.end for step in joined._steps]
    for start, end in ((kept[0], kept[-1]), (kept[1], kept[20]), (kept[5], kept[-1] - STEP // 3)):
        for found, expected in zip(joined.between(start, end), whole.between(start, end), strict=True):
            np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())
        np.testing.assert_allclose(joined.measured(start, end), whole.measured(start, end), atol=1e-9)
        assert joined.drifts(start, end) == pytest.approx(whole.drifts(start, end))


def test_a_gap_is_bridged_with_an_honest_covariance() -> None:
    """Half a second without odometry: no motion, but 0.5 rad and 0.5 m of uncertainty."""
    chain = chain_of([motion(0, gtsam.Pose3())])
    late = RelativeMotion(T0 + STEP + SECOND // 2, T0 + 2 * STEP + SECOND // 2, np.eye(4), COVARIANCE)
    assert chain.add(late) == "odometry_gap"
    between, covariance = chain.between(T0, late.end)
    np.testing.assert_allclose(between, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(covariance, 2.0 * COVARIANCE + 0.25 * np.eye(6), rtol=1e-9)


BAD = {
    "time_backwards": RelativeMotion(T0 + 3 * STEP, T0 + 2 * STEP, np.eye(4), COVARIANCE),
    "overlap": RelativeMotion(T0 + STEP // 2, T0 + 3 * STEP, np.eye(4), COVARIANCE),
    "not_finite": RelativeMotion(T0 + STEP, T0 + 2 * STEP, np.full((4, 4), np.nan), COVARIANCE),
    "covariance": RelativeMotion(T0 + STEP, T0 + 2 * STEP, np.eye(4), -COVARIANCE),
}


@pytest.mark.parametrize("reason", BAD)
def test_bad_motions_change_nothing(reason: str) -> None:
    chain = chain_of([motion(0, steps(1)[0])])
    before = chain.between(T0, T0 + STEP)
    with pytest.raises(InvalidMeasurement) as caught:
        chain.add(BAD[reason])
    assert caught.value.reason == reason
    assert chain.end == T0 + STEP
    for a, b in zip(before, chain.between(T0, T0 + STEP), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not chain.add(motion(1, gtsam.Pose3()))


def test_a_bad_first_motion_does_not_start_a_chain() -> None:
    for bad in BAD.values():
        chain = MotionChain(MotionNoise(), np.eye(4))
        if bad is not BAD["overlap"]:
            with pytest.raises(InvalidMeasurement):
                chain.add(bad)
            assert chain.start is None and chain.end is None


def test_a_covariance_with_nan_is_refused() -> None:
    chain = chain_of([motion(0, gtsam.Pose3())])
    with pytest.raises(InvalidMeasurement) as caught:
        chain.add(motion(1, gtsam.Pose3(), np.full((6, 6), np.nan)))
    assert caught.value.reason == "covariance"


# -- failures -------------------------------------------------------------------------------------------------------


def moved(k: int, x: float, covariance: Array | None = None) -> RelativeMotion:
    """x metres along the body's x axis within a step of 0.1 s."""
    return motion(k, gtsam.Pose3(gtsam.Rot3(), np.array([x, 0.0, 0.0])), covariance)


def test_a_failed_step_is_replaced_by_going_on_as_before() -> None:
    """0.1, 1.5, 0.1 m in 0.1 s each: 1, 15 and again 1 m/s. Of the velocity 0.3^2 is known, and 0.1 s more unseen."""
    chain = MotionChain(MotionNoise(translation_floor=0.1, translation_share=0.0, scene_depth=0.0), np.eye(4))
    said = [chain.add(moved(k, x)) for k, x in enumerate((0.1, 1.5, 0.1))]
    assert said == ["", "odometry_implausible", ""]
    assert chain.between(T0, T0 + 3 * STEP)[0][0, 3] == pytest.approx(0.3)
    assert chain.measured(T0, T0 + 3 * STEP)[0, 3] == pytest.approx(1.7)
    covariance = chain.between(T0 + STEP, T0 + 2 * STEP)[1]
    assert covariance[3, 3] == pytest.approx(0.1 * 0.1**2 + (0.3**2 + 0.1) * 0.1**2)
    assert chain.between(T0, T0 + STEP)[1][3, 3] == pytest.approx(0.1 * 0.1**2)


def test_a_row_of_failures_is_one_wrong_velocity() -> None:
    """Its deviations add up, not their squares; half of the last step is half of its part."""
    chain = MotionChain(
        MotionNoise(rotation_floor=1e-6, translation_floor=1e-6, translation_share=0.0, scene_depth=0.0), np.eye(4)
    )
    for k, x in enumerate((0.1, 3.0, -3.0)):
        chain.add(moved(k, x))
    first, second = (np.sqrt(0.3**2 + 0.1 * n) * 0.1 for n in (1, 2))
    assert chain.between(T0, T0 + 3 * STEP)[1][4, 4] == pytest.approx((first + second) ** 2, rel=1e-6)
    assert chain.between(T0, T0 + 2 * STEP + STEP // 2)[1][4, 4] == pytest.approx((first + 0.5 * second) ** 2, rel=1e-6)


def test_what_a_stated_covariance_explains_is_no_failure() -> None:
    """A change of 14 m/s: as many standard deviations of 5 m/s as anybody has, and seventy of 0.2 m/s."""
    for sigma, expected in ((0.5, ""), (0.02, "odometry_implausible")):
        chain = MotionChain(MotionNoise(), np.eye(4))
        chain.add(moved(0, 0.1, np.eye(6) * sigma**2))
        assert chain.add(moved(1, 1.5, np.eye(6) * sigma**2)) == expected


def test_a_failure_does_not_open_directions_that_are_left_open() -> None:
    """A robot in a plane states 1e6 of height; where its odometry fails, height is as unsure as in a gap, no more."""
    covariance = np.diag([1e-4] * 5 + [1e6])
    chain = MotionChain(MotionNoise(), np.eye(4))
    said = [chain.add(moved(k, x, covariance)) for k, x in enumerate((0.1, 1.5, 0.1))]
    assert said == ["", "odometry_implausible", ""]
    found = chain.between(T0 + STEP, T0 + 2 * STEP)[1]
    assert found[5, 5] == pytest.approx(2.0 * 0.1**2)  # 1 m/s for 0.1 s, once for what is open and once for the failure


def test_after_a_long_gap_any_velocity_is_believed() -> None:
    """Velocities may have changed by 3 m/s in 9 s."""
    chain = MotionChain(MotionNoise(), np.eye(4))
    chain.add(moved(0, 0.1))
    assert chain.add(moved(91, 0.5)) == "odometry_gap"
    assert chain.between(T0 + 91 * STEP, T0 + 92 * STEP)[0][0, 3] == pytest.approx(0.5, abs=0.01)


# -- what is believed of motions without covariance -----------------------------------------------------------------


def test_unknown_covariances_by_hand() -> None:
    """sqrt(time) sqrt(floor^2 + (share * velocity)^2): 0.25 s of turning at 0.5 rad/s, then of moving at 0.24 m/s."""
    noise = MotionNoise(
        rotation_floor=0.03,
        rotation_share=0.08,
        roll_share=0.5,
        translation_floor=0.01,
        translation_share=0.1,
        scene_depth=0.0,
    )
    turn = noise.covariance(np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0]), 0.25)
    np.testing.assert_allclose(np.sqrt(np.diag(turn)), np.array([0.05, 0.05, 0.025] + [0.01] * 3) / 2.0)
    move = noise.covariance(np.array([0.0, 0.0, 0.0, 0.0, 0.24, 0.0]), 0.25)
    np.testing.assert_allclose(np.sqrt(np.diag(move)), np.array([0.03, 0.03, 0.015] + [0.026] * 3) / 2.0)
    assert np.count_nonzero(turn) == 6


@given(st.integers(1, 20), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_how_finely_odometry_is_cut_does_not_matter(parts: int, turn: float, speed: float) -> None:
    """A second of steady motion, in one step or in many; the same again from its half on."""
    velocity = np.array([0.1 * turn, turn, 0.0, speed, 0.0, 0.3])
    whole = exp(velocity)
    found = []
    for count in (1, parts):
        chain, ends = MotionChain(MotionNoise(), np.eye(4)), np.linspace(0, SECOND, count + 1).astype(int)
        for start, end in pairwise(ends):
            step = exp(velocity * (end - start) / SECOND).matrix()
            chain.add(RelativeMotion(T0 + int(start), T0 + int(end), step))
        found.append(chain.between(T0 + SECOND // 2, T0 + SECOND))
        np.testing.assert_allclose(chain.between(T0, T0 + SECOND)[0], whole.matrix(), atol=1e-7)
        assert chain.drifts(T0 + SECOND // 4, T0 + SECOND // 2) == pytest.approx(0.25)
    (one, coarse), (other, fine) = found
    np.testing.assert_allclose(one, other, atol=1e-7)
    # What differs is where on the way the camera is taken to have erred.
    np.testing.assert_allclose(fine, coarse, atol=float(np.linalg.norm(velocity) * np.diag(coarse).max()))


def test_slow_odometry_knows_a_motion_better() -> None:
    """The same way in twice the time: of errors that are a share of the velocity, half the variance."""
    noise = MotionNoise(rotation_floor=1e-6, translation_floor=1e-6)
    way = exp(np.array([0.1, 0.2, 0.0, 0.1, 0.0, 0.3])).matrix()
    covariances = []
    for end in (SECOND, 2 * SECOND):
        chain = MotionChain(noise, np.eye(4))
        chain.add(RelativeMotion(T0, T0 + end, way))
        covariances.append(chain.between(T0, T0 + end)[1])
    np.testing.assert_allclose(covariances[1], covariances[0] / 2.0, rtol=1e-6, atol=1e-10)


@pytest.mark.parametrize("rate", [False, True])
def test_errors_of_visual_odometry_turn_the_camera_about_the_scene(rate: bool) -> None:
    """Drawn: a point 2 m ahead is displaced by the deviation of the translation, whatever that of the rotation."""
    noise = MotionNoise(
        rotation_floor=0.03,
        rotation_share=0.0,
        roll_share=1.0,
        translation_floor=0.004,
        translation_share=0.0,
        drift_rotation=0.03,
        drift_translation=0.004,
        scene_depth=2.0,
    )
    covariance = noise.drift_covariance() if rate else noise.covariance(np.zeros(6), 1.0)
    errors = np.random.default_rng(0).multivariate_normal(np.zeros(6), covariance, size=20_000)
    scene = np.array([0.0, 0.0, 2.0])
    displaced = errors[:, 3:] + np.cross(errors[:, :3], scene)
    np.testing.assert_allclose(displaced.std(axis=0), 0.004, rtol=0.03)
    np.testing.assert_allclose(errors[:, :3].std(axis=0), 0.03, rtol=0.03)
    # By hand: a camera that errs by 0.03 rad about its y axis moves by 2 m * 0.03 rad against x.
    assert covariance[1, 3] == pytest.approx(-2.0 * 0.03**2)
    assert covariance[0, 4] == pytest.approx(2.0 * 0.03**2)
    np.testing.assert_allclose(np.diag(covariance)[3:], [0.004**2 + 0.06**2, 0.004**2 + 0.06**2, 0.004**2])


def test_steps_of_unknown_covariance_add_to_those_that_state_one() -> None:
    """By hand: each step's covariance, seen from the camera at the end."""
    moves = steps(3)
    chain = chain_of([motion(0, moves[0]), motion(1, moves[1], None), motion(2, moves[2])])
    unknown = MotionNoise().covariance(log(moves[1]) * SECOND / STEP, STEP / SECOND)
    expected = COVARIANCE
    for move, noise in ((moves[1], unknown), (moves[2], COVARIANCE)):
        back = move.inverse().AdjointMap()
        expected = back @ expected @ back.T + noise
    np.testing.assert_allclose(chain.between(T0, T0 + 3 * STEP)[1], expected, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(chain.between(T0, T0 + STEP)[1], COVARIANCE, atol=1e-12)
    # A step that only touches the interval is not part of it.
    np.testing.assert_allclose(chain.between(T0 + 2 * STEP, T0 + 3 * STEP)[1], COVARIANCE, atol=1e-12)


# -- drifts ---------------------------------------------------------------------------------------------------------


def test_only_motions_of_unknown_covariance_drift() -> None:
    """Three steps of 0.1 s, the second one unknown: it alone drifts."""
    moves = steps(3)
    chain = chain_of([motion(0, moves[0]), motion(1, moves[1], None), motion(2, moves[2])])
    end = T0 + 3 * STEP
    assert chain.drifts(T0, T0 + STEP) == 0.0
    assert chain.drifts(T0 + 2 * STEP, end) == 0.0
    assert chain.drifts(T0 + 2 * STEP + 1, end) == 0.0
    assert chain.drifts(T0, end) == pytest.approx(0.1)
    assert chain.drifts(T0 + STEP, T0 + 2 * STEP) == pytest.approx(0.1)
    assert chain.drifts(T0 + STEP // 2, T0 + STEP + STEP // 2) == pytest.approx(0.05)
    assert chain.drifts(T0 + 2 * STEP - 1, end) == pytest.approx(1e-9)
    assert chain.drifts(T0, T0) == 0.0


def test_a_bridged_gap_does_not_drift() -> None:
    """What is not measured has no constant error; its covariance says what is not known."""
    chain = chain_of([motion(0, gtsam.Pose3())])
    chain.add(RelativeMotion(T0 + 3 * STEP, T0 + 4 * STEP, np.eye(4), COVARIANCE))
    assert chain.drifts(T0, T0 + 4 * STEP) == 0.0
