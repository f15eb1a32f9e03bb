"""Bags: rosbag2 folders with MCAP storage, written and read without ROS.

``BagWriter`` and ``BagReader`` are for the ordinary case, ``netpos.bags.recover`` saves what a
killed recorder left, ``netpos.bags.importers`` turn other people's recordings into bags.

The names of this package are imported when they are first used: a node needs the encoding of its
messages, and no file.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from netpos.common.lazy import imported_when_used

if TYPE_CHECKING:
    from netpos.bags.errors import BagError
    from netpos.bags.layout import LOST_METADATA
    from netpos.bags.reader import BagEntry, BagReader, TopicInfo
    from netpos.bags.types import cdr_codec, codec, has_common_definition, typestore
    from netpos.bags.writer import BagWriter, whole_bag

__all__ = [
    "LOST_METADATA",
    "BagEntry",
    "BagError",
    "BagReader",
    "BagWriter",
    "TopicInfo",
    "cdr_codec",
    "codec",
    "has_common_definition",
    "typestore",
    "whole_bag",
]

__getattr__ = imported_when_used(__name__, "errors", "types", "layout", "reader", "writer")
