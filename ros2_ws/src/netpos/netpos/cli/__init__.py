"""The ``netpos`` command. Exit status: 0 done, 1 the work failed, 2 bad usage or bad input, with
one sentence on stderr.
"""
