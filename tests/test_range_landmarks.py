"""Landmarks of the range filter: what the sources find is where the scene's truth has it."""

import dataclasses
import functools
import math
import pickle
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
import scipy.ndimage
from pydantic import ValidationError
from recordings_dir import RECORDINGS
from scipy.spatial.transform import Rotation

from pipelines.lens import pinhole, project, rays
from pipelines.ranging import reference
from pipelines.ranging.landmarks.boards import (
    Chessboard,
    Markers,
    board_pose,
    chessboard_grid,
    chessboard_points,
    marker_points,
)
from pipelines.ranging.landmarks.corners import CornerState, TrackedCorners, centred
from pipelines.ranging.landmarks.frames import ideal_px, seen_px
from pipelines.ranging.landmarks.recorded import RecordedBearings, RecordedTracks, bearing_camera
from pipelines.ranging.landmarks.settings import (
    BearingSettings,
    BoardSettings,
    CornerSettings,
    LandmarkKind,
    LandmarkSettings,
    MarkerSettings,
)
from pipelines.ranging.landmarks.sources import source_of
from pipelines.ranging.reference import PoseTrack, ReferenceRanges
from pipelines.ranging.sightings import Sighting
from pipelines.simulation.motion import FORWARD, Mount, Waypoints
from pipelines.simulation.render import expose, noise_key_of, view
from pipelines.simulation.scene import Plane, Scene, chessboard, chessboard_corners, poster, upright
from pipelines.simulation.surfaces import surface_from_periodic
from readers.streams import (
    Camera,
    ImageSample,
    Landmark,
    LandmarkSample,
    PoseSample,
    Problem,
    Sample,
    StreamKind,
    TrackSample,
)

MOUNT = Mount(np.zeros(3), FORWARD)
CAMERA = pinhole(320, 240, 300.0, distortion=(-0.12, 0.05))
WALL_M, POSTER_M = 6.0, 3.5  # their x in the world
POSTER_YZ, POSTER_SIDE = (-0.5, 0.7), 0.5


class Eye(NamedTuple):
    """Where the camera is: world_r_camera [3, 3] and its position [3]."""

    turn: np.ndarray
    position: np.ndarray

    def in_camera(self, points: np.ndarray) -> np.ndarray:
        return (points - self.position) @ self.turn


def eye_at(x: float, y: float = 0.0, heading: float = 0.0, roll: float = 0.0) -> tuple[Waypoints, Eye]:
    motion = Waypoints(np.zeros(1), np.array([[x, y, heading]]), height_m=0.6, roll_rad=roll)
    turns, positions = MOUNT.world_t_camera(motion.at(np.zeros(1)))
    return motion, Eye(turns[0], positions[0])


def image(grey: np.ndarray, t_ns: int = 0) -> ImageSample:
    height, width = grey.shape
    return ImageSample(
        stream="/cam",
        t_ns=t_ns,
        received_ns=t_ns,
        encoding="mono16" if grey.dtype == np.uint16 else "mono8",
        payload=grey.tobytes(),
        width_px=width,
        height_px=height,
        step_bytes=width * grey.itemsize,
    )


# ----------------------------------------------------------------------- corners on a wall


@functools.cache
def room() -> Scene:
    noise = scipy.ndimage.gaussian_filter(np.random.default_rng(1).standard_normal((256, 256)), 2.0, mode="wrap")
    paint = surface_from_periodic(np.clip(120 + 45 * noise / noise.std(), 0, 255), metres_per_px=0.03)
    wall = Plane(paint, upright(np.array([WALL_M, 0, 0.6]), math.pi), (-3.8, 3.8, -3.8, 3.8))
    y, z = POSTER_YZ
    plate = poster(np.array([POSTER_M, y, z]), size_m=POSTER_SIDE, rng=np.random.default_rng(3))
    return Scene(None, planes=(wall, plate))


def eye_of(frame: int) -> tuple[Waypoints, Eye]:
    return eye_at(0.05 * frame, 0.15 * math.sin(frame / 6), 0.04 * math.sin(frame / 5))


@functools.cache
def radiant(frame: int) -> np.ndarray:
    return view(room(), CAMERA, MOUNT, eye_of(frame)[0], 0.0)


def shot(frame: int, gain: float = 1.0) -> ImageSample:
    return image(expose(radiant(frame), noise_key=noise_key_of(0, frame), noise_grey=2.0, gain=gain))


def places(points_px: np.ndarray, eye: Eye) -> tuple[np.ndarray, np.ndarray]:
    """Where in the world image points lie [n, 3], and which of them are on the poster [n]."""
    flat = (points_px - CAMERA.matrix[:2, 2]) / CAMERA.matrix[0, 0]
    directions = np.column_stack([flat, np.ones(len(flat))]) @ eye.turn.T

    def hit(x: float) -> np.ndarray:
        return eye.position + (x - eye.position[0]) / directions[:, :1] * directions

    wall, plate = hit(WALL_M), hit(POSTER_M)
    on_plate = np.all(np.abs(plate[:, 1:] - POSTER_YZ) < POSTER_SIDE / 2, axis=1)
    return np.where(on_plate[:, None], plate, wall), on_plate


def ideal_of(eye: Eye, points: np.ndarray) -> np.ndarray:
    inside = eye.in_camera(points)
    return inside[:, :2] / inside[:, 2:] * CAMERA.matrix[0, 0] + CAMERA.matrix[:2, 2]


class Followed(NamedTuple):
    """Every point of every track: its number, age in frames, error in px [n, 2], whether it is on the poster."""

    ids: np.ndarray
    age: np.ndarray
    error: np.ndarray
    on_plate: np.ndarray
    sigma: np.ndarray


