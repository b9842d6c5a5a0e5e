"""The map of the semi-direct odometry: its tables against a plain model, its growth against a known scene."""

import subprocess
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
import semidirect_flights as flights
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines import lens
from pipelines.geometry import se3_exp, se3_inverse
from pipelines.semidirect import local_map, mapping, refinement, relocalisation
from pipelines.semidirect.beside import Beside, settled
from pipelines.semidirect.local_map import Keyframes, LocalMap, PointState, Sightings
from pipelines.semidirect.mapping import Mapper, Posed
from pipelines.semidirect.optics import optics_of
from pipelines.semidirect.pyramid import Pyramid, pyramid_of
from pipelines.semidirect.refinement import Observations
from pipelines.semidirect.scale import Plane
from pipelines.semidirect.starting import standing, unit_of
from pipelines.semidirect.step import Feature, Stage
from pipelines.semidirect.tracking import Tracker

SETTINGS = flights.settings()
OPTICS = optics_of(SETTINGS.camera(flights.WIDTH, flights.HEIGHT))
ROOT = Path(__file__).parents[1]
TINY = Pyramid(np.zeros(3, np.uint8), 1, 1)


def empty():
    keyframes = Keyframes(np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.zeros((0, 3), np.uint8))
    points = local_map.new_points(
        np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), PointState.KNOWN
    )
    seen = Observations(np.zeros(1, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, np.int64))
    return LocalMap(keyframes, points, seen, local_map.no_filters(), 0)


def told(world):
    """Who saw what: {point's number: {keyframe's number: (u, v, level)}}, read from the tables."""
    table = {}
    for row, number in enumerate(world.points.number.tolist()):
        views = slice(world.seen.first[row], world.seen.first[row + 1])
        table[number] = {
            int(world.keyframes.number[k]): (*pixel, level)
            for k, pixel, level in zip(*(column[views].tolist() for column in world.seen[1:]), strict=True)
        }
    return table


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from(["points", "keyframe", "forget", "drop"]), st.integers(0, 10**6)), max_size=12)
)
def test_tables_are_those_of_a_plain_model(changes):
    world, model, keyframes = empty(), {}, []
    for clock, (change, seed) in enumerate(changes):
        rng = np.random.default_rng(seed)
        if change == "keyframe":
            rows = np.flatnonzero(rng.random(len(model)) < 0.5)
            pixels, level = rng.uniform(0, 99, (len(rows), 2)), rng.integers(0, 3, len(rows))
            world = local_map.with_keyframe(
                world, clock, se3_exp(rng.normal(size=6)), TINY, Sightings(rows, pixels, level)
            )
            keyframes.append(clock)
            for row, pixel, one in zip(rows, pixels.tolist(), level.tolist(), strict=True):
                model[sorted(model)[row]][clock] = (*pixel, one)
        elif change == "points" and keyframes:
            # numbers that lie between those that are there: filters converge in any order
            numbers = np.array(sorted(set(rng.integers(0, 500, 5).tolist()) - set(model)))
            n = len(numbers)
            which, pixels, level = rng.integers(0, len(keyframes), n), rng.uniform(0, 99, (n, 2)), np.zeros(n, np.int64)
            fresh = local_map.new_points(
                numbers, rng.normal(size=(n, 3)), np.ones((n, 3, 3)), np.ones(n), PointState.CANDIDATE
            )
            world = local_map.with_points(world, fresh, which, pixels, level)
            for number, k, pixel in zip(numbers.tolist(), which, pixels.tolist(), strict=True):
                model[number] = {keyframes[k]: (*pixel, 0)}
        elif change == "forget" and keyframes:
            row = int(rng.integers(len(keyframes)))
            world, gone = local_map.without_keyframe(world, row)
            number = keyframes.pop(row)
            left = {p: {k: v for k, v in views.items() if k != number} for p, views in model.items()}
            assert gone == sum(not views for views in left.values())
            model = {p: views for p, views in left.items() if views}
        elif change == "drop":
            out = rng.random(len(model)) < 0.3
            world = local_map.without_points(world, out)
            model = {p: model[p] for p, gone in zip(sorted(model), out, strict=True) if not gone}
        assert told(world) == model
        assert world.keyframes.number.tolist() == keyframes
        assert len(world.keyframes.cam_t_world) == len(world.keyframes.grey) == len(keyframes)
        assert {len(column) for column in world.points} == {len(model)}


