"""A simulated mission: pictures by number, faults in their intervals and nowhere else, patches where they lie."""

import dataclasses

import numpy as np
import pytest

from pipelines.lens import pinhole
from pipelines.simulation import faults as flaws
from pipelines.simulation import trajectories as ways
from pipelines.simulation.curves import curve
from pipelines.simulation.driving import Drive
from pipelines.simulation.faults import Fault
from pipelines.simulation.imaging import CameraOnBoard
from pipelines.simulation.mission import IMAGE, INFO, SimulatedMission, nadir_mission
from pipelines.simulation.motion import NADIR, Hold, Mount, looking
from pipelines.simulation.patches import centres, corners, faded, inside, intervals, overlaps
from pipelines.simulation.render import expose, noise_key_of, view
from pipelines.simulation.scene import Patch, Scene
from pipelines.simulation.speeds import speed
from pipelines.simulation.surfaces import gravel, tiles
from pipelines.simulation.timing import Timing, schedule
from readers.streams import CameraInfo, ImageError, ImageSample, StreamError

RATE_HZ = 20.0
GROUND = gravel(128, np.random.default_rng(0))
CAMERA = pinhole(64, 48, 60.0)


def mission(*faults: Fault, n: int = 40, step_m: float = 0.004, **settings: object) -> SimulatedMission:
    poses = ways.follow(ways.circle(0.3), np.full(n - 1, step_m))
    options = {"camera": CAMERA, "rate_hz": RATE_HZ, "noise_grey": 0.0, "seed": 4} | settings
    return nadir_mission(GROUND, poses, faults=faults, **options)


def images(made: SimulatedMission) -> list[ImageSample]:
    return [sample for sample in made.arrivals([IMAGE]) if isinstance(sample, ImageSample)]


# -------------------------------------------------------------------------------- identity


def test_equal_missions_are_equal_and_others_are_not() -> None:
    same = mission().identity
    assert mission().identity == same
    fault = flaws.ExposureJump(start_s=0.5, stop_s=1, gain=1.2)
    others = [
        mission(seed=5),
        mission(noise_grey=1.0),
        mission(n=41),
        mission(step_m=0.0041),
        mission(fault),
        mission(camera=pinhole(64, 48, 61.0)),
        mission(height_m=0.21),
    ]
    identities = {same, *(other.identity for other in others)}
    assert len(identities) == 1 + len(others)


def test_the_surface_is_part_of_the_identity() -> None:
    poses = ways.standstill(2)
    one, other = (nadir_mission(tiles(32, np.random.default_rng(seed)), poses) for seed in (0, 1))
    assert one.identity != other.identity


def test_two_channels_of_one_name_are_refused() -> None:
    made = mission()
    camera = made.on_board[0]
    with pytest.raises(ValueError, match="the same name"):
        SimulatedMission([camera.channel(), camera.channel()], name="m", start_ns=0, motion=made.motion, description={})


# ------------------------------------------------------------------------- reading in order


def test_random_access_gives_the_bytes_of_reading_in_order() -> None:
    noisy = mission(noise_grey=3.0)
    in_order = [bytes(sample.data) for sample in images(noisy)]
    again = mission(noise_grey=3.0)
    for k in (31, 0, 7):
        assert again.frame(k).tobytes() == in_order[k]
    window = list(again.read([IMAGE], int(again.truth_t_ns[7]), int(again.truth_t_ns[9])))
    assert [bytes(s.data) for s in window if isinstance(s, ImageSample)] == in_order[7:9]
    assert mission(noise_grey=3.0, seed=5).frame(7).tobytes() != in_order[7]


def test_reading_goes_by_stamps_and_arrivals_by_the_log() -> None:
    late = mission(flaws.SwappedStamps(start_s=0.5, stop_s=1.0))
    stamps = [s.t_ns for s in late.read([IMAGE])]
    assert stamps == sorted(stamps)
    arrived = [s.t_ns for s in late.arrivals([IMAGE])]
    assert sorted(arrived) == stamps != arrived
    received = [s.received_ns for s in late.arrivals()]
    assert received == sorted(received)
    assert late.count_before(IMAGE, stamps[5]) == 5
    with pytest.raises(StreamError, match="/nowhere"):
        late.arrivals(["/nowhere"])


