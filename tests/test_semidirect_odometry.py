"""The semi-direct odometry as a whole, on short flights with known truth."""

import dataclasses
import itertools
import math
import threading
import time
import zlib

import cv2
import numpy as np
import pytest
import semidirect_flights as flights
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

import pipelines.semidirect.odometry
from pipelines.estimator import EstimatorError, quantities
from pipelines.semidirect.beside import BEHIND
from pipelines.semidirect.mapping import Mapper
from pipelines.semidirect.odometry import SemidirectOdometry
from pipelines.semidirect.settings import SemidirectSettings
from pipelines.semidirect.step import Feature, SemidirectStep, Stage
from pipelines.verdict import Verdict
from readers.streams import OdometrySample, PoseSample, Problem, RangeSample, StreamKind
from workbench.checkpoints import decode, encode

FRAMES = 90


def samples(pictures, first=0):
    return [flights.sample(grey, first + k) for k, grey in enumerate(pictures)]


# ------------------------------------------------------------------------------------ the way


@pytest.mark.parametrize("changes", [{}, {"bundle_keyframes": 5, "max_keyframes": 30}], ids=["fast", "accurate"])
def test_path_is_the_true_one(changes):
    steps = flights.flight(FRAMES, **changes)
    assert [s.stage for s in steps].count(Stage.STARTED) == 1
    assert all(s.stage == Stage.TRACKED for s in steps if s.map_number == 0 and s.stage != Stage.STARTED)
    error, scale = flights.path_error(steps)
    assert error < 5e-4
    assert abs(scale - 1) < 0.02  # the height gives it
    if not changes:
        few = flights.flight(FRAMES, keyframe_points="tracked")
        assert error < 0.9 * flights.path_error(few)[0]
        assert max(s.keyframe_points for s in few[-30:]) <= flights.settings().max_features


def test_a_keyframe_is_told_with_the_points_that_it_sees():
    steps = [s for s in flights.flight(FRAMES) if s.accepted]
    for step in steps:
        assert (step.keyframe_points > 0) == (step.points_refined > 0) == bool(step.keyframe)
        assert step.points_refined <= step.keyframe_points
        assert step.keyframe_points >= step.tracked * step.keyframe
    assert steps[-1].map_points > 2 * steps[-1].tracked


@pytest.mark.parametrize("through", ["radial-tangential", "equidistant"])
def test_path_through_a_lens_that_bends(through):
    model, coefficients = flights.LENSES[through]
    told = {"distortion_model": model, "distortion": coefficients}
    bent = samples(flights.pictures(50, through=through))
    steps, _ = flights.flown(SemidirectOdometry(flights.settings(**told)), bent)
    assert flights.path_error(steps, 50)[0] < 1.5e-3
    assert not any(s.stage == Stage.LOST for s in steps)
    wrong, _ = flights.flown(SemidirectOdometry(flights.settings()), bent)
    assert flights.path_error(wrong, 50)[0] > 2 * flights.path_error(steps, 50)[0]  # the lens is told for a reason


def test_positions_are_those_of_the_world():
    # the world's plane is the ground, so that without any alignment heights are right
    steps = flights.flight(FRAMES)
    numbers, found = flights.places(steps)
    centres, turns = flights.way(FRAMES)
    assert np.abs(found[:, 2] - centres[numbers, 2]).max() < 0.02
    start = centres[numbers[0]]
    truth = centres[numbers]
    # heading 0 at the first view: the true one has turned a little since the flight's start
    assert (
        np.abs(
            np.linalg.norm(found[:, :2] - found[0, :2], axis=1) - np.linalg.norm(truth[:, :2] - start[:2], axis=1)
        ).max()
        < 0.03
    )
    quats = np.array([steps[k].quat_xyzw for k in numbers])
    off = Rotation.from_matrix(turns[numbers]).inv() * Rotation.from_quat(quats)
    assert np.degrees(off.magnitude()).max() < 1.0


def test_pose_is_the_position_seen_from_above():
    steps = flights.flight(FRAMES)
    for before, step in itertools.pairwise(steps[20:]):
        assert step.pose[:2] == pytest.approx(step.position_m[:2], abs=0)
        assert step.increment_m == pytest.approx(step.pose[:2] - before.pose[:2], abs=1e-12)
        forward = Rotation.from_quat(step.quat_xyzw).apply([1.0, 0, 0])
        assert step.pose[2] == pytest.approx(math.atan2(forward[1], forward[0]), abs=1e-9)
        assert step.path_step_m == pytest.approx(np.linalg.norm(step.position_m - before.position_m), abs=1e-12)