def test_scaling_a_map_changes_no_picture_of_it():
    world = grown()[1]
    about = np.array([0.3, -0.2, 0.0])
    larger = local_map.scaled(world, 1.7, about)
    for row in range(len(world.keyframes.number)):
        before = local_map.projections(OPTICS, world.points.place, world.keyframes.cam_t_world[row])
        after = local_map.projections(OPTICS, larger.points.place, larger.keyframes.cam_t_world[row])
        assert np.allclose(after[:, :2], before[:, :2], atol=1e-9)
        assert np.allclose(after[:, 2], 1.7 * before[:, 2])
    assert np.allclose(larger.filters.belief[:, 0] * 1.7, world.filters.belief[:, 0])
    assert np.allclose(np.sqrt(larger.filters.belief[:, 1]) * 1.7, np.sqrt(world.filters.belief[:, 1]))
    assert np.allclose(larger.points.covariance, world.points.covariance * 1.7**2, equal_nan=True)
    fixed = local_map.scaled(world, 1.7, local_map.centre_of(world.keyframes.cam_t_world[0]))
    assert np.allclose(fixed.keyframes.cam_t_world[0], world.keyframes.cam_t_world[0])


# -------------------------------------------------------------------------------------- growth


def grown(last=40, **changes):
    """The tracker, and the map after a flight's first frames."""
    from pipelines.semidirect.odometry import SemidirectOdometry

    estimator = SemidirectOdometry(flights.settings(**changes))
    pictures = flights.pictures(90)[:last]
    steps, state = flights.flown(estimator, (flights.sample(grey, k) for k, grey in enumerate(pictures)))
    assert steps[-1].stage == Stage.TRACKED
    return Tracker(OPTICS, (flights.HEIGHT, flights.WIDTH), flights.settings(**changes)), state.world, state.last


def mapper_of(**changes):
    return Mapper(Tracker(OPTICS, (flights.HEIGHT, flights.WIDTH), flights.settings(**changes)))


def without_error(world):
    """The map with the observations that its poses and points would give."""
    exact, owner = world.seen.pixels.copy(), local_map.owners(world.seen)
    for row, pose in enumerate(world.keyframes.cam_t_world):
        at = world.seen.frame == row
        exact[at] = local_map.projections(OPTICS, world.points.place[owner[at]], pose)[:, :2]
    return world._replace(seen=world.seen._replace(pixels=exact))


def posed_again(world, last, number=900):
    """The last frame of a flight as the mapping gets it, as if it came once more."""
    tracked = Tracker(OPTICS, (flights.HEIGHT, flights.WIDTH), SETTINGS).refined(world, last.pyramid, last.cam_t_world)
    rows, pixels, level = tracked.sightings
    missed = np.zeros(0, np.int64)
    return Posed(
        number, last.pyramid, tracked.cam_t_world, world.points.number[rows], pixels, level, missed, tracked.depth
    )


def test_points_of_the_filters_lie_on_the_ground():
    _, world, _ = grown()
    fresh = world.points.state == PointState.CANDIDATE
    assert fresh.sum() > 20
    z = world.points.place[:, 2]
    assert np.abs(np.median(z[fresh])) < 0.01
    assert np.percentile(np.abs(z), 95) < 0.04
    # along the ray of the first view the covariance is σ², across it about a pixel
    spread = np.linalg.eigvalsh(world.points.covariance[fresh])
    assert np.allclose(np.sqrt(spread[:, 2]), np.maximum(world.points.sigma[fresh], np.sqrt(spread[:, 1])), rtol=1e-6)
    assert np.median(np.sqrt(spread[:, 0])) == pytest.approx(1.5 / flights.FOCAL, rel=0.2)
    known = np.isfinite(world.points.sigma)
    # σ is that of errors of a whole pixel: they are smaller
    assert 0.05 < np.std(z[known] / world.points.sigma[known]) < 3


