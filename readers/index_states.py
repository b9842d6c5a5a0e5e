"""What opening a log found, as plain values that can be kept, and back.

`put_…` checks everything before it touches the log: a place outside of the file, a number out of range or a name of the
wrong kind is a `StateError`, after which the log is as it was.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Callable, Iterable, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from readers.index_cache import State, StateError
from readers.mcap_records import McapBlock, Segment, Stated
from readers.message_log import Channel, MessageLog
from readers.salvage import Cause, Loss, Tally

if TYPE_CHECKING:
    from readers.mcap_log import McapLog
    from readers.ros1_bag import Chunk

Value = TypeVar("Value")
_TIME_END = 1 << 64
_COUNT_END = 1 << 62
_TALLY = ("recovered", "lost", "withheld", "undecodable")


def _checked(make: Callable[[], Value]) -> Value:
    try:
        return make()
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError, binascii.Error) as error:
        raise StateError(f"its content does not fit ({error})") from error


def _whole(value: Any, low: int, end: int) -> int:
    """A whole number with ``low <= value < end``."""
    if type(value) is not int or not low <= value < end:
        raise StateError(f"a number is {value!r:.40}")
    return value


def _text(value: Any) -> str:
    if type(value) is not str:
        raise StateError(f"a name is {value!r:.40}")
    return value


def _flag(value: Any) -> bool:
    if type(value) is not bool:
        raise StateError(f"a flag is {value!r:.40}")
    return value


# ------------------------------------------------------------------------------ every log


def _channels(channels: Iterable[Channel]) -> list[list[Any]]:
    return [
        [
            one.topic,
            one.type,
            one.encoding,
            one.schema_encoding,
            base64.b64encode(one.schema).decode(),
            one.count,
            one.first_ns,
            one.last_ns,
        ]
        for one in channels
    ]


def _channel(row: Sequence[Any]) -> Channel:
    *names, schema, count, first_ns, last_ns = row
    topic, type_name, encoding, schema_encoding = map(_text, names)
    return Channel(
        topic,
        type_name,
        encoding,
        schema_encoding,
        base64.b64decode(_text(schema), validate=True),
        _whole(count, 0, _COUNT_END),
        _whole(first_ns, -1, _TIME_END),
        _whole(last_ns, -1, _TIME_END),
    )


def _losses(losses: Iterable[Loss]) -> list[list[Any]]:
    return [
        [
            str(one.what),
            one.text,
            one.start,
            one.stop,
            one.first_ns,
            one.last_ns,
            [[topic, [getattr(tally, name) for name in _TALLY]] for topic, tally in one.topics.items()],
        ]
        for one in losses
    ]


def _loss(row: Sequence[Any], file_bytes: int) -> Loss:
    what, text, start, stop, first_ns, last_ns, topics = row
    tallies = {_text(topic): Tally(*(_whole(n, 0, _COUNT_END) for n in counts)) for topic, counts in topics}
    return Loss(
        what=Cause(what),
        text=_text(text),
        start=_whole(start, -1, _COUNT_END),
        stop=_whole(stop, -1, _COUNT_END),
        file_bytes=file_bytes,
        first_ns=_whole(first_ns, -1, _TIME_END),
        last_ns=_whole(last_ns, -1, _TIME_END),
        topics=MappingProxyType(tallies),
    )


def _common(log: MessageLog) -> State:
    return {"channels": _channels(log.channels), "losses": _losses(log.losses), "notes": log.notes}


def _put_common(log: MessageLog, channels: list[Channel], losses: list[Loss], notes: list[str]) -> None:
    log.channels, log.notes = channels, notes
    log.losses, log.damage = [], []
    for loss in losses:
        log.lose(loss)


# ------------------------------------------------------------------------------------ MCAP


def mcap_state(log: McapLog, blocks: Sequence[McapBlock]) -> State:
    """What a walk over an MCAP file found."""
    place = {id(channel): number for number, channel in enumerate(log.channels)}
    segments = list({id(block.segment): block.segment for block in blocks}.values())
    number_of = {id(segment): number for number, segment in enumerate(segments)}
    return _common(log) | {
        "told": sorted(log.told),
        "segments": [
            [one.start, one.profile, [[number, place[id(channel)]] for number, channel in one.channels.items()]]
            for one in segments
        ],
        "blocks": [
            [
                block.offset,
                block.size,
                block.first_ns,
                block.last_ns,
                block.torn,
                block.chunk,
                number_of[id(block.segment)],
                None if block.stated is None else list(block.stated),
                [[place[id(channel)], count] for channel, count in block.counts.items()],
            ]
            for block in blocks
        ],
    }


def put_mcap(log: McapLog, state: State) -> list[McapBlock]:
    """Give a log what `mcap_state` kept; its blocks.

    Raises:
        StateError: it does not fit.
    """
    size = len(log.view)

    def made() -> tuple[list[Channel], list[Loss], list[str], set[int], list[McapBlock]]:
        channels = [_channel(row) for row in state["channels"]]
        segments = [_segment(row, channels, size) for row in state["segments"]]
        blocks = [_block(row, channels, segments, size) for row in state["blocks"]]
        losses = [_loss(row, size) for row in state["losses"]]
        told = {_whole(at, 0, size) for at in state["told"]}
        return channels, losses, [_text(note) for note in state["notes"]], told, blocks

    channels, losses, notes, told, blocks = _checked(made)
    _put_common(log, channels, losses, notes)
    log.told = told
    return blocks


def _segment(row: Sequence[Any], channels: list[Channel], size: int) -> Segment:
    start, profile, numbers = row
    found = {_whole(n, 0, 1 << 16): channels[_whole(place, 0, len(channels))] for n, place in numbers}
    return Segment(_whole(start, 0, size), _text(profile), channels=found)


def _block(row: Sequence[Any], channels: list[Channel], segments: list[Segment], size: int) -> McapBlock:
    offset, length, first_ns, last_ns, torn, chunk, segment, stated, counts = row
    begin = _whole(offset, 0, size)
    known = None
    if stated is not None:
        compression, packed, unpacked = stated
        known = Stated(_text(compression), _whole(packed, 0, _TIME_END), _whole(unpacked, 0, _TIME_END))
    return McapBlock(
        begin,
        _whole(length, 1, size - begin + 1),
        _whole(first_ns, 0, _TIME_END),
        _whole(last_ns, 0, _TIME_END),
        {channels[_whole(place, 0, len(channels))]: _whole(n, 0, _COUNT_END) for place, n in counts},
        _flag(torn),
        segment=segments[_whole(segment, 0, len(segments))],
        chunk=_flag(chunk),
        stated=known,
    )


# ----------------------------------------------------------------------------------- ROS 1


class Ros1Found(NamedTuple):
    """What opening a ROS 1 bag found: channels by connection, chunks, and the losses that were told by place."""

    by_id: dict[int, Channel]
    chunks: list[Chunk]
    told: set[tuple[str, int]]


def ros1_state(log: MessageLog, found: Ros1Found) -> State:
    """What opening a ROS 1 bag found."""
    place = {id(channel): number for number, channel in enumerate(log.channels)}
    return _common(log) | {
        "told": sorted([sentence, start] for sentence, start in found.told),
        "connections": [[number, place[id(channel)]] for number, channel in found.by_id.items()],
        "chunks": [
            [
                chunk.record.offset,
                chunk.record.operation,
                [[key.decode("latin-1"), value.decode("latin-1")] for key, value in chunk.record.fields.items()],
                chunk.record.start,
                chunk.record.stop,
                chunk.record.torn,
                [[number, *span] for number, span in chunk.spans.items()],
            ]
            for chunk in found.chunks
        ],
    }


def put_ros1(log: MessageLog, state: State, size: int) -> Ros1Found:
    """Give a log what `ros1_state` kept.

    Raises:
        StateError: it does not fit.
    """
    from readers.ros1_bag import Chunk, Record, Span, TornError

    def chunk_of(row: Sequence[Any], numbers: dict[int, Channel]) -> Chunk:
        offset, operation, fields, start, stop, torn, spans = row
        header = {_text(key).encode("latin-1"): _text(value).encode("latin-1") for key, value in fields}
        begin = _whole(start, 0, size + 1)
        record = Record(
            _whole(offset, 0, size),
            _whole(operation, 0, 256),
            header,
            begin,
            _whole(stop, begin, size + 1),
            _flag(torn),
        )
        try:
            record.u32(b"size")
        except TornError as error:
            raise StateError("a chunk has no size") from error
        if b"compression" not in header:
            raise StateError("a chunk has no compression")
        found_spans = {}
        for number, messages, first_ns, last_ns, sum_ns in spans:
            numbers[number]
            found_spans[number] = Span(
                _whole(messages, 0, _COUNT_END),
                _whole(first_ns, -1, _TIME_END),
                _whole(last_ns, -1, _TIME_END),
                _whole(sum_ns, 0, _TIME_END),
            )
        if not found_spans:
            raise StateError("a chunk is empty")
        return Chunk(record, found_spans)

    def made() -> tuple[Any, ...]:
        channels = [_channel(row) for row in state["channels"]]
        numbers = {
            _whole(n, 0, 1 << 32): channels[_whole(place, 0, len(channels))] for n, place in state["connections"]
        }
        chunks = [chunk_of(row, numbers) for row in state["chunks"]]
        told = {(_text(sentence), _whole(start, 0, _COUNT_END)) for sentence, start in state["told"]}
        losses = [_loss(row, size) for row in state["losses"]]
        return channels, numbers, chunks, told, losses, [_text(note) for note in state["notes"]]

    channels, numbers, chunks, told, losses, notes = _checked(made)
    _put_common(log, channels, losses, notes)
    return Ros1Found(numbers, chunks, told)


# ------------------------------------------------------------------------------------- db3

Counted = list[tuple[int, int, int, int, Any, Any, Any]]


def db3_state(counted: Counted) -> State | None:
    """How many messages of which topics a database holds, as SQLite counted them; None if it cannot be kept."""
    plain = all(isinstance(value, int | float | str | None) for row in counted for value in row)
    return {"counted": [list(row) for row in counted]} if plain else None


def db3_counted(state: State) -> Counted:
    """The counts that `db3_state` kept.

    Raises:
        StateError: they do not fit.
    """

    def made() -> Counted:
        found: Counted = []
        for number, timed, empty, count, first, last, total in state["counted"]:
            if _whole(timed, 0, 2):
                _whole(first, -_COUNT_END * 2, _COUNT_END * 2)
                _whole(last, first, _COUNT_END * 2)
            _whole(number, -_COUNT_END * 2, _COUNT_END * 2)
            found.append((number, timed, _whole(empty, 0, 2), _whole(count, 1, _COUNT_END), first, last, total))
        return found

    return _checked(made)