def follow(settings: CornerSettings, frames: int = 40, gains: np.ndarray | None = None) -> Followed:
    source = TrackedCorners(CAMERA, settings)
    state, born, rows = source.start(), {}, []
    for frame in range(frames):
        state, seen = source.sight(state, shot(frame, 1.0 if gains is None else float(gains[frame])))
        assert seen is not None
        eye = eye_of(frame)[1]
        points, on_plate = places(seen.points_px, eye)
        for number, point, plate in zip(seen.ids.tolist(), points, on_plate, strict=True):
            born.setdefault(number, (frame, point, plate))
        truth = ideal_of(eye, np.array([born[n][1] for n in seen.ids.tolist()]))
        for number, error, sigma in zip(seen.ids.tolist(), seen.points_px - truth, seen.sigma_px, strict=True):
            rows.append((number, frame - born[number][0], *error, born[number][2], sigma))
    table = np.array(rows)
    return Followed(table[:, 0].astype(int), table[:, 1], table[:, 2:4], table[:, 4] > 0, table[:, 5])


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt((errors**2).mean()))


@functools.cache
def usual() -> Followed:
    return follow(CornerSettings(max_corners=100))


def test_tracks_stay_on_their_points_of_the_wall() -> None:
    track = usual()
    far = np.linalg.norm(track.error, axis=1)
    assert np.mean(far > 2) < 0.05  # they sit on the poster's edge, half on the wall
    for youngest, oldest, limit in ((1, 2, 0.1), (2, 10, 0.2), (10, 20, 0.3), (20, 40, 0.5)):
        chosen = (track.age >= youngest) & (track.age < oldest) & (far <= 2)
        assert chosen.sum() > 100
        assert rms(track.error[chosen]) < limit
    assert np.median(far[(track.age >= 10) & (track.age < 20)]) < 0.15


def test_numbers_rise_and_are_never_used_again() -> None:
    track = usual()
    begun = track.ids[track.age == 0]
    assert np.all(np.diff(begun) > 0)  # hence each begins once
    for number in np.unique(track.ids):
        ages = track.age[track.ids == number]
        np.testing.assert_array_equal(ages, np.arange(len(ages)))  # no track comes back


