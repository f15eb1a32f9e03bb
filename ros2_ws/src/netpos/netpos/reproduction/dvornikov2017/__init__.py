"""Several networks, one track (dvornikov2017): stages, gain floor, fusion.

``paper`` is the reproduction as a whole; the other modules are its parts.
"""
