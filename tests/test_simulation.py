"""The simulator: its scene is what it says, without interpolation bias, with the right signs."""

import functools

import cv2
import numpy as np
import pytest
import scipy.ndimage
from recordings_dir import RECORDINGS

from pipelines.geometry import heading_of_quat
from pipelines.simulation import faults as flaws
from pipelines.simulation import mission as sim
from pipelines.simulation import trajectories as ways
from pipelines.simulation.mission import SimulatedMission, nadir_camera, nadir_mission
from pipelines.simulation.render import expose, noise_key_of, radiance, world_h_pixel
from pipelines.simulation.surfaces import (
    PSF_SIGMA_PX,
    Surface,
    surface_from_image,
    surface_from_periodic,
)
from readers.streams import ImageSample, PoseSample, RangeSample, StreamError

W = sim.PAPER_HEIGHT_M / sim.PAPER_FOCAL_PX
WAVES = ((40, 3, 5, 0.3), (25, -7, 2, 1.1), (15, 11, 9, 2.0))  # amplitude, cycles in x and y, phase
PERIOD = 256


@functools.cache
def paper_surface(name: str = "b_01") -> Surface:
    picture = cv2.imread(str(RECORDINGS / "paper_a_surface_frames" / f"{name}.png"))
    assert picture is not None, "the shared recordings are missing"
    return surface_from_image(picture.astype(float) @ [0.114, 0.587, 0.299])


@functools.cache
def sinusoids() -> Surface:
    rows, columns = np.mgrid[:PERIOD, :PERIOD]
    return surface_from_periodic(analytic_scene(columns, rows, psf_sigma_px=0))


def analytic_scene(x_px: np.ndarray, y_px: np.ndarray, psf_sigma_px: float = PSF_SIGMA_PX) -> np.ndarray:
    """The scene at picture coordinates (columns, rows), in closed form."""
    grey = np.full(np.broadcast(x_px, y_px).shape, 120.0)
    for amplitude, fx, fy, phase in WAVES:
        wx, wy = 2 * np.pi * fx / PERIOD, 2 * np.pi * fy / PERIOD
        attenuation = np.exp(-0.5 * psf_sigma_px**2 * (wx**2 + wy**2))
        grey += amplitude * attenuation * np.cos(wx * x_px + wy * y_px + phase)
    return grey


def see(surface: Surface, pose: tuple[float, float, float], side: int = 512, **tilt: float) -> np.ndarray:
    matrix = nadir_camera(side, side).matrix
    return radiance(surface, world_h_pixel(np.array(pose), matrix, sim.PAPER_HEIGHT_M, **tilt), (side, side))


# -------------------------------------------------------------------------------- the scene


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (0.731, -0.233, 0.9), (-12.3, 45.6, -2.5)])
def test_frames_are_the_analytic_scene(pose: tuple[float, float, float]) -> None:
    side, (x, y, heading) = 200, pose
    v, u = np.mgrid[:side, :side] - (side - 1) / 2
    world_x = x + W * (np.cos(heading) * u + np.sin(heading) * v)  # v to the right: minus y at heading 0
    world_y = y + W * (np.sin(heading) * u - np.cos(heading) * v)
    expected = analytic_scene(world_x / W, -world_y / W)
    # the cubic spline itself is good to (ω/2)⁴/… of an amplitude at twice the resolution
    np.testing.assert_allclose(see(sinusoids(), pose, side), expected, atol=3e-3)


def test_forward_motion_shifts_the_content_backwards() -> None:
    before, after = see(sinusoids(), (0.0, 0.0, 0.0)), see(sinusoids(), (7 * W, 0.0, 0.0))
    np.testing.assert_allclose(after[:, :-7], before[:, 7:], atol=1e-2)


def test_motion_to_the_left_shifts_the_content_down() -> None:
    before, after = see(sinusoids(), (0.0, 0.0, 0.0)), see(sinusoids(), (0.0, 5 * W, 0.0))
    np.testing.assert_allclose(after[5:], before[:-5], atol=1e-2)


