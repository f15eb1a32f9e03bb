"""What goes wrong with bags."""

from __future__ import annotations


class BagError(ValueError):
    """A bag or a recording cannot be used; the sentence names the file and the remedy."""
