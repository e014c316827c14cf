"""`python -m socketcan COMMAND...`: run a command where there are real SocketCAN buses.

vcan0 and vcan1 are up; the command may write to a fresh folder, in which it starts.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from socketcan.vcan import NoCanKernelError, find_launcher

TIMEOUT_S = 600.0


def main() -> int:
    """The command's own exit status; what it printed comes at its end."""
    if not sys.argv[1:]:
        print(__doc__, file=sys.stderr)
        return 2
    try:
        launcher = find_launcher()
    except NoCanKernelError as error:
        print(f"socketcan: {error}", file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory() as folder:
        done = launcher(sys.argv[1:], Path(folder), TIMEOUT_S)
    print(done.stdout, end="")
    print(done.stderr, end="", file=sys.stderr)
    return done.status


if __name__ == "__main__":
    sys.exit(main())