# ---------------------------------------------------------------------------------- faults

WHILE = {"start_s": 0.5, "stop_s": 1.0}  # frames 10 to 19


@pytest.mark.parametrize(
    "fault",
    [
        flaws.ExposureJump(gain=1.3, **WHILE),
        flaws.ImageNoise(noise_grey=8.0, **WHILE),
        flaws.LensDirt(share=0.4, **WHILE),
        flaws.MotionBlur(exposure=0.9, **WHILE),
    ],
    ids=lambda fault: fault.name,
)
def test_faults_of_pictures_hold_in_their_interval_only(fault: Fault) -> None:
    clean, faulty = mission(), mission(fault)
    differs = [k for k in range(40) if not np.array_equal(clean.frame(k), faulty.frame(k))]
    assert differs == list(range(10, 20))


def test_a_picture_is_the_view_exposed_as_the_camera_is_set() -> None:
    jump = flaws.ExposureJump(gain=1.2, offset_grey=5.0, **WHILE)
    camera = dataclasses.replace(
        mission().on_board[0], exposure_s=0.02, readout_s=0.01, vignetting=0.4, noise_grey=3.0, faults=(jump,)
    )
    place = (camera.scene, CAMERA, camera.mount, camera.motion, float(camera.plan.t_s[12]))
    seen = view(*place, exposure_s=0.02, exposure_samples=15, readout_s=0.01)
    expected = expose(seen, noise_key=noise_key_of(4, 12), noise_grey=3.0, gain=1.2, offset_grey=5.0, vignetting=0.4)
    np.testing.assert_array_equal(camera.picture(12), expected)


def test_motion_blur_is_an_exposure_by_share_of_the_frames_interval() -> None:
    blurred = mission(flaws.MotionBlur(exposure=0.8, **WHILE))
    longer = dataclasses.replace(mission().on_board[0], exposure_s=0.8 / RATE_HZ)
    np.testing.assert_array_equal(blurred.frame(12), longer.picture(12))


def test_lens_dirt_stays_where_it_is() -> None:
    dirty = mission(flaws.LensDirt(share=1.0, start_s=0, stop_s=3))
    assert np.array_equal(dirty.frame(3), dirty.frame(30))


def test_noise_of_a_fault_has_its_deviation() -> None:
    clean, noisy = mission(), mission(flaws.ImageNoise(noise_grey=8.0, **WHILE))
    difference = np.concatenate([noisy.frame(k) - clean.frame(k).astype(float) for k in range(10, 20)])
    assert difference.std() == pytest.approx(8.0, rel=0.05)


def test_dropped_and_duplicate_frames() -> None:
    clean = [bytes(s.data) for s in images(mission())]
    dropped = images(mission(flaws.DroppedFrames(**WHILE)))
    assert [bytes(s.data) for s in dropped] == clean[:10] + clean[20:]
    made = mission(flaws.DuplicateFrames(**WHILE))
    twice = images(made)
    assert [bytes(s.data) for s in twice] == clean[:10] + [clean[9]] * 10 + clean[20:]
    assert [s.t_ns for s in twice] == made.truth_t_ns.tolist()
    assert [made.sent(k) for k in (9, 10, 19, 20)] == [True, False, False, True]


def test_late_images() -> None:
    clean, late = images(mission()), images(mission(flaws.LateImages(latency_s=0.02, **WHILE)))
    delay = [b.t_ns - a.t_ns for a, b in zip(clean, late, strict=True)]
    assert delay == [0] * 10 + [20_000_000] * 10 + [0] * 20


def test_wrong_calibration_is_sent_and_changes_no_picture() -> None:
    clean, wrong = mission(), mission(flaws.WrongCalibration(focal_factor=1.1, **WHILE))
    assert np.array_equal(clean.frame(15), wrong.frame(15))
    infos = [s.camera.matrix[0, 0] for s in wrong.read([INFO]) if isinstance(s, CameraInfo)]
    np.testing.assert_allclose(infos, [60.0] * 10 + [66.0] * 10 + [60.0] * 20)
    from_start = mission(flaws.WrongCalibration(focal_factor=1.1, start_s=0, stop_s=1))
    assert from_start.cameras[IMAGE].matrix[0, 0] == pytest.approx(66.0)


