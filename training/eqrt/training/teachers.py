"""Teachers: trained networks whose expectations are some of the futures to learn (distillation).

What happened is one of the futures that there could have been; what several networks expect
of it together is nearer to the middle of them all, and there is such an answer for windows, too,
that their recording cuts off. After Hinton et al., "Distilling the Knowledge in a Neural Network"
(2015), whose classes are trajectories here.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from eqrt.training.augment import Batch
from eqrt.training.evaluate import INPUTS


@torch.no_grad()
def taught(batch: Batch, teachers: Sequence[nn.Module], share: float) -> Batch:
    """The batch, with what the teachers expect for the future of about `share` of its windows.

    Which they are is drawn with torch's global generator. Of networks with one mode it is the mean
    of all teachers' trajectories; of several, one mode of one teacher, drawn by its probability, so
    that the futures of many batches are spread as the teachers expect them.
    """
    future, valid = batch["future"], batch["future_valid"]
    told = (torch.rand(len(future)) < share).nonzero()[:, 0].to(future.device)
    inputs = [batch[name][told] for name in INPUTS]
    said = _expected(inputs, teachers)
    return batch | {
        "future": future.index_copy(0, told, said.to(future)),
        "future_valid": valid.index_fill(0, told, True),
    }


def _expected(inputs: Sequence[Tensor], teachers: Sequence[nn.Module]) -> Tensor:
    """Futures (B, H, 2)."""
    one = teachers[int(torch.randint(len(teachers), ()))]
    trajectories, probabilities, *_ = one(*inputs)  # (B, K, H, 2), (B, K)
    if trajectories.shape[1] == 1:
        return torch.stack([teacher(*inputs)[0][:, 0] for teacher in teachers]).mean(0)
    drawn = probabilities.cpu().multinomial(1)[:, 0].to(probabilities.device)
    chosen: Tensor = trajectories[torch.arange(len(drawn), device=drawn.device), drawn]
    return chosen
