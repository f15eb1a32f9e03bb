"""One module per sensor, and the table of all of them.

``row``       the columns of a measurement row
``model``     ``Sensor``, the record that a sensor fills in
``table``     ``SENSORS``, one line per sensor; ``Kind``, their numbers by name
``geometry``  what several sensors share

The others are sensors. docs/adding_a_sensor.md adds one.
"""
