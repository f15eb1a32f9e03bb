"""The update: rows into the estimate of one component.

``predicted``    the rows, linearised once, as a prediction sees them
``conditioning``, ``robust``  what fits badly counts less, what is late is shifted
``gate``         acceptance by group
``fusion``       row by row into mean and covariance
``iteration``, ``fit``, ``bearing``  again where the model bends
``slow_errors``  what an RSU errs by for long, where the model bends
"""
