"""What we write is opened by libraries that are not ours, and is what we had."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from pipelines.simulation import mission as sim
from pipelines.simulation import trajectories as ways
from pipelines.simulation.faults import DroppedFrames
from pipelines.simulation.mission import SimulatedMission, nadir_camera, nadir_mission
from pipelines.simulation.surfaces import tiles
from readers.streams import (
    ImageError,
    ImageSample,
    Problem,
    Recording,
    RecordingError,
    Sample,
    StreamInfo,
    StreamKind,
)
from workbench.writers import write_mcap

DEMO = Path(__file__).parents[1] / "recordings"
COMPRESSED = sim.IMAGE + "/compressed"


class Given(Recording):
    """A recording of given samples."""

    format, path = "given samples", Path("given")

    def __init__(self, *samples: Sample) -> None:
        self._samples = samples

    @property
    def streams(self) -> tuple[StreamInfo, ...]:
        return ()

    def read(self, streams=None, start_ns=None, stop_ns=None) -> Iterator[Sample]:
        return iter(self._samples)


@pytest.fixture(scope="module")
def mission() -> SimulatedMission:
    poses = ways.follow(ways.circle(), np.full(7, 0.008))
    return nadir_mission(
        tiles(64, np.random.default_rng(0)),
        poses,
        camera=nadir_camera(80, 60, 100),
        height_m=np.linspace(0.2, 0.21, 8),
        faults=[DroppedFrames(start_s=1.5 / 60, stop_s=2.5 / 60)],
    )


def raw_image(encoding: str, pixels: np.ndarray) -> ImageSample:
    return ImageSample(
        stream="/image",
        t_ns=5,
        received_ns=6,
        encoding=encoding,
        payload=pixels.tobytes(),
        width_px=pixels.shape[1],
        height_px=pixels.shape[0],
        step_bytes=pixels[0].nbytes,
    )


def decoded(path: Path) -> dict[str, list]:
    """(message as mcap_ros2 decodes it, its log and publish time), by topic."""
    found: dict[str, list] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, ros in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((ros, message.log_time, message.publish_time))
    return found


def test_mcap_reads_back_what_was_written(mission: SimulatedMission, tmp_path: Path) -> None:
    written = write_mcap(mission, tmp_path / "m.mcap", image_format="png")
    found = decoded(tmp_path / "m.mcap")
    assert written.messages == {topic: len(m) for topic, m in found.items()}
    assert written.messages == {COMPRESSED: 7, sim.INFO: 8, sim.POSE: 8, sim.HEIGHT: 8}
    assert written.left_out == {}
    sent = [k for k in range(8) if k != 2]
    for k, (image, log, publish) in zip(sent, found[COMPRESSED], strict=True):
        stamp = image.header.stamp.sec * 10**9 + image.header.stamp.nanosec
        assert stamp == log == publish == mission.truth_t_ns[k]
        assert (image.format, image.header.frame_id) == ("png", "camera")
        pixels = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(pixels, mission.frame(k))
    for k in range(8):
        pose, height = found[sim.POSE][k][0], found[sim.HEIGHT][k][0]
        x, y, heading = mission.truth_poses[k]
        assert (pose.pose.position.x, pose.pose.position.y) == (x, y)
        assert pose.pose.position.z == np.linspace(0.2, 0.21, 8)[k]
        assert 2 * np.arctan2(pose.pose.orientation.z, pose.pose.orientation.w) == pytest.approx(heading, abs=1e-15)
        assert pose.header.frame_id == "world"
        assert height.range == np.float32(np.linspace(0.2, 0.21, 8)[k])
        assert height.max_range == np.inf
    info = found[sim.INFO][0][0]
    assert np.array_equal(np.reshape(info.k, (3, 3)), mission.camera.matrix)
    assert np.array_equal(np.reshape(info.p, (3, 4)), mission.camera.projection)
    assert (info.width, info.height, info.distortion_model, list(info.d)) == (80, 60, "plumb_bob", [0.0] * 5)


def test_rosbags_reads_it_too(mission: SimulatedMission, tmp_path: Path) -> None:
    write_mcap(mission, tmp_path / "m.mcap", image_format="stored")
    store = get_typestore(Stores.ROS2_HUMBLE)
    with AnyReader([tmp_path / "m.mcap"], default_typestore=store) as reader:
        assert {c.topic: c.msgtype for c in reader.connections} == {s.name: s.type for s in mission.streams}
        images = [(t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages() if c.topic == sim.IMAGE]
    assert [t for t, _ in images] == np.delete(mission.truth_t_ns, 2).tolist()
    for k, (_, image) in zip([0, 1, 3, 4, 5, 6, 7], images, strict=True):
        assert (image.encoding, image.step, image.width, image.height) == ("mono8", 80, 80, 60)
        assert np.array_equal(image.data.reshape(60, 80), mission.frame(k))


def test_jpeg_is_near_and_obeys_its_quality(mission: SimulatedMission, tmp_path: Path) -> None:
    sizes = {}
    for quality in (50, 95):
        path = tmp_path / f"{quality}.mcap"
        write_mcap(mission, path, quality=quality)
        image = decoded(path)[COMPRESSED][0][0]
        assert image.format == "jpeg"
        sizes[quality] = len(image.data)
        pixels = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert sizes[50] < sizes[95]
    assert np.abs(pixels.astype(int) - mission.frame(0)).mean() < 2


def test_the_same_recording_gives_the_same_bytes(mission: SimulatedMission, tmp_path: Path) -> None:
    for name in "ab":
        write_mcap(mission, tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_only_the_named_streams_are_written(mission: SimulatedMission, tmp_path: Path) -> None:
    write_mcap(mission, tmp_path / "p", streams=[sim.POSE])
    assert set(decoded(tmp_path / "p")) == {sim.POSE}


def test_compressed_images_pass_through_and_problems_are_counted(tmp_path: Path) -> None:
    stored = ImageSample(stream="/a/compressed", t_ns=5, received_ns=6, encoding="jpeg", payload=b"\xff\xd8 as it is")
    problem = Problem(stream="/b", t_ns=7, received_ns=7, kind=StreamKind.IMU, reason="short")
    written = write_mcap(Given(stored, problem), tmp_path / "c", image_format="png")
    ((image, log, publish),) = decoded(tmp_path / "c")["/a/compressed"]
    assert (image.format, bytes(image.data), log, publish) == ("jpeg", b"\xff\xd8 as it is", 6, 5)
    assert written.left_out == {"/b": "1 of its messages: they could not be decoded"}


def test_colour_keeps_its_channels(tmp_path: Path) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    write_mcap(Given(raw_image("rgb8", rgb)), tmp_path / "c", image_format="png")
    image = decoded(tmp_path / "c")["/image/compressed"][0][0]
    bgr = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(bgr[..., ::-1], rgb)


def test_sixteen_bits_need_png(tmp_path: Path) -> None:
    deep = np.arange(48, dtype=np.uint16).reshape(6, 8) * 1000
    with pytest.raises(ImageError, match="choose png"):
        write_mcap(Given(raw_image("mono16", deep)), tmp_path / "d")
    assert not (tmp_path / "d").exists()
    write_mcap(Given(raw_image("mono16", deep)), tmp_path / "d", image_format="png")
    image = decoded(tmp_path / "d")["/image/compressed"][0][0]
    assert np.array_equal(cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_UNCHANGED), deep)


def test_errors_name_the_thing_and_the_cure(tmp_path: Path) -> None:
    (tmp_path / "there").write_bytes(b"precious")
    with pytest.raises(RecordingError, match="there: it exists already; choose another name"):
        write_mcap(Given(), tmp_path / "there")
    assert (tmp_path / "there").read_bytes() == b"precious"
    with pytest.raises(RecordingError, match="choose another folder"):
        write_mcap(Given(), tmp_path / "no" / "file")
    written = write_mcap(Given(Sample(stream="/x", t_ns=1, received_ns=1)), tmp_path / "x")
    assert written.left_out == {"/x": "1 of its messages: there is no message for this kind of sample"}