def test_corners_are_spread_and_replenished() -> None:
    source = TrackedCorners(CAMERA, CornerSettings(max_corners=96))
    state = source.start()
    for frame in range(0, 40, 4):
        state, seen = source.sight(state, shot(frame))
        assert seen is not None
        assert 0.7 * 96 <= len(seen.ids) <= 96
        assert len(set(seen.ids.tolist())) == len(seen.ids)
        pairs = np.linalg.norm(state.points_px[:, None] - state.points_px[None], axis=2)[
            np.triu_indices(len(seen.ids), 1)
        ]
        assert pairs.min() >= 6
        assert np.all((state.points_px >= 12) & (state.points_px <= np.array([319, 239]) - 12))
        if frame == 0:
            columns, rows = (state.points_px // [40, 40]).astype(int).T
            assert np.bincount(8 * rows + columns, minlength=48).max() <= 4  # 96 tracks in 48 cells


def test_a_corner_that_something_comes_before_is_lost() -> None:
    """A plate slides sideways before the wall; what it hides must not be tracked on."""

    def sight_of(y: float) -> np.ndarray:
        plate = poster(np.array([POSTER_M, y, 0.6]), size_m=1.2, rng=np.random.default_rng(3))
        return view(Scene(None, planes=(room().planes[0], plate)), CAMERA, MOUNT, eye_at(0.0)[0], 0.0)

    places_y = np.linspace(1.8, 0.5, 12)  # of the plate's centre: it comes in from the left, 10 px a frame
    frames = [expose(sight_of(y), noise_key=noise_key_of(5, k), noise_grey=2.0) for k, y in enumerate(places_y)]
    kept = {}
    for distance in (0.3, 1e3):
        settings = CornerSettings(
            max_corners=400, min_distance_px=7, replenish_below=0, forward_backward_px=distance, max_residual_grey=255
        )
        source = TrackedCorners(CAMERA, settings)
        state, start = source.sight(source.start(), image(frames[0]))
        assert start is not None
        for frame in frames[1:]:
            state, seen = source.sight(state, image(frame))
            assert seen is not None
        # the plate's right edge as a shadow on the wall, where it was and where it is
        first, last = ((y - 0.6) * WALL_M / POSTER_M for y in places_y[[0, -1]])
        wall = places(start.points_px, eye_at(0.0)[1])[0]
        level = np.abs(wall[:, 2] - 0.6) < 0.8
        hidden = level & (wall[:, 1] < first - 0.2) & (wall[:, 1] > last + 0.2)
        clear = wall[:, 1] < last - 0.4
        assert hidden.sum() > 20
        assert clear.sum() > 50
        stayed = np.isin(start.ids, seen.ids)
        assert stayed[clear].mean() > 0.95
        kept[distance] = stayed[hidden].mean()
    assert kept[0.3] < 0.05  # no other check finds them: they slide along with the edge
    assert kept[1e3] > 0.3


def test_a_change_of_exposure_does_not_end_the_tracks() -> None:
    gains = np.where(np.arange(8) % 2, 1.2, 0.9)
    even = follow(CornerSettings(max_corners=100), 8, gains)
    raw = follow(CornerSettings(max_corners=100, exposure_jump=math.inf), 8, gains)
    assert (even.age == 7).sum() > 80
    assert (raw.age == 7).sum() < 20
    assert np.median(np.linalg.norm(even.error[even.age == 7], axis=1)) < 0.1


def test_the_noise_of_a_point_can_follow_its_residual() -> None:
    track = follow(CornerSettings(max_corners=60, sigma_px=0.25, sigma_from="residual"), 4)
    assert np.all(track.sigma[track.age == 0] == 0.25)
    later = track.sigma[track.age > 0]
    assert np.all((later > 0.25) & (later <= math.hypot(0.25, 0.3)))
    assert np.all(usual().sigma == 0.5)


BLANK = np.full((240, 320), 128, dtype=np.uint8)


def broken(kind: StreamKind = StreamKind.IMAGE) -> Problem:
    return Problem(stream="/cam", t_ns=0, received_ns=0, kind=kind, reason="torn")


@pytest.mark.parametrize(
    "bad",
    [image(BLANK), image(np.zeros((120, 160), np.uint8)), broken(), dataclasses.replace(image(BLANK), encoding="png")],
    ids=["blank", "size", "problem", "torn"],
)
def test_a_bad_frame_ends_the_tracks(bad: ImageSample | Problem) -> None:
    source = TrackedCorners(CAMERA, CornerSettings(max_corners=50))
    state, first = source.sight(source.start(), shot(0))
    state, none = source.sight(state, bad)
    assert first is not None
    assert none is not None
    assert len(first.ids) == 50
    assert len(none.ids) == 0
    state, again = source.sight(state, shot(1))
    assert again is not None
    assert len(again.ids) == 50
    assert again.ids.min() == 50
    assert np.all(state.age == 0)


def test_what_is_no_frame_is_passed_over() -> None:
    source = TrackedCorners(CAMERA)
    state, _ = source.sight(source.start(), shot(0))
    same, nothing = source.sight(state, broken(StreamKind.IMU))
    assert nothing is None
    assert same is state


def test_noise_alone_has_no_corners() -> None:
    noisy = expose(np.full((240, 320), 120, np.float32), noise_key=3, noise_grey=3.0)
    _, seen = TrackedCorners(CAMERA).sight(CornerState(), image(noisy))
    assert seen is not None
    assert len(seen.ids) == 0


def test_the_texture_limit_is_in_grey_levels_per_px() -> None:
    v, u = np.mgrid[:60, :60]
    w = 2 * np.pi / 59
    wave = 120 + 60 * np.sin(w * u) * np.cos(w * v)
    slope = 60 * w / 2  # rms over a period, along either axis
    _, texture = centred(np.rint(wave).astype(np.uint8), np.array([[29.0, 29]], np.float32), 59)
    assert texture[0] == pytest.approx(slope, rel=0.05)


def bits(state: CornerState) -> tuple[bytes, ...]:
    return tuple(np.asarray(a).tobytes() for a in (state.ids, state.points_px, state.age, state.error_px))


def test_the_tracks_go_on_from_a_state_with_the_same_bytes() -> None:
    source = TrackedCorners(CAMERA, CornerSettings(max_corners=80))
    threads = cv2.getNumThreads()
    runs = []
    try:
        for number in (1, threads, 4):
            cv2.setNumThreads(number)
            states = [source.start()]
            for frame in range(6):
                states.append(source.sight(states[-1], shot(frame))[0])
            runs.append(states)
    finally:
        cv2.setNumThreads(threads)
    assert [bits(s) for s in runs[0]] == [bits(s) for s in runs[1]] == [bits(s) for s in runs[2]]
    restored = pickle.loads(pickle.dumps(runs[0][3]))
    for frame in (3, 4, 5):
        restored, _ = source.sight(restored, shot(frame))
    assert bits(restored) == bits(runs[0][-1])


def test_a_window_that_grows_keeps_its_centre() -> None:
    """The tracked point of an image and of its copy that is 4 % larger about any point is the same point."""
    grey = expose(radiant(0), noise_key=0)
    source = TrackedCorners(CAMERA, CornerSettings(max_corners=60))
    state, _ = source.sight(source.start(), image(grey))
    larger = np.array([[1.04, 0, -0.04 * 160], [0, 1.04, -0.04 * 120]])
    warped = cv2.warpAffine(grey, larger, (320, 240), flags=cv2.INTER_CUBIC)
    after, _ = source.sight(state, image(warped))
    both, first, second = np.intersect1d(state.ids, after.ids, return_indices=True)
    expected = state.points_px[first] @ larger[:, :2].T + larger[:, 2]
    assert len(both) > 30
    assert np.median(np.linalg.norm(after.points_px[second] - expected, axis=1)) < 0.06


def test_points_are_freed_of_the_distortion_and_back() -> None:
    pixels = np.array([[20.0, 15], [160, 120], [300, 200]])
    ideal = ideal_px(CAMERA, pixels)
    flat = rays(CAMERA, pixels)
    np.testing.assert_allclose(ideal, flat[:, :2] * 300 + [159.5, 119.5], atol=1e-9)
    np.testing.assert_allclose(seen_px(CAMERA, ideal), pixels, atol=1e-9)
    assert np.linalg.norm(ideal - pixels, axis=1)[0] > 5
    folding = pinhole(600, 10, 400.0, distortion=(-0.3,))
    reached = ideal_px(folding, np.array([[299.5, 4.5], [299.5 + 0.71 * 400, 4.5], [np.nan, 0]]))
    assert np.isfinite(reached[:, 0]).tolist() == [True, False, False]


# ---------------------------------------------------------------------------- chessboards

BOARD_M = 5.0
WIDE = pinhole(480, 360, 450.0, distortion=(-0.12, 0.05))


def board_view(
    columns: int, rows: int, square_m: float, eye: tuple[Waypoints, Eye], facing: float = math.pi, noise: float = 2.0
) -> tuple[ImageSample, np.ndarray]:
    """A frame of a chessboard, and its corners [n, 3] in camera axes, row by row from its upper left."""
    pose = upright(np.array([BOARD_M, 0, 0.6]), facing)
    scene = Scene(None, planes=(chessboard(columns, rows, square_m, pose),))
    grey = expose(view(scene, WIDE, MOUNT, eye[0], 0.0), noise_key=noise_key_of(7, 0), noise_grey=noise)
    return image(grey), eye[1].in_camera(chessboard_corners(columns, rows, square_m, pose))


def shown(inside: np.ndarray) -> np.ndarray:
    return inside[:, :2] / inside[:, 2:] * 450 + WIDE.matrix[:2, 2]


def seen_by(source: Any, state: Any, sample: Sample) -> tuple[Any, Sighting]:
    state, seen = source.sight(state, sample)
    assert seen is not None
    return state, seen


def test_corners_and_depths_of_a_board_on_the_way_towards_it() -> None:
    settings = BoardSettings(columns=9, rows=6, square_m=0.06, landmarks="all")
    source, points = Chessboard(WIDE, settings), chessboard_points(settings)
    state, off, wrong = source.start(), [], []
    for x in (0.0, 1.0, 2.0, 3.0, 3.6):  # squares of 5 to 19 px
        sample, inside = board_view(9, 6, 0.06, eye_at(x, 0.2, 0.04))
        state, seen = seen_by(source, state, sample)
        assert seen.ids.tolist() == list(range(54))
        off.append(np.linalg.norm(seen.points_px - shown(inside), axis=1).mean())
        pose = board_pose(seen.points_px, points, WIDE)
        assert pose is not None
        wrong.append(np.abs(pose.in_camera(points)[:, 2] / inside[:, 2] - 1).max())
        assert pose.rms_px < 0.1
        assert np.all(seen.sigma_px == 0.1)
    assert max(off) < 0.1
    assert max(wrong) < 0.01
    assert max(wrong[2:]) < 0.003


def test_numbers_stay_while_the_board_leaves_and_comes_back() -> None:
    source = Chessboard(WIDE, BoardSettings(square_m=0.06, landmarks="all"))
    state = source.start()
    for y, roll in ((0.0, 0.0), (3.0, 0.0), (0.3, 0.0), (0.0, 3.0), (0.0, -1.5)):
        sample, inside = board_view(9, 6, 0.06, eye_at(3.0, y, 0.0, roll))
        before = state
        state, seen = seen_by(source, state, sample)
        if y == 3.0:
            assert len(seen.ids) == 0
            assert state == before
        else:
            assert np.linalg.norm(seen.points_px - shown(inside), axis=1).mean() < 0.1
    assert state.light == 1


def test_the_first_corner_is_at_the_upper_left_or_by_its_colour() -> None:
    upside_down = eye_at(3.0, 0.0, 0.0, math.pi)
    sample, inside = board_view(9, 6, 0.06, upside_down)
    truth = shown(inside)
    for first, expected in (("upper-left", 53), ("light", 0), ("dark", 53)):
        source = Chessboard(WIDE, BoardSettings(landmarks=(0,), first=first))
        _, seen = seen_by(source, source.start(), sample)
        assert seen.ids.tolist() == [0]
        np.testing.assert_allclose(seen.points_px[0], truth[expected], atol=0.2)


@pytest.mark.parametrize(("columns", "rows"), [(7, 7), (8, 6), (7, 5), (5, 8)])
def test_a_board_that_looks_the_same_from_both_ends_is_followed(columns: int, rows: int) -> None:
    source = Chessboard(WIDE, BoardSettings(columns=columns, rows=rows, landmarks="all"))
    state = source.start()
    for roll in (0.0, 0.6, 1.2, 1.8, 2.4, 3.0):
        sample, inside = board_view(columns, rows, 0.06, eye_at(3.0, 0.0, 0.0, roll))
        state, seen = seen_by(source, state, sample)
        assert np.linalg.norm(seen.points_px - shown(inside), axis=1).mean() < 0.1


def test_the_landmarks_of_a_board_are_chosen() -> None:
    assert BoardSettings(columns=4, rows=3).numbers == (0, 3, 8, 11)
    assert BoardSettings(columns=4, rows=3, landmarks="all").numbers == tuple(range(12))
    assert BoardSettings(columns=4, rows=3, landmarks=(5, 2)).numbers == (5, 2)
    sample, inside = board_view(9, 6, 0.06, eye_at(3.0))
    source = Chessboard(WIDE, BoardSettings(landmarks=(10, 4)))
    _, seen = seen_by(source, source.start(), sample)
    assert seen.ids.tolist() == [10, 4]
    np.testing.assert_allclose(seen.points_px, shown(inside)[[10, 4]], atol=0.2)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"landmarks": (54,)}, "0 to 53"),
        ({"landmarks": (1, 1)}, "named twice"),
        ({"rows": 7, "first": "light"}, "do not tell its ends apart"),
        ({"colums": 3}, "colums"),
    ],
)
def test_settings_of_boards_that_cannot_be_are_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        BoardSettings(**change)


