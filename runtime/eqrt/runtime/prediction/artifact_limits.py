"""How large the files of an artifact may be; a larger one is refused before it is read."""

from __future__ import annotations

MAX_MODEL_BYTES = 1 << 28
"""Of model.onnx: 256 MiB, a hundred times what ships, and far beyond what two cores can run."""
MAX_TENSOR_BYTES = 1 << 26
"""Of a file of a test vector: 64 MiB, a hundred times that of 1,000 targets."""
MAX_TENSOR_AXES = 8
"""The contract's tensors have five at most."""
MAX_TEXT_BYTES = 1 << 20
"""Of SHA256SUMS, contract.json, README.md, name.txt: the longest of them has some 20 KiB."""
