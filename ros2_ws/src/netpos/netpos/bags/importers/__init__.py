"""Recordings of others made into bags: ``ble_aoa`` (Bluetooth), ``uwb_anchors`` and
``uwb_trolley`` (ranging)."""

from netpos.bags.importers.ble_aoa import import_ble_aoa
from netpos.bags.importers.uwb_anchors import import_uwb_anchors
from netpos.bags.importers.uwb_trolley import import_uwb_trolley

__all__ = ["import_ble_aoa", "import_uwb_anchors", "import_uwb_trolley"]
