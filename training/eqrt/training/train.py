"""`eqrt train`: train a predictor on recorded or simulated traffic.

    data --> Loader (threads: gather, augment) --> step --> running average --> evaluate, write
                                                    ^                             |
                                                    +--------- --resume ----------+

The weights kept are a running average of the weights trained (which evaluates better than any
single step of it). Everything random is seeded by (seed, step): a training that was stopped, killed
or spread over several processes goes the way that it would have gone undisturbed.
"""

from __future__ import annotations

import argparse
import math
import shlex
from collections.abc import Callable
from contextlib import closing, nullcontext
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from eqrt.core.errors import EqrtError, UsageError
from eqrt.training.augment import Batch
from eqrt.training.claim import claimed
from eqrt.training.configuration import MAX_SEED, LoopConfig, TrainConfig, load_config
from eqrt.training.dataset.store import license_notice
from eqrt.training.evaluate import INPUTS
from eqrt.training.loader import BatchMaker, Loader
from eqrt.training.losses import LOSSES, whole_loss
from eqrt.training.progress import Display, Lines, Silence, new_display
from eqrt.training.ranks import Ranks, alone, join_ranks
from eqrt.training.recorder import MODEL_FILE, STATE_FILE, Goal, Recorder
from eqrt.training.sampling import DROPOUT, Sampler, derived_seed
from eqrt.training.start import Start, credited, open_start
from eqrt.training.state import TrainingState, load_state, new_state, update_average
from eqrt.training.stopping import StopRequest
from eqrt.training.training_data import TrainingData, open_training_data

