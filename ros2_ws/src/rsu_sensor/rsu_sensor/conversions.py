"""Beacons from messages, RSUs and measurements to messages."""

from __future__ import annotations

from netpos_node import CODEC

beacon_from_msg = CODEC.beacon_from_msg
measurement_to_msg = CODEC.measurement_to_msg
rsu_info_to_msg = CODEC.rsu_info_to_msg
