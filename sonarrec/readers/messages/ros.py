"""Decodes ROS messages, CDR and the serialisation of ROS 1, with `rosbags`.

rosbags generates Python code from a message's definition and runs it. So that no text from a file
gets into that code, messages and fields are renamed first, and constants and default values are
left out. Only kinds of numbers and lengths remain, all within bounds.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Mapping
from functools import cache, lru_cache, partial
from importlib import resources
from types import SimpleNamespace
from typing import Any

import numpy as np
import zstandard
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from sonarrec.readers.messages.fields import DefinitionError
from sonarrec.readers.raw import MAX_FRAME_BYTES, UnusableError

_MAX_DEFINITION_BYTES = 2**18
_MAX_FIELDS = 1000  # of a message and those inside it; the largest one read here has about 50
_MAX_DEPTH = 16

Types = Mapping[str, tuple[Any, Any]]
"""Definitions as rosbags has them: package/msg/Name to (constants, [(field, kind)])."""

_FIELD = re.compile(
    r"(?P<type>[a-zA-Z][\w/]*(?:<=[0-9]{1,9})?(?:\[(?:<=)?[0-9]{0,9}\])?)\s+"
    r"(?P<name>[a-zA-Z]\w*)(?P<rest>\s*=.*|\s.*)?",  # a constant, or a field and its default
    re.ASCII,
)
_TITLE = re.compile(r"MSG:\s*([\w/]+)", re.ASCII)
# `time` and `duration` are built into ROS 1, so no file defines them.
_CLOCK = [(name, (Nodetype.BASE, ("uint32", 0))) for name in ("sec", "nanosec")]
_CLOCKS: Types = {f"builtin_interfaces/msg/{name}": ([], _CLOCK) for name in ("Time", "Duration")}
# Kinds as rosbags has them. CDR has no empty message: it is written as one byte.
_OCTETS = (Nodetype.SEQUENCE, ((Nodetype.BASE, ("uint8", 0)), 0))
_EMPTY = [("structure_needs_at_least_one_member", (Nodetype.BASE, ("uint8", 0)))]
_NUMPY = {"byte": "uint8", "char": "uint8"}
_ZSTD = b"\x28\xb5\x2f\xfd"  # a zstd frame begins so; no CDR message does
_ORDERS = {0: "be", 1: "le"}
"""Byte order by the second byte of the encapsulation header of plain CDR."""


@lru_cache(maxsize=16)  # logs share a few definitions, and generating their code is slow
def ros_decoder(name: str, definition: bytes, ros1: bool) -> RosDecoder | None:
    """The decoder of a message type (package/Name). It uses the definition in the file, or else our
    own; None if there is neither. Raises DefinitionError if the file's cannot be used and there is
    none of our own."""
    try:
        if definition.strip():
            types = parse_definition(definition.decode(errors="replace"), name)
            return RosDecoder(types, name, ros1)
    except DefinitionError:
        if not _is_known(name, ros1):
            raise
    return RosDecoder({}, name, ros1) if _is_known(name, ros1) else None


def _is_known(name: str, ros1: bool) -> bool:
    return name.replace("/", "/msg/") in known_messages(ros1).fielddefs


@cache
def known_messages(ros1: bool) -> Typestore:
    """Our own definitions: the messages of a ROS distribution and of the drivers of sonars."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    text = resources.files(__package__).joinpath("sonars.msg").read_text(encoding="utf-8")
    title, _, rest = text.partition("\n")
    store.register(get_types_from_msg(rest, title.removeprefix("MSG: ")))
    return store


