"""Recordings of every container mutated at random, and what no reader may do with them.

``python tests/fuzz_readers.py [--seconds 30] [--seed 1]`` takes the subjects in turn until the time is over. A mutant
is the same for the same seed, subject and number: ``--only SUBJECT --first NUMBER --count 1`` makes it again. One that
fails is kept; one that hangs is left in its subject's folder, in the place of the sound file.
"""

import argparse
import faulthandler
import itertools
import math
import os
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from bad_bags import few_entries
from made_logs import ROS1, ROS2, write_ros1, write_ros2
from mcap_mutations import small_log

from readers import open_recording
from readers.log_recording import LogRecording
from readers.message_log import Message
from readers.streams import ImageError, ImageSample, Problem, Recording, WorkbenchError

CPU_S, WALL_S = 5.0, 60.0
"""What one mutant may take; at the second one the process is ended, however deep it hangs."""
MEMORY = 2 << 30
Content = Mapping[str, bytes]
Read = Counter[tuple[object, ...]]


# ------------------------------------------------------------------------------------- mutants


def mutated(data: bytes, rng: random.Random) -> bytes:
    """One to five changes: bits flipped, random bytes, an extreme number, zeros, a stretch doubled, moved or gone."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, 5)):
        if not changed:
            break
        _mutate(changed, rng)
    return bytes(changed)


def _mutate(data: bytearray, rng: random.Random) -> None:
    at = rng.randrange(len(data))
    size = min(rng.choice((1, 1, 2, 4, 8, 64, 1000)), len(data) - at)
    change = rng.randrange(8)
    if change == 0:
        data[at] ^= 1 << rng.randrange(8)
    elif change == 1:
        data[at : at + size] = rng.randbytes(size)
    elif change == 2:
        data[at : at + 4] = rng.choice((b"\xff\xff\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\x7f", b"\0\0\0\x80"))
    elif change == 3:
        data[at : at + size] = bytes(size)
    elif change == 4:
        data[at:at] = data[at : at + size]
    elif change == 5:
        del data[at : at + size]
    elif change == 6:
        to = rng.randrange(len(data))
        data[to : to + size] = data[at : at + size]
    elif rng.randrange(4) == 0:
        del data[at:]
    else:
        data[at : at + 1] = rng.choice((b"0", b"-", b"9" * 30, b"e9", b"nan", b",", b"\n", b"..", b"\0", b"\xff"))


# ------------------------------------------------------------------------------------- subjects


class Outcome(NamedTuple):
    """What a reader made of a recording: its messages or pictures, and whether it tells of damage."""

    found: Read
    reported: bool
    words: str


Verdict = Callable[[Outcome, Outcome], str]


@dataclass(frozen=True, slots=True)
class Subject:
    """A sound recording that is to be mutated.

    Attributes:
        name: what the command line calls it.
        make: writes it into an empty folder; what is given back is opened.
        verdict: what is wrong with the outcome of a mutant, by that of the sound one; "" if nothing is.
        read: reads a recording.
        mutable: pattern of the files that are changed.
    """

    name: str
    make: Callable[[Path], Path]
    verdict: Verdict
    read: Callable[[Recording], Outcome]
    mutable: str = "*"


def messages_of(recording: Recording) -> Outcome:
    """The messages as they are stored; they are also decoded, so that all that can fail does."""
    assert isinstance(recording, LogRecording)
    found = Counter(plain(message) for message in recording.messages())
    decode(recording)
    return Outcome(found, bool(recording.damage), "; ".join(loss.text for loss in recording.losses))


def plain(message: Message) -> tuple[object, ...]:
    return message.channel.topic, message.log_ns, bytes(message.data)


def decode(recording: Recording) -> list[tuple[object, ...]]:
    """Every sample, the pictures decoded: what each is, or that it tells of its damage."""
    found: list[tuple[object, ...]] = []
    for sample in recording.read():
        what: object = type(sample).__name__
        if isinstance(sample, ImageSample):
            try:
                what = sample.grey().tobytes()
            except ImageError:
                what = Problem.__name__
        found.append((sample.stream, what))
    return found


def pictures_of(recording: Recording) -> Outcome:
    """The samples of a folder, with what the pictures show."""
    found = Counter(decode(recording))
    bad = any(what == Problem.__name__ for _, what in found)
    return Outcome(found, bad or bool(recording.damage) or bool(recording.notes), "")


def checked(outcome: Outcome, sound: Outcome) -> str:
    """MCAP, and chunks of bz2: the times and data that were written, unless the report says there was no checksum.

    What a topic is called may stand outside of what is summed, and be wrong where that is reported.
    """
    written, found = ({message[1:] for message in each.found} for each in (sound, outcome))
    if found - written and "without a checksum" not in outcome.words:
        return "messages that were never written"
    return silent_loss(outcome, sound)


def outlines(outcome: Outcome, sound: Outcome) -> str:
    """ROS 1 without checksums of the data: what is unreported has the topics and times that were written."""
    kept, written = (Counter(message[:2] for message in each.found) for each in (outcome, sound))
    return "loss without a word" if kept != written and not outcome.reported else ""


def silent_loss(outcome: Outcome, sound: Outcome) -> str:
    return "loss without a word" if outcome.found != sound.found and not outcome.reported else ""


def counted(outcome: Outcome, sound: Outcome) -> str:
    """A database, which has no checksums: as many messages as were written."""
    fewer = outcome.found.total() < sound.found.total()
    return "loss without a word" if fewer and not outcome.reported else ""


def anything(outcome: Outcome, sound: Outcome) -> str:
    """Tables and pictures without checksums: an answer is all that can be asked for."""
    del outcome, sound
    return ""


def only_true_pictures(outcome: Outcome, sound: Outcome) -> str:
    """PNG has checksums: a picture is as it was, or it is said that something is wrong."""
    return "loss or a false picture without a word" if outcome.found != sound.found and not outcome.reported else ""


# ---------------------------------------------------------------------------------- what they are


def _mcap(codec: str, *, index: bool = True) -> Subject:
    def make(folder: Path) -> Path:
        path = folder / "a.mcap"
        small_log(path, codec, index=index)
        return path

    return Subject(f"mcap-{codec}" if index else f"mcap-{codec}-unindexed", make, checked, messages_of)


def _ros2_mcap(folder: Path) -> Path:
    return write_ros2(folder / "bag", few_entries(ROS2), "mcap")


def _ros1(codec: str) -> Subject:
    verdict = checked if codec == "bz2" else outlines
    return Subject(
        f"ros1-{codec}",
        lambda folder: write_ros1(folder / "a.bag", few_entries(ROS1), codec, 4000),
        verdict,
        messages_of,
    )


def _db3(folder: Path) -> Path:
    path = write_ros2(folder / "bag", few_entries(ROS2)) / "bag.db3"
    (folder / "bag" / "metadata.yaml").unlink()
    return path


def _packed_db3(folder: Path) -> Path:
    return write_ros2(folder / "bag", few_entries(ROS2), mode="file")


def _folder(name: str, content: Callable[[], Content], verdict: Verdict = anything, mutable: str = "*") -> Subject:
    def make(folder: Path) -> Path:
        for file, data in content().items():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_bytes(data)
        return folder

    return Subject(f"folder-{name}", make, verdict, pictures_of, mutable)


def _pictures(pattern: str, suffix: str, count: int = 3) -> dict[str, bytes]:
    rng = np.random.default_rng(3)
    made = {}
    for k in range(count):
        good, data = cv2.imencode(suffix, rng.integers(0, 255, (12, 16), np.uint8))
        assert good
        made[pattern.format(k)] = bytes(data)
    return made


EUROC_NS = 1403715273262142976
_POSE = " ".join(["1.5", "1", "2", "3", "0", "0", "0", "1"])


def _euroc() -> Content:
    rows = "".join(f"{EUROC_NS + k * 50_000_000},{k}.png\n" for k in range(3))
    turns = "".join(f"{EUROC_NS + k * 5_000_000},0.1,0.2,0.3,1,2,9.75\n" for k in range(20))
    yaml = "resolution: [16, 12]\nintrinsics: [458.6, 457.3, 8, 6]\ncamera_model: pinhole\nT_BS:\n  data: [1,0,0,0,"
    yaml += "0,1,0,0,0,0,1,0,0,0,0,1]\ndistortion_model: radtan\ndistortion_coefficients: [-0.28, 0.07, 0, 0]\n"
    return _pictures("mav0/cam0/data/{}.png", ".png") | {
        "mav0/cam0/data.csv": b"#timestamp [ns],filename\n" + rows.encode(),
        "mav0/cam0/sensor.yaml": yaml.encode(),
        "mav0/imu0/data.csv": b"#timestamp [ns],wx,wy,wz,ax,ay,az\n" + turns.encode(),
        "groundtruth.txt": f"# timestamp tx ty tz qx qy qz qw\n{_POSE}\n".encode(),
    }


def _tum() -> Content:
    rows = "".join(f"1341847980.{k}22988 rgb/{k}.jpg\n" for k in range(3))
    return _pictures("rgb/{}.jpg", ".jpg") | {
        "rgb.txt": b"# timestamp filename\n" + rows.encode(),
        "groundtruth.txt": f"# timestamp tx ty tz qx qy qz qw\n{_POSE}\n".encode(),
    }


def _kitti() -> Content:
    pose = "1 0 0 0.5 0 1 0 0 0 0 1 2\n"
    return _pictures("image_0/00000{}.png", ".png") | {
        "times.txt": b"0.0\n0.1\n0.2\n",
        "calib.txt": f"P0: {pose}P1: {pose}".encode(),
        "poses.txt": (pose * 3).encode(),
    }


def _surface() -> Content:
    rows = "".join(f"{k}.jpg,{0.1 * k:.1f},10,20,30,1,2,3\n" for k in range(3))
    return _pictures("{}.jpg", ".jpg") | {"data.csv": b"file,time,x,y,z,roll,pitch,yaw\n" + rows.encode()}


def _plain() -> Content:
    return _pictures("frame{}.png", ".png") | {
        "times.txt": b"0.0\n0.1\n0.2\n",
        "poses.txt": (_POSE[4:] + "\n").encode() * 3,
    }


def _landmarks() -> Content:
    rows = "".join(f"1248272273.{k} 63 2.0 0.25\n1248272273.{k} 25 3.0 -0.5\n" for k in range(9))
    return {
        "Barcodes.dat": b"# Subject # Barcode #\n 1 5\n 6 63\n 7 25\n",
        "Landmark_Groundtruth.dat": b"6 1.5 -2.5 0.001 0.002\n7 4 5 0.003 0.004\n",
        "Robot1_Odometry.dat": b"1248272272.841 0.074 0.229\n1248272272.903 0.1 -0.5\n",
        "Robot1_Measurement.dat": rows.encode(),
    }


SUBJECTS = (
    *(_mcap(codec) for codec in ("none", "lz4", "zstd")),
    *(_mcap(codec, index=False) for codec in ("none", "zstd")),
    *(_ros1(codec) for codec in ("none", "lz4", "bz2")),
    Subject("db3", _db3, counted, messages_of),
    Subject("db3-packed", _packed_db3, counted, messages_of),
    Subject("ros2-mcap", _ros2_mcap, counted, messages_of),
    _folder("euroc", _euroc),
    _folder("tum", _tum),
    _folder("kitti", _kitti),
    _folder("surface", _surface),
    _folder("plain", _plain),
    _folder("png", _plain, only_true_pictures, "*.png"),
    _folder("landmarks", _landmarks),
)


# ------------------------------------------------------------------------------------- the judge


class Bench:
    """One subject with a copy of it, of which one file at a time is changed."""

    def __init__(self, subject: Subject, folder: Path) -> None:
        self.subject = subject
        folder.mkdir(parents=True, exist_ok=True)
        self.opened = subject.make(folder)
        root = self.opened if self.opened.is_dir() else self.opened.parent
        self.files = {path: path.read_bytes() for path in sorted(root.rglob(subject.mutable)) if path.is_file()}
        self.sound, fault = self._read()
        if fault or self.sound is None or not self.sound.found:
            raise AssertionError(f"{subject.name}, as it was made: {fault or 'nothing is read'}")

    def mutant(self, seed: int, number: int) -> tuple[Path, bytes]:
        """The file that is changed, and what it then holds."""
        rng = random.Random(f"{seed} {self.subject.name} {number}")
        path = rng.choice(list(self.files))
        return path, mutated(self.files[path], rng)

    def fault(self, path: Path, data: bytes) -> str:
        """What a reader does wrong with a mutant, "" if nothing."""
        path.write_bytes(data)
        try:
            outcome, fault = self._read()
        finally:
            path.write_bytes(self.files[path])
        return fault or (self.subject.verdict(outcome, self.sound) if outcome else "")

    def _read(self) -> tuple[Outcome | None, str]:
        """What is read, None if it is refused; and what goes wrong."""
        began = time.process_time()
        outcome, fault = None, ""
        try:
            with open_recording(self.opened) as recording:
                outcome = self.subject.read(recording)
        except WorkbenchError:
            pass
        except Exception as error:
            fault = f"{type(error).__name__}: {error}"
        seconds = time.process_time() - began
        return outcome, fault or (f"{seconds:.1f} s of CPU" if seconds > CPU_S else "")


class Report(NamedTuple):
    """How many mutants of each subject were read, and the first fault of each kind in words."""

    counts: Counter[str]
    faults: dict[str, str]


def fuzz(subjects: Sequence[Subject], seed: int, numbers: Iterable[int], seconds: float, folder: Path) -> Report:
    """Read mutants of all subjects in turn until the time or the numbers are over; bad ones are kept in `folder`."""
    benches = [Bench(subject, folder / subject.name) for subject in subjects]
    end, report = time.monotonic() + seconds, Report(Counter(), {})
    for bench, number in ((bench, number) for number in numbers for bench in benches):
        if time.monotonic() > end:
            break
        name = bench.subject.name
        path, data = bench.mutant(seed, number)
        faulthandler.dump_traceback_later(WALL_S, exit=True, file=sys.stderr)
        what = bench.fault(path, data)
        faulthandler.cancel_dump_traceback_later()
        report.counts[name] += 1
        if what and (kind := f"{name}: {what[:60]}") not in report.faults:
            kept = folder / f"{name}-{number}-{path.name}"
            kept.write_bytes(data)
            report.faults[kind] = f"{name}, mutant {number} of seed {seed}, {kept}: {what}"
    return report


def limit_memory() -> None:
    """Let allocations fail that go `MEMORY` beyond what is taken now, where the system can do so."""
    taken = Path("/proc/self/statm")
    if taken.is_file():
        import resource

        most = int(taken.read_text().split()[0]) * resource.getpagesize() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


def main() -> int:
    names = [subject.name for subject in SUBJECTS]
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=names, action="append")
    parser.add_argument("--first", type=int, default=0, help="number of the first mutant")
    parser.add_argument("--count", type=int, help="how many mutants of each subject, not the time, end it")
    given = parser.parse_args()
    limit_memory()
    sys.stderr = os.fdopen(os.dup(2), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # the libraries of image formats write there whatever they meet
    chosen = [subject for subject in SUBJECTS if subject.name in (given.only or names)]
    numbers = itertools.count(given.first)
    numbers = itertools.islice(numbers, given.count) if given.count else numbers
    folder = Path(tempfile.mkdtemp(prefix="workbench-fuzz-"))
    print(f"seed {given.seed}, in {folder}", flush=True)
    report = fuzz(chosen, given.seed, numbers, math.inf if given.count else given.seconds, folder)
    told = ", ".join(f"{name} {count}" for name, count in report.counts.items())
    print(f"{report.counts.total()} mutants: {told}")
    if report.faults:
        print(*report.faults.values(), sep="\n")
        return 1
    shutil.rmtree(folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())
