"""The PTAM-style baseline: it flies, says when it is lost, finds itself again, and is the same each time."""

import dataclasses
import functools

import cv2
import numpy as np
import pytest
import textured_plane
from pydantic import ValidationError

from pipelines import lens
from pipelines.estimator import EstimatorError, FrameImage, Resumable
from pipelines.geometry import se3_exp, se3_inverse, se3_product
from pipelines.semidirect import baseline_map, baseline_search
from pipelines.semidirect.baseline import BaselineOdometry, levelled
from pipelines.semidirect.baseline_map import Seen
from pipelines.semidirect.baseline_search import (
    SearchOptions,
    Sources,
    find_points,
    free_corners,
    turn_between,
    view_of,
)
from pipelines.semidirect.baseline_settings import BaselineSettings
from pipelines.semidirect.features import FeatureOptions
from pipelines.semidirect.optics import optics_of
from pipelines.semidirect.pyramid import level_image
from pipelines.semidirect.refinement import BundleOptions
from pipelines.semidirect.step import Feature, Stage
from pipelines.simulation.scenario import Scenario, build
from pipelines.verdict import Verdict
from readers.streams import ImageSample, PoseSample, Problem, StreamKind

WIDTH, HEIGHT, FOCAL, ABOVE = 376, 240, 210.0, 1.5
EQUIDISTANT = ("equidistant", (-0.01, 0.004, 0.0, 0.0))
UNUSED = np.zeros((0, 2)), np.zeros(0, np.int64)


@functools.cache
def flight(frames: int = 130, model: str = "none", distortion: tuple[float, ...] = ()):
    """Images of a small UAV over gravel at 30 Hz with the camera's true poses: samples, positions [n, 3], headings."""
    mission = build(
        Scenario.model_validate(
            {
                "name": "flight",
                "seed": 5,
                "frames": frames,
                "ground": {"metres_per_px": 0.0072},
                "trajectory": {
                    "curve": "wander",
                    "parameters": {"amplitude_m": 0.5, "wavelength_m": 4.0},
                    "speed_kmh": 3.6,
                    "profile": "constant",
                },
                "body": {"roll_rms_rad": 0.03, "pitch_rms_rad": 0.03, "roll_tau_s": 0.5, "pitch_tau_s": 0.5},
                "camera": {
                    "width_px": WIDTH,
                    "height_px": HEIGHT,
                    "focal_px": FOCAL,
                    "height_m": ABOVE,
                    "distortion_model": model,
                    "distortion": distortion,
                    "timing": {"rate_hz": 30.0},
                },
                "reference": {"timing": {"rate_hz": 30.0}},
            }
        )
    )
    samples = list(mission.read(["/camera/image_raw", "/reference/pose"]))
    images = [sample(s.grey(), s.t_ns, k) for k, s in enumerate(s for s in samples if isinstance(s, ImageSample))]
    poses = {s.t_ns: s for s in samples if isinstance(s, PoseSample)}
    return images, np.array([poses[image.t_ns].position_m for image in images]), mission.truth_poses[:, 2]


def sample(grey: np.ndarray, t_ns: int, frame: int) -> ImageSample:
    grey = np.ascontiguousarray(grey)
    rows, columns = grey.shape
    return ImageSample(
        stream="/camera/image_raw",
        t_ns=t_ns,
        received_ns=t_ns,
        encoding="mono8",
        payload=grey.tobytes(),
        width_px=columns,
        height_px=rows,
        step_bytes=columns,
        frame=frame,
    )


def blank(image: ImageSample) -> ImageSample:
    return sample(np.full((HEIGHT, WIDTH), 90 + image.frame % 2, np.uint8), image.t_ns, image.frame)


def odometry(**settings) -> BaselineOdometry:
    return BaselineOdometry(BaselineSettings(**{"focal_px": FOCAL, "height_m": ABOVE} | settings))


def flown(estimator: BaselineOdometry, samples):
    state, steps = estimator.start(), []
    for one in samples:
        state, step = estimator.step(state, one)
        steps.append(step)
    return state, steps


@functools.cache
def usual():
    """The steps of the usual flight."""
    return flown(odometry(start_pose=(2.0, -1.0, 0.4)), flight()[0])[1]


