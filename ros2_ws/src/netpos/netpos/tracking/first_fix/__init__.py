"""The first fix: ``initialise`` from whatever has been measured (``wrong_rsu``: one that errs
grossly), ``phase_start`` from range and phase of one array (``step_heading``), ``strapdown_start``
with an IMU."""
