"""The training loop and its command, on real recordings, for a few steps."""

from __future__ import annotations

import json
import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from eqrt.cli import main
from eqrt.core.errors import EqrtError
from eqrt.export.model_card import model_card
from eqrt.training.checkpoint import load_checkpoint
from eqrt.training.claim import claimed
from eqrt.training.compare import Run, curve
from eqrt.training.configuration import TrainConfig, load_config
from eqrt.training.dataset.split import group_digest
from eqrt.training.dataset.store import open_data
from eqrt.training.evaluate import INPUTS, evaluate, evaluate_constant_velocity, predict
from eqrt.training.networks.registry import build_network
from eqrt.training.recorder import MODEL_FILE, STATE_FILE
from eqrt.training.sampling import Pool
from eqrt.training.state import new_optimizer, new_state, update_average
from eqrt.training.train import learning_rate, train, train_step
from eqrt.training.training_data import TrainingData, open_training_data
from source_tree import ROOT
from tiny_training import DATA, NGSIM, TOML, tiny, tiny_data, tiny_file
from window_samples import packed_scenes

SHIPPED = load_config(ROOT / "training/configs/eqrt-free.toml")


def command(config: Path, out: Path, *more: str, data: tuple[Path, ...] = DATA) -> list[str]:
    sources = [word for path in data for word in ("--data", str(path))]
    return ["train", "--config", str(config), *sources, "--out", str(out), *more]


def run_tiny(out: Path, config: TrainConfig, steps: int) -> torch.nn.Module:
    return train(config.with_steps(steps), tiny_data(), out).average


def test_training_beats_constant_velocity_on_what_it_saw(tmp_path: Path) -> None:
    """A hundred steps on eight seconds of motorway."""
    scene = SHIPPED.model.scene
    store = open_data(
        NGSIM / "USA_US101-15_1_T-1.xml.gz",
        scene.contract("test", "0.0.0"),
        options=SHIPPED.data.window_options(),
    )
    windows = store.gather(store.rows())
    loop = replace(SHIPPED.train, steps=100, batch_size=32, average_decay=0.9)
    data = TrainingData(Pool.of(windows), windows, store.source)
    model = train(replace(SHIPPED, train=loop), data, tmp_path).average
    course = evaluate_constant_velocity(windows, scene.num_modes, scene.dt_s)
    assert evaluate(model, windows, scene.dt_s)["ade_3s"] < 0.95 * course["ade_3s"]
    assert np.isfinite(predict(model, windows).trajectories).all()


def test_the_same_seed_trains_the_same_network_and_another_seed_another(tmp_path: Path) -> None:
    configs = [tiny(), tiny(), tiny({"train": {"seed": 2}})]
    one, same, other = (run_tiny(tmp_path, config, 3).state_dict() for config in configs)
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert not all(torch.equal(one[name], other[name]) for name in one)


def test_the_command_writes_a_checkpoint_that_says_where_it_comes_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, out = tiny_file(tmp_path), tmp_path / "out"
    assert main(command(config, out, "--steps", "4")) == 0
    checkpoint = load_checkpoint(out / "model.safetensors")
    card = checkpoint.card
    assert checkpoint.config == tiny().model
    assert "NGSIM" in card.data
    assert card.license == "CC-BY-SA-4.0"
    assert not card.non_commercial
    assert card.trained_on == (group_digest("NGSIM", "USA_Peach-4"),)  # the other is held out
    assert card.metrics.keys() == card.baseline.keys()
    assert card.metrics["fde_3s"] > 0.0
    assert (card.steps, card.seed) == (4, 1)
    assert card.config_sha256 == tiny().with_steps(4).sha256
    assert card.command.startswith(f"eqrt train --config {config} --data {DATA[0]} --data ")
    assert card.parameters == sum(p.numel() for p in checkpoint.network.parameters())
    said = capsys.readouterr().out
    assert "constant velocity" in said
    assert "loader " in said
    assert "NON-COMMERCIAL" not in said.upper()


def test_the_checkpoint_predicts_what_was_evaluated(tmp_path: Path) -> None:
    assert main(command(tiny_file(tmp_path), tmp_path / "out", "--steps", "4")) == 0
    checkpoint = load_checkpoint(tmp_path / "out" / "model.safetensors")
    again = evaluate(checkpoint.network, tiny_data().held_out, checkpoint.config.scene.dt_s)
    assert again == checkpoint.card.metrics


