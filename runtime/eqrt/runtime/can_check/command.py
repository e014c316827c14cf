"""Is this mapping right? `eqrt can check LOG --profile P` decodes a log and says what looks wrong.

Exit status 1 when nothing in the log decodes.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from eqrt.core.errors import EqrtError
from eqrt.core.files import write_whole
from eqrt.runtime.bench.json_form import to_json
from eqrt.runtime.bus.channels import parse_channels
from eqrt.runtime.bus.logs import read_log
from eqrt.runtime.can_check.check import check
from eqrt.runtime.can_check.observation import observe
from eqrt.runtime.can_check.pictures import write_pictures
from eqrt.runtime.can_check.text import lines
from eqrt.runtime.decoding.profile import load_profile


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`check LOG --profile P`."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="COMMAND")
    check_parser = actions.add_parser(
        "check",
        help="say what a profile makes of a log, and what looks wrong",
        description="say what a profile makes of a log, and what looks wrong",
        epilog="example: eqrt can check drive.log --profile mine.toml --plot pictures",
        allow_abbrev=False,
    )
    check_parser.add_argument(
        "log", type=Path, metavar="LOG", help="candump .log, .asc, .blf or .trc, also with .gz"
    )
    check_parser.add_argument(
        "--profile", required=True, metavar="NAME|FILE", help="built-in name, or a .toml file"
    )
    check_parser.add_argument(
        "--can",
        action="append",
        default=[],
        metavar="[ROLE=]NAME",
        help="read only the log's channel NAME; with ROLE= for one of the profile's buses "
        "(repeatable; default: all channels for everything)",
    )
    check_parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write everything that was found as JSON"
    )
    check_parser.add_argument(
        "--plot", type=Path, metavar="FOLDER", help="write pictures of it into FOLDER (SVG)"
    )


def run(args: argparse.Namespace) -> int:
    """Check, and print what was found."""
    log = read_log(args.log)
    profile = load_profile(args.profile)
    channels = parse_channels(args.can, profile.roles) or None
    checked = check(profile, observe(log, profile, channels), str(args.log), channels)
    if log.remark:
        print(f"eqrt: {log.remark}", file=sys.stderr)
    for line in lines(checked.report):
        print(line)
    if args.json:
        _write(args.json, to_json(checked.report))
    if args.plot:
        for path in write_pictures(args.plot, profile, checked):
            print(f"drawn: {path}")
    return 0 if checked.report.decoded else 1


def _write(path: Path, text: str) -> None:
    try:
        write_whole(path, text.encode())
    except OSError as error:
        raise EqrtError(
            f"cannot write {path} ({error.strerror}); give --json a file that can be written"
        ) from error