REPORT_EVERY = 50
"""Steps between two looks at the loss."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt train`."""
    parser.add_argument(
        "--config", type=Path, required=True, help="TOML file, see training/configs"
    )
    parser.add_argument(
        "--data",
        type=Path,
        required=True,
        action="append",
        help="folder of `eqrt prepare`, or a dataset as it is; may be given several times",
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for checkpoint and metrics")
    parser.add_argument(
        "--from",
        type=Path,
        dest="start",
        metavar="CHECKPOINT",
        help="begin with the weights of this checkpoint, instead of random ones",
    )
    parser.add_argument(
        "--resume", action="store_true", help="go on from the state in --out, if there is one"
    )
    parser.add_argument("--steps", type=int, help="instead of the configuration's")
    parser.add_argument("--seed", type=int, help="instead of the configuration's")
    parser.add_argument(
        "--train-share",
        type=float,
        metavar="SHARE",
        help="of the recordings to train on, instead of the configuration's (0 to 1)",
    )
    parser.add_argument("--threads", type=int, default=1, help="CPU threads to compute (default 1)")
    parser.add_argument(
        "--loader-threads", type=int, default=1, help="threads that make batches (default 1)"
    )
    parser.add_argument(
        "--device", choices=("cpu", "cuda"), default="cpu", help="where to train (default cpu)"
    )


def run(args: argparse.Namespace) -> int:
    """Train, evaluate, save; 128 + its number after a signal."""
    config = _config(args)
    torch.set_num_threads(args.threads)
    with join_ranks(args.device) as ranks, claimed(args.out) if ranks.leads else nullcontext():
        _check_out(args.out, args.resume)
        data = open_training_data(config, args.data)
        start = None if args.start is None else open_start(args.start, config)
        steps = config.train.total_steps(data.pool.samples_per_epoch)
        shown = new_display(steps) if ranks.leads else Silence()
        with shown as display, StopRequest() as stop:
            _introduce(config, data, start, ranks, display)
            state = train(
                config,
                data,
                args.out,
                start=start,
                ranks=ranks,
                resume=args.resume,
                loader_threads=args.loader_threads,
                display=display,
                should_stop=stop,
                command=_command(args),
            )
            if state.step < steps:
                display.line(f"stopped after step {state.step} of {steps}; to go on:")
                display.line(f"  {_command(args, resume=True)}")
                return stop.exit_status
            display.line(f"checkpoint          {args.out / MODEL_FILE}")
    return 0


def train(
    config: TrainConfig,
    data: TrainingData,
    out: Path,
    *,
    start: Start | None = None,
    ranks: Ranks | None = None,
    resume: bool = False,
    loader_threads: int = 1,
    display: Display | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    command: str = "",
) -> TrainingState:
    """The loop. `out` receives the checkpoint, the state, the metrics and their plots.

    It begins with the weights of `start`, or with random ones. The state returned has done all its
    steps, or fewer if `should_stop` said so. With `resume`, the training goes on from the state in
    `out` if there is one. Raises EqrtError if that state is of another training, or if the loss is
    no longer a number.
    """
    loop, ranks, display = config.train, ranks or alone(), display or Lines()
    make = batch_maker(config, data, ranks)
    steps = loop.total_steps(data.pool.samples_per_epoch)
    state = new_state(config, ranks.device)
    goal = Goal(config, data, out, command, start)
    if resume and (out / STATE_FILE).exists():
        load_state(out / STATE_FILE, state, config, goal.fingerprint())
        display.line(f"resumed             after step {state.step} of {steps}")
    elif start is not None:
        start.begin(state)
    model = ranks.parallel(state.network)
    with (
        closing(Recorder(goal, state, ranks=ranks, display=display)) as recorder,
        Loader(make, state.step, steps, loader_threads, ranks.device) as loader,
    ):
        for batch in loader:
            set_learning_rate(state.optimizer, learning_rate(loop, state.step, steps))
            torch.manual_seed(derived_seed(DROPOUT, loop.seed, state.step, ranks.rank))
            recorder.add(*train_step(model, state.optimizer, batch, loop))
            update_average(state.average, state.network, loop.average_decay)
            state.step += 1
            stopping = ranks.any(should_stop())
            if state.step % loop.evaluate_every == 0 or state.step == steps:
                recorder.evaluate()
            elif state.step % REPORT_EVERY == 0:
                recorder.report()
            if stopping:
                recorder.save_state()
                break
        recorder.plot()
        recorder.summarize(loader.times, loader_threads)
    return state


def train_step(
    model: nn.Module, optimizer: Optimizer, batch: Batch, config: LoopConfig
) -> tuple[Tensor, Tensor]:
    """One step of the optimizer. Returns the loss, and the gradient's length before clipping."""
    model.train()
    in_bf16 = config.precision == "bf16"
    with torch.autocast(batch["future"].device.type, torch.bfloat16, enabled=in_bf16):
        outputs = model(*(batch[name] for name in INPUTS))
    loss = whole_loss(LOSSES[config.loss], outputs, batch["future"], batch["future_valid"])
    optimizer.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
    grad_norm = torch.nn.utils.clip_grad_norm_(model.parameters(), config.max_grad_norm)
    optimizer.step()
    return loss, grad_norm


def learning_rate(config: LoopConfig, step: int, steps: int) -> float:
    """Linear warm-up, then half a cosine down to zero, or no change."""
    if step < config.warmup_steps:
        return config.learning_rate * (step + 1) / config.warmup_steps
    if config.schedule == "constant":
        return config.learning_rate
    done = (step - config.warmup_steps) / max(steps - config.warmup_steps, 1)
    return config.learning_rate * 0.5 * (1.0 + math.cos(math.pi * done))


def set_learning_rate(optimizer: Optimizer, rate: float) -> None:
    """For every group of weights."""
    for group in optimizer.param_groups:
        group["lr"] = rate


def batch_maker(config: TrainConfig, data: TrainingData, ranks: Ranks) -> BatchMaker:
    """What makes this rank's part of each step's batch.

    Raises EqrtError if the batch cannot be shared equally: the mean of unequal parts' means is not
    the mean of the whole.
    """
    loop = config.train
    if loop.batch_size % ranks.world:
        raise EqrtError(
            f"batch_size {loop.batch_size} cannot be shared equally by {ranks.world} processes; "
            "make it a multiple"
        )
    return BatchMaker(
        pool=data.pool,
        sampler=Sampler(data.pool, loop.batch_size, loop.seed),
        augmentation=config.augment,
        batch_size=loop.batch_size,
        seed=loop.seed,
        rank=ranks.rank,
        world=ranks.world,
    )


def _config(args: argparse.Namespace) -> TrainConfig:
    config = load_config(args.config)
    for option in ("steps", "threads", "loader_threads"):
        value = getattr(args, option)
        if value is not None and value < 1:
            raise UsageError(f"--{option.replace('_', '-')} is {value}, expected 1 or more")
    if args.train_share is not None:
        if not 0.0 < args.train_share <= 1.0:
            raise UsageError(f"--train-share is {args.train_share}, expected above 0 to 1")
        config = config.with_train_share(args.train_share)
    if args.seed is not None:
        if not 0 <= args.seed <= MAX_SEED:
            raise UsageError(f"--seed is {args.seed}, expected 0 to {MAX_SEED}")
        config = config.with_seed(args.seed)
    return config.with_steps(args.steps) if args.steps else config


def _check_out(out: Path, resume: bool) -> None:
    """No training is overwritten."""
    if (out / STATE_FILE).exists():
        if not resume:
            raise UsageError(
                f"{out}: holds a training already; go on with --resume, or choose another --out"
            )
    elif (out / MODEL_FILE).exists():
        raise UsageError(
            f"{out}: holds {MODEL_FILE} and no {STATE_FILE} to go on from; choose another --out"
        )


def _introduce(
    config: TrainConfig, data: TrainingData, start: Start | None, ranks: Ranks, display: Display
) -> None:
    """What is trained, on what, from what, and whether one may sell the result."""
    display.line(f"training windows    {len(data.pool)}, {data.pool.samples_per_epoch} an epoch")
    display.line(f"held-out targets    {len(data.held_out)}")
    if start is not None:
        display.line(f"begins with         {start.path}")
    source = credited(data.source, start)
    display.line(license_notice(source) or f"data licence        {source.license}")
    if ranks.world > 1:
        share = config.train.batch_size // ranks.world
        display.line(f"processes           {ranks.world}, {share} windows of every batch each")


def _command(args: argparse.Namespace, resume: bool = False) -> str:
    """The command line again."""
    words = ["eqrt", "train", "--config", args.config]
    words += [word for path in args.data for word in ("--data", path)]
    words += ["--out", args.out]
    words += [] if args.start is None else ["--from", args.start]
    words += ["--steps", args.steps] if args.steps else []
    for option in ("seed", "train_share"):
        value = getattr(args, option)
        words += [] if value is None else [f"--{option.replace('_', '-')}", value]
    for option in ("threads", "loader_threads"):
        words += [f"--{option.replace('_', '-')}", getattr(args, option)]
    words += ["--device", args.device]
    words += ["--resume"] if resume else []
    return shlex.join(map(str, words))