def test_one_point_a_cell_and_no_more_than_wanted():
    tracker, world, last = grown(max_features=40)
    tracked = tracker.refined(world, last.pyramid, last.cam_t_world)
    found = tracked.looked.features.predicted[tracked.looked.outcome == Feature.MATCHED]
    cells = np.floor(found / SETTINGS.cell_px).astype(int)
    assert len(found) <= 40
    assert len(np.unique(cells, axis=0)) == len(cells)
    assert not np.any(tracked.looked.outcome == Feature.NOT_TRIED)


def test_a_wrong_start_is_drawn_to_the_true_pose():
    tracker, world, last = grown()
    off = se3_exp(np.array([0.004, -0.003, 0.002, 0.002, -0.001, 0.003]))
    tracked = tracker.refined(world, last.pyramid, off @ last.cam_t_world)
    miss = local_map.centre_of(tracked.cam_t_world) - local_map.centre_of(last.cam_t_world)
    assert np.linalg.norm(miss) < 5e-4
    assert tracked.points > 60


def test_the_bundle_takes_planted_errors_back_and_drops_a_false_view():
    _, world, _ = grown(bundle_keyframes=0)
    k = world.keyframes
    rng = np.random.default_rng(3)
    truth, owner = without_error(world), local_map.owners(world.seen)
    poses = k.cam_t_world.copy()
    poses[-1] = se3_exp(np.array([0.01, -0.01, 0.005, 0.004, 0.002, -0.004])) @ poses[-1]
    views = np.diff(world.seen.first)
    false = int(np.flatnonzero((world.seen.frame == len(k.number) - 1) & (views[owner] > 2))[0])
    pixels = truth.seen.pixels.copy()
    pixels[false] += (15.0, -12.0)
    shaken = truth._replace(
        keyframes=k._replace(cam_t_world=poses),
        points=world.points._replace(place=world.points.place + rng.normal(0, 0.002, world.points.place.shape)),
        seen=truth.seen._replace(pixels=pixels),
    )
    mapper = mapper_of(bundle_keyframes=len(k.number), max_keyframes=30, bundle_iterations=60)
    after, bundle, taking_part, _ = mapper._bundled(shaken)
    assert bundle is not None
    assert taking_part >= 3
    rows = mapping.sharing_keyframes(shaken, len(k.number))
    assert np.array_equal(after.keyframes.cam_t_world[rows[:2]], poses[rows[:2]])  # held
    before = np.linalg.norm(local_map.centre_of(poses[-1]) - local_map.centre_of(k.cam_t_world[-1]))
    miss = np.linalg.norm(local_map.centre_of(after.keyframes.cam_t_world[-1]) - local_map.centre_of(k.cam_t_world[-1]))
    assert miss < before / 3  # Huber bounds what the false view does
    assert len(after.seen.frame) < len(shaken.seen.frame)
    number = int(world.points.number[owner[false]])
    assert int(k.number[-1]) not in told(after).get(number, {})
    again = mapper._bundled(after)[0].keyframes.cam_t_world[-1]  # without it nothing is left of the error
    assert np.linalg.norm(local_map.centre_of(again) - local_map.centre_of(k.cam_t_world[-1])) < 1e-6


def test_keyframes_beyond_the_bundle_are_held_and_their_views_count():
    truth = without_error(grown(60)[1])
    inside = mapping.sharing_keyframes(truth, 4)
    assert len(truth.keyframes.number) > len(inside) == 4
    noise = np.random.default_rng(4).normal(0, 0.3, truth.seen.pixels.shape)
    noisy = truth._replace(seen=truth.seen._replace(pixels=truth.seen.pixels + noise))
    without = local_map.with_observations(noisy, np.isin(noisy.seen.frame, inside))
    of_inside = np.unique(local_map.owners(truth.seen)[np.isin(truth.seen.frame, inside)])
    points = of_inside[np.diff(truth.seen.first)[of_inside] > 1]
    error = {}
    for name, world in {"all": noisy, "inside": without}.items():
        after, bundle, taking_part, _ = mapper_of(bundle_keyframes=4, bundle_iterations=60)._bundled(world)
        assert taking_part == 4
        held = np.setdiff1d(np.arange(len(truth.keyframes.number)), inside[2:])
        assert np.array_equal(after.keyframes.cam_t_world[held], truth.keyframes.cam_t_world[held])
        rows = local_map.rows_of(after.points.number, truth.points.number[points])
        off = np.linalg.norm(after.points.place[rows] - truth.points.place[points], axis=1)[rows >= 0]
        error[name] = np.sqrt(np.mean(off**2))
        if name == "all":
            assert len(bundle.error_px) == np.diff(truth.seen.first)[points].sum()
    assert error["all"] < 0.8 * error["inside"]