def similarity(a: np.ndarray, b: np.ndarray) -> tuple[float, np.ndarray]:
    """The scale and the distances [n] that are left after Umeyama's Sim(3) of a over b."""
    a0, b0 = a - a.mean(0), b - b.mean(0)
    u, d, vt = np.linalg.svd(b0.T @ a0)
    sign = np.array([1, 1, np.linalg.det(u @ vt)])
    scale = float((d * sign).sum() / (a0**2).sum())
    return scale, np.linalg.norm(scale * a0 @ (u @ np.diag(sign) @ vt).T - b0, axis=1)


def same(a, b) -> bool:
    return all(
        np.array_equal(getattr(a, f.name), getattr(b, f.name), equal_nan=True) for f in dataclasses.fields(type(a))
    )


# ---------------------------------------------------------------------------------- whole flights


def accuracy(steps, truth: np.ndarray) -> tuple[float, float]:
    """Scale, and root mean square error over the path."""
    found = np.array([s.accepted for s in steps])
    scale, error = similarity(np.array([s.position_m for s in steps])[found], truth[found])
    way = np.linalg.norm(np.diff(truth[found], axis=0), axis=1).sum()
    return scale, float(np.sqrt(np.mean(error**2)) / way)


def test_a_flight_is_followed_within_three_thousandths_of_its_path() -> None:
    steps, (_, truth, heading) = usual(), flight()
    begun = next(k for k, s in enumerate(steps) if s.stage == Stage.STARTED)
    assert begun < 40
    assert all(s.stage == Stage.TRACKED and s.verdict == Verdict.OK for s in steps[begun + 1 :])
    scale, error = accuracy(steps, truth)
    assert error < 3e-3
    assert scale == pytest.approx(1, abs=0.02)  # height_m is that of the level body
    assert steps[-1].keyframes > 10
    # the world's axes: z up, x along the start's heading
    turned = np.array([s.pose[2] for s in steps[begun:]]) - (heading[begun:] - heading[0]) - 0.4
    np.testing.assert_allclose(np.angle(np.exp(1j * turned)), 0, atol=0.01)
    way = steps[-1].position_m - [2.0, -1.0, ABOVE]
    c, s = np.cos(0.4 - heading[0]), np.sin(0.4 - heading[0])
    np.testing.assert_allclose(way, np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ (truth[-1] - truth[0]), atol=0.1)


def test_the_map_lies_on_the_ground_but_for_few_points() -> None:
    last = [s for s in usual() if len(s.map_id)][-1]
    assert len(last.map_id) == last.map_points == len(set(last.map_id.tolist()))
    assert np.mean(np.abs(last.map_point_m[:, 2]) < 0.05) > 0.95
    assert np.all(last.map_point_views >= 2)
    assert np.nanmedian(last.map_point_sigma_m) < 0.02


def test_alignment_of_all_matches_is_better_than_whole_pixels() -> None:
    _, steps = flown(odometry(align_level=0), flight()[0])
    assert accuracy(steps, flight()[1])[1] < 0.5 * accuracy(usual(), flight()[1])[1]


def test_a_fisheye_lens_is_flown_with() -> None:
    images, truth, _ = flight(45, *EQUIDISTANT)
    model, distortion = EQUIDISTANT
    _, steps = flown(odometry(distortion_model=model, distortion=distortion), images)
    assert sum(s.accepted for s in steps) > 25
    assert accuracy(steps, truth)[1] < 5e-3


def test_without_a_height_the_unit_is_the_depth_of_the_first_map() -> None:
    steps = flown(odometry(height_m=None), flight()[0][:60])[1]
    with_height = usual()[59]
    assert steps[-1].scale_known == 0
    assert np.isnan(steps[-1].metres_per_unit)
    assert with_height.scale_known == 1
    assert with_height.position_m[2] == pytest.approx(with_height.metres_per_unit * steps[-1].position_m[2], rel=1e-2)


# ------------------------------------------------------------------------------ lost and found


def test_blank_images_are_lost_and_the_way_goes_on_behind_them() -> None:
    images, truth, _ = flight()
    dark = range(80, 92)
    _, steps = flown(odometry(), [blank(i) if i.frame in dark else i for i in images])
    for k in dark:
        assert steps[k].stage == Stage.LOST
        assert steps[k].verdict == Verdict.LOST
        assert not steps[k].accepted
        np.testing.assert_array_equal(steps[k].position_m, steps[79].position_m)
        assert steps[k].path_step_m == 0
    found = next(k for k in range(92, len(steps)) if steps[k].accepted)
    assert found < 95
    assert all(s.accepted and s.map_number == 0 for s in steps[found:])
    assert accuracy(steps, truth)[1] < 5e-3