def test_a_left_turn_turns_the_content_clockwise_on_the_screen() -> None:
    before, after = see(sinusoids(), (0.1, 0.2, 0.0)), see(sinusoids(), (0.1, 0.2, np.pi / 2))
    np.testing.assert_allclose(after, np.rot90(before, k=-1), atol=1e-2)


def test_roll_and_pitch_follow_the_right_hand() -> None:
    k = nadir_camera().matrix
    nose_down = world_h_pixel(np.zeros(3), k, 0.2, pitch_rad=0.1) @ [255.5, 255.5, 1]
    left_up = world_h_pixel(np.zeros(3), k, 0.2, roll_rad=0.1) @ [255.5, 255.5, 1]
    np.testing.assert_allclose(nose_down[:2] / nose_down[2], [-0.2 * np.tan(0.1), 0], atol=1e-12)
    np.testing.assert_allclose(left_up[:2] / left_up[2], [0, 0.2 * np.tan(0.1)], atol=1e-12)


def test_a_camera_below_the_ground_is_refused() -> None:
    with pytest.raises(ValueError, match="above the ground"):
        world_h_pixel(np.zeros(3), np.eye(3), 0.0)


# ------------------------------------------------------------------------- no bias (A4)


def quintic_shift_error(before: np.ndarray, after: np.ndarray, shift_px: float) -> float:
    """Shift along u by least squares on a quintic spline, 212 x 212 window, minus the true one.

    The gradient is the central difference over whole pixels, as in the study.
    """
    side, edge = 212, 22
    rows, columns = np.mgrid[edge : edge + side, edge : edge + side].astype(float)
    template = before[edge : edge + side, edge : edge + side].astype(float)
    spline = scipy.ndimage.spline_filter(after.astype(float), order=5, mode="mirror")
    sample = functools.partial(scipy.ndimage.map_coordinates, spline, order=5, prefilter=False, mode="mirror")
    d = np.array([shift_px, 0.0])
    for _ in range(4):
        here, right, left, below, above = (
            sample([rows + d[1] + dy, columns + d[0] + dx]) for dx, dy in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
        )
        jacobian = np.stack([right - left, below - above], axis=-1).reshape(-1, 2) / 2
        d += np.linalg.lstsq(jacobian, (template - here).ravel(), rcond=None)[0]
    return float(d[0] - shift_px)


FRACTIONS = np.arange(8) / 8


def s_curve(errors_px: list[float]) -> float:
    return float(2 * np.mean(errors_px * np.sin(2 * np.pi * FRACTIONS)))


@pytest.mark.parametrize("heading", [0.0, 0.7])
def test_a4_render_bias(heading: float) -> None:
    way = -W * np.array([np.cos(heading), np.sin(heading), 0])
    at = np.array([0.2, -0.2, heading])
    frames = [see(paper_surface(), tuple(at + shift * way), 256).astype(float) for shift in FRACTIONS]
    sharp = [quintic_shift_error(frames[0], frame, d) for frame, d in zip(frames, FRACTIONS, strict=True)]
    assert abs(s_curve(sharp)) <= 0.8e-3
    assert np.max(np.abs(sharp)) <= 0.8e-3
    # most of that is the quintic spline's own: without the finest detail almost nothing is left
    smooth = [scipy.ndimage.gaussian_filter(frame, 1.0) for frame in frames]
    soft = [quintic_shift_error(smooth[0], frame, d) for frame, d in zip(smooth, FRACTIONS, strict=True)]
    assert abs(s_curve(soft)) <= 0.08e-3


def test_a4_would_find_a_bilinear_renderer() -> None:
    before = see(paper_surface(), (0.2, -0.2, 0.0), 256).astype(float)
    frames = [scipy.ndimage.shift(before, (0, d), order=1, mode="nearest") for d in FRACTIONS]
    errors = [quintic_shift_error(before, frame, d) for frame, d in zip(frames, FRACTIONS, strict=True)]
    assert abs(s_curve(errors)) > 8e-3


# ------------------------------------------------------------------------------ the sensor


