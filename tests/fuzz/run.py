"""`make fuzz`: every target for some seconds, then a table; 1 if anything broke.

What the fuzzer finds stays in .fuzz/corpus/TARGET and is begun with the next time. An input that
breaks something is kept in .fuzz/crashes, and the command that shows it again is printed.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from fuzz.target import Target
from fuzz.targets import ALL

FOLDER = Path(".fuzz")
MAX_INPUT_S = 10
"""One input that takes longer is a hang: all of them are small."""
MAX_RSS_MB = 1024
"""More memory than this is a leak, or was asked for by an input; a target takes 100 to 250."""
_GRACE_S = 120  # to import, to read the corpus, to end


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """What came of one target."""

    target: str
    executions: int
    per_second: float
    edges: int
    """Places in the code that the inputs reached, as atheris counts them."""
    inputs: int
    """In the corpus at the end."""
    peak_rss_mb: int
    crashes: list[Path]
    failure: str
    """The end of what the fuzzer said, if something broke."""

    @property
    def good(self) -> bool:
        """Whether it ran, to the end, and nothing broke."""
        return not self.failure and not self.crashes and self.executions > 0


def main(argv: Sequence[str] | None = None) -> int:
    """Fuzz; 0 if nothing broke."""
    args = _arguments(argv)
    targets = [ALL[name] for name in args.targets or ALL]
    results = []
    print(_HEADER, flush=True)
    with ThreadPoolExecutor(args.jobs) as pool:
        for result in pool.map(lambda target: _fuzz(target, args.seconds), targets):
            results.append(result)
            print(_row(result), flush=True)
    print(f"{sum(result.executions for result in results):,} executions")
    for result in results:
        _explain(result)
    bad = sum(not result.good for result in results)
    print(f"{len(results) - bad} passed, {bad} failed")
    return 1 if bad else 0


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="make fuzz", description=__doc__)
    parser.add_argument(
        "targets", nargs="*", metavar="TARGET", default=[], help=f"of {', '.join(ALL)}"
    )
    parser.add_argument("--seconds", type=int, default=60, help="per target (default 60)")
    parser.add_argument("--jobs", type=int, default=1, help="targets at a time (default 1)")
    args = parser.parse_args(argv)
    if unknown := [name for name in args.targets if name not in ALL]:
        parser.error(f"no target {unknown[0]!r}; there are {', '.join(ALL)}")
    return args


def _fuzz(target: Target, seconds: int) -> Result:
    corpus, crashes = FOLDER / "corpus" / target.name, FOLDER / "crashes"
    corpus.mkdir(parents=True, exist_ok=True)
    crashes.mkdir(exist_ok=True)
    for i, seed in enumerate([*target.seeds(), *(p.read_bytes() for p in target.regressions)]):
        (corpus / f"seed-{i}").write_bytes(seed[: target.max_bytes])
    began_s = time.time()
    said = _run(target, [
        f"-max_total_time={seconds}",
        f"-max_len={target.max_bytes}",
        f"-timeout={MAX_INPUT_S}",
        f"-rss_limit_mb={MAX_RSS_MB}",
        f"-artifact_prefix={crashes}/{target.name}-",
        "-print_final_stats=1",
        *_dictionary(target),
        str(corpus),
    ], seconds + _GRACE_S)  # fmt: skip
    found = [
        path for path in crashes.glob(f"{target.name}-*") if path.stat().st_mtime >= began_s - 1
    ]
    return _result(target.name, said, sorted(found))


def _run(target: Target, flags: list[str], limit_s: int) -> str:
    """What the fuzzer says; a last line of ours if it did not end well."""
    command = [sys.executable, "-m", "fuzz.worker", target.name, *flags]
    try:
        done = subprocess.run(command, capture_output=True, timeout=limit_s, check=False)
    except subprocess.TimeoutExpired as error:
        return f"{(error.stderr or b'').decode(errors='replace')}\nEXIT: did not end in time"
    said = done.stderr.decode(errors="replace") + done.stdout.decode(errors="replace")
    return said if done.returncode == 0 else f"{said}\nEXIT: status {done.returncode}"


def _result(name: str, said: str, crashes: list[Path]) -> Result:
    last = re.findall(r"#\d+\s.*cov: (\d+).* corp: (\d+)/", said)
    edges, inputs = map(int, last[-1]) if last else (0, 0)
    failed = "\nEXIT: " in said
    return Result(
        target=name,
        executions=_stat("number_of_executed_units", said),
        per_second=_stat("average_exec_per_sec", said),
        edges=edges,
        inputs=inputs,
        peak_rss_mb=_stat("peak_rss_mb", said),
        crashes=crashes,
        failure=said[-1500:] if failed else "",
    )


def _stat(name: str, said: str) -> int:
    found = re.search(rf"stat::{name}:\s+(\d+)", said)
    return int(found[1]) if found else 0


def _dictionary(target: Target) -> list[str]:
    """libFuzzer's flag for the words of a format; it takes no empty file."""
    if not target.words:
        return []
    path = FOLDER / f"{target.name}.dict"
    path.write_text(
        "".join(json.dumps(word).replace("\\n", "\\x0A") + "\n" for word in target.words)
    )
    return [f"-dict={path}"]


_HEADER = """\
| target | executions | per second | edges | inputs kept | peak MB | crashes |
| --- | ---: | ---: | ---: | ---: | ---: | ---: |"""


def _row(result: Result) -> str:
    crashes = len(result.crashes) or int(not result.good)
    return (
        f"| {result.target} | {result.executions:,} | {result.per_second:,} | {result.edges:,} "
        f"| {result.inputs:,} | {result.peak_rss_mb} | {crashes} |"
    )


def _explain(result: Result) -> None:
    if result.good:
        return
    print(f"\n{result.target}:\n{result.failure}")
    for crash in result.crashes:
        print(f"again: PYTHONPATH=tests {sys.executable} -m fuzz.replay {result.target} {crash}")


if __name__ == "__main__":
    sys.exit(main())