def test_a_keyframe_sees_all_points_in_its_view_and_has_its_pose_by_them():
    _, world, last = grown()
    posed = posed_again(world, last)
    pose, sightings = mapper_of()._sighted(world, posed)
    expected = local_map.projections(OPTICS, world.points.place, pose)
    edge = np.array([flights.WIDTH, flights.HEIGHT]) - 12
    inside = np.flatnonzero(((expected[:, :2] >= 12) & (expected[:, :2] < edge)).all(axis=1))
    assert len(sightings.rows) > 1.4 * len(posed.found)
    assert np.isin(inside, sightings.rows).mean() > 0.9
    assert np.all(np.diff(sightings.rows) > 0)
    error = sightings.pixels - expected[sightings.rows, :2]
    assert np.linalg.norm(error, axis=1).max() <= 2 * SETTINGS.inlier_px
    alone = refinement.refine_pose(
        OPTICS, world.points.place[sightings.rows], sightings.pixels, sightings.level, pose, refinement.PoseOptions()
    )
    assert np.abs(alone.cam_t_world - pose).max() < 1e-6  # nothing is left to gain


def test_a_keyframe_without_more_points_keeps_what_tracking_found():
    _, world, last = grown()
    posed = posed_again(world, last)
    blank = pyramid_of(np.full((flights.HEIGHT, flights.WIDTH), 90, np.uint8))
    for mapper, frame in ((mapper_of(), posed._replace(pyramid=blank)), (mapper_of(keyframe_points="tracked"), posed)):
        pose, sightings = mapper._sighted(world, frame)
        assert np.array_equal(pose, posed.cam_t_world)
        assert np.array_equal(world.points.number[sightings.rows], posed.found)
        assert np.array_equal(sightings.pixels, posed.pixels)


def test_points_of_a_keyframe_are_refined_at_once():
    _, world, last = grown()
    rng = np.random.default_rng(8)
    moved = world._replace(
        points=world.points._replace(place=world.points.place + rng.normal(0, 0.002, world.points.place.shape))
    )
    growth = mapper_of(keyframe_distance=1e-9, max_keyframes=30).grown(moved, posed_again(world, last))
    after = growth.world
    seen_by_last = local_map.owners(after.seen)[after.seen.frame == len(after.keyframes.number) - 1]
    rows = seen_by_last[np.diff(after.seen.first)[seen_by_last] > 1]
    assert growth.keyframe
    assert growth.sighted == len(seen_by_last)
    assert growth.refined == len(rows) > 80
    again = refinement.refine_points(
        OPTICS, after.keyframes.cam_t_world, mapping._observations_of_points(after.seen, rows),
        after.points.place[rows], 5,
    )  # fmt: skip
    assert np.abs(again.points - after.points.place[rows]).max() < 1e-6  # nothing is left to gain
    assert np.isfinite(after.points.covariance[rows]).all()


def test_points_that_are_not_found_again_go():
    _, world, last = grown()
    mapper = mapper_of(point_failures=2, candidate_failures=4)
    known = world.points.number[world.points.state >= PointState.KNOWN][:5]
    fresh = world.points.number[world.points.state == PointState.CANDIDATE][:5]
    posed = Posed(
        900, last.pyramid, last.cam_t_world, np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, np.int64),
        np.sort(np.concatenate([known, fresh])), 1.5,
    )  # fmt: skip
    world = world._replace(points=world.points._replace(missed=np.zeros(len(world.points.number), np.int64)))
    for turn in range(5):
        world, gone = mapper._counted(world, posed)
        assert np.isin(known, world.points.number).all() == (turn < 2)
        assert np.isin(fresh, world.points.number).all() == (turn < 4)
        assert gone == {2: 5, 4: 5}.get(turn, 0)


