"""Trained networks in the form that an exported graph is cheapest in.

The same function of the same parameters, arranged for an operator-by-operator runtime on a CPU:
products of weights are multiplied out, once and in float64, and what is left are few operators on
contiguous rows. Networks that have no such form are exported as they are.
"""

from __future__ import annotations

from torch import nn

from eqrt.export.folded.backbone import FoldedEqMotion
from eqrt.training.networks.eqmotion import EqMotion


def folded(model: nn.Module, num_agents: int) -> nn.Module:
    """What to export in place of `model`, which stays as it is."""
    if isinstance(model, EqMotion) and num_agents > 1:  # the form is one of pairs of agents
        return FoldedEqMotion(model, num_agents)
    return model
