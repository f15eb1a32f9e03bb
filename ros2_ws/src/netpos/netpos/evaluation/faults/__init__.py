"""Faults of sensors, networks, clocks, processes and attackers, put into a scenario's stream; what
noticed them, how large the error was, and when the track was right again."""

from netpos.evaluation.faults.campaign import campaign
from netpos.evaluation.faults.outcome import Outcome
from netpos.evaluation.faults.plan import Entry, Plan, load_plan
from netpos.evaluation.faults.table import FAULTS

__all__ = ["FAULTS", "Entry", "Outcome", "Plan", "campaign", "load_plan"]
