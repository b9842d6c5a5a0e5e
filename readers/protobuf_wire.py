"""Protobuf messages, by the FileDescriptorSet that the log holds."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

from google.protobuf import (  # type: ignore[import-untyped, unused-ignore]
    descriptor_pb2,
    descriptor_pool,
    duration_pb2,
    message_factory,
    timestamp_pb2,
)
from google.protobuf.message import DecodeError  # type: ignore[import-untyped, unused-ignore]

from readers.message_log import Buffer, MessageError

_WELL_KNOWN = {module.DESCRIPTOR.name: module.DESCRIPTOR for module in (duration_pb2, timestamp_pb2)}


def definition_text(schema: bytes) -> str:
    """The definition for people to read."""
    try:
        return str(descriptor_pb2.FileDescriptorSet.FromString(schema))
    except DecodeError:
        return f"{len(schema)} bytes that are no FileDescriptorSet"


@lru_cache(maxsize=256)
def decoder(type_name: str, schema: bytes) -> Callable[[Buffer], Any]:
    """The function that turns the bytes of a type's messages into objects with attributes.

    Raises:
        MessageError: the definition, a FileDescriptorSet, cannot be parsed.
    """
    try:
        files = {file.name: file for file in descriptor_pb2.FileDescriptorSet.FromString(schema).file}
        pool = descriptor_pool.DescriptorPool()
        added: set[str] = set()

        def add(name: str) -> None:
            if name in added:
                return
            added.add(name)
            file = files.get(name)
            if file is None:
                file = descriptor_pb2.FileDescriptorProto()
                _WELL_KNOWN[name].CopyToProto(file)
            for dependency in file.dependency:
                add(dependency)
            pool.Add(file)

        for name in files:
            add(name)
        message_class = message_factory.GetMessageClass(pool.FindMessageTypeByName(type_name))
    except (DecodeError, KeyError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())[:120]
        raise MessageError(f"the definition of {type_name} in the log cannot be parsed ({reason})") from error

    def decode(data: Buffer) -> Any:
        try:
            return message_class.FromString(bytes(data))
        except (DecodeError, ValueError) as error:
            raise MessageError(f"the message does not fit {type_name} ({error})") from error

    return decode
