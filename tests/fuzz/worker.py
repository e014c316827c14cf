"""Fuzzes one target with atheris: `python -m fuzz.worker NAME FLAGS...`, libFuzzer's flags."""

from __future__ import annotations

import logging
import sys
import warnings

import atheris

_INSTRUMENTED = ["eqrt", "can", "cantools", "textparser", "tomllib", "argparse", "mcap"]


def main(arguments: list[str]) -> None:
    """Runs until the flags say to end, or something breaks; then the process ends."""
    name, *flags = arguments
    with atheris.instrument_imports(include=_INSTRUMENTED):
        import cantools.database.can.formats.dbc  # noqa: F401  # eqrt imports these late
        import mcap.stream_reader  # noqa: F401

        from fuzz.targets import ALL  # instrumented while it is imported
    logging.disable()  # python-can prints what it does not understand
    warnings.simplefilter("error", RuntimeWarning)
    target = ALL[name]
    atheris.Setup([sys.argv[0], *flags], target.run)
    atheris.Fuzz()


if __name__ == "__main__":
    main(sys.argv[1:])
