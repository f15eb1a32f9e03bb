"""What one state is and how it changes: filters and the models they take, compiled with Numba and
cached on disk.

``state``        which entry of a state is what
``motion``       f, F and Q of the process models
``sensors``      one module per sensor and the table of all: h, H, second-order term, refusals
``measurement``  rows of measurements in a planar filter, ``space`` in a spatial one; ``rows``
                 makes them of messages
``ekf``          extended and iterated extended Kalman filter: predict, gate, update
``fusion``, ``iteration``  rows into the estimate; again where the model bends (``fit``)
``ukf``, ``srukf``  unscented filters on ``sigma`` points, the second on the square root of P
``kf``           linear filter with an optional floor under its gain
``imm``          interacting multiple models
``gate``         acceptance by group; ``conditioning``, ``robust``: what fits badly counts less
``intersection``  two estimates of one state into one, whatever they have in common
``engine``       one epoch of one component; ``components`` of a mixture (``mixture``)
``protection``   the radius that holds the error
``smooth``       Rauch-Tung-Striebel smoothing
``filterpy_backend``  the reference
"""

from netpos.estimation.first_compilation import tell_first_compilation

tell_first_compilation()
