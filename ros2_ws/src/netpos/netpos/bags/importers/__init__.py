"""Recordings of others made into bags: ``ble_aoa`` (Bluetooth), ``uwb_anchors`` (ranging)."""

from netpos.bags.importers.ble_aoa import import_ble_aoa
from netpos.bags.importers.uwb_anchors import import_uwb_anchors

__all__ = ["import_ble_aoa", "import_uwb_anchors"]
