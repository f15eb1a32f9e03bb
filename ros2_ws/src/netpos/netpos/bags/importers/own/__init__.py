"""Anybody's recording: columns of a text file or fields of messages, named on the command line."""

from netpos.bags.importers.own.columns import Columns
from netpos.bags.importers.own.recording import Truth, import_csv, import_ros, truth_of

__all__ = ["Columns", "Truth", "import_csv", "import_ros", "truth_of"]
