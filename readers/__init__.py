"""Readers: a mission's log in, timestamped samples out.

`open_recording` is the one door. It guesses the format from the content of the file or
folder, not only from its name, and imports the reader of that format when it is needed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING

from readers.streams import ReadOptions, Recording, RecordingError, WorkbenchError

if TYPE_CHECKING:
    from tempfile import TemporaryDirectory

    from readers.bag_folder import BagMetadata
    from readers.index_cache import Entry
    from readers.message_log import MessageLog
    from readers.salvage import Loss

__all__ = ["ReadOptions", "Recording", "RecordingError", "open_recording"]

PLUGIN_GROUP = "estimator_workbench.readers"
MCAP, ROS1, SQLITE, ZSTD = b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n", b"SQLite format 3\0", b"\x28\xb5\x2f\xfd"
MATLAB = b"MATLAB "
STORAGE_SUFFIXES = (".db3", ".mcap", ".db3.zstd", ".mcap.zstd")
REFUSED = {
    b"#ROSRECORD": ("it is a ROS bag of a format older than 2.0", "rewrite it with ROS 1's `rosbag fix`"),
    b"#ROSBAG V": ("it is a ROS 1 bag of a format other than 2.0", "rewrite it with ROS 1's `rosbag fix`"),
    b"RRF": ("it is a Rerun recording, not a log", "look at it with `workbench view`"),
    b"PK\x03\x04": ("it is a zip archive", "unpack it and give what is inside"),
    b"\x1f\x8b": ("it is packed with gzip", "unpack it and give what is inside"),
    b"BZh": ("it is packed with bzip2", "unpack it and give what is inside"),
    b"\xfd7zXZ": ("it is packed with xz", "unpack it and give what is inside"),
}


def open_recording(path: Path | str, options: ReadOptions = ReadOptions()) -> Recording:  # noqa: B008 (frozen)
    """Open a mission's log: a ROS 1 or ROS 2 bag, an MCAP file, an image folder or a video.

    The source is never written to. Readers of third parties, entry points of the group
    ``estimator_workbench.readers`` called with (path, options), are asked before a path is taken for images;
    they return None for what is not theirs.

    Raises:
        RecordingError: the path is none of these, or nothing of it can be read.
        StreamError: the options name a stream that is not there.
    """
    from readers.adjusted import adjusted

    path = Path(path)
    try:
        recording = _open(path, options)
        try:
            return adjusted(recording, options)
        except WorkbenchError:
            recording.close()
            raise
    except FileNotFoundError as error:
        raise RecordingError(path, "there is no such file or folder", "check the path") from error
    except PermissionError as error:
        raise RecordingError(path, "it must not be read", "check the permissions") from error
    except OSError as error:
        raise RecordingError(path, f"it cannot be read ({error.strerror or error})", "check the disk") from error


def _open(path: Path, options: ReadOptions) -> Recording:
    if path.is_dir():
        return _open_folder(path, options)
    if path.name == "metadata.yaml" and _is_bag_folder(path.parent):
        return _open_bag_folder(path.parent, options)
    return _open_file(path, options)


# ------------------------------------------------------------------------------------ files


def _open_file(path: Path, options: ReadOptions) -> Recording:
    from readers.log_recording import LogRecording

    with _scratch() as scratch:
        log = _open_log(path, scratch, _kept(path, options))
        if log is not None:
            return LogRecording(path, [log], options, scratch=scratch.pop() if scratch else None)
    if (recording := _ask_plugins(path, options)) is not None:
        return recording
    if _start_of(path).startswith(MATLAB):
        from readers.landmark_tables import course_table

        return course_table(path).recording()
    from readers.video import open_video

    try:
        return open_video(path, options)
    except RecordingError as error:
        start = _start_of(path)[:8].hex(" ")
        tried = "tried MCAP, ROS 1 bag, ROS 2 database, plug-ins and video"
        problem = f"no reader knows this file (it begins with {start}; {tried}: {error.problem})"
        raise RecordingError(path, problem, "give a .bag, .db3 or .mcap file, a folder of images or a video") from error


@contextmanager
def _scratch() -> Iterator[list[TemporaryDirectory[str]]]:
    """A list for a temporary folder, which is removed at the end unless a recording has taken it out."""
    folders: list[TemporaryDirectory[str]] = []
    try:
        yield folders
    finally:
        for folder in folders:
            folder.cleanup()


def _start_of(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(16)


def _kept(path: Path, options: ReadOptions) -> Entry | None:
    """Where the index of a log is kept; None if it is not to be."""
    from readers.index_cache import Entry, user_folder

    folder = user_folder() if options.cache else None
    return Entry(path, folder) if folder is not None else None


def _open_log(path: Path, scratch: list[TemporaryDirectory[str]], cached: Entry | None = None) -> MessageLog | None:
    """The container reader that the first bytes of the file ask for; None if they ask for none.

    A file that is packed with zstd is unpacked into a temporary folder, which is added to `scratch`.
    """
    start = _start_of(path)
    if not start:
        raise RecordingError(path, "the file is empty (0 bytes)", "record or copy it again")
    if start.startswith(MCAP):
        from readers.mcap_log import McapLog

        return McapLog(path, cached)
    if start.startswith(ROS1):
        from readers.ros1_bag import Ros1Log

        return Ros1Log(path, cached)
    if start.startswith(SQLITE):
        from readers.ros2_db3 import SqliteLog

        return SqliteLog(path, cached)
    if start.startswith(ZSTD):
        from readers.bag_folder import unpack
        from readers.salvage import Cause, Loss

        unpacked, fault = unpack(path, scratch)
        try:
            log = _open_log(unpacked, scratch)
        except RecordingError as error:
            raise RecordingError(path, f"inside of the zstd file: {error.problem}", error.cure) from error
        if log is not None and fault:
            log.lose(Loss(what=Cause.CODEC, text=f"the file is packed and {fault}; what could be unpacked is read"))
        return log
    for magic, (problem, cure) in REFUSED.items():
        if start.startswith(magic):
            raise RecordingError(path, problem, cure)
    if path.suffix in (".bag", ".mcap", ".db3"):
        problem = f"it is named {path.suffix} but does not begin like one (it begins with {start[:8].hex(' ')})"
        raise RecordingError(path, problem, "check that the file is complete")
    return None


# ---------------------------------------------------------------------------------- folders


def _open_folder(path: Path, options: ReadOptions) -> Recording:
    if _is_bag_folder(path):
        return _open_bag_folder(path, options)
    bags = sorted(file for file in path.iterdir() if file.suffix == ".bag")
    if bags:
        return _open_parts(path, bags, options, "ROS 1 bag 2.0")
    if (recording := _ask_plugins(path, options)) is not None:
        return recording
    from readers.image_folder import open_folder

    return open_folder(path, options)


def _storage_files(path: Path) -> list[Path]:
    return [file for file in path.iterdir() if file.name.endswith(STORAGE_SUFFIXES) and file.is_file()]


def _is_bag_folder(path: Path) -> bool:
    if _storage_files(path):
        return True
    metadata = path / "metadata.yaml"
    return metadata.is_file() and b"rosbag2_bagfile_information" in metadata.read_bytes()


def _open_bag_folder(path: Path, options: ReadOptions) -> Recording:
    from readers.bag_folder import read_metadata

    files = _storage_files(path)
    metadata = read_metadata(path)
    notes, losses = list(metadata.remarks), []
    if metadata.files is None:
        return _open_parts(path, files, options, "ROS 2 bag", notes)
    found = [path / name for name in metadata.files if (path / name) in files]
    missing = [name for name in metadata.files if (path / name) not in files]
    if not found:
        raise RecordingError(path, f"the files of the bag are missing ({', '.join(missing)})", "copy the whole folder")
    losses = [_gone(f"the bag's file {name} is missing; the others are read") for name in missing]
    extra = sorted(file.name for file in files if file not in found)
    notes += [f"{name} is not listed in metadata.yaml and was not read." for name in extra]
    return _join(path, found, options, "ROS 2 bag", notes, metadata, losses)


def _open_parts(
    path: Path, files: Sequence[Path], options: ReadOptions, form: str, notes: Sequence[str] = ()
) -> Recording:
    """Take files without a list of them for one log, if their names differ in numbers only."""
    from readers.bag_folder import missing_numbers, natural_key

    files = sorted(files, key=lambda file: natural_key(file.name))
    shapes = {"".join(part for number, part in natural_key(file.name) if number < 0) for file in files}
    if len(shapes) > 1:
        names = ", ".join(file.name for file in files)
        raise RecordingError(path, "the folder holds several logs that are not parts of one", f"open one of {names}")
    gaps = missing_numbers([file.name for file in files])
    notes = [*notes, *(f"There is no {name} between the parts of the log." for name in gaps)]
    return _join(path, files, options, form, notes)


def _gone(text: str) -> Loss:
    from readers.salvage import Cause, Loss

    return Loss(what=Cause.CUT, text=text)


def _join(
    path: Path,
    files: Sequence[Path],
    options: ReadOptions,
    form: str,
    notes: Sequence[str],
    metadata: BagMetadata | None = None,
    losses: Sequence[Loss] = (),
) -> Recording:
    """One recording of several files, compared with what metadata.yaml says of its topics."""
    from readers.log_recording import LogRecording

    logs: list[MessageLog] = []
    remarks, gone = list(notes), list(losses)
    with _scratch() as scratch:
        for file in files:
            try:
                log = _open_log(file, scratch, _kept(file, options))
                if log is None:
                    raise RecordingError(file, "it is no file of a bag", "remove it from the folder")
                logs.append(log)
            except RecordingError as error:
                if len(files) == 1:
                    raise
                gone.append(_gone(f"{file.name} is left out: {error.problem}"))
        if not logs:
            raise RecordingError(
                path, f"no file of the bag can be read ({gone[-1].text})", "copy the whole folder again"
            )
        if metadata is not None:
            remarks += _other_formats(metadata, logs)
            gone += list(_other_counts(metadata, logs, gone=bool(gone)))
        kinds = ", ".join(dict.fromkeys(log.format for log in logs))
        whole = kinds if kinds.startswith(form) else f"{form}, {kinds}"
        count = f", {len(logs)} files" if len(logs) > 1 else ""
        folder = scratch.pop() if scratch else None
        return LogRecording(path, logs, options, form=f"{whole}{count}", notes=remarks, scratch=folder, losses=gone)


def _other_formats(metadata: BagMetadata, logs: Sequence[MessageLog]) -> Iterator[str]:
    """The topics that metadata.yaml states to be serialised in another way than their files do."""
    for topic, encoding in {channel.topic: channel.encoding for log in logs for channel in log.channels}.items():
        if (stated := metadata.formats.get(topic, encoding)) != encoding:
            yield f"{topic} is {stated} by metadata.yaml and {encoding} by its file, which was believed."


def _other_counts(metadata: BagMetadata, logs: Sequence[MessageLog], *, gone: bool) -> Iterator[Loss]:
    """The topics of which metadata.yaml states other counts than the files hold; lost where files are `gone`."""
    from readers.salvage import Cause, Loss, lost_by_topic

    counts = Counter(dict.fromkeys(metadata.counts, 0))
    for log in logs:
        for channel in log.channels:
            counts[channel.topic] += channel.count
    gone = gone and not any(log.losses for log in logs)
    for topic, count in counts.items():
        if (announced := metadata.counts.get(topic, count)) != count:
            words = f"metadata.yaml states {announced} messages of {topic}, and the files hold {count}"
            lost = lost_by_topic([(topic, announced - count)]) if gone and announced > count else {}
            yield Loss(what=Cause.COUNT, text=words, topics=lost)


# ---------------------------------------------------------------------------------- plug-ins


def _ask_plugins(path: Path, options: ReadOptions) -> Recording | None:
    """The first recording that a plug-in makes of the path, None if there is none."""
    for entry in entry_points(group=PLUGIN_GROUP):
        cure = f"mend or remove the plug-in {entry.value}"
        try:
            found = entry.load()(path, options)
        except (ImportError, AttributeError, TypeError) as error:
            raise RecordingError(path, f"the reader plug-in {entry.name} fails ({error})", cure) from error
        if isinstance(found, Recording):
            return found
        if found is not None:
            raise RecordingError(path, f"the reader plug-in {entry.name} returns no Recording", cure)
    return None
