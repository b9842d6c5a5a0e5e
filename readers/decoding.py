"""Serialised bytes → message objects with attributes, for ROS 1, CDR, JSON and protobuf.

Definitions come from the log; where it has none, from a distribution (the named or the latest of ROS 2, Noetic of
ROS 1), and where that has none, from the user's folder of ``.msg`` files. All are `rosbags`' type system, which holds
the bytes that a definition takes against the message's length. Every channel has types of its own, so that
one bad definition harms no other topic.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import zstandard
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from readers import ros1_wire
from readers.message_log import Buffer, Channel, text
from readers.message_log import MessageError as MessageError

Decoder = Callable[[Buffer], Any]
LARGEST_MESSAGE_BYTES = 2**28
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_IDL_RULE = "=" * 80 + "\n"


class Definitions(NamedTuple):
    """Where definitions are looked up that the log does not have: a distribution of ROS 2, then a folder of ``.msg``.

    `distribution` is a name such as ``humble``, the latest if empty; ROS 1 is always Noetic.
    """

    distribution: str = ""
    folder: Path | None = None


def decoder_of(channel: Channel, definitions: Definitions = Definitions()) -> Decoder:  # noqa: B008 (frozen)
    """The function that turns the bytes of the channel's messages into objects with attributes.

    Raises:
        MessageError: the encoding is not supported, or the definition cannot be parsed.
    """
    if channel.encoding in ("ros1", "cdr"):
        return _ros_decoder(channel.encoding, channel.type, channel.schema_encoding, channel.schema, definitions)
    if channel.encoding == "json":
        return _decode_json
    if channel.encoding == "protobuf":
        from readers import protobuf_wire  # takes longer to load than a small log to read

        return protobuf_wire.decoder(channel.type, channel.schema)
    raise MessageError(f"serialization format {channel.encoding!r} is not supported")


def definition_text(channel: Channel) -> str:
    """The channel's definition for people to read."""
    if channel.schema_encoding != "protobuf":
        return text(channel.schema)
    from readers import protobuf_wire

    return protobuf_wire.definition_text(channel.schema)


def ros_name(name: str) -> str:
    """The long form of a ROS type name: ``sensor_msgs/Imu`` → ``sensor_msgs/msg/Imu``."""
    package, _, rest = name.partition("/")
    return name if "/" in rest or not rest else f"{package}/msg/{rest}"


def unpacked(encoding: str, data: Buffer) -> Buffer:
    """The message itself, where it is one of a ROS 2 bag that was packed with zstd on its own.

    Raises:
        MessageError: it cannot be unpacked.
    """
    if encoding != "cdr" or data[:4] != ZSTD_MAGIC:
        return data
    try:
        found = zstandard.ZstdDecompressor().stream_reader(data).read(LARGEST_MESSAGE_BYTES + 1)
    except zstandard.ZstdError as error:
        raise MessageError(f"the message cannot be unpacked ({error})") from error
    if len(found) > LARGEST_MESSAGE_BYTES:
        raise MessageError(f"the message is larger than {LARGEST_MESSAGE_BYTES} bytes when unpacked")
    return found


def definition_of(channel: Channel, definitions: Definitions) -> tuple[str, bytes]:
    """Encoding and text of the definition of a channel's type: the log's, else one from elsewhere, else empty.

    Raises:
        MessageError: the places to look it up cannot be used.
    """
    name = ros_name(channel.type)
    if channel.schema.strip() or channel.encoding not in ("ros1", "cdr"):
        return channel.schema_encoding, channel.schema
    generation = 1 if channel.encoding == "ros1" else 2
    store = _types_elsewhere(channel.encoding, definitions)
    known = name in store.fielddefs
    return f"ros{generation}msg", store.generate_msgdef(name, ros_version=generation)[0].encode() if known else b""


@lru_cache(maxsize=256)
def _ros_decoder(
    encoding: str, type_name: str, schema_encoding: str, schema: bytes, definitions: Definitions
) -> Decoder:
    name = ros_name(type_name)
    store = _types_of_log(name, schema_encoding, schema) if schema.strip() else _types_elsewhere(encoding, definitions)
    if name not in store.fielddefs:
        raise MessageError(
            f"the log has no definition of {type_name} and the distribution has none either; give a folder of its .msg"
            " file with --msg"
        )
    if encoding == "ros1" and (fixed := ros1_wire.LAYOUTS.get((name, _md5(store, name)))) is not None:
        return partial(_decode_fixed, fixed, type_name)
    deserialize = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr

    def decode(data: Buffer) -> Any:
        try:
            return deserialize(unpacked(encoding, data), name)
        except (SerdeError, TypesysError, KeyError, AssertionError, OverflowError, MemoryError) as error:
            raise MessageError(f"the message does not fit {type_name} ({error})") from error

    return decode


