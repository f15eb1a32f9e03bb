"""Record and play bags of a running graph."""