def test_pose_sigma_is_of_the_size_of_the_error():
    steps = [s for s in flights.flight(FRAMES) if s.stage == Stage.TRACKED]
    centres, _ = flights.way(FRAMES)
    step_error = []
    for before, after in itertools.pairwise(steps):
        moved = np.linalg.norm(after.position_m - before.position_m)
        step_error.append(moved - np.linalg.norm(centres[after.frame] - centres[before.frame]))
    sigma = np.median([np.linalg.norm(s.pose_sigma[:3]) for s in steps])
    assert 0.1 * sigma < np.std(step_error) < 3 * sigma


def test_start_pose_and_mounting_yaw_turn_the_world():
    plain = flights.flight(30)
    turned = flights.flight(30, start_pose=(2.0, -1.0, 0.7), mounting_yaw_rad=0.3)
    numbers, found = flights.places(plain)
    _, moved = flights.places(turned)
    c, s = math.cos(1.0), math.sin(1.0)  # heading of the camera: 0.7 + 0.3
    expected = found[:, :2] @ np.array([[c, s], [-s, c]]) + (2.0, -1.0)
    assert np.abs(moved[:, :2] - expected).max() < 1e-6
    assert turned[numbers[0]].pose[2] == pytest.approx(plain[numbers[0]].pose[2] + 0.7, abs=1e-6)


# ---------------------------------------------------------------------------------- determinism


def same(one, other):
    for field in dataclasses.fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if isinstance(a, np.ndarray):
            assert a.dtype == b.dtype
            assert a.tobytes() == b.tobytes(), field.name
        else:
            assert a == b or (a != a and b != b), field.name


def test_two_replays_are_equal_byte_by_byte():
    again, _ = flights.flown(SemidirectOdometry(flights.settings()), samples(flights.pictures(FRAMES)))
    for one, other in zip(flights.flight(FRAMES), again, strict=True):
        same(one, other)


@pytest.mark.parametrize("stop", [4, 40])
def test_a_kept_state_goes_on_with_the_same_bytes(stop):
    pictures = flights.pictures(60)
    first = SemidirectOdometry(flights.settings())
    _, state = flights.flown(first, samples(pictures[:stop]))
    second = SemidirectOdometry(flights.settings())
    state = second.adopted(second.unpacked(first.packed(state), lambda frame: pictures[frame]))
    steps, _ = flights.flown(second, samples(pictures[stop:], stop), state)
    whole = flights.flight(FRAMES)[stop:60]
    for one, other in zip(steps, whole, strict=True):
        same(one, other)


def test_a_step_does_not_touch_the_state_before_it():
    pictures = flights.pictures(FRAMES)
    estimator = SemidirectOdometry(flights.settings())
    _, state = flights.flown(estimator, samples(pictures[:50]))
    one = estimator.step(state, flights.sample(pictures[50], 50))[1]
    flights.flown(estimator, samples(pictures[50:60], 50), state)
    same(one, estimator.step(state, flights.sample(pictures[50], 50))[1])


def test_states_of_another_camera_are_not_adopted():
    _, state = flights.flown(SemidirectOdometry(flights.settings()), samples(flights.pictures(FRAMES)[:3]))
    with pytest.raises(EstimatorError, match="another camera"):
        SemidirectOdometry(flights.settings(focal_px=210.0)).adopted(state)
    with pytest.raises(EstimatorError, match="replay again"):
        SemidirectOdometry(flights.settings()).unpacked((1, 2), lambda frame: flights.pictures(FRAMES)[frame])


# -------------------------------------------------------------------------------- lost and found


def test_blank_frames_are_lost_and_the_way_is_found_again():
    pictures = flights.pictures(FRAMES).copy()
    pictures[50:56] = 128
    steps, _ = flights.flown(SemidirectOdometry(flights.settings()), samples(pictures))
    assert [s.stage for s in steps[50:56]] == [Stage.LOST] * 6
    assert all(Verdict.LOST in s.alarms and not s.accepted for s in steps[50:56])
    assert Verdict.FEW_POINTS in steps[50].alarms
    assert all(np.array_equal(s.position_m, steps[49].position_m) for s in steps[50:56])  # held
    assert steps[56].stage == Stage.RELOCALISED
    assert Verdict.RELOCALISED in steps[56].alarms
    assert all(Verdict.AFTER_RELOCALISATION in s.alarms for s in steps[57:])
    assert [s.relocalised_frames for s in steps[55:60]] == [-1, 1, 2, 3, 4]
    centres, _ = flights.way(FRAMES)
    gone = np.linalg.norm(steps[60].position_m - steps[49].position_m)
    assert gone == pytest.approx(np.linalg.norm(centres[60] - centres[49]), abs=0.01)


