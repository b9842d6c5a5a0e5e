"""Scenarios: the named ones, what they make, what they refuse, and that a mission on disk is the one replayed."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.correlation.step import CorrelationStep
from pipelines.geometry import heading_of_quat
from pipelines.simulation import scenario as making
from pipelines.simulation.families import ground
from pipelines.simulation.faults import FAULTS, FAULTS_STREAM, from_text, to_text
from pipelines.simulation.mission import IMAGE, SimulatedMission
from pipelines.simulation.motion import NADIR, Hold, looking
from pipelines.simulation.scenario import landmarks_of
from pipelines.simulation.scene import Relief
from pipelines.simulation.sections import is_section, meanings
from pipelines.simulation.surfaces import surface_from_image
from readers.streams import (
    CameraInfo,
    ImageSample,
    ImuSample,
    OdometrySample,
    PoseSample,
    RangeSample,
    ReadOptions,
    RecordingError,
    StreamKind,
    TextSample,
    TrackSample,
)
from workbench import inputs, scenarios
from workbench.opening import open_any
from workbench.rrd import read_steps
from workbench.session import Request, run
from workbench.settings import SettingsError
from workbench.writers import write

DEMO = Path(__file__).parents[1] / "recordings" / "demo.mcap"
SMALL = (
    "ground.size_px=256",
    "camera.width_px=96",
    "camera.height_px=72",
    "camera.focal_px=100",
    "trajectory.speed_kmh=0.4",
)


def made(name: str, *overrides: str, seed: int | None = None) -> SimulatedMission:
    return scenarios.mission(scenarios.load(name, overrides=overrides, seed=seed))


def small(name: str, *overrides: str, seed: int | None = None) -> SimulatedMission:
    return made(name, *SMALL, *overrides, seed=seed)


# ------------------------------------------------------------------------ the named scenarios


@pytest.mark.parametrize("name", scenarios.names())
def test_every_named_scenario_is_what_it_says(name: str) -> None:
    mission = made(name, "ground.size_px=256")
    assert scenarios.about(name)
    first = mission.on_board[0]
    assert mission.frame(0).shape == (first.camera.height_px, first.camera.width_px)
    assert mission.frame(0).std() > 3
    assert {f.start_s < f.stop_s <= mission.motion.duration_s + 0.2 for f in mission.faults} <= {True}
    wanted = scenarios.load(name).scenario
    assert [f.name for f in mission.faults] == [f.name for f in wanted.faults]
    if wanted.reference is not None and not wanted.reference.position_noise_m:
        _the_reference_is_the_truth(mission)
    (told,) = (s.text for s in mission.read([FAULTS_STREAM]) if isinstance(s, TextSample))
    records = from_text(told)
    assert [(r.name, r.start_ns) for r in records] == [
        (f.name, mission.start_ns + round(f.start_s * 1e9)) for f in mission.faults
    ]
    assert json.loads(told)["scenario"]["name"] == name


def _the_reference_is_the_truth(mission: SimulatedMission) -> None:
    poses = [s for s in mission.read(["/reference/pose"]) if isinstance(s, PoseSample)]
    t_s = np.array([(s.t_ns - mission.start_ns) * 1e-9 for s in poses])
    first = mission.on_board[0]
    point = first.mount.position_m if first.stream == IMAGE else np.zeros(3)  # of a front camera's: the body itself
    state = mission.motion.at(t_s).at_point(point)
    np.testing.assert_allclose([s.position_m for s in poses], state.position_m, atol=1e-8)
    turns = np.exp(1j * (np.array([heading_of_quat(s.quat_xyzw) for s in poses]) - state.heading_rad))
    np.testing.assert_allclose(turns, 1, atol=1e-7)


def test_there_is_a_scenario_for_every_fault_and_curve_of_the_paper() -> None:
    names = scenarios.names()
    assert {f"fault-{kind}" for kind in FAULTS} <= set(names)
    assert {
        "paper-a",
        "paper-b",
        "demo",
        "line",
        "circle",
        "square",
        "figure-eight",
        "s-curve",
        "patrol-lanes",
        "intersecting",
        "non-intersecting",
    } <= set(names)


def test_paper_a_is_the_papers_experiment() -> None:
    mission = made("paper-a")
    assert len(mission.truth_poses) == 2111
    assert mission.truth_t_ns[-1] - mission.truth_t_ns[0] == round(2110 / 60 * 1e9)
    assert mission.metres_per_px == pytest.approx(0.000782, rel=1e-3)
    shift = np.linalg.norm(np.diff(mission.truth_poses[100:, :2], axis=0), axis=1) / mission.metres_per_px
    assert shift.mean() == pytest.approx(11, abs=0.5)
    assert mission.frame(0).shape == (512, 512)


def test_paper_b_goes_forth_and_back_before_the_chessboard() -> None:
    mission = made("paper-b")
    rates = {s.name: s.rate_hz for s in mission.streams if s.count > 1}
    expected = {"/front/image_raw": 5, "/imu": 50, "/wheel/odometry": 20, "/front/tracks": 5}
    assert {name: rates[name] for name in expected} == pytest.approx(expected)
    x = mission.motion.at(np.linspace(0, 51, 500)).position_m[:, 0]
    assert (x[0], x.max(), x[-1]) == pytest.approx((0, 1.25, 0), abs=0.01)
    still = mission.motion.at(np.array([0.7, 13.0, 25.5])).velocity_mps
    np.testing.assert_allclose(still, 0, atol=1e-12)
    k = 40
    tracks = [s for s in mission.read(["/front/tracks"]) if isinstance(s, TrackSample)][k]
    assert len(tracks.ids) == 4 + 48
    done, corners = cv2.findChessboardCorners(mission.frame(k), (8, 6))
    assert done
    board = tracks.points_px[tracks.ids >= 4]
    nearest = np.linalg.norm(board[:, None] - corners.reshape(1, -1, 2), axis=2).min(axis=1)
    assert np.median(nearest) < 0.7  # the tracks have 0.1 px of noise, the corners are found to half a pixel


def test_a_square_on_the_spot_turns_where_it_stands() -> None:
    """Each round: 1 m at 0.5 m/s and 0.5 m/s² in 3 s, a stop of 0.5 s, a quarter turn in 2 s."""
    mission = made("square-on-the-spot", "ground.size_px=256")
    assert mission.motion.duration_s == pytest.approx(4 * 5.5)
    ends = mission.motion.at(np.arange(9) // 2 * 5.5 + np.array([0, 3.25] * 4 + [0])).poses
    corners = np.array([[0, 0], [1, 0], [1, 0], [1, 1], [1, 1], [0, 1], [0, 1], [0, 0], [0, 0]])
    np.testing.assert_allclose(ends[:, :2], corners, atol=1e-9)
    np.testing.assert_allclose(ends[:, 2], np.array([0, 0, 1, 1, 2, 2, 3, 3, 4]) * np.pi / 2, atol=1e-9)
    turning = mission.motion.at(np.linspace(3.01, 5.49, 50))
    np.testing.assert_allclose(turning.velocity_mps, 0, atol=1e-12)
    assert turning.angular_velocity_radps[:, 2].max() == pytest.approx(1.875 * np.pi / 2 / 2, rel=0.01)


def test_legs_go_back_in_reverse_and_along_curves() -> None:
    legs = "trajectory.legs=[{drive_m=1, curve='circle', parameters={radius_m=0.5}}, {drive_m=-0.5}]"
    mission = small("line", legs, "trajectory.speed_kmh=1.8")
    end = mission.motion.at(np.array([mission.motion.duration_s]))
    corner = np.array([0.5 * np.sin(2), 0.5 - 0.5 * np.cos(2)])  # after 1 m of a circle of 0.5 m: 2 rad
    np.testing.assert_allclose(end.poses[0, :2], corner - 0.5 * np.array([np.cos(2), np.sin(2)]), atol=1e-9)
    assert end.heading_rad[0] == pytest.approx(2)


def test_sideslip_wavers_about_its_mean() -> None:
    steady = ("duration_s=60", "trajectory.profile=constant", "trajectory.sideslip_rad=0.1")
    motion = small("sideslip", *steady).motion
    velocity = motion.at(np.linspace(0, 60, 3000)).body_velocity_mps
    slip = np.arctan2(velocity[:, 1], velocity[:, 0])
    assert (slip.mean(), slip.std()) == pytest.approx((0.1, 0.05), abs=0.01)
    other = small("sideslip", *steady, seed=4).motion.at(np.linspace(0, 60, 3000)).body_velocity_mps
    assert np.abs(np.corrcoef(velocity[:, 1], other[:, 1])[0, 1]) < 0.5


def test_cameras_say_where_they_sit_unless_a_gimbal_moves_them() -> None:
    place = ("camera.ahead_m=0.1", "camera.left_m=-0.02", "camera.pitch_rad=-0.3")
    mission = small("circle", *place, "body.roll_rms_rad=0.05")
    camera, state = mission.on_board[0], mission.motion.at(np.array([1.3]))
    world_r_camera, position = camera.mount.world_t_camera(state)
    body_t_camera = mission.cameras[IMAGE].body_t_camera
    np.testing.assert_allclose(state.world_r_body[0] @ body_t_camera[:3, :3], world_r_camera[0], atol=1e-12)
    seen = state.position_m[0] + state.world_r_body[0] @ body_t_camera[:3, 3]
    np.testing.assert_allclose(seen, position[0], atol=1e-12)
    (told,) = mission.read(["/reference/pose"], mission.start_ns + 1_300_000_000, mission.start_ns + 1_300_000_001)
    assert isinstance(told, PoseSample)
    np.testing.assert_allclose(told.position_m, position[0], atol=1e-12)
    np.testing.assert_array_equal(body_t_camera[3], [0, 0, 0, 1])
    assert np.isnan(small("gimballed").cameras[IMAGE].body_t_camera).all()


def test_the_reference_of_a_camera_is_no_pose_of_the_bodys_frame() -> None:
    def frames(*overrides: str) -> set[str]:
        poses = small("circle", "frames=3", *overrides).read(["/reference/pose"])
        return {s.child_frame for s in poses if isinstance(s, PoseSample)}

    assert frames() == {"camera_ground"}
    assert frames("reference.child_frame=prism") == {"prism"}
    assert frames("camera=none", "height=none", "frames=none", "duration_s=0.1") == {"base_link"}


def test_tracks_are_of_the_missions_landmarks() -> None:
    mission = made("paper-b", "ground.size_px=256", "tracks.noise_px=0")
    assert sorted(mission.landmarks) == list(range(4 + 48))
    track = next(s for s in mission.read(["/front/tracks"]) if isinstance(s, TrackSample))
    camera = mission.on_board[0]
    state = mission.motion.at(np.array([(track.t_ns - mission.start_ns) * 1e-9]))
    world_r_camera, position = camera.mount.world_t_camera(state)
    for number, point in zip(track.ids.tolist(), track.points_px, strict=True):
        ray = world_r_camera[0].T @ (mission.landmarks[number].position_m - position[0])
        pixel = camera.camera.matrix @ ray
        np.testing.assert_allclose(point, pixel[:2] / pixel[2], atol=1e-4)


# ------------------------------------------------------------------------------ determinism


def content(mission: SimulatedMission) -> list[tuple[object, ...]]:
    found: list[tuple[object, ...]] = []
    for sample in mission.arrivals():
        key: tuple[object, ...] = (sample.stream, sample.t_ns, sample.received_ns)
        if isinstance(sample, ImageSample):
            key += (bytes(sample.data),)
        elif isinstance(sample, ImuSample):
            key += (sample.angular_velocity_radps.tobytes(),)
        elif isinstance(sample, OdometrySample):
            key += (sample.linear_velocity_mps.tobytes(),)
        elif isinstance(sample, TrackSample):
            key += (sample.points_px.tobytes(),)
        found.append(key)
    return found


BRIEF = ("duration_s=0.5", "front.width_px=80", "front.height_px=60", "front.focal_px=60")


def test_same_seed_same_bytes() -> None:
    first, again, other = (small("sensors", *BRIEF, seed=seed) for seed in (1, 1, 2))
    assert first.identity == again.identity != other.identity
    a, b, c = content(first), content(again), content(other)
    assert a == b
    by_stream = [dict(Counter(k[0] for k in x)) for x in (a, c)]
    assert by_stream[0].keys() == by_stream[1].keys()
    for stream in ("/camera/image_raw", "/imu", "/wheel/odometry", "/front/tracks"):
        ours, theirs = ([k[3:] for k in x if k[0] == stream] for x in (a, c))
        assert ours != theirs, stream


def test_one_section_does_not_change_the_noise_of_another() -> None:
    with_it, without = small("sensors", *BRIEF), small("sensors", *BRIEF, "gnss=none", "camera.noise_grey=0")
    for stream in ("/imu", "/wheel/odometry", "/front/tracks", "/front/image_raw"):
        assert [k for k in content(with_it) if k[0] == stream] == [k for k in content(without) if k[0] == stream]


def test_the_two_cameras_have_noise_of_their_own() -> None:
    """The front camera looks down here, from the same place as the other one."""
    both = (
        "frames=1",
        "ground.size_px=256",
        "camera.width_px=64",
        "camera.height_px=64",
        "front={width_px=64, height_px=64, pitch_rad=1.5707963267948966, height_m=0.2002, focal_px=256}",
    )
    noisy = made("line", *both).on_board
    clean = made("line", *both, "camera.noise_grey=0", "front.noise_grey=0").on_board
    noise = [(a.picture(0).astype(float) - b.picture(0)).ravel() for a, b in zip(noisy, clean, strict=True)]
    assert [n.std() for n in noise] == pytest.approx([2, 2], rel=0.1)
    assert abs(np.corrcoef(*noise)[0, 1]) < 0.1


def test_a_shorter_mission_is_the_beginning_of_the_longer_one() -> None:
    short, long = small("figure-eight", "frames=20"), small("figure-eight", "frames=60")
    np.testing.assert_array_equal(short.truth_poses, long.truth_poses[:20])
    assert np.array_equal(short.frame(19), long.frame(19))


# ---------------------------------------------------------------------------------- keys


def test_what_is_shown_is_the_scenario_again(tmp_path: Path) -> None:
    for name in scenarios.names():
        scenario = scenarios.load(name).scenario
        file = tmp_path / f"{name}.toml"
        file.write_text(scenarios.to_text(scenario))
        assert scenarios.load(str(file)).scenario == scenario


def test_every_key_is_described() -> None:
    def check(kind: type, value: object, where: str) -> None:
        texts = meanings(kind)
        assert texts, where
        for key, text in texts.items():
            assert text, f"{where}.{key}"
            inner = getattr(value, key)
            if is_section(inner):
                check(type(inner), inner, f"{where}.{key}")

    full = scenarios.load("sensors").scenario
    check(type(full), full, "scenario")
    for section in ("imu", "odometer", "reference", "height", "gnss", "tracks"):
        value = getattr(full, section)
        assert set(meanings(type(value))) == set(value.__dataclass_fields__), section
        check(type(value), value, section)


@pytest.mark.parametrize(
    ("override", "text"),
    [
        ("camera.nois=1", "unknown setting 'camera.nois'; did you mean noise_grey?"),
        ("trajectory.speed_mps=1", "did you mean speed_kmh"),
        ("camera.noise_grey=-1", "camera.noise_grey = -1: input should be greater than or equal to 0"),
        ("camera.noise_grey=much", "camera.noise_grey = 'much': input should be a valid number"),
        ("frames=0", "frames = 0: input should be greater than 0"),
        ("imu.timing.rate=3", "unknown key 'rate'; did you mean rate_hz?"),
        ("imu.timing.rate_hz=0", "rate_hz is 0.0, it must be above 0"),
        ("truth={}", "truth.rate_hz must be given"),
        ("imu.gyro_density=-1", "gyro_density is -1.0, it must be 0 or more"),
        ("faults.0.gian=1", "exposure-jump: unknown key 'gian'; did you mean gain?"),
        ("faults.0.gain=bright", "exposure-jump: gain: Input should be a valid number"),
        ("faults.0.kind=exposure", "no fault is named 'exposure'; did you mean exposure-jump"),
        ("faults.1.gain=1", "faults has 1 entries, and the first one is faults.0"),
        ("faults.0.stop_s=2", "exposure-jump: from 3.0 to 2.0 s: 0 <= start_s < stop_s is needed"),
        ("faults=[5]", "a fault is a table such as"),
        ("faults.0.stop_s=inf", "exposure-jump: stop_s is inf, it must be a finite number"),
        ("faults.0.gain=-1", "exposure-jump: gain is -1.0, it must be 0 or more"),
        ("camera.timing.clock_offset_s=1e10", "clock_offset_s is 10000000000.0, it must be within ±1e9"),
        ("start_ns=99999999999999999999", "start_ns = 99999999999999999999: input should be less than or equal to"),
        ('faults=[{kind="gyro-bias", start_s=1, stop_s=2, bias_radps=[0,0,1]}]', "gyro-bias needs a section imu"),
        ('faults=[{kind="track-outliers", start_s=1, stop_s=2}]', "track-outliers needs a section tracks"),
        ("camera=none", "height: it is the downward camera's; add a section camera"),
        ("trajectory.legs=[{drive_m=1, turn_rad=1}]", "a leg has one of drive_m, turn_rad and stop_s, here: drive_m, "),
        ("trajectory.legs=[{speed=1}]", "unknown setting 'trajectory.legs.0.speed'"),
        ("trajectory={legs=[{stop_s=1}], stops=[[1, 2]]}", "leave stops and sideslip_rms_rad out"),
        ("trajectory={legs=[{stop_s=1}], speed_kmh=-1}", "legs are driven at a positive speed_kmh"),
        ("tracks.noise_px=1", "tracks: they need a section front, and landmarks_m or a chessboard"),
    ],
)
def test_a_wrong_value_is_named_with_its_cure(override: str, text: str) -> None:
    with pytest.raises(SettingsError) as caught:
        scenarios.load("fault-exposure-jump", overrides=[override])
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)
    assert f"--set {override}: " in str(caught.value) or "entries" in text


@pytest.mark.parametrize(
    ("override", "text"),
    [
        ("trajectory.curve=oval", "trajectory: no curve is named 'oval'"),
        ("trajectory.parameters={size=1}", "trajectory: curve 'figure-eight'.*length_m, width_m"),
        ("trajectory.profile=fast", "trajectory: no speed profile is named 'fast'"),
        ("trajectory.profile_parameters={jump=1}", "trajectory: speed profile 'jitter'"),
        ("ground.family=moss", "ground: .*moss.*gravel"),
        ("ground.picture=a.png", "a.png: the picture of the ground cannot be read"),
        ("camera.distortion_model=fish", "camera: .*fish"),
        ("duration_s=2", "exposure-jump begins at 3.0 s, but the mission ends at 2 s"),
        (
            'faults=[{kind="repetitive-texture", start_s=1, stop_s=2, area_m=[5,6,5,6]}]',
            "the way does not lead over it",
        ),
        ("surroundings.landmarks_m=[[3,0,0.1]]", "surroundings: plane 0 reaches"),
        ("camera.distortion=[-5]", "camera: no ray of the plumb_bob model leads to pixel"),
        ("body.roll_rms_rad=3", "camera: it is at a height of -0.2"),
        ("trajectory.legs=[{drive_m=0}]", "trajectory: 0.0 m at 0.5.* m/s: there is no such speed profile"),
    ],
)
def test_what_cannot_be_built_names_the_section(override: str, text: str) -> None:
    loaded = scenarios.load("fault-exposure-jump", overrides=["ground.size_px=256", override])
    with pytest.raises((SettingsError, RecordingError), match=text):
        scenarios.mission(loaded)


def test_a_clock_keeps_the_usual_rate(tmp_path: Path) -> None:
    late = ("imu.timing.latency_s=0.1", "camera.timing.latency_s=0.2", "front.timing.start_s=1")
    file = tmp_path / "mine.toml"
    file.write_text("\n".join(late))
    for scenario in (scenarios.load("line", overrides=late).scenario, scenarios.load(str(file)).scenario):
        assert (scenario.imu.timing.rate_hz, scenario.imu.timing.latency_s) == (100, 0.1)
        assert (scenario.camera.timing.rate_hz, scenario.camera.timing.latency_s) == (60, 0.2)
        assert (scenario.front.timing.rate_hz, scenario.front.timing.start_s) == (5, 1)


@pytest.mark.parametrize(
    ("kind", "values", "text"),
    [
        ("motion-blur", "exposure=1.5", "exposure is 1.5, it must be a share within 0 and 1"),
        ("motion-blur", "exposure=0.5, samples=0", "samples is 0, it must be a whole number above 0"),
        ("image-noise", "noise_grey=-3", "noise_grey is -3.0, it must be 0 or more"),
        ("lens-dirt", "share=3", "share is 3.0, it must be a share within 0 and 1"),
        ("late-images", "latency_s=nan", "latency_s is nan, it must be a finite number"),
        ("wrong-calibration", "focal_factor=0", "focal_factor is 0.0, it must be above 0"),
        ("low-texture", "margin_m=-1", "margin_m is -1.0, it must be 0 or more"),
        ("repetitive-texture", "period_px=5", "period_px is 5, it must be an even number above 0"),
        ("track-outliers", "size_px=-3", "size_px is -3.0, it must be 0 or more"),
    ],
)
def test_a_fault_that_cannot_be_is_named(kind: str, values: str, text: str) -> None:
    with pytest.raises(SettingsError) as caught:
        scenarios.load("sensors", overrides=[f'faults=[{{kind="{kind}", start_s=1, stop_s=2, {values}}}]'])
    assert f"{kind}: {text}" in str(caught.value)


def test_files_that_are_no_scenario(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="there is no scenario 'papera'; did you mean paper-a"):
        scenarios.load("papera")
    with pytest.raises(SettingsError, match="cannot be read"):
        scenarios.load(str(tmp_path / "none.toml"))
    (tmp_path / "bad.toml").write_text("camera = [")
    with pytest.raises(SettingsError, match="not valid TOML"):
        scenarios.load(str(tmp_path / "bad.toml"))
    (tmp_path / "odd.toml").write_text("camra.noise_grey = 1")
    with pytest.raises(SettingsError, match=r"odd.toml: unknown setting 'camra'; did you mean camera\?"):
        scenarios.load(str(tmp_path / "odd.toml"))


# ------------------------------------------------------------------- every key reaches its part


def test_the_keys_of_a_camera_are_those_of_the_camera_on_board() -> None:
    keys = {"exposure_s": 0.004, "readout_s": 0.01, "noise_grey": 1.5, "vignetting": 0.3}
    place = {"ahead_m": 0.1, "left_m": -0.02, "height_m": 0.25}
    turn = {"yaw_rad": 0.1, "pitch_rad": -0.2, "roll_rad": 0.05}
    words = [f"camera.{key}={value}" for key, value in (keys | place | turn).items()]
    camera = small("line", "frames=3", "camera.hold=levelled", "camera.distortion=[-0.1]", *words).on_board[0]
    assert {key: getattr(camera, key) for key in keys} == keys
    np.testing.assert_array_equal(camera.mount.position_m, list(place.values()))
    np.testing.assert_allclose(camera.mount.body_r_camera, looking(NADIR, **turn), atol=1e-15)
    assert camera.mount.hold is Hold.LEVELLED
    np.testing.assert_array_equal(camera.camera.distortion, [-0.1, 0, 0, 0, 0])


def test_the_keys_of_the_ground_are_those_of_its_family() -> None:
    keys = {"contrast": 3.0, "repetition": 0.5, "spectrum": 1.5, "metres_per_px": 0.001}
    words = [f"ground.{key}={value}" for key, value in keys.items()]
    expected = ground("sand", seed=7, size_px=512, scatter=False, **keys)
    scenario = ("frames=2", "ground.family=sand", "ground.arrange=mirror", *words)
    found = made("line", "ground.size_px=512", *scenario, seed=7).on_board[0].scene.ground
    assert found is not None
    np.testing.assert_array_equal(found.coefficients, expected.coefficients)
    assert (found.scatter, found.metres_per_px) == (expected.scatter, 0.001)
    for key in keys:
        without = [word for word in words if key not in word]
        other = made("line", "ground.size_px=512", *scenario[:3], *without, seed=7).on_board[0].scene.ground
        assert other is not None
        assert other.metres_per_px != 0.001 or not np.array_equal(other.coefficients, expected.coefficients), key


def test_the_keys_of_a_picture_are_those_of_its_surface() -> None:
    picture = np.random.default_rng(0).uniform(60, 200, (96, 128))
    keys = ("ground.picture=a.png", "ground.psf_sigma_px=0.9", "ground.arrange=mirror", "ground.metres_per_px=0.002")
    scenario = scenarios.load("line", overrides=("frames=2", *keys), seed=3).scenario
    found = making.build(scenario, picture=picture).on_board[0].scene.ground
    expected = surface_from_image(picture, metres_per_px=0.002, psf_sigma_px=0.9, arrange="mirror", seed=3)
    assert found is not None
    np.testing.assert_array_equal(found.coefficients, expected.coefficients)
    assert (found.scatter, found.metres_per_px) == (expected.scatter, expected.metres_per_px)


def test_the_body_sways_as_it_is_told() -> None:
    rms = ("body.height_rms_m=0.01", "body.roll_rms_rad=0.02", "body.pitch_rms_rad=0.03")
    means = ("body.roll_rad=0.1", "body.pitch_rad=-0.2")
    state = small("line", "duration_s=200", *rms, *means).motion.at(np.linspace(0, 200, 4000))
    heading, pitch, roll = Rotation.from_matrix(state.world_r_body).as_euler("ZYX").T
    assert (state.position_m[:, 2].mean(), roll.mean(), pitch.mean()) == pytest.approx((0, 0.1, -0.2), abs=3e-3)
    assert (state.position_m[:, 2].std(), roll.std(), pitch.std()) == pytest.approx((0.01, 0.02, 0.03), rel=0.15)
    np.testing.assert_allclose(heading, 0, atol=1e-9)
    assert np.abs(np.corrcoef([state.position_m[:, 2], roll, pitch]) - np.eye(3)).max() < 0.2
    quick = small("line", "duration_s=200", *rms, "body.roll_tau_s=0.05").motion.at(np.linspace(0, 200, 4000))
    assert quick.angular_velocity_radps[:, 0].std() > 3 * state.angular_velocity_radps[:, 0].std()


def test_the_vehicle_stops_as_it_is_told() -> None:
    stops = ("trajectory.stops=[[2, 1]]", "trajectory.stop_ramp_s=0.25", "trajectory.profile=constant")
    motion = small("line", *stops).motion
    speed = np.linalg.norm(motion.at(np.array([1.7, 1.9, 2.0, 2.9, 3.1, 3.3])).velocity_mps, axis=1)
    assert speed == pytest.approx(np.array([1, 0.4, 0, 0, 0.4, 1]) * 0.4 / 3.6)


def test_what_stands_around_is_what_is_seen() -> None:
    base = ("frames=1", "camera=none", "height=none", "reference=none", "ground.size_px=256", "front.noise_grey=0")
    board = "surroundings.chessboard={position_m=[4,0,0.8], facing_rad=2.8}"
    places = "surroundings.landmarks_m=[[3.0, 0.8, 0.6], [3.0, -0.8, 0.6]]"
    bare = made("line", *base, "surroundings.background_grey=90").frame(0)
    assert bare[:150].tolist() == [[90] * 640] * 150
    plain = made("line", *base, places, "surroundings.poster_m=0").frame(0)
    posters = made("line", *base, places, "surroundings.poster_m=0.4").frame(0).astype(float)
    changed = np.abs(posters - plain) > 0
    assert np.flatnonzero(changed.any(axis=0)).min() == pytest.approx(319.5 - 500 * (0.8 + 0.2) / 3, abs=3)
    left, right = (posters[200:280, c - 33 : c + 34] for c in (186, 453))
    assert np.abs(left - right).mean() > 5  # no poster looks like another
    corners = landmarks_of(scenarios.load("line", overrides=(*base, board)).scenario.surroundings)
    across = corners[7] - corners[0]
    assert across / np.linalg.norm(across) == pytest.approx([-np.sin(2.8), np.cos(2.8), 0], abs=1e-12)


def test_every_sensor_is_told_the_start_and_the_seed() -> None:
    moved = small("sensors", *BRIEF, "start_ns=1234567890123456789", seed=5)
    usual, other = small("sensors", *BRIEF, seed=5), small("sensors", *BRIEF, seed=6)
    by_stream = [_first_samples(mission) for mission in (moved, usual, other)]
    for stream, sample in by_stream[1].items():
        shift = moved.start_ns - usual.start_ns
        assert by_stream[0][stream].t_ns - sample.t_ns == shift, stream
        assert by_stream[0][stream].received_ns - sample.received_ns == shift, stream
    for stream, value in (("/gnss/fix", "altitude_m"), ("/camera/height", "range_m")):
        ours, same, theirs = (getattr(found[stream], value) for found in (by_stream[1], by_stream[0], by_stream[2]))
        assert ours == same != theirs
    assert np.any(by_stream[1]["/reference/pose"].position_m != by_stream[2]["/reference/pose"].position_m)
    assert {"/camera/camera_info", "/front/camera_info"} <= set(by_stream[1])


def _first_samples(mission: SimulatedMission) -> dict[str, Any]:
    first: dict[str, Any] = {}
    for sample in mission.read():
        first.setdefault(sample.stream, sample)
    return first


def test_a_rolling_shutter_is_seen_while_the_vehicle_turns() -> None:
    keys = ("frames=30", "trajectory.profile=constant", "trajectory.speed_kmh=4", "camera.noise_grey=0")
    still, rolling = small("circle", *keys), small("circle", *keys, "camera.readout_s=0.02")
    middle, top = (np.abs(rolling.frame(9)[r].astype(int) - still.frame(9)[r]).mean() for r in (36, 0))
    assert top > 3 * middle + 1


def test_faults_of_images_act_on_the_front_camera_too() -> None:
    keys = ("duration_s=1", "camera=none", "height=none", "ground.size_px=256", "front.noise_grey=0")
    fault = 'faults=[{kind="dropped-frames", start_s=0.2, stop_s=0.6}]'
    images = [s.t_ns for s in made("line", *keys, fault).read(["/front/image_raw"])]
    assert [round((t - making.START_NS) * 1e-9, 3) for t in images] == [0, 0.6, 0.8, 1.0]
    wrong = 'faults=[{kind="wrong-calibration", start_s=0.2, stop_s=0.6, focal_factor=1.1}]'
    infos = made("line", *keys, wrong).read(["/front/camera_info"])
    assert [s.camera.matrix[0, 0] for s in infos if isinstance(s, CameraInfo)] == pytest.approx(
        [500, 550, 550, 500, 500, 500]
    )


# ------------------------------------------------------------------------- ground and relief


def test_a_picture_becomes_the_ground(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.integers(0, 256, (160, 200, 3)).astype(np.uint8), (0, 0), 1.5)
    cv2.imwrite(str(tmp_path / "floor.png"), picture)
    (tmp_path / "mine.toml").write_text('ground.picture = "floor.png"\ncamera = {}\n')
    by_file = scenarios.mission(scenarios.load(str(tmp_path / "mine.toml"), overrides=SMALL))
    picture_grey = picture.astype(float) @ [0.114, 0.587, 0.299]
    assert by_file.frame(0).mean() == pytest.approx(picture_grey.mean(), abs=6)
    assert by_file.frame(0).std() == pytest.approx(picture_grey.std(), rel=0.3)
    by_option = scenarios.mission(scenarios.load("line", picture=tmp_path / "floor.png"))
    other = cv2.flip(picture, 0)
    cv2.imwrite(str(tmp_path / "floor.png"), other)
    again = scenarios.mission(scenarios.load("line", picture=tmp_path / "floor.png"))
    assert by_option.identity != again.identity  # the same name, another picture
    assert str(tmp_path) not in by_option.identity
    (tmp_path / "floor.png").write_bytes(b"no picture")
    with pytest.raises(RecordingError, match="it is no picture"):
        scenarios.mission(scenarios.load("line", picture=tmp_path / "floor.png"))


def test_the_height_over_a_relief_is_that_of_the_rendered_ground() -> None:
    mission = made("relief", "frames=40", "ground.size_px=256")
    ranges = [s.range_m for s in mission.read(["/camera/height"]) if isinstance(s, RangeSample)]
    assert 0.0005 < np.std(ranges) < 0.01
    camera = mission.on_board[0]
    seen = camera.scene.relief
    assert seen is not None
    expected = camera.heights_m - making.height_of(seen, *camera.poses[:, :2].T)
    np.testing.assert_allclose(ranges, expected, atol=1e-7)
    relief = Relief(0.01, 0.05, seed=3)
    at = np.array([0.1, -0.3, 0.7]), np.array([0.2, 0.5, -0.4])
    step = relief.metres_per_sample
    for number, (x, y) in enumerate(zip(*at, strict=True)):
        row, column = -y / step, x / step
        i, j = int(np.floor(row)), int(np.floor(column))
        weights = [_cubic(place - int(np.floor(place))) for place in (row, column)]
        n = relief.samples
        rows, columns = (np.arange(i - 1, i + 3) % n) + 1, (np.arange(j - 1, j + 3) % n) + 1
        expected = weights[0] @ relief.coefficients[np.ix_(rows, columns)] @ weights[1]
        assert making.height_of(relief, *at)[number] == pytest.approx(expected, abs=1e-9)


def _cubic(f: float) -> np.ndarray:
    """The four weights of the cubic B-spline at a share f between two knots."""
    e = 1 - f
    return np.array([e**3, 4 - (6 - 3 * f) * f * f, 4 - (6 - 3 * e) * e * e, f**3]) / 6


# -------------------------------------------------------------------- faults of the motion


def test_jumps_move_the_vehicle_while_they_last() -> None:
    clean = small("line", "trajectory.curve=figure-eight")
    for name, column, size in (("fault-turn-jump", 2, 0.2), ("fault-shift-jump", None, 0.03)):
        pushed = small(name)
        difference = pushed.truth_poses - clean.truth_poses
        off = np.abs(difference[:, column]) if column else np.linalg.norm(difference[:, :2], axis=1)
        np.testing.assert_allclose(off[:180], 0, atol=1e-12)
        np.testing.assert_allclose(off[185:236], size, atol=1e-9)
        np.testing.assert_allclose(off[241:], 0, atol=1e-9)
    lifted = small("fault-height-change").on_board[0].heights_m - clean.on_board[0].heights_m
    np.testing.assert_allclose(lifted[200:220], 0.02, atol=1e-12)
    np.testing.assert_allclose(np.delete(lifted, slice(180, 241)), 0, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "stream", "value"),
    [
        ("fault-odometer-scale", "/wheel/odometry", lambda s: s.linear_velocity_mps[0]),
        ("fault-gyro-bias", "/imu", lambda s: s.angular_velocity_radps[2]),
        ("fault-track-slip", "/front/tracks", lambda s: s.points_px.sum()),
        ("fault-track-outliers", "/front/tracks", lambda s: s.points_px.sum()),
    ],
)
def test_faults_of_sensors_hold_in_their_interval_only(name: str, stream: str, value: object) -> None:
    faulty, clean = made(name, "ground.size_px=256"), made(name, "ground.size_px=256", "faults=[]")
    a, b = (np.array([value(s) for s in m.read([stream])]) for m in (faulty, clean))  # type: ignore[operator]
    t_s = np.array([(s.t_ns - faulty.start_ns) * 1e-9 for s in clean.read([stream])])
    differs, held = a != b, (t_s >= 3 - 1e-9) & (t_s < 4 - 1e-9)
    assert not np.any(differs & ~held)
    assert np.mean(differs[held]) > 0.5


# ----------------------------------------------------------------------- on disk, and replayed


def test_the_fault_list_reads_back_from_every_container(tmp_path: Path) -> None:
    mission = small("fault-repetitive-texture", "duration_s=4.5", "camera.timing.rate_hz=10")
    expected = from_text(to_text(mission.faults, mission.start_ns, {}))
    assert expected
    for container, name in (("mcap", "m.mcap"), ("mcap-json", "j.mcap"), ("ros1", "m.bag"), ("ros2", "folder")):
        write(mission, tmp_path / name, container=container)
        with open_any(tmp_path / name, ReadOptions()) as recording:
            (told,) = (s.text for s in recording.read([FAULTS_STREAM]) if isinstance(s, TextSample))
        assert from_text(told) == expected
        assert json.loads(told)["scenario"] == mission.description


def test_replaying_directly_is_replaying_the_file(tmp_path: Path) -> None:
    options = ("frames=12", "camera.width_px=256", "camera.height_px=200", "ground.size_px=256")
    mission = made("fault-exposure-jump", *options, "faults.0.start_s=0.05", "faults.0.stop_s=0.15")
    write(mission, tmp_path / "stored.mcap", image_format="stored")
    write(mission, tmp_path / "png.mcap", image_format="png")
    runs = {
        "direct": run(Request(path=Path("sim:x"), out=tmp_path / "direct"), recording=mission),
        "stored": run(Request(path=tmp_path / "stored.mcap", out=tmp_path / "a")),
        "png": run(Request(path=tmp_path / "png.mcap", out=tmp_path / "b")),
    }
    steps = {name: read_steps(o.run_file, o.summary["run"], CorrelationStep) for name, o in runs.items()}
    assert len(steps["direct"]) == 12
    for name in ("stored", "png"):
        for ours, theirs in zip(steps["direct"], steps[name], strict=True):
            for field in CorrelationStep.__dataclass_fields__:
                np.testing.assert_array_equal(getattr(ours, field), getattr(theirs, field), err_msg=field)


def test_a_scenario_stands_where_a_recording_does(tmp_path: Path) -> None:
    with open_any(Path("sim:line"), ReadOptions()) as recording:
        assert recording.format == "simulated mission"
        assert recording.of_kind(StreamKind.IMAGE)[0].name == IMAGE
    digests = []
    for number, curve in enumerate(("line", "line", "circle")):
        file = tmp_path / f"{number}.toml"
        file.write_text(f'name = "mine"\nground.size_px = 256\ntrajectory.curve = "{curve}"\n[camera]\n')
        with open_any(file, ReadOptions()) as recording:
            digests.append(inputs.digest_of(recording, file))
    assert digests[0] == digests[1] != digests[2]


# ---------------------------------------------------------------------------------- the demo


def test_the_built_in_recording_is_the_scenario_demo() -> None:
    mission = made("demo")
    assert DEMO.stat().st_size < 4.2e6
    with open_any(DEMO, ReadOptions()) as recording:
        counts = {s.name: s.count for s in recording.streams}
        samples = list(recording.read())
    (told,) = (s.text for s in samples if isinstance(s, TextSample))
    poses = [s.position_m[:2] for s in samples if isinstance(s, PoseSample)]
    images = [s for s in samples if isinstance(s, ImageSample)]
    assert set(counts.values()) == {1, 300}
    np.testing.assert_allclose(poses, mission.truth_poses[:, :2], atol=1e-12)
    for k in (30, 70, 200):
        assert np.abs(images[k].grey().astype(int) - mission.frame(k)).mean() < 5  # the next frame is 15 to 27 away
    assert from_text(told) == from_text(to_text(mission.faults, mission.start_ns, {}))
    said = (DEMO.with_name("make_demo.py")).read_text()
    for record, frames in zip(from_text(told), ("frames 60 to 84", "frames 198 to 205"), strict=True):
        held = [k for k, t_ns in enumerate(mission.truth_t_ns) if record.start_ns <= t_ns < record.stop_ns]
        assert f"frames {held[0]} to {held[-1]}" == frames
        assert frames in said
