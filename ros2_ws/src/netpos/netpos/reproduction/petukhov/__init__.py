"""One anchor with a long baseline and the steps of a pedestrian (petukhov).

``paper`` is the reproduction as a whole; the other modules are its parts.
"""
