"""The health of the RSUs: ``observations`` of all devices, ``health`` says who is silent or lies,
``probation`` who has a vote, ``diagnosis`` what an operator is told."""
