"""Logs of messages: MCAP with ROS 2 or JSON messages, ROS 1 bags, ROS 2 bags.

Messages go in the order in which they were received; the log time is `received_ns`, the header stamp `t_ns`.
"""

from __future__ import annotations

import abc
import contextlib
import shutil
import struct
from collections.abc import Iterator, Mapping
from typing import Any, BinaryIO, ClassVar, Literal

from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer

from readers.streams import ImageSample, Sample, StreamError
from workbench.writers.json_messages import JsonMessages, as_bytes
from workbench.writers.ros_messages import RosMessages
from workbench.writers.target import Order, Target, first_missing

LIBRARY = "estimator-workbench"
NO_MESSAGE = "there is no message for this kind of sample"
ROS2_VERSION: Any = 8  # of metadata.yaml: the newest that Humble reads too


class LogTarget(Target):
    """A log: every topic with one type of messages is registered when its first message comes."""

    def __init__(self, order: Order) -> None:
        super().__init__(order)
        self._frames = {info.name: info.frame for info in order.recording.streams}
        self._owners: dict[str, str] = {}
        self._channels: dict[tuple[str, str], Any] = {}

    def samples(self) -> Iterator[Sample]:
        """The samples in the order in which they were received."""
        return self.order.recording.arrivals(self.order.streams)

    def put(self, sample: Sample) -> None:
        """Write one sample as a message."""
        if isinstance(sample, ImageSample):
            sample = self.order.coding.encoded(sample)
        found = self._message(sample, self._frames.get(sample.stream, ""))
        if found is None:
            self.skip(sample.stream, NO_MESSAGE)
            return
        topic, type_name, data = found
        self._claim(topic, sample.stream)
        if (topic, type_name) not in self._channels:
            self._channels[topic, type_name] = self._register(topic, type_name)
        try:
            self._add(self._channels[topic, type_name], topic, sample, data)
        except (struct.error, OverflowError) as error:
            raise StreamError(
                f"{sample.stream}: the log time {sample.received_ns} ns does not fit ({error})"
            ) from error
        self.messages[topic] += 1

    def _claim(self, topic: str, stream: str) -> None:
        """Refuse two streams in one topic, unless it is one of transforms."""
        owner = self._owners.setdefault(topic, stream)
        if owner != stream and not stream.startswith(topic + ":"):
            raise StreamError(f"{owner} and {stream} would both be written as {topic}; name the streams to write")

    @abc.abstractmethod
    def _message(self, sample: Sample, frame: str) -> tuple[str, str, bytes] | None:
        """Topic, type and bytes of the message."""

    @abc.abstractmethod
    def _register(self, topic: str, type_name: str) -> Any:
        """Make a channel of the log."""

    @abc.abstractmethod
    def _add(self, channel: Any, topic: str, sample: Sample, data: bytes) -> None:
        """Write one message at the times of its sample."""


def _ros(messages: RosMessages, sample: Sample, frame: str) -> tuple[str, str, bytes] | None:
    envelope = messages.build(sample, frame)
    if envelope is None:
        return None
    return envelope.topic, envelope.message.__msgtype__, messages.serialized(sample, envelope.message)


# ------------------------------------------------------------------------------------- MCAP


class Mcap(LogTarget):
    """An MCAP file of any encoding of messages."""

    profile: ClassVar[str] = ""
    encoding: ClassVar[str]
    schema_encoding: ClassVar[str]
    metadata: ClassVar[Mapping[str, str]] = {}

    def __init__(self, order: Order) -> None:
        super().__init__(order)
        self._schemas: dict[str, int] = {}
        self._file: BinaryIO | None = None

    def open(self) -> None:
        """Make the file and write its header."""
        self._file = self.path.open("xb")
        self._writer = McapWriter(self._file)
        self._writer.start(profile=self.profile, library=LIBRARY)

    @abc.abstractmethod
    def _schema(self, type_name: str) -> bytes:
        """The definition of a type."""

    def _register(self, topic: str, type_name: str) -> int:
        if type_name not in self._schemas:
            schema = self._schema(type_name)
            self._schemas[type_name] = self._writer.register_schema(type_name, self.schema_encoding, schema)
        schema_id, metadata = self._schemas[type_name], dict(self.metadata)
        channel: int = self._writer.register_channel(topic, self.encoding, schema_id, metadata)
        return channel

    def _add(self, channel: Any, topic: str, sample: Sample, data: bytes) -> None:
        self._writer.add_message(
            channel_id=channel,
            log_time=sample.received_ns,
            publish_time=sample.t_ns,
            data=data,
            sequence=self.messages[topic],
        )

    def close(self) -> None:
        """Write the index."""
        assert self._file is not None
        self._writer.finish()
        self._file.close()

    def discard(self) -> None:
        """Remove the file."""
        if self._file is not None:
            self._file.close()
            self.path.unlink()


