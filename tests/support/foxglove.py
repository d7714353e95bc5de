"""Messages of an overlay, each checked by its schema and as Foxglove publishes it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import jsonschema
from mcap.reader import make_reader


def messages(path: Path) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """(schema, log time, message), each valid by the schema in the file and as published."""
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            found = json.loads(message.data)
            validator(schema.data).validate(found)
            parse_as_published(schema.name, found)
            yield schema.name, message.log_time, found


@cache
def validator(schema: bytes) -> Any:
    """Of the messages of a schema, which is checked itself."""
    told = json.loads(schema)
    kind = jsonschema.validators.validator_for(told)
    kind.check_schema(told)
    return kind(told)


@cache
def published(name: str) -> Any:
    """A message of Foxglove by its own definition."""
    import foxglove.messages
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    kind = getattr(foxglove.messages, name.removeprefix("foxglove."))
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(kind.get_schema().data).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


def parse_as_published(name: str, message: dict[str, Any]) -> None:
    """Read by Foxglove's own definition, which refuses unknown fields and other types."""
    from google.protobuf import json_format

    def protobuf_times(value: Any) -> Any:
        if isinstance(value, dict) and set(value) == {"sec", "nsec"}:
            day = datetime.fromtimestamp(value["sec"], UTC).strftime("%Y-%m-%dT%H:%M:%S")
            return f"{day}.{value['nsec']:09d}Z"
        if isinstance(value, dict):
            return {key: protobuf_times(item) for key, item in value.items()}
        return [protobuf_times(item) for item in value] if isinstance(value, list) else value

    json_format.ParseDict(protobuf_times(message), published(name)())


def nanoseconds(time: dict[str, int]) -> int:
    return time["sec"] * 10**9 + time["nsec"]
