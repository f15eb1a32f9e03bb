"""A client of ``ros2 run netpos_bringup live``, or of any Foxglove WebSocket server of ROS 2
topics: bytes in, messages out. Needs no ROS."""

from __future__ import annotations

import json
import re
import struct
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

from rosbags.serde import SerdeError
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from netpos.bags.errors import BagError
from netpos.bags.types import check_type_name, store_of_definition

SUBPROTOCOLS = (Subprotocol("foxglove.sdk.v1"), Subprotocol("foxglove.websocket.v1"))
DEFAULT_URL = "ws://127.0.0.1:8765"
_MESSAGE = 1  # operation of a binary frame: subscription, log time, content
_HEAD = struct.Struct("<BIQ")
_OPEN_S = 5.0
_ERROR = 2  # level of a status
_AGAIN_S = 0.1
_SIZE_MAX = 64 * 1024 * 1024


class ViewError(RuntimeError):
    """A server that cannot be viewed; the text says which, why and what to do."""


@dataclass(frozen=True, slots=True)
class Received:
    """One message; message : as rosbags decodes it."""

    topic: str
    type_name: str
    log_time_ns: int
    message: Any


@dataclass(frozen=True, slots=True)
class _Channel:
    topic: str
    type_name: str
    definition: str


def full_url(text: str) -> str:
    """The address of a server: ``ws://host:port``; host and port alone will do.

    Raises
    ------
    ValueError  the text is not an address
    """
    if "://" not in text:
        text = f"ws://{text}"
    scheme, _, place = text.partition("://")
    if scheme not in ("ws", "wss") or not place:
        raise ValueError(f"{text!r} is not the address of a server; write ws://HOST:PORT")
    return text


class Viewer:
    """A connection to a server: it subscribes to the topics that are ``wanted``.

    Raises
    ------
    ViewError  there is no server at the address, or it is not a Foxglove WebSocket server
    """

    def __init__(self, url: str, wanted: Callable[[str, str], bool]) -> None:
        self.url = url
        self.left_out: dict[str, str] = {}
        """Topics that cannot be decoded, and why."""
        self._wanted = wanted
        self._channels: dict[int, _Channel] = {}
        self._again_s: dict[int, float] = {}
        self._connection = _connected(url)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the connection."""
        self._connection.close()

    def receive(self, timeout_s: float) -> Received | None:
        """The next message; None if none came in time, or if it was not a message of a topic.

        Raises
        ------
        ViewError  the server has ended the connection
        """
        self._ask_again()
        try:
            frame = self._connection.recv(timeout=max(timeout_s, 0.0))
        except TimeoutError:
            return None
        except ConnectionClosed as error:
            raise ViewError(
                f"{self.url} has ended the connection; is 'ros2 run netpos_bringup live' still "
                "running?"
            ) from error
        if isinstance(frame, str):
            self._obey(frame)
            return None
        return self._decoded(frame)

    @property
    def topics(self) -> dict[str, str]:
        """Type names of the topics subscribed to, by topic."""
        return {channel.topic: channel.type_name for channel in self._channels.values()}

    def _obey(self, text: str) -> None:
        said = json.loads(text)
        if said.get("op") == "unadvertise":
            for number in said["channelIds"]:
                self._channels.pop(number, None)
        elif said.get("op") == "advertise":
            new = {entry["id"]: channel for entry in said["channels"] if (channel := _read(entry))}
            chosen = {k: c for k, c in new.items() if self._wanted(c.topic, c.type_name)}
            self._channels |= chosen
            self._ask(chosen)
        elif said.get("op") == "status" and said.get("level") == _ERROR:
            numbers = {int(digits) for digits in re.findall(r"\d+", said.get("message", ""))}
            due_s = time.monotonic() + _AGAIN_S
            self._again_s |= dict.fromkeys(numbers & self._channels.keys(), due_s)

    def _ask(self, numbers: Iterable[int]) -> None:
        asked = [{"id": number, "channelId": number} for number in numbers]
        self._connection.send(json.dumps({"op": "subscribe", "subscriptions": asked}))

    def _ask_again(self) -> None:
        """Subscribe again where it was refused: a server may announce a channel too early."""
        now_s = time.monotonic()
        due = [number for number, due_s in self._again_s.items() if now_s >= due_s]
        for number in due:
            del self._again_s[number]
        if due:
            self._ask(number for number in due if number in self._channels)

    def _decoded(self, frame: bytes) -> Received | None:
        if len(frame) < _HEAD.size:
            return None
        operation, number, log_time_ns = _HEAD.unpack_from(frame)
        channel = self._channels.get(number)
        if operation != _MESSAGE or channel is None or channel.topic in self.left_out:
            return None
        try:
            store = store_of_definition(channel.type_name, channel.definition)
            message = store.deserialize_cdr(frame[_HEAD.size :], channel.type_name)
        except (BagError, SerdeError) as error:
            self.left_out[channel.topic] = str(error) or type(error).__name__
            return None
        return Received(channel.topic, channel.type_name, log_time_ns, message)


def _connected(url: str) -> ClientConnection:
    try:
        return connect(
            url,
            subprotocols=SUBPROTOCOLS,
            open_timeout=_OPEN_S,
            max_size=_SIZE_MAX,
            compression=None,
        ).__enter__()
    except (OSError, TimeoutError) as error:
        why = error.strerror or str(error) or type(error).__name__
        raise ViewError(
            f"nothing answers at {url}: {why}; start it with: ros2 run netpos_bringup live"
        ) from error
    except WebSocketException as error:
        raise ViewError(f"{url} is no Foxglove WebSocket server: {error}") from error


def _read(entry: Any) -> _Channel | None:
    """A channel of ROS 2 messages; None for any other."""
    if entry.get("encoding") != "cdr" or entry.get("schemaEncoding", "ros2msg") != "ros2msg":
        return None
    try:
        name = check_type_name(entry["schemaName"])
    except BagError:
        return None
    return _Channel(entry["topic"], name, entry["schema"])