def test_a_picture_that_cannot_be_rendered_is_an_error_of_that_image() -> None:
    below = dataclasses.replace(mission().on_board[0], mount=Mount(np.array([0, 0, -0.3])))
    image = below.channel().sample(5, 0, 0)
    assert isinstance(image, ImageSample)
    with pytest.raises(ImageError, match=r"simulated /camera/image_raw frame 5: camera height -0\.0998 m"):
        _ = image.data


def test_faults_of_other_things_are_refused() -> None:
    with pytest.raises(ValueError, match="gyro-bias is no fault of the images or the ground"):
        mission(flaws.GyroBias(bias_radps=(0, 0, 1), **WHILE))


# --------------------------------------------------------------------------------- patches


def there_and_back(fault: Fault) -> SimulatedMission:
    x = np.concatenate([np.linspace(0, 1, 41), np.linspace(1, 0, 41)[1:]])
    return nadir_mission(
        GROUND, np.column_stack([x, 0 * x, 0 * x]), camera=CAMERA, rate_hz=RATE_HZ, noise_grey=0, faults=[fault]
    )


def test_a_patch_is_met_as_often_as_the_way_leads_over_it() -> None:
    made = there_and_back(flaws.RepetitiveTexture(start_s=0.5, stop_s=0.75, margin_m=0.1))
    assert [(f.name, round(f.start_s * RATE_HZ), round(f.stop_s * RATE_HZ)) for f in made.faults] == [
        ("repetitive-texture", 10, 15),
        ("repetitive-texture", 66, 71),
    ]
    fault = made.faults[0]
    assert isinstance(fault, flaws.RepetitiveTexture)
    assert fault.area_m == pytest.approx((0.2375, 0.3625, -0.1, 0.1), abs=1e-3)
    clean = nadir_mission(GROUND, made.truth_poses, camera=CAMERA, rate_hz=RATE_HZ, noise_grey=0)
    differs = np.array([not np.array_equal(made.frame(k), clean.frame(k)) for k in range(81)])
    seen = np.zeros(81, dtype=bool)
    for first, stop in fault.in_view_s:
        seen[round(first * RATE_HZ) : round(stop * RATE_HZ)] = True
    assert np.all(seen | ~differs)  # no frame shows it that is said not to
    assert differs.sum() >= seen.sum() - 4  # at its soft edge a patch may be in view and change no grey level


def test_low_texture_is_the_same_ground_with_less_contrast() -> None:
    pale = faded(GROUND, 0.5)
    scene, ground = Scene(pale), Scene(GROUND)
    mount, still = Mount(np.array([0, 0, 0.2002])), Drive(curve("line"), speed("constant", speed_mps=0, duration_s=1))
    camera = pinhole(128, 128, 256.0)
    paler, usual = (view(s, camera, mount, still, 0.0).astype(float) for s in (scene, ground))
    slope = np.concatenate([np.diff(paler).ravel(), np.diff(paler, axis=0).ravel()])
    assert np.sqrt(np.mean(slope**2)) == pytest.approx(0.5, rel=0.1)
    assert np.corrcoef(paler.ravel(), usual.ravel())[0, 1] > 0.9999
    made = there_and_back(flaws.LowTexture(start_s=0.5, stop_s=0.75, gradient_rms=0.2, margin_m=0.5))
    assert np.ptp(made.frame(12)[:, 24:40]) < 0.1 * np.ptp(made.frame(40))


def test_a_patch_must_be_met() -> None:
    area = (5.0, 6.0, 5.0, 6.0)
    with pytest.raises(ValueError, match="does not lead over it"):
        there_and_back(flaws.RepetitiveTexture(start_s=0, stop_s=1, area_m=area))
    with pytest.raises(ValueError, match="no frame between"):
        there_and_back(flaws.LowTexture(start_s=0.501, stop_s=0.502))