def test_the_farthest_keyframe_goes():
    steps = flights.flight(90, max_keyframes=4)
    assert max(s.keyframes for s in steps) == 4
    gone = [s for s in steps if s.keyframe_removed >= 0]
    assert gone
    place = {int(n): p for s in steps for n, p in zip(s.keyframe_number, s.keyframe_position_m, strict=True)}
    for step in gone:
        away = np.linalg.norm(step.keyframe_position_m - step.position_m, axis=1)
        assert np.linalg.norm(place[step.keyframe_removed] - step.position_m) > away.max()
    assert sum(s.points_removed[0] for s in gone) > 0


# ------------------------------------------------------------------------- beside, lost and found


SHIFT = se3_exp(np.array([0.1, 0, 0, 0, 0, 0.02]))


class Growing:
    """A mapper that works when it is let, notes the frames it gets, and moves the poses of each."""

    def __init__(self):
        self.let, self.got = threading.Semaphore(0), []

    def grown(self, world, posed):
        assert self.let.acquire(timeout=30)
        self.got.append((posed, threading.current_thread()))
        if posed.number == 99:
            raise ValueError("broken on purpose")
        nothing = dict.fromkeys(mapping.Growth._fields)
        world = world._replace(next_number=posed.number)
        return mapping.Growth(**nothing | {"world": world, "shift": SHIFT, "cam_t_world": posed.cam_t_world @ SHIFT})


def frame_of(last, number):
    none = np.zeros(0, np.int64)
    return Posed(number, last.pyramid, last.cam_t_world, none, np.zeros((0, 2)), none, none, 1.5)


def test_mapping_beside_takes_every_frame_in_its_turn_and_hands_on_adjustments():
    _, world, last = grown()
    mapper = Growing()
    beside, pending = Beside(mapper), ()
    for number in (50, 51, 52):
        pending = beside.posted(world, pending, frame_of(last, number))  # the mapping is stuck: nothing waits for it
    mapper.let.release(3)
    poses = [last.cam_t_world @ np.linalg.matrix_power(SHIFT, k) for k in range(4)]
    for k, number in enumerate((50, 51, 52)):
        assert np.allclose(pending[0].posed.cam_t_world, poses[k])  # by the map that it grows
        growth, pending = settled(pending)
        assert growth.world.next_number == number
        assert np.allclose(growth.cam_t_world, poses[k + 1])
    assert pending == ()
    assert [posed.number for posed, _ in mapper.got] == [50, 51, 52]
    assert len({thread for _, thread in mapper.got} - {threading.current_thread()}) == 1


def test_what_the_mapping_raises_is_raised_for_its_frame_and_those_behind():
    _, world, last = grown()
    mapper = Growing()
    mapper.let.release(3)
    pending = Beside(mapper).begun(world, [frame_of(last, number) for number in (50, 99, 51)])
    _, pending = settled(pending)
    with pytest.raises(ValueError, match="on purpose"):
        settled(pending)
    with pytest.raises(ValueError, match="on purpose"):
        pending[1].growth.result(timeout=30)
    assert [posed.number for posed, _ in mapper.got] == [50, 99]


def test_the_thread_ends_when_nobody_holds_the_mapper():
    _, world, last = grown()
    mapper = Growing()
    mapper.let.release()
    settled(Beside(mapper).posted(world, (), frame_of(last, 50)))
    thread = mapper.got[0][1]
    thread.join(timeout=30)
    assert not thread.is_alive()


END = """
import time
from pipelines.semidirect.beside import Beside, settled

class Slow:
    def grown(self, world, posed):
        time.sleep(0.3)
        print("mapped", posed, flush=True)
        return type("Growth", (), {"world": world, "shift": None})

Beside(Slow()).posted(None, (), 7)
"""