def test_noise_is_white_of_the_right_size_and_belongs_to_its_frame() -> None:
    flat = np.full((512, 512), 100.25, dtype=np.float32)
    frames = [expose(flat, noise_key=noise_key_of(3, k), noise_grey=2).astype(float) - 100.25 for k in range(4)]
    n = flat.size
    for noise in frames:
        assert abs(noise.mean()) < 5 * 2 / np.sqrt(n)
        assert noise.std() == pytest.approx(np.sqrt(4 + 1 / 12), rel=0.01)
        for lag in range(1, 9):
            r = np.mean(noise.ravel()[lag:] * noise.ravel()[:-lag]) / noise.var()
            assert abs(r) < 5 / np.sqrt(n)
    assert np.max(np.abs(np.corrcoef([f.ravel() for f in frames]) - np.eye(4))) < 5 / np.sqrt(n)


def test_gain_offset_vignetting_and_clipping() -> None:
    flat = np.full((5, 5), 100, dtype=np.float32)
    assert np.all(expose(flat, noise_key=1, gain=1.5, offset_grey=7) == 157)
    assert np.all(expose(flat, noise_key=1, gain=3.0) == 255)
    assert np.all(expose(flat, noise_key=1, gain=-1.0) == 0)
    dark = expose(flat, noise_key=1, vignetting=0.6)
    assert (dark[2, 2], dark[0, 0], dark[2, 4]) == (100, 40, 70)


# ---------------------------------------------------------------------------- trajectories


def test_image_motion_is_what_the_renderer_shows() -> None:
    poses = np.array([[0.3, 0.1, 0.5], [0.3 + 6.3 * W, 0.1 - 3.1 * W, 0.55]])
    (shift,), (turn,) = ways.image_motion(poses, W)
    before, after = (see(sinusoids(), tuple(p), 201) for p in poses)
    v, u = np.mgrid[:201, :201] - 100.0
    p = np.stack([u, v], axis=-1)
    clockwise = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])  # on the screen: +u to +v
    source = (p - shift) @ clockwise + 100  # the inverse of moved = clockwise @ source + shift
    seen = scipy.ndimage.map_coordinates(before.astype(float), [source[..., 1], source[..., 0]], order=5)
    np.testing.assert_allclose(seen[40:-40, 40:-40], after[40:-40, 40:-40], atol=0.02)


# --------------------------------------------------------------------------------- mission


def frames(kind: type[flaws.Fault], start: int, stop: int, **parameters: object) -> flaws.Fault:
    """A fault from one frame to before another at 60 Hz; half a frame early, so that nothing hangs on rounding."""
    return kind(start_s=(start - 0.5) / 60, stop_s=(stop - 0.5) / 60, **parameters)


def small_mission(*faults: flaws.Fault, n: int = 12, **settings: object) -> SimulatedMission:
    poses = ways.follow(ways.circle(), np.full(n - 1, 0.008))
    return nadir_mission(sinusoids(), poses, camera=nadir_camera(64, 48), seed=5, faults=faults, **settings)


def images(mission: SimulatedMission) -> dict[int, np.ndarray]:
    samples = [s for s in mission.read([sim.IMAGE]) if isinstance(s, ImageSample)]
    first = mission.truth_t_ns[0]
    return {
        round((s.t_ns - first) * 60 / 1e9): np.frombuffer(s.data, np.uint8).reshape(s.height_px, s.width_px)
        for s in samples
    }


def test_any_frame_can_be_rendered_by_itself() -> None:
    mission, again = small_mission(), small_mission()
    in_order = images(mission)
    for k in (7, 0, 11):
        assert np.array_equal(again.frame(k), in_order[k])
    assert not np.array_equal(small_mission().frame(0), nadir_mission(sinusoids(), mission.truth_poses).frame(0))
    with pytest.raises(IndexError, match="12 frames"):
        mission.frame(12)


def test_reading_is_merged_half_open_and_by_name() -> None:
    mission = small_mission()
    everything = list(mission.read())
    assert len(everything) == 48
    assert [s.t_ns for s in everything] == sorted(s.t_ns for s in everything)
    some = list(mission.read([sim.POSE], int(mission.truth_t_ns[2]), int(mission.truth_t_ns[5])))
    assert [s.t_ns for s in some] == mission.truth_t_ns[2:5].tolist()
    assert {i.name: i.count for i in mission.streams} == dict.fromkeys([sim.IMAGE, sim.INFO, sim.POSE, sim.HEIGHT], 12)
    assert mission.stream(sim.IMAGE).rate_hz == pytest.approx(60)
    with pytest.raises(StreamError, match="/nowhere"):
        mission.read(["/nowhere"])


