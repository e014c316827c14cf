"""Trainings that learn from what other networks expect, too."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from eqrt.cli import main
from eqrt.core.errors import EqrtError
from eqrt.training.augment import Batch
from eqrt.training.checkpoint import load_checkpoint, read_tensors
from eqrt.training.configuration import TrainConfig
from eqrt.training.evaluate import INPUTS
from eqrt.training.origins import Origin, Origins, open_origin
from eqrt.training.teachers import taught
from eqrt.training.train import train
from tiny_training import DATA, same_tensors, tiny, tiny_data, tiny_file

MODEL, STATE = "model.safetensors", "state.safetensors"
HORIZON = 30
TAUGHT = {"train": {"teacher_share": 0.5}, "network": {"dropout": 0.0}}


class Says(nn.Module):
    """Always the same modes (K, H, 2), with these probabilities (K,)."""

    def __init__(self, modes: Tensor, probabilities: Sequence[float]) -> None:
        super().__init__()
        self.modes, self.probabilities = modes, torch.tensor(probabilities)

    def forward(self, history: Tensor, *_: Tensor) -> tuple[Tensor, Tensor]:
        batch = len(history)
        return self.modes.expand(batch, -1, -1, -1), self.probabilities.expand(batch, -1)


def says(*values: float, probabilities: Sequence[float] = (1.0,)) -> Says:
    """A network whose modes are everywhere at these values."""
    return Says(torch.tensor(values)[:, None, None].expand(-1, HORIZON, 2), probabilities)


def batch_of(size: int) -> Batch:
    """Futures at 0 of which nothing but the first step was seen."""
    seen = torch.zeros(size, HORIZON, dtype=torch.bool)
    seen[:, 0] = True
    inputs = {name: torch.zeros(size, 1) for name in INPUTS}
    return inputs | {"future": torch.zeros(size, HORIZON, 2), "future_valid": seen}


def test_the_mean_of_all_teachers_is_the_future_of_about_a_share() -> None:
    torch.manual_seed(0)
    batch = batch_of(1000)
    told = taught(batch, [says(1.0), says(4.0), says(7.0)], 0.3)
    is_told = told["future_valid"].all(-1)
    assert 250 < int(is_told.sum()) < 350
    assert (told["future"][is_told] == 4.0).all()
    assert (told["future"][~is_told] == 0.0).all()
    assert (told["future_valid"][~is_told].sum(-1) == 1).all()
    assert (batch["future"] == 0.0).all()  # what was given stays as it was
    assert (batch["future_valid"].sum(-1) == 1).all()


def test_all_or_none_may_be_told() -> None:
    batch = batch_of(50)
    assert (taught(batch, [says(1.0)], 1.0)["future"] == 1.0).all()
    assert (taught(batch, [says(1.0)], 0.0)["future"] == 0.0).all()


def test_of_several_modes_one_is_drawn_by_its_probability() -> None:
    torch.manual_seed(0)
    told = taught(batch_of(4000), [says(1.0, 2.0, 3.0, probabilities=(0.7, 0.3, 0.0))], 1.0)
    share = [(told["future"] == value).all(-1).all(-1).double().mean() for value in (1, 2, 3)]
    assert share == pytest.approx([0.7, 0.3, 0.0], abs=0.03)
    one_of_two = [
        float(
            taught(batch_of(1), [says(1.0, 1.0, probabilities=(0.5, 0.5)), TWO], 1.0)["future"][
                0, 0, 0
            ]
        )
        for _ in range(200)
    ]
    assert 60 < one_of_two.count(1.0) < 140
    assert one_of_two.count(1.0) + one_of_two.count(2.0) == 200


TWO = says(2.0, 2.0, probabilities=(0.5, 0.5))


@pytest.fixture(scope="module")
def teachers(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two checkpoints of short trainings."""
    folder = tmp_path_factory.mktemp("teachers")
    for seed in (1, 2):
        train(tiny({"train": {"seed": seed, "steps": 30}}), tiny_data(), folder / str(seed))
    return [folder / "1" / MODEL, folder / "2" / MODEL]


def origins(paths: Sequence[Path], config: TrainConfig) -> Origins:
    return Origins(teachers=tuple(open_origin(path, config) for path in paths))