def test_a_camera_that_stays_lost_begins_a_new_map():
    pictures = flights.pictures(FRAMES).copy()
    pictures[30:45] = 128
    steps, _ = flights.flown(
        SemidirectOdometry(flights.settings(restart_s=0.2, relocalise_correlation=1.0)), samples(pictures)
    )
    started = [s for s in steps if s.stage == Stage.STARTED]
    assert [s.map_number for s in started] == [0, 1]
    assert Verdict.NEW_MAP in started[1].alarms
    assert not any(s.accepted for s in steps if 30 <= s.frame < started[1].frame)
    assert all(Verdict.AFTER_RELOCALISATION in s.alarms for s in steps[started[1].frame + 1 :])
    # in metres again by the given height, which is not quite that of its first view
    scale = flights.path_error(steps[started[1].frame :])[1]
    assert scale == pytest.approx(flights.way(FRAMES)[0][45, 2] / 1.5, abs=0.005)


def test_another_place_is_not_taken_for_the_map():
    pictures = flights.pictures(FRAMES)
    elsewhere = np.array([np.ascontiguousarray(p[::-1, ::-1]) for p in flights.pictures(FRAMES)[60:66]])
    steps, _ = flights.flown(SemidirectOdometry(flights.settings()), samples([*pictures[:40], *elsewhere]))
    assert [s.stage for s in steps[40:]] == [Stage.LOST] * 6


def test_standing_still_makes_no_keyframes_and_no_way():
    rng = np.random.default_rng(8)
    still = flights.pictures(FRAMES)[40].astype(float)
    frames = [np.clip(np.rint(still + rng.normal(0, 1, still.shape)), 0, 255).astype(np.uint8) for _ in range(40)]
    moving = samples(flights.pictures(FRAMES)[:41])
    steps, _ = flights.flown(SemidirectOdometry(flights.settings()), [*moving, *samples(frames, 41)])
    standing = steps[45:]
    assert all(s.stage == Stage.TRACKED for s in standing)
    assert sum(s.keyframe for s in standing) == 0
    places = np.array([s.position_m for s in standing])
    assert np.linalg.norm(places - places[0], axis=1).max() < 2e-3


def test_a_start_needs_parallax():
    # the same picture again and again has no motion; a featureless one has no corners
    still = [flights.pictures(FRAMES)[0]] * 10
    steps, _ = flights.flown(SemidirectOdometry(flights.settings()), samples(still))
    assert [s.stage for s in steps] == [Stage.FIRST] + [Stage.STARTING] * 9
    assert all(Verdict.STARTING in s.alarms and not s.accepted for s in steps[1:])
    assert np.isnan(steps[-1].position_m[2])
    flat = [np.full((240, 320), 90, np.uint8)] * 3
    steps, _ = flights.flown(SemidirectOdometry(flights.settings()), samples(flat))
    assert all(Verdict.LOW_TEXTURE in s.alarms for s in steps)


# ------------------------------------------------------------------------------------ bad input


def test_frames_that_cannot_be_used_are_passed_over():
    pictures = list(samples(flights.pictures(FRAMES)[:40]))
    small = np.zeros((120, 160), np.uint8)
    problem = Problem(
        stream="/camera", t_ns=31 * flights.RATE_NS, received_ns=0, kind=StreamKind.IMAGE, reason="cut off", frame=31
    )
    given = [*pictures[:30], flights.sample(small, 30), problem, flights.sample(small, 32, t_ns=5), *pictures[33:]]
    steps, _ = flights.flown(SemidirectOdometry(flights.settings()), given)
    assert [s.verdict for s in steps[30:33]] == [Verdict.SIZE_CHANGED, Verdict.UNDECODABLE, Verdict.OUT_OF_ORDER]
    assert [s.stage for s in steps[30:33]] == [Stage.SKIPPED] * 3
    assert steps[33].stage == Stage.TRACKED
    assert (
        Verdict.FRAME_GAP
        in flights.flown(SemidirectOdometry(flights.settings()), [*pictures[:30], *pictures[35:]])[0][30].alarms
    )


