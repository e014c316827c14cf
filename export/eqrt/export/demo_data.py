"""Makes the recordings of `eqrt demo`: `python -m eqrt.export.demo_data NGSIM_FOLDER RAV4_LOG OUT`.

Every NGSIM scenario in it is held out of training (training/configs/eqrt-free.toml).
"""

from __future__ import annotations

import argparse
import gzip
import itertools
import sys
from collections.abc import Sequence
from pathlib import Path

from eqrt.export import encode

SCENARIOS = (  # a minute: motorway, arterial, motorway, arterial ...
    "USA_US101-22_4_T-1",
    "USA_Lanker-2_23_T-1",
    "USA_US101-5_1_T-1",
    "USA_Peach-2_1_T-1",
    "USA_US101-15_1_T-1",
    "USA_Lanker-1_2_T-1",
)
RAV4_S = 30.0


def main(argv: Sequence[str] | None = None) -> int:
    """Write ngsim.log.gz, ngsim.tile and rav4.log.gz."""
    parser = argparse.ArgumentParser(prog="python -m eqrt.export.demo_data", description=__doc__)
    parser.add_argument("ngsim", type=Path, help="folder of CommonRoad scenarios")
    parser.add_argument("rav4", type=Path, help="candump log, gzip'd")
    parser.add_argument("out", type=Path)
    args = parser.parse_args(argv)
    encoder = argparse.ArgumentParser()
    encode.add_arguments(encoder)
    scenarios = [str(args.ngsim / f"{name}.xml.gz") for name in SCENARIOS]
    targets = ["--out", str(args.out / "ngsim.log.gz"), "--tile", str(args.out / "ngsim.tile")]
    status = encode.run(encoder.parse_args([*scenarios, *targets]))
    (args.out / "rav4.log.gz").write_bytes(excerpt(args.rav4, RAV4_S))
    return status


def excerpt(log: Path, seconds: float) -> bytes:
    """The first seconds of a gzip'd candump log, its lines as they are."""
    with gzip.open(log, "rb") as stream:
        first = stream.readline()
        end = _stamp(first) + seconds
        lines = itertools.takewhile(lambda line: _stamp(line) < end, stream)
        return gzip.compress(first + b"".join(lines), mtime=0)


def _stamp(line: bytes) -> float:
    return float(line[1 : line.index(b")")])


if __name__ == "__main__":
    sys.exit(main())