class RosMcap(Mcap):
    """ROS 2 messages in CDR, with their definitions."""

    profile, encoding, schema_encoding = "ros2", "cdr", "ros2msg"
    metadata: ClassVar[Mapping[str, str]] = {"offered_qos_profiles": ""}

    def __init__(self, order: Order) -> None:
        super().__init__(order)
        self._messages = RosMessages(2)

    def _message(self, sample: Sample, frame: str) -> tuple[str, str, bytes] | None:
        return _ros(self._messages, sample, frame)

    def _schema(self, type_name: str) -> bytes:
        return self._messages.definition(type_name).encode()


class JsonMcap(Mcap):
    """JSON messages with their schemas: Foxglove's types, and ROS's where Foxglove has none."""

    encoding, schema_encoding = "json", "jsonschema"

    def __init__(self, order: Order) -> None:
        super().__init__(order)
        self._messages = JsonMessages()

    def _message(self, sample: Sample, frame: str) -> tuple[str, str, bytes] | None:
        found = self._messages.build(sample, frame)
        return None if found is None else (found.topic, found.type, as_bytes(found.fields))

    def _schema(self, type_name: str) -> bytes:
        return as_bytes(self._messages.schema(type_name))


# ------------------------------------------------------------------------------------- bags


class RosBag(LogTarget):
    """A bag that `rosbags` writes."""

    generation: ClassVar[Literal[1, 2]]

    def __init__(self, order: Order) -> None:
        super().__init__(order)
        self._messages = RosMessages(self.generation)
        self._writer: Ros1Writer | Ros2Writer | None = None

    @abc.abstractmethod
    def _new_writer(self) -> Ros1Writer | Ros2Writer:
        """A writer that is not opened yet."""

    @abc.abstractmethod
    def _remove(self) -> None:
        """Remove what was made."""

    def open(self) -> None:
        """Make the file or folder."""
        self._writer = self._new_writer()
        self._writer.open()

    def _message(self, sample: Sample, frame: str) -> tuple[str, str, bytes] | None:
        return _ros(self._messages, sample, frame)

    def _register(self, topic: str, type_name: str) -> Any:
        assert self._writer is not None
        return self._writer.add_connection(topic, type_name, typestore=self._messages.store)

    def _add(self, channel: Any, topic: str, sample: Sample, data: bytes) -> None:
        assert self._writer is not None
        self._writer.write(channel, sample.received_ns, data)

    def close(self) -> None:
        """Write the index, or commit the database and write metadata.yaml."""
        assert self._writer is not None
        self._writer.close()

    def discard(self) -> None:
        """Remove the file or folder."""
        if self._writer is not None:
            self._writer.abort()
            with contextlib.suppress(OSError):
                self._remove()


class Ros1Bag(RosBag):
    """A ROS 1 bag 2.0, its chunks uncompressed."""

    generation = 1

    def _new_writer(self) -> Ros1Writer:
        return Ros1Writer(self.path)

    def _remove(self) -> None:
        self.path.unlink()


class Ros2Bag(RosBag):
    """A folder with a ROS 2 bag: sqlite3 storage, which has the folder's name, and metadata.yaml."""

    generation = 2

    def __init__(self, order: Order) -> None:
        super().__init__(order)
        self._root = first_missing(self.path)

    def _new_writer(self) -> Ros2Writer:
        return Ros2Writer(self.path, version=ROS2_VERSION, storage_plugin=StoragePlugin.SQLITE3)

    def _remove(self) -> None:
        shutil.rmtree(self._root)