def test_blurred_and_brighter_frames_are_told():
    pictures = flights.pictures(FRAMES)[:50].copy()
    pictures[40] = cv2.GaussianBlur(pictures[40], (0, 0), 4)
    pictures[45] = np.clip(pictures[45].astype(int) + 30, 0, 255).astype(np.uint8)
    steps, _ = flights.flown(SemidirectOdometry(flights.settings()), samples(pictures))
    assert [s.frame for s in steps if Verdict.BLURRED in s.alarms] == [40]
    assert steps[40].sharpness < 0.5 * steps[39].sharpness
    assert [s.frame for s in steps if Verdict.EXPOSURE_JUMP in s.alarms] == [45, 46]
    assert steps[45].mean_grey == pytest.approx(steps[44].mean_grey + 27, abs=6)


def test_settings_that_cannot_be():
    with pytest.raises(EstimatorError, match="focal_px"):
        SemidirectOdometry(SemidirectSettings())
    with pytest.raises(ValidationError, match="align_finest exceeds"):
        flights.settings(align_finest=4, align_coarsest=2)
    with pytest.raises(ValidationError, match="two oldest are held"):
        flights.settings(bundle_keyframes=2)
    with pytest.raises(ValidationError, match="every frame would be lost"):
        flights.settings(min_tracked=100)
    with pytest.raises(ValidationError, match="Extra inputs"):
        flights.settings(no_such_setting=1)
    other = SemidirectOdometry(flights.settings(image_size_px=(640, 480)))
    with pytest.raises(EstimatorError, match=r"for 640 x 480 px, the images are 320 x 240 px"):
        other.step(other.start(), flights.sample(flights.pictures(FRAMES)[0], 0))
    tiny = SemidirectOdometry(flights.settings())
    with pytest.raises(EstimatorError, match="cannot be halved"):
        tiny.step(tiny.start(), flights.sample(np.zeros((8, 8), np.uint8), 0))


# ----------------------------------------------------------------------------------------- scale


def test_without_a_height_lengths_are_of_the_map_and_it_is_said():
    steps = flights.flight(FRAMES, height_m=None)
    good = [s for s in steps if s.stage == Stage.TRACKED]
    assert all(Verdict.SCALE_UNKNOWN in s.alarms and s.scale_known == 0 for s in good)
    assert flights.path_error(steps)[1] == pytest.approx(1.5, rel=0.1)  # of a scene 1.5 m deep


def test_a_height_stream_gives_the_scale_and_tells_its_drift():
    pictures = samples(flights.pictures(FRAMES))
    given = []
    for k, picture in enumerate(pictures):
        height = 1.5 if k < 60 else 2.0  # the sensor jumps: the map did not
        given.append(height_sample(picture.t_ns, height - 0.1))
        given.append(picture)
    estimator = SemidirectOdometry(flights.settings(height_m=None, height_stream="/height", height_offset_m=0.1))
    steps, _ = flights.flown(estimator, given)
    assert flights.path_error(steps)[1] == pytest.approx(1.0, abs=0.02)
    drifted = [Verdict.SCALE_DRIFT in s.alarms for s in steps]
    assert not any(drifted[:60])
    assert all(drifted[60:])
    assert steps[70].height_m == 2.0
    assert steps[70].map_height_m == pytest.approx(flights.way(FRAMES)[0][70, 2], abs=0.03)


def test_the_height_counts_at_the_frame_that_it_came_with():
    # a climb of 1 m/s: between the two views of the start the height changes by a tenth
    centres, _ = flights.way(50, 1.0)
    given = []
    for k, picture in enumerate(samples(flights.pictures(50, climb=1.0))):
        given.append(height_sample(picture.t_ns, centres[k, 2]))
        given.append(picture)
    estimator = SemidirectOdometry(flights.settings(height_m=None, height_stream="/height"))
    steps, _ = flights.flown(estimator, given)
    assert flights.path_error(steps, 50, 1.0)[1] == pytest.approx(1.0, abs=0.01)
    assert not any(Verdict.SCALE_DRIFT in s.alarms for s in steps)


def height_sample(t_ns, height_m):
    return RangeSample(
        stream="/height", t_ns=t_ns, received_ns=0, range_m=height_m, min_range_m=0, max_range_m=9,
        field_of_view_rad=0.1,
    )  # fmt: skip


