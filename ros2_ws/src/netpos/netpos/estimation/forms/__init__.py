"""The forms of the filter: one module per form, and the table of all of them.

``form``    ``FilterForm``, the record that a form fills in
``table``   ``FORMS``, one line per form
``choice``  the compiled choice of a form by its number

``ekf``     extended and iterated extended Kalman filter
``ukf``     unscented; ``srukf`` its square root
``kf``      linear, with an optional floor under its gain

docs/adding_a_motion_model_or_filter.md adds one.
"""
