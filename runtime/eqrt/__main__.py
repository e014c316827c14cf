"""`python -m eqrt` is the `eqrt` command."""

import sys

from eqrt.cli import main

sys.exit(main())