def test_back_over_a_keyframe_the_camera_is_relocalised() -> None:
    """After the loss the images are those of the way back: the motion model is wrong, the keyframes are not."""
    images, _truth, _ = flight()
    gap = images[100].t_ns - images[99].t_ns
    back = [
        sample(images[k].grey(), images[99].t_ns + (i + 11) * gap, 110 + i) for i, k in enumerate(range(70, 50, -1))
    ]
    dark = [blank(sample(images[0].grey(), images[99].t_ns + (i + 1) * gap, 100 + i)) for i in range(10)]
    _, steps = flown(odometry(), [*images[:100], *dark, *back])
    first = next(s for s in steps[110:] if s.accepted)
    assert first.stage == Stage.RELOCALISED
    assert Verdict.REACQUIRED in first.alarms
    assert first.relocalised_frames == 0
    assert first.relocalise_correlation > 0.5
    assert first.relocalise_keyframe in range(40, 90)
    assert steps[-1].relocalised_frames == len(steps) - 1 - steps.index(first)
    np.testing.assert_allclose(steps[-1].position_m, steps[51].position_m, atol=0.02)


def test_a_new_map_is_begun_when_lost_for_long() -> None:
    images, *_ = flight()
    _, steps = flown(odometry(restart_s=0.2), [blank(i) if 50 <= i.frame < 60 else i for i in images])
    started = [k for k, s in enumerate(steps) if s.stage == Stage.STARTED]
    assert [steps[k].map_number for k in started] == [0, 1]
    assert all(Verdict.LOST in s.alarms and not s.accepted for s in steps[50 : started[1]])
    after = steps[started[1]]
    assert after.scale_known == 0
    assert np.isnan(after.metres_per_unit)
    assert min(after.map_id) > max(max(s.map_id, default=-1) for s in steps[: started[1]])
    assert after.position_m[2] == pytest.approx(ABOVE, abs=0.15)
    assert steps[-1].accepted


def test_a_camera_that_stands_makes_no_map_and_no_keyframes() -> None:
    images, *_ = flight()
    noise = np.random.default_rng(1)
    still = [
        sample(
            np.clip(images[0].grey() + noise.normal(0, 2, (HEIGHT, WIDTH)), 0, 255).astype(np.uint8), i.t_ns, i.frame
        )
        for i in images[:20]
    ]
    _, steps = flown(odometry(), still)
    assert [s.stage for s in steps] == [Stage.FIRST] + [Stage.STARTING] * 19
    assert not any(s.accepted or s.keyframe for s in steps)


# ------------------------------------------------------------------------------ frames that fail


def test_frames_that_cannot_be_used_are_skipped() -> None:
    images, *_ = flight()
    estimator = odometry()
    state, steps = flown(estimator, images[:60])
    t_ns, late = images[60].t_ns, images[30]
    broken = Problem(
        stream="/camera/image_raw", t_ns=t_ns, received_ns=t_ns, kind=StreamKind.IMAGE, reason="", frame=60
    )
    small = sample(images[60].grey()[:200], t_ns, 60)
    short = dataclasses.replace(images[60], payload=b"12")
    again = sample(images[59].grey(), t_ns, 60)
    for one, verdict in (
        (broken, Verdict.UNDECODABLE),
        (short, Verdict.UNDECODABLE),
        (small, Verdict.SIZE_CHANGED),
        (late, Verdict.OUT_OF_ORDER),
        (again, Verdict.DUPLICATE_FRAME),
    ):
        after, step = estimator.step(state, one)
        assert step.stage == Stage.SKIPPED
        assert step.verdict == verdict
        assert not step.accepted
        np.testing.assert_array_equal(step.position_m, steps[-1].position_m)
        assert estimator.step(after, images[60])[1].accepted
    assert estimator.step(state, dataclasses.replace(broken, kind=StreamKind.IMU)) == (state, None)


def test_missing_frames_are_told() -> None:
    images, *_ = flight()
    _, steps = flown(odometry(), [i for i in images[:70] if i.frame not in (50, 51)])
    assert [s.frame for s in steps if Verdict.FRAME_GAP in s.alarms] == [52]