@pytest.mark.parametrize("bad", [BLANK, np.zeros((90, 120), np.uint8), None], ids=["blank", "size", "torn"])
@pytest.mark.parametrize("source", [Chessboard(WIDE), Markers(WIDE)], ids=["chessboard", "markers"])
def test_a_frame_without_a_board_has_no_landmarks(source: Any, bad: np.ndarray | None) -> None:
    if bad is BLANK:
        bad = np.full((360, 480), 128, np.uint8)
    state, seen = seen_by(source, source.start(), broken() if bad is None else image(bad))
    assert len(seen.ids) == 0
    assert state == source.start()


def test_images_of_sixteen_bits_are_as_good() -> None:
    sample, inside = board_view(9, 6, 0.06, eye_at(3.0))
    deep = sample.grey().astype(np.uint16) << 4  # a camera of 12 bits
    source = Chessboard(WIDE, BoardSettings(landmarks="all"))
    _, seen = seen_by(source, source.start(), image(deep))
    assert np.linalg.norm(seen.points_px - shown(inside), axis=1).mean() < 0.1


def test_the_pose_of_a_tilted_board_is_the_right_one_of_two() -> None:
    settings = BoardSettings(columns=9, rows=6, square_m=0.06)
    points = chessboard_points(settings)
    rng = np.random.default_rng(2)
    for tilt in (0.2, 0.5, 0.9):
        truth = np.eye(4)
        truth[:3, :3] = Rotation.from_euler("xyz", [tilt, -0.7 * tilt, 0.3]).as_matrix()
        truth[:3, 3] = [-0.3, 0.1, 2.0]
        pixels = shown(points @ truth[:3, :3].T + truth[:3, 3])
        exact = board_pose(pixels, points, WIDE)
        assert exact is not None
        np.testing.assert_allclose(exact.camera_t_board, truth, atol=1e-6)
        assert exact.rms_px < 1e-6
        noisy = board_pose(pixels + 0.1 * rng.standard_normal(pixels.shape), points, WIDE)
        assert noisy is not None
        assert noisy.rms_px == pytest.approx(0.1 * math.sqrt(2), rel=0.2)
        assert not noisy.other_rms_px < 3 * noisy.rms_px
    with pytest.raises(ValueError, match="at least 4"):
        board_pose(pixels[:3], points[:3], WIDE)
    line = points[:5]
    assert board_pose(shown(line + np.array([0, 0, 2.0])), line, WIDE) is None