@pytest.mark.parametrize(("steps", "end"), [(15, "1.5s"), (40, "4s")])
def test_any_horizon_is_trained_and_measured_up_to_its_end(
    tmp_path: Path, steps: int, end: str
) -> None:
    config = tiny({"scene": {"horizon_steps": steps}}).with_steps(2)
    train(config, open_training_data(config, DATA), tmp_path)
    card = load_checkpoint(tmp_path / MODEL_FILE).card
    assert list(card.metrics)[-2:] == list(card.baseline)[-2:] == [f"ade_{end}", f"fde_{end}"]
    assert (tmp_path / "errors.png").exists()
    assert f"| FDE {end[:-1]} s | " in model_card(config.model.contract("x", "1.0.0"), card, 0.0)
    figure = curve([Run("x", card)])
    assert figure.axes[1].get_ylabel().startswith(f"FDE {end[:-1]} s")


def test_metrics_stand_in_a_line_per_evaluation_and_in_pictures(tmp_path: Path) -> None:
    evaluated = ("evaluate_every = 25", "evaluate_every = 2")
    assert main(command(tiny_file(tmp_path, evaluated), tmp_path / "out", "--steps", "5")) == 0
    text = (tmp_path / "out" / "metrics.jsonl").read_text(encoding="utf-8")
    lines = [json.loads(line) for line in text.splitlines()]
    assert [line["step"] for line in lines] == [2, 4, 5]
    assert all(
        {"loss", "learning_rate", "samples_per_s", "ade_3s"} <= line.keys() for line in lines
    )
    for name in ("loss", "errors"):
        assert (tmp_path / "out" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert b"<svg" in (tmp_path / "out" / f"{name}.svg").read_bytes()


def test_data_that_may_not_be_sold_says_so_while_training_and_in_the_checkpoint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Together with data that may: the strictest terms count, and all credits stand."""
    config = tiny_file(tmp_path, ('held_out = ["USA_Peach-2"]', 'held_out = ["USA_Peach-2", "1"]'))
    scenes = packed_scenes(tmp_path / "scenes.npz", 4)
    data = (*DATA, scenes)
    assert main(command(config, tmp_path / "out", "--steps", "1", data=data)) == 0
    assert "non-commercial" in capsys.readouterr().out
    card = load_checkpoint(tmp_path / "out" / "model.safetensors").card
    assert card.non_commercial
    assert "NGSIM" in card.data
    assert "Argoverse" in card.data
    assert "AND" in card.license


def test_a_folder_with_a_training_in_it_is_not_overwritten(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = command(tiny_file(tmp_path), tmp_path / "out", "--steps", "1")
    assert main(words) == 0
    before = (tmp_path / "out" / "model.safetensors").read_bytes()
    assert main(words) == 2
    assert "--resume" in capsys.readouterr().err
    assert (tmp_path / "out" / "model.safetensors").read_bytes() == before


def test_a_folder_that_another_training_writes_to_is_left_to_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, out = tiny_file(tmp_path), tmp_path / "out"
    with claimed(out):
        for more in ((), ("--resume",)):
            assert main(command(config, out, "--steps", "2", *more)) == 1
            assert f"{out}: another process is writing to it" in capsys.readouterr().err
            assert not any(out.iterdir())
    assert main(command(config, out, "--steps", "2")) == 0


@pytest.mark.parametrize(
    ("size", "name"),
    [(100, "metrics.jsonl"), (20_000, MODEL_FILE), (60_000, STATE_FILE)],
)
def test_a_full_disk_is_said_and_leaves_nothing_half_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], size: int, name: str
) -> None:
    config, out = tiny_file(tmp_path), tmp_path / "out"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        assert main(command(config, out, "--steps", "2")) == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert f"eqrt: {out / name}: cannot be written (File too large)" in capsys.readouterr().err
    names = ["metrics.jsonl", MODEL_FILE, STATE_FILE]
    whole = names[: max(names.index(name), 1)]
    assert sorted(path.name for path in out.iterdir()) == whole


def test_a_folder_that_cannot_be_made_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tiny_file(tmp_path)
    assert main(command(config, config / "out", "--steps", "2")) == 1
    assert f"eqrt: {config / 'out'}: cannot be written (Not a directory)" in capsys.readouterr().err


def test_can_logs_are_prepared_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "drive.log"
    log.write_text("(0.0) can0 60A#00\n")
    assert main(command(tiny_file(tmp_path), tmp_path / "out", data=(log,))) == 1
    assert "CAN logs are read by `eqrt prepare` first" in capsys.readouterr().err


def test_a_training_that_cannot_begin_leaves_no_folder(tmp_path: Path) -> None:
    config, out = tiny_file(tmp_path), tmp_path / "out"
    assert main(command(config, out, data=(tmp_path / "nothing",))) == 1
    assert not out.exists()


@pytest.mark.parametrize("more", [[], ["--resume"]])
def test_a_model_whose_state_is_gone_is_not_overwritten(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str]
) -> None:
    model = tmp_path / "out/model.safetensors"
    model.parent.mkdir()
    model.write_bytes(b"weeks of work")
    arguments = ["train", "--config", str(tiny_file(tmp_path)), "--data", str(DATA[0])]
    assert main([*arguments, "--out", str(tmp_path / "out"), *more]) == 2
    assert "holds model.safetensors and no state.safetensors" in capsys.readouterr().err
    assert model.read_bytes() == b"weeks of work"


def test_held_out_recordings_that_are_not_there_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command(tiny_file(tmp_path), tmp_path / "out", data=DATA[:1])) == 1
    assert "USA_Peach-2 is not here" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_share_of_the_recordings_is_asked_for_on_the_command_line(tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = ["--steps", "1", "--seed", "7", "--train-share", "0.9"]
    assert main(command(tiny_file(tmp_path), out, *options)) == 0
    card = load_checkpoint(out / MODEL_FILE).card
    assert "--seed 7 --train-share 0.9" in card.command
    assert card.config_sha256 == tiny().with_steps(1).with_seed(7).with_train_share(0.9).sha256
    assert card.seed == 7
    assert card.recordings == 1
    assert card.samples == tiny().train.batch_size


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("--train-share", "1.5", "--train-share is 1.5, expected above 0 to 1"),
        ("--seed", "-1", "--seed is -1, expected 0 to 9223372036854775807"),
    ],
)
def test_a_share_or_seed_that_is_none_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, value: str, said: str
) -> None:
    words = command(tiny_file(tmp_path), tmp_path / "out", option, value)
    assert main(words) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--steps", "--threads", "--loader-threads"])
def test_numbers_below_one_are_refused(tmp_path: Path, option: str) -> None:
    assert main(command(tiny_file(tmp_path), tmp_path / "out", option, "0")) == 2


@pytest.mark.skipif(torch.cuda.is_available(), reason="only where there is no such device")
def test_a_device_that_is_not_there_is_a_usage_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command(tiny_file(tmp_path), tmp_path / "out", "--device", "cuda")) == 2
    assert "no CUDA device" in capsys.readouterr().err


def test_a_loss_that_is_no_number_ends_it_and_leaves_what_was_good(tmp_path: Path) -> None:
    """Step 7 meets a window with a NaN among its futures."""
    windows = tiny_data().held_out
    future = windows.future.copy()
    config = tiny({"train": {"evaluate_every": 5, "batch_size": len(windows)}})
    config = replace(config, augment=None)
    good = TrainingData(Pool.of(windows), windows, tiny_data().source)
    train(config.with_steps(5), good, tmp_path)
    before = (tmp_path / "state.safetensors").read_bytes()
    future[3, 7] = np.nan
    bad = TrainingData(Pool.of(replace(windows, future=future)), windows, tiny_data().source)
    with pytest.raises(EqrtError, match=r"broke down at step 1: loss nan") as refused:
        train(config.with_steps(5), bad, tmp_path)
    assert "\n" not in str(refused.value)
    assert (tmp_path / "state.safetensors").read_bytes() == before


@pytest.mark.parametrize("loss", ["ade", "best_mode"])
@pytest.mark.parametrize("optimizer", ["adam", "adamw"])
def test_every_loss_and_optimizer_trains(tmp_path: Path, loss: str, optimizer: str) -> None:
    config = tiny({"train": {"loss": loss, "optimizer": optimizer}})
    before = new_state(config, torch.device("cpu")).average.state_dict()
    after = run_tiny(tmp_path, config, 2).state_dict()
    assert any(not torch.equal(before[name], after[name]) for name in before)


def test_modes_beyond_the_first_are_measured_too(tmp_path: Path) -> None:
    config = tiny({"scene": {"num_modes": 3}})
    metrics = evaluate(run_tiny(tmp_path, config, 2), tiny_data().held_out, 0.1)
    assert {"min_ade", "min_fde", "miss_rate"} < metrics.keys()
    assert metrics["min_fde"] <= metrics["fde_3s"]


def test_predicted_uncertainty_is_trained_and_measured(tmp_path: Path) -> None:
    """Of what it saw, it then expects more than at the start."""
    config = replace(tiny({"network": {"uncertainty": True}}), augment=None)
    windows = tiny_data().held_out
    data = TrainingData(Pool.of(windows), windows, tiny_data().source)
    before = evaluate(new_state(config, torch.device("cpu")).average, windows, 0.1)
    after = evaluate(train(config.with_steps(60), data, tmp_path).average, windows, 0.1)
    assert after["nll"] < before["nll"] - 0.1
    assert 0.0 < after["inside_50"] < after["inside_90"] <= 1.0
    checkpoint = load_checkpoint(tmp_path / "model.safetensors")
    assert checkpoint.card.metrics == after
    assert set(after) - set(checkpoint.card.baseline) == {"nll", "inside_50", "inside_90"}
    assert predict(checkpoint.network, tiny_data().held_out).end_covariances is not None


@pytest.mark.parametrize("uncertainty", [False, True])
def test_in_bf16_the_loss_is_float32_and_close(tmp_path: Path, uncertainty: bool) -> None:
    network = {"dropout": 0.0, "uncertainty": uncertainty}
    config = tiny({"train": {"precision": "bf16"}, "network": network})
    windows = tiny_data().held_out.tensors()
    losses = []
    for precision in ("float32", "bf16"):
        state = new_state(config, torch.device("cpu"))
        loop = replace(config.train, precision=precision)
        loss, _ = train_step(state.network, state.optimizer, windows, loop)
        assert loss.dtype == torch.float32
        losses.append(loss.item())
    assert losses[0] != losses[1]
    assert losses[1] == pytest.approx(losses[0], rel=0.05)
    assert np.isfinite(evaluate(run_tiny(tmp_path, config, 2), tiny_data().held_out, 0.1)["ade_3s"])


def test_the_learning_rate_warms_up_and_comes_down_to_nothing() -> None:
    loop = replace(tiny().train, learning_rate=2.0, warmup_steps=10)
    rates = [learning_rate(loop, step, 100) for step in (0, 10, 55, 100)]
    assert rates == pytest.approx([0.2, 2.0, 1.0, 0.0])
    steady = replace(loop, schedule="constant")
    assert [learning_rate(steady, step, 100) for step in (0, 10, 99)] == [0.2, 2.0, 2.0]


def test_weight_decay_is_for_matrices_only() -> None:
    network = build_network(tiny().model)
    decayed, spared = new_optimizer(network, tiny().train).param_groups
    assert decayed["weight_decay"] == 0.05
    assert all(weight.dim() >= 2 for weight in decayed["params"])
    assert spared["weight_decay"] == 0.0
    assert all(weight.dim() < 2 for weight in spared["params"])
    both = len(decayed["params"]) + len(spared["params"])
    assert both == len(list(network.parameters()))


def test_the_average_follows_weights_and_buffers() -> None:
    """Half the way for numbers; counters are what they are."""
    mean, new = torch.nn.BatchNorm1d(2), torch.nn.BatchNorm1d(2)
    torch.nn.init.constant_(new.weight, 3.0)
    new.running_mean = torch.tensor([4.0, 8.0])
    new.num_batches_tracked = torch.tensor(7)
    update_average(mean, new, 0.5)
    assert mean.weight.tolist() == [2.0, 2.0]
    assert mean.running_mean is not None
    assert mean.running_mean.tolist() == [2.0, 4.0]
    assert mean.num_batches_tracked == 7
    update_average(mean, new, 0.0)
    assert mean.weight.tolist() == [3.0, 3.0]


def test_inputs_are_the_contracts() -> None:
    assert tuple(tiny().model.scene.contract("test", "0.0.0").inputs) == INPUTS


def test_epochs_count_what_is_drawn() -> None:
    """64 windows of which half are drawn, in batches of 16, for three epochs: six steps."""
    text = TOML.replace("steps = 100", "epochs = 3", 1)
    assert "epochs" in text
    loop = replace(tiny().train, steps=None, epochs=3.0)
    assert loop.total_steps(32) == 6
    assert replace(loop, epochs=0.1).total_steps(32) == 1
