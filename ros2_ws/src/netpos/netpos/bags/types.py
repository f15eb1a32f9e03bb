"""Message types without ROS: definitions, the rosbags type store and the codec on its classes.

Definitions are the ``.msg`` files of the ROS installation (``AMENT_PREFIX_PATH``) or, for
``netpos_msgs``, those that the library brings; rosbags brings the standard Jazzy types.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from netpos.bags.errors import BagError
from netpos.messages.cdr import STRING, CdrCodec
from netpos.messages.codec import Codec
from netpos.messages.fields import Frames

SEPARATOR = "=" * 80
_OWN_PACKAGE = "netpos_msgs"
_CODES = {  # of the module struct
    "bool": "?",
    "byte": "B",
    "char": "B",
    "octet": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
    STRING: STRING,
}


def _message_folders(package: str) -> list[Path]:
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    folders = [Path(prefix) / "share" / package / "msg" for prefix in prefixes if prefix]
    if package == _OWN_PACKAGE:
        folders.append(Path(__file__).parent / "msg")
    return folders


def _message_file(type_name: str) -> Path | None:
    package, _, name = type_name.split("/")
    candidates = (folder / f"{name}.msg" for folder in _message_folders(package))
    return next((file for file in candidates if file.is_file()), None)


def check_type_name(type_name: str) -> str:
    """``type_name`` itself; BagError unless it reads package/msg/Type."""
    parts = type_name.split("/")
    if len(parts) != 3 or parts[1] != "msg" or not all(p.isidentifier() for p in parts):
        raise BagError(f"{type_name!r} is not a message type; write it as package/msg/Type")
    return type_name


def _nested_types(fields: Any) -> list[str]:
    """Type names the fields of one parsed message refer to, in order."""
    names: list[str] = []
    for _, (kind, detail) in fields:
        inner_kind, inner = (
            detail[0] if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) else (kind, detail)
        )
        if inner_kind == Nodetype.NAME:
            names.append(inner)
    return names


def _parse(text: str, type_name: str) -> Any:
    try:
        return get_types_from_msg(text, type_name)
    except Exception as error:  # an unsound definition raises nearly anything
        raise BagError(f"the definition of {type_name} cannot be parsed: {error}") from error


def _text_of(type_name: str) -> str:
    """The text of one type's .msg."""
    file = _message_file(type_name)
    if file is not None:
        return file.read_text(encoding="utf-8")
    standard = get_typestore(Stores.ROS2_JAZZY)
    if type_name not in standard.types:
        raise BagError(
            f"no definition of {type_name} found; install its package and source the ROS "
            "environment (AMENT_PREFIX_PATH)"
        )
    return standard.generate_msgdef(type_name, ros_version=2)[0].partition(SEPARATOR)[0]


@cache
def _gather(type_name: str) -> tuple[tuple[str, str], ...]:
    """(type name, text of its .msg) of a type and all it is made of, the type itself first."""
    texts: dict[str, str] = {}
    waiting = [type_name]
    while waiting:
        name = waiting.pop(0)
        if name in texts:
            continue
        texts[name] = _text_of(name)
        parsed = _parse(texts[name], name)
        waiting.extend(_nested_types(parsed[name][1]))
    return tuple(texts.items())


@cache
def definition(type_name: str) -> str:
    """The type's definition with everything it is made of, as MCAP's ``ros2msg`` schema.

    Raises
    ------
    BagError  no definition is known
    """
    check_type_name(type_name)
    parts = _gather(type_name)
    texts = [parts[0][1].rstrip("\n") + "\n"]
    for name, text in parts[1:]:
        short = name.replace("/msg/", "/")
        texts.append(f"{SEPARATOR}\nMSG: {short}\n" + text.rstrip("\n") + "\n")
    return "".join(texts)


@cache
def typestore() -> Typestore:
    """ROS 2 Jazzy's standard types and netpos_msgs; other types join on first use. Cached."""
    store = get_typestore(Stores.ROS2_JAZZY)
    folder = next((f for f in _message_folders(_OWN_PACKAGE) if f.is_dir()), None)
    if folder is None:
        raise BagError(
            f"{_OWN_PACKAGE} not found; source env.sh, which names it in AMENT_PREFIX_PATH"
        )
    definitions: dict[str, Any] = {}
    for file in sorted(folder.glob("*.msg")):
        name = f"{_OWN_PACKAGE}/msg/{file.stem}"
        definitions.update(_parse(file.read_text(encoding="utf-8"), name))
    store.register(definitions)
    return store


def require_type(type_name: str) -> Typestore:
    """The type store, holding ``type_name``.

    Raises
    ------
    BagError  no definition is known, or it contradicts a type already in use
    """
    store = typestore()
    if type_name not in store.types:
        try:
            store.register(_parse(definition(type_name), type_name))
        except TypesysError as error:
            raise BagError(f"{type_name}: {error}") from error
    return store


@cache
def store_of_definition(type_name: str, text: str) -> Typestore:
    """A store that decodes ``type_name`` by the definition ``text``: the common store if equal."""
    types = _parse(text, type_name)
    try:
        common = typestore()
        common.register(types)
    except TypesysError:
        store = get_typestore(Stores.EMPTY)
        try:
            store.register(types)
        except TypesysError as error:
            raise BagError(f"the definition of {type_name} cannot be used: {error}") from error
        return store
    return common


def has_common_definition(type_name: str, text: str) -> bool:
    """Whether a bag's definition (``""``: it has none) is the one the common store holds."""
    return not text or store_of_definition(type_name, text) is typestore()


def type_hash(type_name: str, text: str) -> str:
    """REP-2016 hash of a definition, such as ``RIHS01_5df957...``."""
    try:
        return store_of_definition(type_name, text).hash_rihs01(type_name)
    except KeyError as error:
        raise BagError(f"the definition of {type_name} lacks {error}") from error


@cache
def codec() -> Codec:
    """Codec that builds and reads rosbags messages. Cached."""
    return Codec(lambda type_name: require_type(type_name).types[type_name])


def flat_items(type_name: str) -> Iterator[str]:
    """Fields of a type without nesting, as ``netpos.messages.cdr.Layout`` takes them.

    Raises
    ------
    BagError  no definition is known, or the type has arrays or sequences of messages
    """
    fields: Any = require_type(type_name).get_msgdef(type_name).fields
    for name, (kind, detail) in fields:
        if kind == Nodetype.NAME:
            yield from flat_items(detail)
            continue
        (inner_kind, inner), count = ((kind, detail), 1) if kind == Nodetype.BASE else detail
        if inner_kind != Nodetype.BASE or (kind == Nodetype.ARRAY and inner[0] == STRING):
            raise BagError(f"{type_name}: {name} cannot be laid out; decode the whole message")
        code = _CODES[inner[0]]
        yield {Nodetype.BASE: code, Nodetype.ARRAY: f"{count}{code}"}.get(kind, f"{code}[]")


@cache
def cdr_codec(frames: Frames | None = None) -> CdrCodec:
    """Codec between values and the bytes of messages that name their ``frames`` so. Cached."""
    return CdrCodec(flat_items, frames)
