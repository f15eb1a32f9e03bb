"""Quality of a run: pairing with the truth, figures, consistency, verdicts and pictures.

``evaluate_bag`` does all of it for a recording, ``survey_bag`` what can be said of one without
ground truth, ``assess_bag`` the one or the other. Positions are judged in the horizontal plane of
``map`` unless a name says otherwise.
"""

from netpos.evaluation.evaluate import (
    Evaluation,
    VueEvaluation,
    assess_bag,
    evaluate_bag,
    survey_bag,
)
from netpos.evaluation.survey import Survey

__all__ = [
    "Evaluation",
    "Survey",
    "VueEvaluation",
    "assess_bag",
    "evaluate_bag",
    "survey_bag",
]