def test_the_reference_is_the_truth() -> None:
    mission = small_mission(height_m=np.linspace(0.2, 0.21, 12))
    poses = [s for s in mission.read([sim.POSE]) if isinstance(s, PoseSample)]
    heights = [s for s in mission.read([sim.HEIGHT]) if isinstance(s, RangeSample)]
    read_back = [[*p.position_m[:2], heading_of_quat(p.quat_xyzw)] for p in poses]
    np.testing.assert_allclose(read_back, mission.truth_poses, atol=1e-14)
    assert [h.range_m for h in heights] == [p.position_m[2] for p in poses] == np.linspace(0.2, 0.21, 12).tolist()
    assert mission.metres_per_px == pytest.approx(0.205 / 256)


def test_dropped_and_duplicate_frames() -> None:
    clean = images(small_mission())
    faulty = images(small_mission(frames(flaws.DroppedFrames, 3, 5), frames(flaws.DuplicateFrames, 8, 10)))
    assert sorted(faulty) == [0, 1, 2, 5, 6, 7, 8, 9, 10, 11]
    for k, image in faulty.items():
        assert np.array_equal(image, clean[7 if k in (8, 9) else k])
    info = small_mission(frames(flaws.DroppedFrames, 0, 12)).stream(sim.IMAGE)
    assert (info.count, info.first_ns) == (0, -1)


def test_exposure_jump() -> None:
    clean, bright = (
        small_mission(noise_grey=0),
        small_mission(frames(flaws.ExposureJump, 4, 6, gain=1.2, offset_grey=5), noise_grey=0),
    )
    for k in range(12):
        expected = clean.frame(k) * (1.2 if k in (4, 5) else 1) + (5 if k in (4, 5) else 0)
        np.testing.assert_allclose(bright.frame(k), np.clip(expected, 0, 255), atol=1.2)


def test_motion_blur_weakens_the_texture_along_the_motion_and_keeps_the_place() -> None:
    poses = ways.follow(ways.line(), np.full(4, 12 * W))
    sharp, blurred = (
        nadir_mission(sinusoids(), poses, noise_grey=0, faults=faults)
        for faults in ((), (frames(flaws.MotionBlur, 2, 3, exposure=0.5),))
    )
    assert np.array_equal(sharp.frame(1), blurred.frame(1))
    v, u = np.mgrid[:512, :512] - 255.5
    expected = np.full((512, 512), 120.0)
    for amplitude, fx, fy, phase in WAVES:
        wx, wy = 2 * np.pi * fx / PERIOD, 2 * np.pi * fy / PERIOD
        attenuation = np.exp(-0.5 * PSF_SIGMA_PX**2 * (wx**2 + wy**2)) * np.sinc(wx * 6 / (2 * np.pi))
        expected += amplitude * attenuation * np.cos(wx * (u + 24) + wy * v + phase)
    np.testing.assert_allclose(blurred.frame(2), expected, atol=0.6)


def test_a_repetitive_patch_lies_on_the_ground() -> None:
    poses = ways.follow(ways.line(), np.full(99, 0.01))
    fault = frames(flaws.RepetitiveTexture, 40, 60, period_px=32, margin_m=1.0)
    clean = nadir_mission(sinusoids(), poses, noise_grey=0)
    faulty = nadir_mission(sinusoids(), poses, noise_grey=0, faults=[fault])
    assert np.array_equal(clean.frame(10), faulty.frame(10))
    inside = faulty.frame(50)[:, 200:312].astype(int)  # 0.2 m are 256 px, the frame sees 512
    np.testing.assert_allclose(inside[32:], inside[:-32], atol=1)
    far = np.r_[0:110, 402:512]
    assert np.array_equal(clean.frame(50)[:, far], faulty.frame(50)[:, far])


def test_arrays_of_another_length_are_refused() -> None:
    with pytest.raises(ValueError, match=r"height_m: .* give one number"):
        small_mission(height_m=np.ones(3))