def test_a_small_board_far_away_has_a_second_pose() -> None:
    points = chessboard_points(BoardSettings(columns=3, rows=3, square_m=0.02))
    turn = Rotation.from_euler("x", 0.3).as_matrix()
    pixels = shown(points @ turn.T + [0, 0, 3.0]) + 0.1 * np.random.default_rng(1).standard_normal((9, 2))
    pose = board_pose(pixels, points, WIDE)
    assert pose is not None
    assert pose.rms_px <= pose.other_rms_px < 1.2 * pose.rms_px


# --------------------------------------------------------------------------------- markers

MARKER_PX = 96  # of a printed marker's black square; a quarter of that is its margin


def printed_markers(settings: MarkerSettings, facing: float = math.pi) -> tuple[Plane, np.ndarray, np.ndarray]:
    """A board of markers with a light margin, its corners' numbers [n] and places in the world [n, 3]."""
    assert settings.marker_m is not None
    name = f"DICT_{settings.dictionary.upper()}"
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    gap = round(MARKER_PX * settings.gap_m / settings.marker_m)
    pitch, margin = MARKER_PX + gap, MARKER_PX // 4
    picture = np.full((settings.rows * pitch - gap, settings.columns * pitch - gap), 225.0)
    for number in range(settings.columns * settings.rows):
        v, u = pitch * (number // settings.columns), pitch * (number % settings.columns)
        code = cv2.aruco.generateImageMarker(dictionary, settings.first_tag + number, MARKER_PX)
        picture[v : v + MARKER_PX, u : u + MARKER_PX] = np.where(code > 0, 225.0, 25.0)
    height, width = picture.shape
    soft = scipy.ndimage.gaussian_filter(np.pad(picture, margin, constant_values=225.0), 0.7)
    texel = settings.marker_m / MARKER_PX
    pose = upright(np.array([BOARD_M, 0, 0.6]), facing)
    first = np.eye(4)  # the plane's origin is the middle of the picture's first px
    first[:2, 3] = texel * np.array([0.5 - width / 2 - margin, height / 2 + margin - 0.5])
    bounds = (-0.5 * texel, (width + 2 * margin - 0.5) * texel, -(height + 2 * margin - 0.5) * texel, 0.5 * texel)
    plane = Plane(surface_from_periodic(soft, metres_per_px=texel), pose @ first, bounds)
    corners = marker_points(settings)
    ids = np.concatenate([4 * tag + np.arange(4) for tag in corners])
    flat = np.concatenate(list(corners.values())) - texel * np.array([width / 2, height / 2, 0])
    return plane, ids, (flat * [1, -1, 1]) @ pose[:3, :3].T + pose[:3, 3]


@pytest.mark.parametrize(
    "change",
    [
        {"marker_m": 0.4},
        {"marker_m": 0.2, "columns": 3, "rows": 2, "gap_m": 0.05, "first_tag": 7},
        {"marker_m": 0.3, "dictionary": "apriltag_36h11", "columns": 2, "gap_m": 0.1, "first_tag": 3},
    ],
    ids=["one", "board", "apriltag"],
)
def test_corners_and_depths_of_markers(change: dict[str, Any]) -> None:
    settings = MarkerSettings(**change)
    plane, ids, places_m = printed_markers(settings)
    source = Markers(WIDE, settings)
    for x, roll in ((2.0, 0.0), (3.0, 0.4)):
        motion, eye = eye_at(x, 0.1, 0.03, roll)
        grey = expose(view(Scene(None, planes=(plane,)), WIDE, MOUNT, motion, 0.0), noise_key=1, noise_grey=2.0)
        _, seen = seen_by(source, source.start(), image(grey))
        np.testing.assert_array_equal(seen.ids, ids)
        inside = eye.in_camera(places_m)
        off = np.linalg.norm(seen.points_px - shown(inside), axis=1)
        assert off.max() < 0.15
        found = reference.of_markers(seen, settings, WIDE)
        np.testing.assert_allclose(found.depth_m, inside[:, 2], rtol=0.002)
        np.testing.assert_allclose(found.distance_m, np.linalg.norm(inside, axis=1), rtol=0.002)
        assert np.all(seen.sigma_px == 0.1)
        again = source.sight(None, image(grey))[1]
        assert again is not None
        assert again.points_px.tobytes() == seen.points_px.tobytes()


def test_markers_without_a_board_have_each_their_own_pose() -> None:
    settings = MarkerSettings(marker_m=0.3, columns=2, gap_m=0.1, first_tag=7)
    plane, _, places_m = printed_markers(settings)
    motion, eye = eye_at(3.0, 0.1, 0.2)
    grey = expose(view(Scene(None, planes=(plane,)), WIDE, MOUNT, motion, 0.0), noise_key=1, noise_grey=2.0)
    alone = MarkerSettings(marker_m=0.3)  # tag 0, which is not there
    _, seen = seen_by(Markers(WIDE, alone), None, image(grey))
    found = reference.of_markers(seen, alone, WIDE)
    np.testing.assert_allclose(found.depth_m, eye.in_camera(places_m)[:, 2], rtol=0.005)
    few = reference.of_markers(Sighting(seen.ids[:3], seen.points_px[:3], seen.sigma_px[:3]), alone, WIDE)
    assert np.isnan(few.depth_m).all()


def test_a_marker_that_is_too_small_has_no_corners() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_7X7_50)
    small = np.full((360, 480), 230, np.uint8)
    small[40:76, 60:96] = cv2.aruco.generateImageMarker(dictionary, 5, 36)
    small[200:212, 60:72] = cv2.aruco.generateImageMarker(dictionary, 6, 12)
    _, seen = seen_by(Markers(WIDE, MarkerSettings(dictionary="7x7_50")), None, image(small))
    assert set((seen.ids // 4).tolist()) <= {5}
    assert np.isfinite(seen.points_px).all()


def test_another_board_of_the_same_shape_is_not_taken_for_the_one() -> None:
    source = Chessboard(WIDE, BoardSettings(columns=8, rows=6, landmarks="all"))
    sample, _ = board_view(8, 6, 0.06, eye_at(3.0))
    state, seen = seen_by(source, source.start(), sample)
    assert len(seen.ids) == 48
    inverted = image(255 - np.asarray(sample.grey()))
    assert len(chessboard_grid(inverted.grey(), source.settings)) == 6
    same, nothing = seen_by(source, state, inverted)
    assert len(nothing.ids) == 0
    assert same == state


def test_tags_are_chosen_and_those_seen_twice_left_out() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    grey = np.full((360, 480), 230, np.uint8)
    for tag, u, v in ((1, 40, 60), (2, 200, 60), (3, 340, 60), (2, 60, 220)):
        grey[v : v + 80, u : u + 80] = cv2.aruco.generateImageMarker(dictionary, tag, 80)
    _, seen = seen_by(Markers(WIDE), None, image(grey))
    assert sorted(set((seen.ids // 4).tolist())) == [1, 3]
    _, seen = seen_by(Markers(WIDE, MarkerSettings(tags=(3, 9))), None, image(grey))
    assert seen.ids.tolist() == [12, 13, 14, 15]
    plain = Markers(pinhole(480, 360, 450.0), MarkerSettings(tags=(3,)))
    _, seen = seen_by(plain, None, image(grey))  # clockwise from the upper left
    np.testing.assert_allclose(seen.points_px, np.array([[340, 60], [420, 60], [420, 140], [340, 140]]) - 0.5, atol=0.7)


def test_markers_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValidationError, match="apriltag_36h11"):
        MarkerSettings(dictionary="5x4_20")
    with pytest.raises(ValueError, match="0 to 49, not 50"):
        Markers(WIDE, MarkerSettings(columns=51))
    with pytest.raises(ValueError, match="marker_m is unknown"):
        marker_points(MarkerSettings())
    with pytest.raises(ValueError, match="square_m is unknown"):
        chessboard_points(BoardSettings())


# -------------------------------------------------------------------- what was recorded


def test_recorded_tracks_are_freed_of_distortion() -> None:
    inside = np.array([[0.5, 0.2, 2.0], [-0.4, -0.3, 1.5], [0.1, 0, 3]])
    pixels = np.vstack([project(CAMERA, inside), [[np.nan, 3]], [[1.0, 1.0]]])
    sample = TrackSample(stream="t", t_ns=0, received_ns=0, ids=np.array([9, 2, 5, 7, 2]), points_px=pixels)
    source = RecordedTracks(CAMERA)
    _, seen = seen_by(source, None, sample)
    assert seen.ids.tolist() == [2, 5, 9]
    truth = inside[:, :2] / inside[:, 2:] * 300 + CAMERA.matrix[:2, 2]
    np.testing.assert_allclose(seen.points_px, truth[[1, 2, 0]], atol=1e-9)
    assert seen.sigma_px.tolist() == [0.5] * 3
    assert source.sight(None, image(BLANK)) == (None, None)
    assert len(seen_by(source, None, broken(StreamKind.TRACK))[1].ids) == 0
    blind = pinhole(10, 10, 5.0)
    with pytest.raises(ValueError, match="no calibration"):
        RecordedTracks(dataclasses.replace(blind, matrix=np.full((3, 3), np.nan)))


def test_bearings_are_points_of_a_camera_that_looks_ahead() -> None:
    settings = BearingSettings(focal_px=400.0, sigma_rad=0.01)
    bearing = np.array([0.3, -0.5, np.radians(81), np.nan, 0.0, 0.1])
    sample = LandmarkSample(
        stream="l",
        t_ns=0,
        received_ns=0,
        ids=np.array([8, 6, 9, 10, 3, 8]),
        range_m=np.full(6, 2.0),
        bearing_rad=bearing,
    )
    _, seen = seen_by(RecordedBearings(settings), None, sample)
    assert seen.ids.tolist() == [3, 6, 8]
    expected = np.array([0.0, -0.5, 0.3])
    in_body = np.column_stack([np.cos(expected), np.sin(expected), np.zeros(3)])
    camera = bearing_camera(settings)
    in_cam = in_body @ camera.body_t_camera[:3, :3]
    np.testing.assert_allclose(seen.points_px, project(camera, in_cam), atol=1e-9)
    shift = (400 * np.tan(expected + 1e-6) - 400 * np.tan(expected)) / 1e-6
    np.testing.assert_allclose(seen.sigma_px, 0.01 * shift, rtol=1e-4)
    _, few = seen_by(RecordedBearings(settings, only={8}), None, sample)
    assert few.ids.tolist() == [8]
    assert len(seen_by(RecordedBearings(), None, broken(StreamKind.LANDMARKS))[1].ids) == 0


# ---------------------------------------------------------------------------------- factory

TRACKS = TrackSample(stream="t", t_ns=0, received_ns=0, ids=np.array([1]), points_px=np.array([[5.0, 6]]))
BEARINGS = LandmarkSample(
    stream="l", t_ns=0, received_ns=0, ids=np.array([4]), range_m=np.array([2.0]), bearing_rad=np.array([0.1])
)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("tracks", RecordedTracks),
        ("bearings", RecordedBearings),
        ("corners", TrackedCorners),
        ("chessboard", Chessboard),
        ("aruco", Markers),
    ],
)
def test_a_source_by_its_name(kind: str, expected: type) -> None:
    settings = LandmarkSettings(landmarks=LandmarkKind(kind), corners=CornerSettings(max_corners=7))
    source = source_of(settings, CAMERA)
    assert type(source) is expected
    if kind == "corners":
        assert len(seen_by(source, source.start(), shot(0))[1].ids) == 7
    if kind != "bearings":
        with pytest.raises(ValueError, match="calibrated camera"):
            source_of(settings, None)


def test_the_first_frame_chooses_the_source() -> None:
    source = source_of(LandmarkSettings(), CAMERA, surveyed={4})
    for first, other, expected in ((TRACKS, BEARINGS, [1]), (BEARINGS, TRACKS, [4])):
        state, nothing = source.sight(source.start(), broken(StreamKind.IMU))
        assert nothing is None
        state, seen = seen_by(source, state, first)
        assert seen.ids.tolist() == expected
        assert source.sight(state, other)[1] is None
    state, seen = seen_by(source, source.start(), shot(0))
    assert len(seen.ids) > 50
    assert source.sight(state, TRACKS)[1] is None


# -------------------------------------------------------------------------------- reference


def turned(heading: float) -> np.ndarray:
    return np.array([0, 0, math.sin(heading / 2), math.cos(heading / 2)])


def test_a_surveyed_landmark_s_range_from_a_pose() -> None:
    world_t_body = np.eye(4)
    world_t_body[:3, :3] = Rotation.from_euler("z", 0.5).as_matrix()
    world_t_body[:3, 3] = [1, 2, 0.3]
    body_t_camera = np.eye(4)
    body_t_camera[:3, :3], body_t_camera[:3, 3] = FORWARD, [0.2, 0, 0.1]
    ahead = np.array([math.cos(0.5), math.sin(0.5), 0])
    left = np.array([-math.sin(0.5), math.cos(0.5), 0])
    eye = np.array([1, 2, 0.3]) + 0.2 * ahead + [0, 0, 0.1]
    flat = eye + 3 * ahead - 1 * left
    landmarks = np.array([eye + 4 * ahead + 3 * left, flat, [*flat[:2], np.nan], [np.nan] * 3])
    found = reference.surveyed(landmarks, world_t_body, body_t_camera)
    np.testing.assert_allclose(found.depth_m, [4, 3, 3, np.nan], atol=1e-12)
    np.testing.assert_allclose(found.distance_m, [5, math.sqrt(10), math.sqrt(10), np.nan], atol=1e-12)


def test_a_measured_range_and_its_depth() -> None:
    found = reference.measured(np.array([2.0, np.nan]), np.array([math.pi / 3, 0]))
    np.testing.assert_allclose(found.depth_m, [1.0, np.nan])
    np.testing.assert_allclose(found.distance_m, [2.0, np.nan])


def test_the_truth_of_a_simulation() -> None:
    motion = Waypoints(np.array([0.0, 4.0]), np.array([[0, 0, 0], [2.0, 0, 0]]))
    mount = Mount(np.array([0.1, 0, 0.5]), FORWARD)
    found = reference.of_truth(motion, mount, np.array([[5.0, 3, 0.5], [5, 0, 0.5]]), 2.0)
    np.testing.assert_allclose(found.depth_m, [3.9, 3.9])
    np.testing.assert_allclose(found.distance_m, [math.hypot(3.9, 3), 3.9])


def test_poses_between_poses() -> None:
    track = PoseTrack(max_gap_s=2.0)
    assert np.isnan(track.at(0)).all()
    for t_s, x, heading in ((1, 0.0, 3.0), (2, 4.0, -3.0), (6, 8.0, 0.0)):  # the short way, over π
        track.add(t_s * 10**9, np.array([x, 1, 0]), turned(heading))
    track.add(7 * 10**9, np.array([np.nan, 1, 0]), turned(0))
    track.add(5 * 10**9, np.zeros(3), turned(0))
    quarter = track.at(1_250_000_000)
    np.testing.assert_allclose(quarter[:3, 3], [1, 1, 0])
    turn = 3.0 + 0.25 * (2 * math.pi - 6.0)
    np.testing.assert_allclose(quarter[:3, :3], Rotation.from_euler("z", turn).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(track.at(2 * 10**9)[:3, 3], [4, 1, 0])
    for outside in (999_999_999, 6_000_000_001, 3 * 10**9):  # before, after, in a gap
        assert np.isnan(track.at(outside)).all()
    np.testing.assert_allclose(track.at(10**9)[:3, 3], [0, 1, 0])
    np.testing.assert_allclose(track.at(6 * 10**9)[:3, 3], [8, 1, 0])


def pose_sample(t_ns: int, x: float) -> PoseSample:
    nowhere = np.full((6, 6), np.nan)
    position = np.array([x, 0.0, 0.0])
    return PoseSample(
        stream="/reference", t_ns=t_ns, received_ns=t_ns, position_m=position, quat_xyzw=turned(0), covariance=nowhere
    )


def test_references_are_known_once_the_samples_have_passed() -> None:
    body_t_camera = np.eye(4)
    body_t_camera[:3, :3] = FORWARD
    camera = dataclasses.replace(CAMERA, body_t_camera=body_t_camera)
    unknown = np.full(3, np.nan)
    survey = {4: Landmark(position_m=np.array([9.0, 0, 0]), sigma_m=unknown)}
    known = ReferenceRanges(camera, landmarks=survey, pose_stream="/reference")
    known.take(pose_sample(0, 0.0))
    known.take(dataclasses.replace(pose_sample(1, 7.0), stream="/other"))
    ids = np.array([4, 5])
    assert np.isnan(known.at(500_000_000, ids).depth_m).all()
    known.take(pose_sample(10**9, 1.0))
    np.testing.assert_allclose(known.at(500_000_000, ids).depth_m, [8.5, np.nan])
    measured = dataclasses.replace(
        BEARINGS, t_ns=500_000_000, ids=ids, range_m=np.array([3.0, 2.0]), bearing_rad=np.array([0.0, 1.0])
    )
    known.take(measured)  # the survey counts more
    np.testing.assert_allclose(known.at(500_000_000, ids).depth_m, [8.5, 2 * math.cos(1.0)])
    np.testing.assert_allclose(known.at(500_000_000, ids).distance_m, [8.5, 2.0])
    assert np.isnan(known.at(500_000_001, ids).depth_m[1])
    assert known.at(0, np.zeros(0, np.int64)).depth_m.shape == (0,)


def test_the_range_of_one_corner_is_known_by_the_whole_board() -> None:
    settings = BoardSettings(square_m=0.06, landmarks=(0,))
    known = ReferenceRanges(WIDE, board=settings)
    sample, inside = board_view(9, 6, 0.06, eye_at(3.0, 0.2, 0.04))
    known.take(dataclasses.replace(sample, t_ns=77))
    known.take(image(np.full((360, 480), 128, np.uint8), 78))
    found = known.at(77, np.array([0, 53, 54]))
    np.testing.assert_allclose(found.depth_m, [*inside[[0, 53], 2], np.nan], rtol=0.003)
    assert np.isnan(known.at(78, np.array([0])).depth_m).all()
    with pytest.raises(ValueError, match="square_m is unknown"):
        ReferenceRanges(WIDE, board=BoardSettings())
    with pytest.raises(ValueError, match="calibrated camera"):
        ReferenceRanges(None, board=settings)


# -------------------------------------------------------------------------------- real data

PAIRS = RECORDINGS / "stereo_chessboard"
NUMBERS = [n for n in range(1, 15) if n != 10]
PRINTED = BoardSettings(square_m=0.025, landmarks="all", first="light")
SIDES = ("left", "right")


@functools.cache
def real_corners(side: str) -> list[np.ndarray]:
    """Corners [54, 2] in each image of one camera, with its distortion."""
    source = Chessboard(pinhole(640, 480, 500.0, model="none"), PRINTED)
    found = []
    for number in NUMBERS:
        grey = cv2.imread(str(PAIRS / f"{side}{number:02d}.jpg"), cv2.IMREAD_GRAYSCALE)
        found.append(seen_by(source, source.start(), image(grey))[1].points_px)
    return found


def poses_of(camera: Camera, side: str) -> tuple[list[np.ndarray], float]:
    """The board's pose in each image, and the largest of their reprojection errors."""
    points = chessboard_points(PRINTED)
    poses = [board_pose(ideal_px(camera, pixels), points, camera) for pixels in real_corners(side)]
    return [pose.camera_t_board for pose in poses if pose], max(pose.rms_px for pose in poses if pose)


def baselines(cameras: dict[str, Camera]) -> np.ndarray:
    left, right = (poses_of(cameras[side], side)[0] for side in SIDES)
    return np.array([np.linalg.norm((b @ np.linalg.inv(a))[:3, 3]) for a, b in zip(left, right, strict=True)])


def with_lens(matrix: np.ndarray, distortion: np.ndarray) -> Camera:
    return dataclasses.replace(pinhole(640, 480, 500.0), matrix=matrix, distortion=distortion.ravel())


def stereo(cameras: dict[str, Camera]) -> float:
    """The baseline by OpenCV's stereo calibration of all pairs together."""
    corners = [[pixels.astype(np.float32) for pixels in real_corners(side)] for side in SIDES]
    lenses = [x for side in SIDES for x in (cameras[side].matrix, cameras[side].distortion)]
    board = [chessboard_points(PRINTED).astype(np.float32)] * len(NUMBERS)
    together = cv2.stereoCalibrate(board, *corners, *lenses, (640, 480), flags=cv2.CALIB_FIX_INTRINSIC)
    return float(np.linalg.norm(together[6]))


def test_every_real_board_is_found() -> None:
    for side in SIDES:
        assert [len(corners) for corners in real_corners(side)] == [54] * 13


def test_real_boards_with_the_calibrations_that_came_with_them() -> None:
    """Those of the file `intrinsics.yml` do not fit its images well: its left lens is off by 1 to 3 px."""
    storage = [
        cv2.FileStorage(str(PAIRS / f"{n}.yml"), cv2.FILE_STORAGE_READ) for n in ("left_intrinsics", "intrinsics")
    ]
    names = (("camera_matrix", "distortion_coefficients"), ("M2", "D2"))
    lenses = [[s.getNode(name).mat() for name in pair] for s, pair in zip(storage, names, strict=True)]
    cameras = {side: with_lens(*lens) for side, lens in zip(SIDES, lenses, strict=True)}
    assert poses_of(cameras["left"], "left")[1] < 0.3
    assert poses_of(cameras["right"], "right")[1] < 0.9
    assert np.median(baselines(cameras)) == pytest.approx(stereo(cameras), rel=0.04)


def test_real_boards_with_a_calibration_by_their_own_corners() -> None:
    board = [chessboard_points(PRINTED).astype(np.float32)] * len(NUMBERS)
    cameras = {}
    for side in SIDES:
        corners = [pixels.astype(np.float32) for pixels in real_corners(side)]
        flags = cv2.CALIB_FIX_ASPECT_RATIO
        rms_px, matrix, distortion, _, _ = cv2.calibrateCamera(board, corners, (640, 480), np.eye(3), None, flags=flags)
        cameras[side] = with_lens(matrix, distortion)
        assert rms_px < 0.22
        assert poses_of(cameras[side], side)[1] < 0.3
    found = baselines(cameras)
    assert found.mean() == pytest.approx(stereo(cameras), rel=0.005)
    assert found.std() < 0.01 * found.mean()
