"""The model card: what an artifact is, for people."""

from __future__ import annotations

import re

from eqrt.core.contract import ModelContract
from eqrt.training.checkpoint import Card

TRAINED_ON = "trained_on.txt"
"""Beside the card: `Card.trained_on`, a group per line, for `eqrt eval` to say when it measures on
one of them."""
EQUIVARIANT_M = 5e-3
"""What turning a scene 500 m away may change by float32's rounding."""


def model_card(contract: ModelContract, card: Card, turned_apart_m: float) -> str:
    """The text. `turned_apart_m`: how far turning a scene leaves its prediction behind, metres."""
    rows = "".join(
        f"| {_metric(name)} | {value:.3f} | {_number(card.baseline.get(name))} |\n"
        for name, value in card.metrics.items()
    )
    tensors = "".join(
        f"| `{name}` | {kind} | ({', '.join(map(str, shape))}) |\n"
        for name, (kind, shape) in (contract.inputs | contract.outputs).items()
    )
    turning = (
        "turning or shifting that frame turns or shifts the prediction and nothing else"
        if turned_apart_m < EQUIVARIANT_M
        else f"the model is not equivariant: where the test vectors are turned, it predicts up to "
        f"{turned_apart_m:.2g} m off"
    )
    modes = f"{contract.num_modes} trajectories" if contract.num_modes > 1 else "one trajectory"
    return f"""# {contract.name} {contract.version}

Predicts where traffic goes: for each target, its history and its neighbours' and the lane
centerlines around it become {modes} of {contract.horizon_steps * contract.dt_s:g} s.

| | |
| --- | --- |
| data | {card.data} |
| licence of the weights | {card.license}{", non-commercial" if card.non_commercial else ""} |
| parameters | {card.parameters} |
| trained by | `{_anywhere(card.command)}`, {card.steps} steps, seed {card.seed} |
| its configuration | SHA-256 {card.config_sha256[:16]} |
| contract | version 1, `contract.json` |
| check | `sha256sum -c SHA256SUMS`; `test_data_set_*` hold inputs and expected outputs |

Errors on held-out recordings, metres ({_what_counts(contract)}):

| metric | this model | constant velocity |
| --- | --- | --- |
{rows}
| tensor | type | shape |
| --- | --- | --- |
{tensors}
All positions are metres in one local frame (x east, y north) whose origin lies within 1 km of the
car; {turning}.

Limits: it knows vehicles on roads like those in its data; not pedestrians or cyclists, nor other
countries' roads. It predicts what usually happens; it is no guarantee of what will.
"""


def _what_counts(contract: ModelContract) -> str:
    known = "; NLL and ellipses of the end" if contract.covariances else ""
    if contract.num_modes == 1:
        return f"mean and final displacement of the trajectory{known}"
    return (
        "ADE and FDE of the most probable trajectory; minADE, minFDE and miss rate of the best of "
        f"{contract.num_modes}{known}"
    )


def _metric(name: str) -> str:
    """How a table calls a metric: `ade_3s` is ADE 3 s."""
    if of_mean := re.fullmatch(r"(ade|fde)_([\d.]+)s", name):
        return f"{of_mean[1].upper()} {of_mean[2]} s"
    if ellipse := re.fullmatch(r"inside_(\d+)", name):
        return f"truth inside the {ellipse[1]} % ellipse, share"
    others = {"min_ade": "minADE", "min_fde": "minFDE", "miss_rate": "miss rate, share"}
    return (others | {"nll": "NLL, nats"})[name]


def _number(value: float | None) -> str:
    """Constant velocity does not say how sure it is."""
    return "" if value is None else f"{value:.3f}"


def _anywhere(command: str) -> str:
    """A command line without the folders of the machine that it ran on."""
    return re.sub(r"(?<=\s)\S*/(?=\S)", "", command)
