"""The example `deploy/examples/python/predict.py`, which is a program and in no package."""

from __future__ import annotations

import importlib.util

from source_tree import ROOT

PATH = ROOT / "deploy/examples/python/predict.py"

_spec = importlib.util.spec_from_file_location("eqrt_python_example", PATH)
assert _spec is not None
assert _spec.loader is not None
_module = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_module)

compare = _module.compare
main = _module.main
pack = _module.pack
read_contract = _module.read_contract
read_tensor = _module.read_tensor
