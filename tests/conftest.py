"""Which tests can run where.

The environment of the car has neither torch nor onnx: what is built with them is tested on the
workstation only, and the rest in both (`make test` sets up and uses the two).
"""

from __future__ import annotations

from importlib.util import find_spec

if not (find_spec("torch") and find_spec("onnx")):
    collect_ignore = ["documentation", "export", "packaging", "training"]
