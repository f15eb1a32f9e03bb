"""What one state is and how it changes: filters and the models they take, compiled with Numba and
cached on disk.

``state``        which entry of a state is what
``motion``       one module per motion model and the table of all: f, F, Q, parameters
``forms``        one module per form of the filter and the table of all: EKF and IEKF, UKF, its
                 square root, linear KF
``sensors``      one module per sensor and the table of all: h, H, second-order term, refusals
``measurement``  rows of measurements in a planar filter, ``space`` in a spatial one; ``rows``
                 makes them of messages
``fusion``, ``iteration``  rows into the estimate; again where the model bends (``fit``)
``sigma``        what unscented forms take from sigma points; ``dispatch``: the compiled choice
``gate``         acceptance by group; ``conditioning``, ``robust``: what fits badly counts less
``intersection``  two estimates of one state into one, whatever they have in common
``engine``       one epoch of one component
``mixture``      one epoch of several components, and a module for each reason to have them
``protection``   the radius that holds the error
``smooth``       Rauch-Tung-Striebel smoothing
"""

from netpos.estimation.compile import tell_first_compilation

tell_first_compilation()
