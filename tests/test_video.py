"""Videos as frames: times by index, half-open ranges, files that are cut or no video."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings_dir import RECORDINGS

from readers.streams import ImageSample, ReadOptions, Recording, RecordingError, StreamError, StreamKind
from readers.video import open_video

FRAMES, STEP = 40, 5


@pytest.fixture(params=["MJPG avi", "mp4v mp4"])
def video(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    codec, suffix = request.param.split()
    return write_video(tmp_path / f"clip.{suffix}", codec)


def write_video(path: Path, codec: str = "MJPG", rate_hz: float = 25.0) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), rate_hz, (64, 48))
    assert writer.isOpened()
    for index in range(FRAMES):
        writer.write(np.full((48, 64, 3), STEP * index, np.uint8))
    writer.release()
    return path


def frames(recording: Recording, start_ns: int | None = None, stop_ns: int | None = None) -> list[ImageSample]:
    found = list(recording.read(["frames"], start_ns, stop_ns))
    assert all(isinstance(s, ImageSample) for s in found)
    return [s for s in found if isinstance(s, ImageSample)]


def test_all_frames_with_times_by_index(video: Path) -> None:
    with open_video(video) as recording:
        (info,) = recording.streams
        assert (info.name, info.kind, info.count) == ("frames", StreamKind.IMAGE, FRAMES)
        assert (info.first_ns, info.last_ns) == (0, 39 * 40_000_000)
        assert info.rate_hz == pytest.approx(25)
        found = frames(recording)
        assert [s.t_ns for s in found] == [40_000_000 * k for k in range(FRAMES)]
        for index, sample in enumerate(found):
            assert (sample.encoding, sample.width_px, sample.height_px) == ("bgr8", 64, 48)
            assert sample.source == f"frame {index}"
            assert abs(int(sample.grey().mean()) - STEP * index) <= 4
            assert sample.colour().shape == (48, 64, 3)
        assert recording.damage == ()
        assert "no sensor clock" in recording.notes[0]


@pytest.mark.parametrize("first", [0, 1, 17, 39])
def test_half_open_ranges_begin_at_the_right_frame(video: Path, first: int) -> None:
    recording = open_video(video)
    found = frames(recording, 40_000_000 * first, 40_000_000 * (first + 3))
    assert [s.source for s in found] == [f"frame {k}" for k in range(first, min(first + 3, FRAMES))]
    for index, sample in enumerate(found, first):
        assert abs(int(sample.grey().mean()) - STEP * index) <= 4
    later = frames(recording, 40_000_000 * first + 1, 40_000_000 * (first + 1))
    assert later == []
    assert frames(recording, 40_000_000 * FRAMES) == []
    assert recording.damage == ()


def test_a_given_rate_overrides_the_files(video: Path) -> None:
    recording = open_video(video, ReadOptions(rate_hz=30000 / 1001))
    found = frames(recording)
    assert [s.t_ns for s in found[:3]] == [0, 33366667, 66733333]
    assert found[30].t_ns == 1_001_000_000
    assert "given" in recording.notes[0]
    with pytest.raises(RecordingError, match="--rate HZ"):
        open_video(video, ReadOptions(rate_hz=0.0))


def test_frames_stay_valid_while_the_next_are_read(video: Path) -> None:
    found = frames(open_video(video))
    assert len({bytes(s.data[:3]) for s in found}) > FRAMES // 2


@pytest.mark.parametrize("start", [None, 30 * 40_000_000])
def test_a_cut_video_is_read_as_far_as_it_goes(tmp_path: Path, start: int | None) -> None:
    path = write_video(tmp_path / "clip.avi")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    recording = open_video(path)
    assert recording.streams[0].count == FRAMES
    found = frames(recording, start)
    (damage,) = recording.damage
    count = recording.streams[0].count
    assert 0 < count < FRAMES
    assert len(found) == (count if start is None else 0)
    assert f"states {FRAMES} frames, {count} can be decoded" in damage.what
    assert damage.affected == pytest.approx(1 - count / FRAMES)


def test_streams_are_asked_for_by_name(video: Path) -> None:
    recording = open_video(video)
    assert list(recording.read([])) == []
    with pytest.raises(StreamError, match="no stream named 'left'"):
        recording.read(["left"])


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("empty.avi", b"", r"empty \(0 bytes\)"),
        ("junk.mp4", bytes(range(256)) * 100, "none of the known formats"),
        ("list.m3u8", b"#EXTM3U\n#EXTINF:1,\n/etc/passwd\n", "a text file"),
        ("one.png", cv2.imencode(".png", np.zeros((4, 4), np.uint8))[1].tobytes(), r"single image \(png\).*folder"),
        ("odometry.dat", b"1248272272.841 0.074 0.229\n", "a text file.*give the folder"),
    ],
)
def test_files_that_are_no_video(
    tmp_path: Path, name: str, content: bytes, words: str, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError, match=words) as caught:
        open_video(tmp_path / name)
    assert name in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_an_mp4_without_its_index_is_refused(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.mp4", "mp4v")
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(RecordingError, match="copied whole"):
        open_video(path)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="No such file"):
        open_video(tmp_path / "gone.avi")


def test_shared_files_that_are_no_video() -> None:
    folder = RECORDINGS / "_no_licence_stated"
    with pytest.raises(RecordingError, match="text file"):
        open_video(folder / "mrclam1_robot1" / "Robot1_Odometry.dat")
