"""Angle and time of arrival at roadside units (fokin2020): METIS Madrid, a fast passage, a turn.

``paper`` is the reproduction as a whole; the other modules are its parts.
"""