def test_an_unknown_camera_and_wrong_sizes_are_errors() -> None:
    image = flight()[0][0]
    for settings, words in (
        ({"focal_px": None}, "set focal_px"),
        ({"image_size_px": (752, 480)}, "752 x 480"),
        ({"distortion_model": "odd"}, "odd"),
    ):
        estimator = odometry(**settings)
        with pytest.raises(EstimatorError, match=words):
            estimator.step(estimator.start(), image)
    with pytest.raises(EstimatorError, match="larger"):
        odometry().step(odometry().start(), sample(np.zeros((8, 8), np.uint8), 0, 0))


@pytest.mark.parametrize(
    "wrong",
    [
        {"coarse_level": 0},
        {"coarsest_level": 1},
        {"min_tracked": 2000},
        {"coarse_min": 61},
        {"max_keyframes": 2},
        {"corners": 3},
    ],
)
def test_settings_that_cannot_be_are_errors(wrong: dict) -> None:
    with pytest.raises(ValidationError, match=next(iter(wrong))):
        BaselineSettings(**wrong)


# ----------------------------------------------------------------------------- the same each time


def test_equal_input_gives_equal_steps_also_from_a_packed_state() -> None:
    images, *_ = flight()
    estimator = odometry(start_pose=(2.0, -1.0, 0.4))
    assert isinstance(estimator, Resumable)
    state, steps = flown(estimator, images[:75])
    assert all(map(same, steps, usual()[:75]))
    packed = estimator.packed(state)
    assert packed.map.buffers is None
    assert all(isinstance(v, FrameImage) for v in (packed.view, *packed.map.views))
    again = estimator.unpacked(packed, lambda frame: images[frame].grey())
    for image in images[75:90]:
        again, step = estimator.step(again, image)
        assert same(step, usual()[image.frame])
    early = estimator.unpacked(estimator.packed(flown(estimator, images[:5])[0]), lambda frame: images[frame].grey())
    assert same(estimator.step(early, images[5])[1], usual()[5])


def test_a_state_is_adopted_by_the_same_camera_only() -> None:
    state, _ = flown(odometry(), flight()[0][:50])
    assert odometry(fine_points=300).adopted(state) is state
    with pytest.raises(EstimatorError, match="another camera"):
        odometry(focal_px=300.0).adopted(state)


# -------------------------------------------------------------------------------------- parts


CAMERA = lens.pinhole(WIDTH, HEIGHT, FOCAL, model="none")
DOWN = np.diag([1.0, 1.0, 1.0])


def plane_view(centre=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0)):
    """The textured plane z = 1.5 from a place, and cam_T_world there."""
    cam_T_world = se3_inverse(se3_exp(np.array([*np.zeros(3), *turn], float)))
    world_r_cam = cam_T_world[:3, :3].T
    cam_T_world[:3, 3] = -cam_T_world[:3, :3] @ np.array(centre, float)
    image = textured_plane.picture(CAMERA, world_r_cam, np.array(centre, float))
    return view_of(image, 1, 3, 10), cam_T_world


def test_the_table_holds_opencvs_corners_row_by_row() -> None:
    view, _ = plane_view()
    assert not np.any(np.diff(view.corners.first[[0, 4]]))
    for level in (1, 2, 3):
        image = level_image(view.pyramid, level)
        first = view.corners.first[level]
        mine = {(u, v) for v in range(HEIGHT) for u in view.corners.column[first[v] : first[v + 1]].tolist()}
        found = cv2.FastFeatureDetector.create(10, False).detect(image)
        assert mine == {(int(k.pt[0]), int(k.pt[1])) for k in found}
        assert len(mine) > 5


def points_of(view):
    """Corners of a view of the plane from the origin, as map points: points [n, 3], sources."""
    corners = free_corners(view, *UNUSED, 12, 4.0)
    points = lens.rays(CAMERA, corners.pixels)
    return points * (1.5 / points[:, 2:]), Sources(np.zeros(len(points), np.int64), corners.pixels, corners.level)


OPTIONS = SearchOptions(8.0, 1500.0, 0.5, 1, 3, 0, FeatureOptions(10))


