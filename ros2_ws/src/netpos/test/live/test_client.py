"""The client against a server made with the websockets package, which follows the protocol."""

from __future__ import annotations

import json
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import pytest
from netpos.bags import codec, typestore
from netpos.bags.types import definition
from netpos.live.client import Received, Viewer, ViewError, full_url
from netpos.messages.values import Odometry
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve
from websockets.typing import Subprotocol

ODOMETRY = "nav_msgs/msg/Odometry"


def odometry_cdr() -> bytes:
    value = Odometry(
        stamp_ns=1_500_000_000,
        vue_id="vue_1",
        position=np.array([1.0, 2.0, 3.0]),
        quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
        linear_velocity=np.zeros(3),
    )
    return bytes(typestore().serialize_cdr(codec().odometry_to_msg(value), ODOMETRY))


def channel(number: int, topic: str = "/vue_1/odometry", **changes: str) -> dict[str, Any]:
    return {
        "id": number,
        "topic": topic,
        "encoding": "cdr",
        "schemaName": ODOMETRY,
        "schemaEncoding": "ros2msg",
        "schema": definition(ODOMETRY),
        **changes,
    }


def frame(number: int, content: bytes, time_ns: int = 7) -> bytes:
    return struct.pack("<BIQ", 1, number, time_ns) + content


@contextmanager
def served(
    behave: Callable[[ServerConnection], None], protocol: str = "foxglove.sdk.v1"
) -> Iterator[str]:
    """The address of a server that behaves so with everybody who comes."""
    with serve(behave, "127.0.0.1", 0, subprotocols=[Subprotocol(protocol)]) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join()


def advertise(connection: ServerConnection, *channels: dict[str, Any]) -> None:
    connection.send(json.dumps({"op": "advertise", "channels": channels}))


def asked(connection: ServerConnection) -> list[int]:
    """Channels of the next request to subscribe."""
    said = json.loads(connection.recv(timeout=10.0))
    assert said["op"] == "subscribe"
    return [entry["channelId"] for entry in said["subscriptions"]]


def wait_for_the_end(connection: ServerConnection) -> None:
    with suppress(ConnectionClosed):
        connection.recv(timeout=10.0)


def next_message(viewer: Viewer) -> Received:
    for _ in range(100):
        received = viewer.receive(0.1)
        if received is not None:
            return received
    raise AssertionError("no message")


def test_messages_of_wanted_topics_are_decoded() -> None:
    requests = []

    def behave(connection: ServerConnection) -> None:
        connection.send(json.dumps({"op": "serverInfo", "name": "x", "capabilities": []}))
        others = channel(4, encoding="json"), channel(5, schemaName="../../x"), channel(6, "/no")
        advertise(connection, channel(3), *others)
        requests.append(asked(connection))
        connection.send(frame(9, b""))  # of no channel
        connection.send(b"\x02" + bytes(8))  # the time
        connection.send(frame(3, odometry_cdr(), 42))
        wait_for_the_end(connection)

    with served(behave) as url, Viewer(url, lambda topic, _: topic != "/no") as viewer:
        received = next_message(viewer)
        assert viewer.topics == {"/vue_1/odometry": ODOMETRY}
    assert requests == [[3]]
    assert (received.topic, received.type_name) == ("/vue_1/odometry", ODOMETRY)
    assert received.log_time_ns == 42
    value = codec().odometry_from_msg(received.message)
    assert value.stamp_ns == 1_500_000_000
    assert value.position.tolist() == [1.0, 2.0, 3.0]


def test_a_refused_subscription_is_asked_for_again() -> None:
    """A server that tells of a channel a moment before it knows it itself."""

    def behave(connection: ServerConnection) -> None:
        advertise(connection, channel(3))
        assert asked(connection) == [3]
        refusal = {"op": "status", "level": 2, "message": "Unknown channel ID: 3"}
        connection.send(json.dumps(refusal))
        assert asked(connection) == [3]
        connection.send(frame(3, odometry_cdr()))
        wait_for_the_end(connection)

    with served(behave) as url, Viewer(url, lambda *_: True) as viewer:
        assert next_message(viewer).topic == "/vue_1/odometry"


def test_bytes_that_are_no_message_leave_their_topic_out() -> None:
    def behave(connection: ServerConnection) -> None:
        advertise(connection, channel(3, "/bad"), channel(4, "/none", schema="no definition!"))
        advertise(connection, channel(5, "/good"))
        asked(connection), asked(connection)
        for number, content in ((3, b"\0\1\0\0\7"), (4, odometry_cdr()), (5, odometry_cdr())):
            connection.send(frame(number, content))
        wait_for_the_end(connection)

    with served(behave) as url, Viewer(url, lambda *_: True) as viewer:
        assert next_message(viewer).topic == "/good"
        assert viewer.left_out.keys() == {"/bad", "/none"}


def test_a_channel_that_went_is_no_topic_any_more() -> None:
    def behave(connection: ServerConnection) -> None:
        advertise(connection, channel(3), channel(4, "/other"))
        asked(connection)
        connection.send(json.dumps({"op": "unadvertise", "channelIds": [4]}))
        connection.send(frame(3, odometry_cdr()))
        wait_for_the_end(connection)

    with served(behave) as url, Viewer(url, lambda *_: True) as viewer:
        next_message(viewer)
        assert viewer.topics == {"/vue_1/odometry": ODOMETRY}


def test_an_ended_connection_is_told() -> None:
    with (
        served(lambda connection: connection.close()) as url,
        Viewer(url, lambda *_: True) as viewer,
        pytest.raises(ViewError, match="has ended the connection"),
    ):
        viewer.receive(10.0)


def test_where_nothing_answers_the_remedy_is_told() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and nobody listens
        url = f"ws://127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(ViewError, match="ros2 run netpos_bringup live"):
            Viewer(url, lambda *_: True)


def test_what_is_no_foxglove_server_is_told() -> None:
    with (
        served(lambda _: None, "chat") as url,
        pytest.raises(ViewError, match="no Foxglove WebSocket server"),
    ):
        Viewer(url, lambda *_: True)


@pytest.mark.parametrize(
    ("text", "url"),
    [
        ("localhost:8765", "ws://localhost:8765"),
        ("ws://10.0.0.1:1", "ws://10.0.0.1:1"),
        ("wss://edge", "wss://edge"),
    ],
)
def test_an_address_may_be_short(text: str, url: str) -> None:
    assert full_url(text) == url


@pytest.mark.parametrize("text", ["http://localhost:8765", "ws://", ""])
def test_what_is_no_address_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="ws://HOST:PORT"):
        full_url(text)