def test_ground_points_are_what_a_tilted_camera_with_a_lens_shows() -> None:
    drive = Drive(curve("circle"), speed("constant", speed_mps=0.5, duration_s=4))
    camera = pinhole(64, 48, 60.0, distortion=(-0.2, 0.03))
    mount = Mount(np.array([0.1, -0.05, 0.3]), looking(NADIR, yaw_rad=0.3, pitch_rad=-0.2, roll_rad=0.1))
    (centre,) = centres(camera, mount, drive, np.array([2.0]))
    spot = tiles(8, np.random.default_rng(0), joint_px=1)
    patch = Patch(spot, *(centre[0] + np.array([-0.01, 0.01])), *(centre[1] + np.array([-0.01, 0.01])))
    plain, marked = (view(Scene(GROUND, patches), camera, mount, drive, 2.0) for patches in ((), (patch,)))
    rows, columns = np.nonzero(np.abs(plain - marked) > 1)
    assert (rows.mean(), columns.mean()) == pytest.approx((23.5, 31.5), abs=0.5)


def test_corners_of_a_level_camera() -> None:
    drive = Drive(curve("line"), speed("constant", speed_mps=1.0, duration_s=4))
    (corner,) = corners(CAMERA, Mount(np.array([0, 0, 0.6])), drive, np.array([2.0]))
    half = np.array([32.0, 24.0]) * 0.6 / 60
    expected = np.array([2.0, 0.0]) + half * [[-1, 1], [1, 1], [1, -1], [-1, -1]]
    np.testing.assert_allclose(corner, expected, atol=1e-12)


def test_overlaps_agrees_with_points_inside() -> None:
    rng = np.random.default_rng(2)
    area = (-1.0, 1.0, -0.5, 0.5)
    turns, places = rng.uniform(0, 7, 200), rng.uniform(-2.5, 2.5, (200, 2))
    box = np.array([[-0.8, -0.4], [0.8, -0.4], [0.8, 0.4], [-0.8, 0.4]])
    grid = np.stack(np.meshgrid(np.linspace(-0.8, 0.8, 81), np.linspace(-0.4, 0.4, 41)), axis=-1).reshape(-1, 2)
    cos, sin = np.cos(turns), np.sin(turns)
    rotations = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], 1)
    quads = box @ rotations.swapaxes(1, 2) + places[:, None]
    expected = [inside(area, grid @ r.T + p).any() for r, p in zip(rotations, places, strict=True)]
    found = overlaps(area, quads)
    assert 40 < np.count_nonzero(expected) < 160
    assert np.count_nonzero(found != expected) <= 4  # corners that are cut by less than the grid's step
    assert not np.any(np.array(expected) & ~found)


def test_intervals_are_half_open() -> None:
    held = np.array([True, True, False, False, True])
    assert intervals(held, np.arange(5) / 10, 0.1) == [(0.0, 0.2), (0.4, 0.5)]
    assert intervals(~held, np.arange(5) / 10, 0.1) == [(0.2, 0.4)]


# ---------------------------------------------------------------------------------- mounts


@pytest.mark.parametrize(("hold", "turned"), [(Hold.RIGID, True), (Hold.LEVELLED, True), (Hold.GIMBALLED, False)])
def test_poses_of_a_camera_ahead_of_the_turning_point(hold: Hold, turned: bool) -> None:
    drive = Drive(curve("circle", radius_m=1.0), speed("constant", speed_mps=1.0, duration_s=8))
    plan = schedule(Timing(rate_hz=10), duration_s=8, start_ns=0, seed=0, stream=IMAGE)
    camera = CameraOnBoard(
        stream=IMAGE,
        camera=CAMERA,
        mount=Mount(np.array([0.1, 0, 0.2]), hold=hold),
        motion=drive,
        scene=Scene(GROUND),
        start_ns=0,
        plan=plan,
        rate_hz=10,
    )
    t = plan.t_s  # the radius is 1 m and the speed 1 m/s: the heading is the time
    expected = np.column_stack([np.sin(t) + 0.1 * np.cos(t), 1 - np.cos(t) + 0.1 * np.sin(t), t if turned else 0 * t])
    np.testing.assert_allclose(camera.poses, expected, atol=1e-9)
    np.testing.assert_allclose(camera.heights_m, 0.2)
    longer = dataclasses.replace(camera, exposure_s=0.05)
    assert not np.array_equal(longer.picture(5), camera.picture(5))