def test_the_mapping_ends_its_frame_before_the_interpreter_goes():
    """A thread that is still within OpenCV's code then aborts the process."""
    done = subprocess.run([sys.executable, "-c", END], capture_output=True, text=True, timeout=60, cwd=ROOT)
    assert (done.returncode, done.stdout, done.stderr) == (0, "mapped 7\n", "")


def test_shifts_of_many_keyframes_stay_motions():
    """What a matrix lacks of a rotation must not grow from keyframe to keyframe."""
    pose, rng = np.eye(4), np.random.default_rng(3)
    for _ in range(200):
        adjusted = se3_exp(1e-3 * rng.standard_normal(6)) @ pose
        shift = mapping.motion_between(pose, adjusted)
        assert np.abs(pose @ shift - adjusted).max() < 1e-12
        pose = pose @ shift
    assert np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() < 1e-12


@pytest.mark.parametrize("angle", [0.0, 0.2])
def test_small_images_tell_a_rigid_motion(angle):
    pyramid = pyramid_of(flights.pictures(90)[20])
    level = relocalisation.small_level(pyramid)
    assert min(pyramid.height, pyramid.width) >> level >= 30
    image = local_level(pyramid, level)
    c, s = np.cos(angle), np.sin(angle)
    centre = (np.array(image.shape[::-1]) - 1) / 2
    turn = np.array([[c, -s], [s, c]])
    motion = np.column_stack([turn, centre - turn @ centre + (4.0, -3.0)])
    moved = cv2.warpAffine(image, motion, image.shape[::-1], borderMode=cv2.BORDER_REFLECT)
    found, correlation = relocalisation.small_motion(image, moved)
    assert correlation > 0.97
    assert np.allclose(found @ [*centre, 1], motion @ [*centre, 1], atol=0.2)
    assert np.arctan2(found[1, 0], found[0, 0]) == pytest.approx(angle, abs=0.03)
    pixels = np.array([[100.0, 80.0]])
    there = relocalisation.moved_pixels(motion, pixels, level)
    size = 1 << level
    small = (pixels + 0.5) / size - 0.5
    assert np.allclose((there + 0.5) / size - 0.5, small @ motion[:, :2].T + motion[:, 2])


def test_images_without_contrast_tell_nothing():
    image = np.full((30, 40), 90, np.uint8)
    assert np.isnan(relocalisation.small_motion(image, image)[1])


def local_level(pyramid, level):
    from pipelines.semidirect.pyramid import level_image

    return level_image(pyramid, level)


@pytest.mark.parametrize(("direction", "height"), [("vertical", 1.5), ("axis", 1.5 / np.cos(0.4))])
def test_heights_along_the_axis_are_longer_than_over_the_ground(direction, height):
    normal = np.array([np.sin(0.4), 0.0, np.cos(0.4)])
    plane = Plane(normal, 0.75, 0.001, 0.001, 100)  # 0.75 units over the ground are 1.5 m
    assert unit_of(plane, height, direction) == pytest.approx(2.0)
    assert unit_of(plane, np.nan, direction) == 1.0


def test_the_world_of_a_start_stands_on_the_plane():
    normal = np.array([0.1, -0.05, 1.0]) / np.linalg.norm([0.1, -0.05, 1.0])
    pose = standing(normal, 2.0, (3.0, -4.0), 0.6)
    world_t_cam = se3_inverse(pose)
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    assert np.allclose(world_t_cam[:3, 3], (3.0, -4.0, 2.0))
    assert np.allclose(world_t_cam[:3, :3] @ normal, (0, 0, -1))
    assert np.arctan2(world_t_cam[1, 0], world_t_cam[0, 0]) == pytest.approx(0.6)
    # a point of the plane n·x = 2 in camera axes is on the ground
    ray = lens.rays(flights.CAMERA, np.array([[40.0, 200.0]]))[0]
    point = ray * (2.0 / (ray @ normal))
    assert (world_t_cam @ [*point, 1])[2] == pytest.approx(0, abs=1e-12)
