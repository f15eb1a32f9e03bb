"""A Gaussian mixture over one state, for a posterior that is not one Gaussian: split, weigh,
merge, prune. A component is one hypothesis about the device.

``epoch``        one epoch of a mixture, and whole runs; ``candidates`` weighs explanations
``gaussians``    components and their moments and modes; ``reduction`` merges and drops them

Each reason to have more than one component is a module:

``turns``        a measurement fails the gate, or one RSU alone is heard: the device has turned
``splits``       a measurement divides a component: a range that is a ring, a path that may be
                 blocked, and what else the table there names (``in_turn``)
``sectors``      a phase is known but for whole turns
``ridge``        a first fix is a bent arc, or several places (``window``: what it is made of)
``mixing``       the device changes between several motion models: each has a component
"""
