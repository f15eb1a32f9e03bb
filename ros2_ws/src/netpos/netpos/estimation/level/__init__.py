"""The protection level: ``protection`` is the radius that holds the error, ``manoeuvre`` what a
turn that nobody has noticed adds, ``report`` both, of one epoch or of a whole run."""
