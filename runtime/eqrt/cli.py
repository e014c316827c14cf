"""The `eqrt` command: a table of subcommands, each imported only when it is the one asked for.

A subcommand is a module with `add_arguments(parser)` and `run(args) -> int`; its docstring's first
line is its help. Exit status: 0 done, 1 the user can fix it, 2 wrong usage or a missing extra, 3 a
budget is broken or something became slower.
"""

from __future__ import annotations

import argparse
import difflib
import importlib
import importlib.metadata
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import NoReturn

from eqrt.core.errors import EqrtError, UsageError

COMMANDS = {
    "demo": ("eqrt.runtime.demo.command", "see it work: recorded traffic, predicted and scored"),
    "serve": ("eqrt.runtime.serve", "predict from a CAN bus, publish on CAN and as datagrams"),
    "doctor": ("eqrt.runtime.doctor.command", "check machine, bus, model and map: what to do"),
    "play": ("eqrt.runtime.play", "put a recorded log on a CAN bus"),
    "can": ("eqrt.runtime.can_check.command", "check a sensor's profile against a recorded log"),
    "replay": (
        "eqrt.runtime.replay",
        "run the service on a log or recording again, offline; compare",
    ),
    "replay-fleet": (
        "eqrt.export.replay_fleet",
        "replay a folder of logs, on all cores or a cluster",
    ),
    "convert": (
        "eqrt.export.bridges.convert",
        "turn a recording into Foxglove, ROS 2, candump or JSON files (extra: bridges)",
    ),
    "bridge": (
        "eqrt.export.bridges.bridge",
        "pass predictions on to PlotJuggler or zenoh while the service runs (extra: bridges)",
    ),
    "view": (
        "eqrt.runtime.view.command",
        "watch the service, or a recorded file, in a browser (extra: view)",
    ),
    "top": ("eqrt.runtime.view.top", "watch the service in a terminal (extra: view)"),
    "tile": ("eqrt.runtime.tile_command", "look at a map tile, or build one"),
    "prepare": ("eqrt.export.prepare", "cut recordings into training windows (extra: train)"),
    "simulate": ("eqrt.training.simulation.command", "record traffic driven by SUMO (extra: sim)"),
    "train": ("eqrt.training.train", "train a predictor (extra: train)"),
    "compare": ("eqrt.training.compare", "trainings side by side: a table, a curve (extra: train)"),
    "eval": (
        "eqrt.export.evaluation.command",
        "measure a model on recorded traffic (extra: train)",
    ),
    "plot": (
        "eqrt.export.evaluation.plot",
        "draw predictions: the worst, and a sample (extra: train)",
    ),
    "export": ("eqrt.export.command", "turn a checkpoint into an ONNX artifact (extra: export)"),
    "info": ("eqrt.runtime.verify.info", "say what an artifact is: sizes, licence, errors"),
    "verify": (
        "eqrt.runtime.verify.command",
        "check that an artifact keeps its contract: a table, a verdict",
    ),
    "bench": (
        "eqrt.runtime.bench.command",
        "measure model or service on this machine: latency, memory, verdict",
    ),
    "encode": ("eqrt.export.encode", "turn a recorded scenario into a CAN log and its tile"),
}
EXTRA_OF = {  # third-party module -> the extra that brings it
    "torch": "train",
    "safetensors": "train",
    "rich": "train",
    "matplotlib": "train",
    "pyarrow": "data",
    "dask": "scale",
    "distributed": "scale",
    "libsumo": "sim",
    "sumolib": "sim",
    "onnx": "export",
    "onnxscript": "export",
    "lanelet2": "maps",
    "foxglove_schemas_protobuf": "bridges",
    "google": "bridges",
    "rosbags": "bridges",
    "websockets": "view",
    "zenoh": "bridges",
}
_EXTRA_OF_COMMAND = {"view": "view", "top": "view"}  # for packages that come with several extras


class Parser(argparse.ArgumentParser):
    """Says what is wrong with the command line in one line, like every other error."""

    def error(self, message: str) -> NoReturn:
        """Raises UsageError."""
        raise UsageError(f"{message}; see {self.prog} --help")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand and return the exit status."""
    args_list = list(sys.argv[1:] if argv is None else argv)
    name = args_list[0] if args_list else None
    try:
        if name in COMMANDS:
            return _run_command(name, args_list[1:])
        return _top_level(args_list)
    except EqrtError as error:
        print(f"eqrt: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return 130  # 128 + SIGINT, the shell's convention
    except BrokenPipeError:
        sys.stderr.close()  # the reader has gone; there is nobody to tell
        return 1
    except OSError as error:
        if error.filename is None:
            raise
        print(f"eqrt: cannot use {error.filename}: {error.strerror}", file=sys.stderr)
        return 1


def _run_command(name: str, argv: list[str]) -> int:
    module = command_module(name)
    return int(module.run(command_parser(name, module).parse_args(argv)))


def command_module(name: str) -> ModuleType:
    """The module of a subcommand. Raises UsageError if an extra that it needs is not installed."""
    try:
        return importlib.import_module(COMMANDS[name][0])
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        extra = EXTRA_OF.get(package)
        if extra is None:
            raise
        extra = _EXTRA_OF_COMMAND.get(name, extra)
        raise missing_extra(f"eqrt {name}", package, extra) from error


def command_parser(name: str, module: ModuleType) -> Parser:
    """What reads the options of a subcommand."""
    parser = Parser(prog=f"eqrt {name}", description=COMMANDS[name][1], allow_abbrev=False)
    module.add_arguments(parser)
    return parser


def missing_extra(what: str, module: str, extra: str) -> UsageError:
    """The error for a feature whose optional packages are not installed."""
    return UsageError(
        f"{what} needs the package {module!r}, which is not installed; "
        f"install it with: pip install 'eqrt[{extra}]'"
    )


def _top_level(argv: list[str]) -> int:
    width = max(map(len, COMMANDS))
    listing = "\n".join(f"  {name:<{width}}  {text}" for name, (_, text) in COMMANDS.items())
    parser = Parser(
        prog="eqrt",
        description="Motion prediction from CAN object lists and a lane map, on a 2-core CPU.",
        epilog=f"commands:\n{listing}\n\n`eqrt COMMAND --help` says more.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
        usage="eqrt [--help] [--version] COMMAND ...",
    )
    parser.add_argument(
        "--version", action="version", version=f"eqrt {importlib.metadata.version('eqrt')}"
    )
    if not argv:
        parser.print_help()
        return 2
    parser.parse_known_args(argv)
    near = difflib.get_close_matches(argv[0], COMMANDS, n=1)
    advice = f"did you mean {near[0]!r}?" if near else f"the commands are {', '.join(COMMANDS)}"
    raise UsageError(f"there is no command {argv[0]!r}; {advice}")


if __name__ == "__main__":
    sys.exit(main())