def parse_definition(text: str, name: str) -> Types:
    """The definitions in a text: of message `name` (package/Name) and of those listed below it.
    Comments, constants and default values are dropped; nothing in the text is evaluated. Raises
    DefinitionError if the text cannot be parsed or is too long."""
    if len(text) > _MAX_DEFINITION_BYTES:
        raise DefinitionError(f"{len(text)} bytes are more than is read")
    owner, lines = name, []
    for line in text.splitlines():
        line = line.partition("#")[0].strip()
        if title := _TITLE.fullmatch(line):
            owner = title[1]
            lines += ["=" * 80, f"MSG: {owner}"]
        elif line.strip("="):
            field = _FIELD.fullmatch(line)
            if field is None:
                raise DefinitionError(f"{line[:60]!r} in {owner} is no field")
            if (field["rest"] or "").lstrip().startswith("="):
                continue
            lines.append(f"{field['type']} {field['name']}")
    if len(lines) > 3 * _MAX_FIELDS:  # titles and unused messages included
        raise DefinitionError(f"{len(lines)} lines are more than is read")
    try:
        return get_types_from_msg("\n".join(lines) + "\n", name)
    except TypesysError:
        raise DefinitionError(f"the definition of {name} cannot be parsed") from None


class RosDecoder:
    """Decodes messages of one definition into their fields.

    Sequences of numbers become arrays, without a copy; texts become arrays of their bytes; messages
    inside become dicts, and sequences of messages become lists.
    rosbags gets the definition with names of our own for messages and fields. Texts are arrays of
    bytes, because it rejects a whole message if one text in it, such as frame_id, is not UTF-8 or
    lacks its closing zero.
    """

    def __init__(self, types: Types, name: str, ros1: bool) -> None:
        """types: the definitions in the file; messages missing there are from known_messages.
        Raises DefinitionError if a message is not defined anywhere or is too large."""
        self._types, self._ros1 = types, ros1
        self._store: Any = Typestore()
        # By name of a message: (kind in the store, nesting depth).
        self._registered: dict[str, tuple[Any, int]] = {}
        # Messages whose fields are all of one kind of number: (that kind, names of the fields).
        self._vectors: dict[str, tuple[Any, list[str]]] = {}
        self._field_count = 0
        self._register("string", [_OCTETS], lambda values: values[0])
        (_, root), _ = self._message(name.replace("/", "/msg/"), 0)
        self._root = self._store.get_msgdef(root)

    def __call__(self, message: memoryview) -> dict[str, Any]:
        """The fields of a message. A CDR message begins with an encapsulation header of 4 bytes.
        Bytes behind its end are ignored. Raises UnusableError if it is malformed."""
        if self._ros1:
            return self._fields("deserialize_ros1", message)
        if message[:4] == _ZSTD:  # a bag that was compressed message by message
            message = _inflate(message)
        if len(message) < 4 or message[0] != 0 or message[1] > 11:
            raise UnusableError("malformed message (no CDR header)")
        if message[1] not in _ORDERS:
            raise UnusableError("encoded otherwise than as plain CDR, as XCDR2 is")
        return self._fields(f"deserialize_cdr_{_ORDERS[message[1]]}", message[4:])

    def _fields(self, function: str, body: memoryview) -> dict[str, Any]:
        """Decode a message. function: the name of the method of rosbags for its encoding."""
        try:
            parsed, _ = getattr(self._root, function)(body, 0, self._root.cls, self._store)
        except (SerdeError, struct.error, ValueError):
            raise UnusableError("malformed message (its bytes do not fit its definition)") from None
        return dict(parsed)

    def _message(self, name: str, depth: int) -> tuple[Any, int]:
        """Register a message and those inside it; returns (its kind, its nesting depth)."""
        kind, height = self._registered.get(name, (None, 0))
        if depth + height > _MAX_DEPTH:
            raise DefinitionError(f"{name} nests too deeply")
        if kind is None:
            definition = self._types.get(name) or (_CLOCKS.get(name) if self._ros1 else None)
            definition = definition or known_messages(self._ros1).fielddefs.get(name)
            if definition is None:
                raise DefinitionError(f"{name} is not defined")
            names = [field for field, _ in definition[1]]
            kinds = [self._kind(kind_of_field, depth + 1) for _, kind_of_field in definition[1]]
            self._add_fields(len(kinds))
            alias, height = f"m{len(self._registered)}", max((h + 1 for _, h in kinds), default=0)
            self._register(
                alias, [k for k, _ in kinds], lambda values: dict(zip(names, values, strict=False))
            )
            kind = Nodetype.NAME, alias
            if len({k for k, _ in kinds}) == 1 and kinds[0][0][0] == Nodetype.BASE:
                self._vectors[alias] = kinds[0][0], names
            self._registered[name] = kind, height
        return kind, height

    def _kind(self, listed: Any, depth: int) -> tuple[Any, int]:
        """Translate the kind of a field for the store; returns (kind, nesting depth)."""
        node, detail = listed
        if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            single, count = detail
            kind, height = self._kind(single, depth)
            if kind == _OCTETS:  # a text: the message "string" that holds its bytes
                kind = Nodetype.NAME, "string"
            if node == Nodetype.SEQUENCE and kind[1] in self._vectors:
                return self._table(*self._vectors[kind[1]]), 0
            if node == Nodetype.ARRAY:
                if not count:
                    raise DefinitionError("an array of no element")
                if kind[0] == Nodetype.NAME:  # rosbags generates code for each element
                    self._add_fields(count)
            return (node, (kind, count)), height
        if node == Nodetype.NAME:
            return self._message(detail, depth)
        if detail[0] == "string":
            return _OCTETS, 0
        return listed, 0

    def _add_fields(self, count: int) -> None:
        self._field_count += count
        if self._field_count > _MAX_FIELDS:
            raise DefinitionError(f"more than {_MAX_FIELDS} fields")

    def _table(self, number: Any, names: list[str]) -> Any:
        """Register a sequence of vectors, to be read into one array per component. rosbags reads
        vectors one by one: the beam directions of a ping would take six times as long as all the
        rest."""
        code = np.dtype(_NUMPY.get(number[1][0], number[1][0])).str[1:]

        def read(order: str, aligned: bool, body: memoryview, pos: int, *_: Any) -> tuple[Any, int]:
            dtype = np.dtype(order + code)
            (count,) = struct.unpack_from(f"{order}I", body, pos)
            pos += 4
            if aligned and count:
                pos += -pos % dtype.itemsize
            table = np.frombuffer(body, dtype, count * len(names), pos).reshape(count, len(names))
            return {name: table[:, i] for i, name in enumerate(names)}, pos + table.nbytes

        name = f"table{len(self._store.cache)}"
        self._store.cache[name] = SimpleNamespace(
            fields=[("f0", (Nodetype.SEQUENCE, (number, 0)))],
            size_cdr=0,
            size_ros1=0,
            cls=None,
            deserialize_cdr_le=partial(read, "<", True),
            deserialize_cdr_be=partial(read, ">", True),
            deserialize_ros1=partial(read, "<", False),
        )
        return Nodetype.NAME, name

    def _register(
        self, name: str, kinds: list[Any], make: Callable[[tuple[Any, ...]], Any]
    ) -> None:
        """Put a message into the store. make: turns its fields into what is returned."""

        fields = [(f"f{k}", kind) for k, kind in enumerate(kinds)]
        self._store.fielddefs[name] = ([], fields or _EMPTY)
        self._store.types[name] = lambda *values: make(values)


def _inflate(message: memoryview) -> memoryview:
    """Inflate a message that was compressed by itself. Raises UnusableError if that fails."""
    decoder = zstandard.ZstdDecompressor(max_window_size=2 * MAX_FRAME_BYTES)
    try:
        with decoder.stream_reader(bytes(message), read_across_frames=True) as reader:
            inflated = reader.read(MAX_FRAME_BYTES + 1)
    except zstandard.ZstdError:
        raise UnusableError("malformed message (does not inflate)") from None
    if len(inflated) > MAX_FRAME_BYTES:
        raise UnusableError(f"inflates to more than {MAX_FRAME_BYTES} bytes")
    return memoryview(inflated)