@pytest.mark.parametrize("mapping", ["synchronous", "beside"])
@pytest.mark.parametrize("source", ["speed", "position"])
def test_speed_or_positions_give_the_scale_once_there_is_way(source, mapping):
    centres, _ = flights.way(FRAMES)
    given = []
    for k, picture in enumerate(samples(flights.pictures(FRAMES))):
        if k and source == "speed":
            speed = np.linalg.norm(centres[min(k + 1, FRAMES - 1)] - centres[k - 1]) / (
                (min(k + 1, FRAMES - 1) - k + 1) * flights.RATE_NS * 1e-9
            )
            given.append(odometry(picture.t_ns, speed))
        elif source == "position":
            given.append(PoseSample(
                stream="/truth", t_ns=picture.t_ns, received_ns=0, position_m=centres[k] + (5.0, 2.0, 0.0),
                quat_xyzw=np.array([0, 0, 0, 1.0]), covariance=np.full((6, 6), np.nan),
            ))  # fmt: skip
        given.append(picture)
    stream = {"speed": {"speed_stream": "/odometry"}, "position": {"position_stream": "/truth"}}[source]
    estimator = SemidirectOdometry(flights.settings(height_m=None, scale_way=0.4, mapping=mapping, **stream))
    steps, _ = flights.flown(estimator, given)
    known = [s.scale_known for s in steps]
    assert 0 in known
    assert known == sorted(known)
    first = known.index(1)
    assert 20 < first < 60
    assert flights.path_error(steps[first:])[1] == pytest.approx(1.0, abs=0.03)
    assert steps[-1].metres_per_unit == pytest.approx(1.5, abs=0.1)
    assert 0 < steps[-1].metres_per_unit_sigma < 0.1
    assert steps[first + 1].path_step_m == pytest.approx(1.6 / 60, rel=0.1)


def odometry(t_ns, speed):
    unknown = np.full(3, np.nan)
    return OdometrySample(
        stream="/odometry", t_ns=t_ns, received_ns=0, linear_velocity_mps=np.array([speed, 0, 0]),
        angular_velocity_radps=unknown, position_m=unknown, quat_xyzw=np.full(4, np.nan),
    )  # fmt: skip


# ---------------------------------------------------------------------------------------- the log


def test_every_field_has_its_declared_shape():
    for step in (
        *flights.flight(FRAMES)[:3],
        *flights.flight(FRAMES)[30:],
        *flights.flight(FRAMES, bundle_keyframes=5, max_keyframes=30)[-3:],
    ):
        letters = {}
        for name, declared in quantities(SemidirectStep).items():
            value = np.asarray(getattr(step, name)) if declared["shape"] else None
            if value is None:
                assert np.ndim(getattr(step, name)) == 0
                continue
            assert value.ndim == len(declared["shape"]), name
            for size, length in zip(declared["shape"], value.shape, strict=True):
                if isinstance(size, int):
                    assert length == size, name
                else:
                    assert letters.setdefault(size, length) == length, name


def test_the_log_of_a_frame_fits_together():
    steps = [s for s in flights.flight(FRAMES) if s.stage == Stage.TRACKED]
    for step in steps:
        assert step.tracked == np.count_nonzero(step.outcome == Feature.MATCHED)
        assert np.array_equal(step.outcome_count, np.bincount(step.outcome, minlength=9))
        assert len(np.unique(step.point_id)) == len(step.point_id)
        found = step.outcome == Feature.MATCHED
        assert np.all(step.error_px[found] <= 2.0)
        assert step.filter_count.sum() >= len(step.filter_id)
        if step.keyframe:
            assert step.keyframe_number[-1] == step.frame
            assert len(step.keyframe_number) == step.keyframes
            assert len(step.map_id) == step.map_points
            assert np.all(np.abs(step.map_point_m[:, 2]) < 0.15)  # the ground is at z = 0
        else:
            assert len(step.map_id) == len(step.keyframe_number) == 0
    assert sum(s.keyframe for s in steps) > 3
    assert np.isnan([s.stage_ms for s in steps]).all()  # no clock in a log that must be the same every time
    timed = flights.flight(20, stage_times=True)[-1].stage_ms
    assert np.isfinite(timed).all()
    assert timed[[0, 1, 2, 4]].min() > 0


# ----------------------------------------------------------------------------- mapping beside


ACCURATE = {"bundle_keyframes": 5, "max_keyframes": 30}