def test_a_student_comes_to_say_what_its_teachers_say(teachers: list[Path], tmp_path: Path) -> None:
    """All of its futures are theirs: it ends nearer to their mean than they are to each other."""
    config = tiny({"train": {"teacher_share": 1.0, "steps": 150}, "network": {"dropout": 0.0}})
    state = train(config, tiny_data(), tmp_path, origins=origins(teachers, config))
    tensors = tiny_data().held_out.complete().tensors()
    inputs = [tensors[name] for name in INPUTS]
    with torch.no_grad():
        first, second = (load_checkpoint(path).network(*inputs)[0] for path in teachers)
        student = state.average(*inputs)[0]
    apart = (first - second).norm(dim=-1).mean()
    assert (student - (first + second) / 2).norm(dim=-1).mean() < 0.5 * apart


def test_stopped_and_resumed_it_comes_to_the_same_bits(
    teachers: list[Path], tmp_path: Path
) -> None:
    config = tiny(TAUGHT | {"train": {"teacher_share": 0.5, "steps": 6, "evaluate_every": 3}})
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    train(config, tiny_data(), whole, origins=origins(teachers, config))
    steps = iter([False, False, True])
    stop = lambda: next(steps)  # noqa: E731
    train(config, tiny_data(), parts, origins=origins(teachers, config), should_stop=stop)
    train(config, tiny_data(), parts, origins=origins(teachers, config), resume=True)
    assert same_tensors(whole / STATE, parts / STATE)


def test_other_teachers_than_before_are_refused(teachers: list[Path], tmp_path: Path) -> None:
    config = tiny(TAUGHT).with_steps(2)
    train(config, tiny_data(), tmp_path, origins=origins(teachers, config))
    with pytest.raises(
        EqrtError, match=r"another data: teacher 1 .*; teacher 2 \(\d+ there, absent"
    ):
        train(config, tiny_data(), tmp_path, origins=origins(teachers[1:], config), resume=True)


def test_the_licence_of_the_data_behind_a_teacher_counts_too(teachers: list[Path]) -> None:
    data = tiny_data().source
    theirs = Origin(
        teachers[0],
        load_checkpoint(teachers[0]).network,
        type(data)(
            name="Secret", credits="Ours.", license="LicenseRef-Secret", non_commercial=True
        ),
        ("a group",),
    )
    both = Origins(teachers=(theirs,))
    credited = both.credited(data)
    assert credited.non_commercial
    assert credited.license == f"{data.license} AND LicenseRef-Secret"
    assert "Ours." in credited.credits
    assert both.trained_on(["mine"]) == ("a group", "mine")


def test_the_command_says_who_teaches_and_the_card_how_it_was_called(
    teachers: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tiny_file(tmp_path, ("seed = 1", "seed = 1\nteacher_share = 0.5"))
    command = ["train", "--config", str(config), "--steps", "1", "--out", str(tmp_path / "out")]
    command += [word for path in DATA for word in ("--data", str(path))]
    told = [word for path in teachers for word in ("--teacher", str(path))]
    assert main([*command, *told]) == 0
    said = capsys.readouterr().out
    assert all(f"learns from         {path}" in said for path in teachers)
    assert " ".join(told) in load_checkpoint(tmp_path / "out" / MODEL).card.command
    assert read_tensors(tmp_path / "out" / STATE)[1]["step"] == "1"


@pytest.mark.parametrize(
    ("share", "option", "said"),
    [
        (
            "",
            ["--teacher"],
            "teacher_share is 0, so --teacher would teach nothing; give --teacher-share 0.5",
        ),
        ("teacher_share = 0.5", [], "teacher_share is 0.5, but nobody teaches; give --teacher"),
    ],
)
def test_a_share_without_a_teacher_and_the_reverse_are_usage_errors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], share: str, option: list[str], said: str
) -> None:
    config = tiny_file(tmp_path, ("seed = 1", f"seed = 1\n{share}"))
    command = ["train", "--config", str(config), "--out", str(tmp_path / "out")]
    command += [word for path in DATA for word in ("--data", str(path))]
    command += [word for name in option for word in (name, str(tmp_path / MODEL))]
    assert main(command) == 2
    error = capsys.readouterr().err
    assert said in error
    assert str(config) in error


def test_teachers_do_not_teach_covariances() -> None:
    with pytest.raises(ValueError, match=r"teacher_share and .* uncertainty do not go together"):
        tiny({"train": {"teacher_share": 0.5}, "network": {"uncertainty": True}})