@pytest.mark.parametrize("align_level", [0, 4])
def test_points_are_found_where_they_are_not_where_they_are_thought(align_level: int) -> None:
    first, first_pose = plane_view()
    second, pose = plane_view((0.12, -0.05, 0.03), (0.02, -0.01, 0.1))
    points, sources = points_of(first)
    guess = se3_product(se3_exp(np.array([0.015, -0.01, 0.0, 0.0, 0.0, 0.002])), pose)
    options = OPTIONS._replace(align_level=align_level)
    match = find_points(
        optics_of(CAMERA), first.pyramid.buffer[None], first_pose[None], second, guess, points, sources, options
    )
    truth = lens.project(CAMERA, points @ pose[:3, :3].T + pose[:3, 3])
    got = match.outcome == Feature.MATCHED
    assert np.count_nonzero(got) > 60
    assert np.mean(got) > 0.5
    np.testing.assert_allclose(
        match.predicted, lens.project(CAMERA, points @ guess[:3, :3].T + guess[:3, 3]), atol=1e-9
    )
    error = np.linalg.norm(match.found - truth, axis=1)[got] / 2.0 ** match.level[got]
    assert np.median(np.linalg.norm(match.predicted - truth, axis=1)) > 1.5
    assert np.median(error) < (0.1 if align_level == 0 else 0.8)
    assert np.all(match.score[got] < OPTIONS.max_score)
    assert np.all(np.isin(match.level[got], (1, 2, 3)))
    outside = (truth < -20).any(1) | (truth > np.array([WIDTH + 20, HEIGHT + 20])).any(1)
    assert np.all(match.outcome[outside] == Feature.OUT_OF_VIEW)


def test_points_are_not_found_on_other_ground() -> None:
    first, first_pose = plane_view()
    points, sources = points_of(first)
    blank_view = view_of(np.full((HEIGHT, WIDTH), 100, np.uint8), 1, 3, 10)
    match = find_points(
        optics_of(CAMERA),
        first.pyramid.buffer[None],
        first_pose[None],
        blank_view,
        first_pose,
        points,
        sources,
        OPTIONS,
    )
    assert np.all(np.isin(match.outcome, (Feature.NOT_CONVERGED, Feature.REFERENCE_OUT_OF_VIEW, Feature.OUT_OF_VIEW)))
    near = first_pose.copy()
    near[2, 3] = -1.3  # 20 cm over the ground: a pixel there is far smaller
    match = find_points(
        optics_of(CAMERA), first.pyramid.buffer[None], first_pose[None], first, near, points, sources, OPTIONS
    )
    assert np.all(np.isin(match.outcome, (Feature.OBLIQUE, Feature.OUT_OF_VIEW)))


def test_corners_keep_out_of_cells_that_are_taken() -> None:
    view, _ = plane_view()
    free = free_corners(view, *UNUSED, 12, 4.0)
    assert set(free.level.tolist()) == {1, 2, 3}
    assert np.all(free.score > 4.0)
    cells = {
        (int(k), *np.floor((p + 0.5) / (12 << k)).astype(int)) for p, k in zip(free.pixels, free.level, strict=True)
    }
    assert len(cells) == len(free.level)
    half = free.pixels[::2], free.level[::2]
    rest = free_corners(view, *half, 12, 4.0)
    np.testing.assert_array_equal(
        np.column_stack([rest.pixels, rest.level]), np.column_stack([free.pixels, free.level])[1::2]
    )


def test_small_images_tell_a_turn() -> None:
    turn = np.array([0.05, -0.04, 0.15])
    before, first = plane_view()
    after, second = plane_view(turn=turn)
    found = turn_between(optics_of(CAMERA), before, after)
    np.testing.assert_allclose(found, second[:3, :3] @ first[:3, :3].T, atol=0.02)
    assert baseline_search.correlation(before.small, before.small) == pytest.approx(1)
    blank_view = view_of(np.full((HEIGHT, WIDTH), 100, np.uint8), 1, 3, 10)
    assert baseline_search.correlation(before.small, blank_view.small) == 0
    assert turn_between(optics_of(CAMERA), before, blank_view) is None


