"""`eqrt prepare`: cut recorded traffic into training windows, once, in shards on the disk.

Every piece of the dataset becomes a shard, made by whichever worker is free. Shards that are there
are not made again, so a run that was cut short goes on where it was.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from eqrt.core.contract import ModelContract
from eqrt.core.errors import ContractError, UsageError
from eqrt.export.cluster import add_worker_arguments
from eqrt.export.formats import FORMATS, add_reader_arguments
from eqrt.export.preparation import prepare
from eqrt.export.profiles import absolute_profile
from eqrt.training.configuration import TrainConfig, load_config
from eqrt.training.dataset.pieces import RawData
from eqrt.training.dataset.split import Split
from eqrt.training.dataset.windows import TARGETS, WindowOptions
from eqrt.training.recordings.formats import ReaderOptions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `eqrt prepare`."""
    parser.epilog = (
        "example: eqrt prepare argoverse1/train/data --out prepared --config training/configs/"
        "eqrt-free.toml. Formats and numbers: docs/data.md"
    )
    parser.add_argument("data", type=Path, metavar="DATA", help="the recorded traffic")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="new, or its own")
    model = parser.add_mutually_exclusive_group(required=True)
    model.add_argument(
        "--config", type=Path, metavar="FILE", help="cut for the model of a training configuration"
    )
    model.add_argument(
        "--model", type=Path, metavar="FOLDER", help="cut for an artifact (its contract.json)"
    )
    parser.add_argument(
        "--targets",
        choices=TARGETS,
        help="whose windows: those the dataset is evaluated on, every track that is complete and "
        "drives, or all (default: the configuration's; all)",
    )
    parser.add_argument(
        "--stride",
        type=_positive,
        metavar="N",
        help="steps between windows (default: the configuration's; where the dataset says now)",
    )
    parser.add_argument("--keep-going", action="store_true", help="skip what cannot be read")
    parser.add_argument("--force", action="store_true", help="replace another preparation in --out")
    _add_split_arguments(parser)
    add_worker_arguments(parser)
    _add_reader_arguments(parser)


def _add_split_arguments(parser: argparse.ArgumentParser) -> None:
    split = parser.add_argument_group("split")
    split.add_argument(
        "--held-out",
        type=_share,
        metavar="SHARE",
        help="of the groups of recordings, drawn (default: those that the configuration names; "
        "where it names none, 0.2)",
    )
    split.add_argument("--seed", type=int, metavar="N", help="of the draw (default 0)")
    split.add_argument(
        "--held-out-groups",
        type=Path,
        metavar="FILE",
        help="hold out these instead: a recording or a group per line",
    )


def _add_reader_arguments(parser: argparse.ArgumentParser) -> None:
    reader = add_reader_arguments(parser)
    reader.add_argument(
        "--format",
        metavar="NAME",
        help=f"of DATA: {', '.join(kind.name for kind in FORMATS)} (default: told by the files)",
    )
    reader.add_argument(
        "--license", metavar="NAME", help="CAN logs, CommonRoad: under which the data may be used"
    )
    reader.add_argument("--credits", metavar="TEXT", help="CAN logs, CommonRoad: whose it is")


def run(args: argparse.Namespace) -> int:
    """Prepare, and say what came of it."""
    config = None if args.config is None else load_config(args.config)
    contract, options = _wanted(args, config)
    data = RawData.open(
        args.data,
        contract,
        options,
        formats=FORMATS,
        format_name=args.format,
        reader_options=ReaderOptions(
            maps=args.maps,
            profile=args.profile and absolute_profile(args.profile),
            tile=args.tile,
            can=tuple(args.can),
            stationary=args.stationary,
            license=args.license,
            credits=args.credits,
        ),
    )
    prepare(
        data,
        args.out.absolute(),
        _split(args, config),
        keep_going=args.keep_going,
        force=args.force,
        jobs=args.jobs,
        scheduler=args.scheduler,
    )
    return 0


def _wanted(
    args: argparse.Namespace, config: TrainConfig | None
) -> tuple[ModelContract, WindowOptions]:
    """For which model, and which windows."""
    if config is None:
        contract = _contract(args.model)
        return contract, WindowOptions(stride=args.stride, targets=args.targets or "all")
    usual = config.data.window_options() or WindowOptions()
    options = WindowOptions(
        stride=args.stride or usual.stride, targets=args.targets or usual.targets
    )
    return config.model.scene.contract(config.name, "0.0.0"), options


def _contract(folder: Path) -> ModelContract:
    path = folder / "contract.json"
    try:
        return ModelContract.from_json(path.read_text(encoding="utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ContractError(
            f"{path}: cannot be read ({error}); give --model the folder of an artifact"
        ) from error


def _split(args: argparse.Namespace, config: TrainConfig | None) -> Split:
    """As the options say; without any, as training with the configuration will split it."""
    said = {"seed": args.seed, "held_out_share": args.held_out}
    drawn = replace(Split(), **{name: value for name, value in said.items() if value is not None})
    if args.held_out_groups:
        return replace(drawn, held_out=_lines(args.held_out_groups))
    named = (
        () if config is None or any(v is not None for v in said.values()) else config.data.held_out
    )
    return replace(drawn, held_out=named, others_elsewhere=True) if named else drawn


def _lines(path: Path) -> tuple[str, ...]:
    """The lines of a file, without comments."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"--held-out-groups {path}: cannot be read ({error})") from error
    names = tuple(name for line in lines if (name := line.partition("#")[0].strip()))
    if not names:
        raise UsageError(f"--held-out-groups {path}: no names in it; one per line")
    return names


def _positive(text: str) -> int:
    number = int(text) if text.isdecimal() else 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of steps (1 or more)")
    return number


def _share(text: str) -> float:
    try:
        share = float(text)
    except ValueError:
        share = -1.0
    if not 0.0 <= share <= 1.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a share (0 to 1)")
    return share
