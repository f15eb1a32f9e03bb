"""Reasons to split a component before a measurement is fused: each is one module and one line of
``table.SPLITS``; ``choice`` asks them.

``split``        what such a reason is
``ring``         the likelihood of a range is a ring over a wide component
``paths``        the path of a range is direct or blocked
"""