def test_a_levelled_camera_has_its_heading_and_up() -> None:
    up = np.array([0.1, -0.2, -1.0])
    up /= np.linalg.norm(up)
    world_T_cam = levelled(up, 0.7, np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(world_T_cam[:3, :3] @ up, [0, 0, 1], atol=1e-12)
    assert np.arctan2(world_T_cam[1, 0], world_T_cam[0, 0]) == pytest.approx(0.7)
    np.testing.assert_allclose(world_T_cam[:3, :3] @ world_T_cam[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(world_T_cam[:3, :3]) == pytest.approx(1)
    np.testing.assert_array_equal(world_T_cam[:3, 3], [1, 2, 3])


def three_views():
    """A map of the plane from three places without any error: its points, each seen by all."""
    places = ((0.0, 0.0, 0.0), (0.2, 0.0, 0.0), (0.1, 0.15, 0.0))
    views = [plane_view(centre) for centre in places]
    points, sources = points_of(views[0][0])
    m = baseline_map.empty(len(views[0][0].pyramid.buffer), 100)
    for frame, (view, pose) in enumerate(views):
        m = baseline_map.with_keyframe(m, 10 * frame, view, pose)
    n = len(points)
    pixels = [lens.project(CAMERA, points @ pose[:3, :3].T + pose[:3, 3]) for _, pose in views]
    seen = Seen(np.tile(np.arange(n), 3), np.repeat([0, 1, 2], n), np.vstack(pixels), np.tile(sources.level, 3))
    return baseline_map.with_points(m, points, seen)


def test_a_map_stays_in_order_whatever_goes() -> None:
    m = three_views()
    n = len(m.points)
    assert m.made == 100 + n
    assert m.ids[0] == 100
    np.testing.assert_array_equal(m.seen.keyframe, np.tile([0, 1, 2], n))
    gone = np.arange(n) % 3 == 0
    less = baseline_map.without(m, points=gone, keyframe=0)
    np.testing.assert_array_equal(less.ids, m.ids[~gone])
    np.testing.assert_array_equal(less.frames, [10, 20])
    np.testing.assert_array_equal(less.seen.keyframe, np.tile([0, 1], np.count_nonzero(~gone)))
    np.testing.assert_array_equal(less.buffers, m.buffers[1:])
    truth = lens.project(CAMERA, less.points[less.seen.point] + less.poses[less.seen.keyframe, :3, 3])
    np.testing.assert_allclose(less.seen.pixels, truth, atol=1e-9)
    assert len(baseline_map.without(less, seen=less.seen.keyframe == 0).points) == 0  # one view is no point
    assert len(m.points) == n


def test_the_local_bundle_puts_a_keyframe_back_and_throws_a_wrong_match_out() -> None:
    m = three_views()
    poses, pixels = m.poses.copy(), m.seen.pixels.copy()
    poses[2] = se3_product(se3_exp(np.array([0.01, -0.01, 0.01, 0.004, 0.0, 0.004])), poses[2])
    wrong = int(np.flatnonzero(m.seen.keyframe == 2)[7])
    pixels[wrong] += 30
    bent = dataclasses.replace(m, poses=poses, seen=m.seen._replace(pixels=pixels))
    done = baseline_map.local_bundle(bent, optics_of(CAMERA), 5, BundleOptions(20))
    assert done.outliers == 1
    assert done.bundle is not None
    np.testing.assert_allclose(done.map.poses[2], m.poses[2], atol=1e-3)
    np.testing.assert_array_equal(done.map.poses[:2], m.poses[:2])
    assert len(done.map.seen.point) == len(m.seen.point) - 1
    two = baseline_map.without(m, keyframe=2)
    assert baseline_map.global_bundle(two, optics_of(CAMERA), BundleOptions()) == (two, None, 0)


def test_new_points_lie_on_the_plane() -> None:
    m = three_views()
    few = np.arange(len(m.points)) % 4 == 0
    growth = baseline_map.Growth(12, 4.0, 2.0, 0.05, baseline_map.epipolar.Limits(top_level=3))
    grown = baseline_map.with_new_points(baseline_map.without(m, points=~few), optics_of(CAMERA), growth)
    new = grown.ids >= m.made
    assert np.count_nonzero(new) > 50
    assert np.mean(np.abs(grown.points[new, 2] - 1.5) < 0.03) > 0.9
    assert np.all(np.bincount(grown.seen.point)[new] == 2)
    again = baseline_map.found_again(grown, optics_of(CAMERA), np.flatnonzero(new), np.array([0, 1]), OPTIONS)
    assert np.mean(np.bincount(again.seen.point)[new] == 3) > 0.5