def has_fixed_layout(decode: Decoder) -> bool:
    """Whether it decodes ROS 1 messages of a standard definition, whose layout is known."""
    return isinstance(decode, partial) and decode.func is _decode_fixed


def _decode_fixed(decode: Decoder, type_name: str, data: Buffer) -> Any:
    try:
        return decode(data)
    except (ros1_wire.WireError, struct.error) as error:
        raise MessageError(f"the message does not fit {type_name}") from error


def _md5(store: Any, name: str) -> str:
    """The MD5 sum of a definition, "" where a type that it names is missing."""
    try:
        return str(store.generate_msgdef(name, ros_version=1)[1])
    except (TypesysError, KeyError, RecursionError):
        return ""


def _types_of_log(name: str, schema_encoding: str, schema: bytes) -> Any:
    definition = text(schema)
    try:
        types = _idl_types(definition) if "idl" in schema_encoding else get_types_from_msg(definition, name)
        store = get_typestore(Stores.EMPTY)
        store.register(types)
        store.get_msgdef(name)
    except (TypesysError, KeyError, ValueError, TypeError, AssertionError, RecursionError, SyntaxError) as error:
        reason = " ".join(str(error).split())[:120]
        raise MessageError(f"the definition of {name} in the log cannot be parsed ({reason})") from error
    return store


def _idl_types(definition: str) -> Any:
    types: dict[str, Any] = {}
    if not definition.startswith(_IDL_RULE + "IDL: "):
        return get_types_from_idl(definition)
    for part in definition.split(_IDL_RULE)[1:]:
        types.update(get_types_from_idl(part.partition("\n")[2]))
    return types


def distributions() -> dict[str, Stores]:
    """The distributions of ROS 2 whose definitions are known, by name."""
    return {store.name.partition("_")[2].lower(): store for store in Stores if store.name.startswith("ROS2_")}


@lru_cache(maxsize=4)
def _types_of_distribution(encoding: str, name: str = "") -> Any:
    if encoding == "ros1":
        return get_typestore(Stores.ROS1_NOETIC)
    known = distributions()
    if name and name.lower() not in known:
        raise MessageError(f"no distribution of ROS 2 is named {name!r}; known are {', '.join(sorted(known))}")
    return get_typestore(known[name.lower()] if name else Stores.LATEST)


@lru_cache(maxsize=4)
def _types_elsewhere(encoding: str, definitions: Definitions) -> Any:
    """The types of the distribution, with those of the user's folder that it does not have."""
    standard = _types_of_distribution(encoding, definitions.distribution)
    if definitions.folder is None:
        return standard
    store = get_typestore(Stores.EMPTY)
    store.register(standard.fielddefs | _types_of_folder(definitions.folder, frozenset(standard.fielddefs)))
    return store


def _types_of_folder(folder: Path, known: frozenset[str]) -> dict[str, Any]:
    """The definitions in the ``.msg`` files of a folder, PACKAGE/msg/NAME.msg or PACKAGE/NAME.msg, but the `known`.

    Raises:
        MessageError: one of them cannot be read.
    """
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*.msg")):
        package = path.parent.parent.name if path.parent.name == "msg" else path.parent.name
        name = f"{package}/msg/{path.stem}"
        if name in known:
            continue
        try:
            found |= {key: value for key, value in get_types_from_msg(_read(path), name).items() if key not in known}
        except (TypesysError, KeyError, ValueError, TypeError, AssertionError, RecursionError) as error:
            raise MessageError(f"{path} cannot be parsed ({' '.join(str(error).split())[:120]})") from error
    return found


def _read(path: Path) -> str:
    try:
        return text(path.read_bytes())
    except OSError as error:
        raise MessageError(f"{path} cannot be read ({error.strerror})") from error


def _decode_json(data: Buffer) -> Any:
    try:
        return json.loads(bytes(data), object_hook=lambda fields: SimpleNamespace(**fields))
    except (ValueError, RecursionError) as error:
        raise MessageError(f"the message is no JSON ({error})") from error