@pytest.mark.parametrize("changes", [{}, ACCURATE], ids=["fast", "accurate"])
def test_mapping_beside_tracking_flies_the_same_way(changes):
    steps, alone = flights.flight(FRAMES, mapping="beside", **changes), flights.flight(FRAMES, **changes)
    assert sum(s.stage == Stage.LOST for s in steps) == 0
    assert flights.path_error(steps)[0] < 1.2 * flights.path_error(alone)[0]
    for field in ("keyframe", "points_added", "bundle_iterations"):
        ours, theirs = (sum(getattr(s, field) for s in flight) for flight in (steps, alone))
        assert ours == pytest.approx(theirs, rel=0.15)
    assert [s.frame for s in steps if len(s.map_id)] == [s.frame for s in steps if s.keyframe]


class Stumbling(Mapper):
    """A mapper that takes its time with some frames."""

    def grown(self, world, posed):
        if posed.number % 7 == 0:
            time.sleep(0.05)
        return super().grown(world, posed)


def test_what_a_frame_meets_does_not_hang_on_how_fast_the_mapping_is(monkeypatch):
    monkeypatch.setattr(pipelines.semidirect.odometry, "Mapper", Stumbling)
    slow, _ = flights.flown(SemidirectOdometry(flights.settings(mapping="beside")), samples(flights.pictures(FRAMES)))
    for one, other in zip(flights.flight(FRAMES, mapping="beside"), slow, strict=True):
        same(one, other)


class Paused(Mapper):
    """A mapper that waits until it is let go on."""

    go_on = threading.Event()

    def grown(self, world, posed):
        assert self.go_on.wait(30)
        return super().grown(world, posed)


def test_tracking_runs_while_the_mapping_works_and_waits_when_it_is_behind(monkeypatch):
    pictures = samples(flights.pictures(FRAMES)[:40])
    monkeypatch.setattr(pipelines.semidirect.odometry, "Mapper", Paused)
    monkeypatch.setattr(Paused, "go_on", threading.Event())
    estimator = SemidirectOdometry(flights.settings(mapping="beside"))
    state, tracked = estimator.start(), []
    done = threading.Event()

    def fly():
        nonlocal state
        for one in pictures:
            state, step = estimator.step(state, one)
            tracked.append(step.stage)
        done.set()

    thread = threading.Thread(target=fly)
    thread.start()
    try:
        assert not done.wait(1.0)
        assert tracked.count(Stage.TRACKED) == BEHIND + 1
    finally:
        Paused.go_on.set()
        thread.join(30)
    assert done.is_set()
    assert tracked.count(Stage.LOST) == 0


def checksum(*tables):
    columns = (column for table in tables for column in table if isinstance(column, np.ndarray))
    return [zlib.crc32(np.ascontiguousarray(column)) for column in columns]


@pytest.mark.parametrize("changes", [{}, ACCURATE], ids=["fast", "accurate"])
def test_neither_thread_writes_to_what_both_read(changes, monkeypatch):
    shared = []

    class Watching(Mapper):
        def grown(self, world, posed):
            tables = (*world[:4], posed, posed.pyramid)
            shared.append((tables, checksum(*tables)))
            return super().grown(world, posed)

    monkeypatch.setattr(pipelines.semidirect.odometry, "Mapper", Watching)
    estimator = SemidirectOdometry(flights.settings(mapping="beside", **changes))
    flights.flown(estimator, samples(flights.pictures(FRAMES)[:70]))
    assert len(shared) > 40
    for tables, before in shared:
        assert checksum(*tables) == before


@pytest.mark.parametrize("stop", [4, 41])
def test_a_kept_state_goes_on_with_the_mapping_beside(stop):
    pictures, changes = flights.pictures(FRAMES)[:60], {"mapping": "beside"} | ACCURATE
    first = SemidirectOdometry(flights.settings(**changes))
    _, state = flights.flown(first, samples(pictures[:stop]))
    second = SemidirectOdometry(flights.settings(**changes))
    kept = decode(encode(first.packed(state)))
    steps, _ = flights.flown(second, samples(pictures[stop:], stop), second.unpacked(kept, lambda k: pictures[k]))
    for one, other in zip(steps, flights.flight(FRAMES, **changes)[stop:60], strict=True):
        same(one, other)
    alone = SemidirectOdometry(flights.settings(**ACCURATE))
    steps, state = flights.flown(
        alone, samples(pictures[stop:], stop), alone.adopted(first.unpacked(kept, pictures.__getitem__))
    )
    assert state.pending == ()
    assert sum(s.stage == Stage.LOST for s in steps) == 0
