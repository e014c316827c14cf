"""Runs one stored input again: `python -m fuzz.replay TARGET FILE`; needs no atheris."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

from fuzz.targets import ALL


def main(arguments: list[str]) -> None:
    """Shows the traceback if the input still breaks something."""
    name, path = arguments
    warnings.simplefilter("error", RuntimeWarning)
    ALL[name].run(Path(path).read_bytes())
    print(f"{path}: nothing breaks")


if __name__ == "__main__":
    main(sys.argv[1:])
