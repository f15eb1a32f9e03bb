"""What one state is and how it changes: filters and the models they take, compiled with Numba and
cached on disk.

``state``        which entry of a state is what
``motion``       one module per motion model and the table of all: f, F, Q, parameters
``forms``        one module per form of the filter and the table of all: EKF and IEKF, UKF, its
                 square root, linear KF
``sensors``      one module per sensor and the table of all: h, H, second-order term, refusals
``measurement``  rows of measurements in a planar filter; ``rows`` makes them of messages
``update``       rows into the estimate: prediction, gate, fusion, iteration, slow errors
``engine``       one epoch of one component; ``mixture`` of several, and the reasons to have them
``level``        the radius that holds the error
``fixes``        a position from measurements alone
``spatial``      rows and filter of a strapdown track
``smooth``       Rauch-Tung-Striebel smoothing
``intersection``  two estimates of one state into one, whatever they have in common
``compile``, ``dispatch``  how kernels are compiled, and chosen among the entries of a table
"""

from netpos.estimation.compile import tell_first_compilation

tell_first_compilation()
