"""An experiment that takes a moment."""

from collections.abc import Sequence
from typing import Any

from rhp_drake.evaluation.experiment import PLANAR, Experiment, make_columns
from rhp_drake.random_streams import VALIDATION


def experiment(
    policies: Sequence[str] = ("gp",),
    weights: Sequence[str] = ("best",),
    **changes: Any,
) -> Experiment:
    """GP on two validation tasks in a very uncertain world, but for the changes."""
    values = {
        "levels": ["high"],
        "instances": VALIDATION,
        "num_objects": 3,
        "num_instances": 2,
        "num_trials": 1,
        "world": PLANAR,
        "seed": 0,
    }
    return Experiment(make_columns(policies, weights), **values | changes)
