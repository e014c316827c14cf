"""Where the sources under test stand."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCE_ROOTS = ("runtime", "training", "export")
WORKSTATION_PACKAGES = {
    "lanelet2",
    "matplotlib",
    "onnx",
    "onnxscript",
    "rich",
    "safetensors",
    "torch",
}
"""What the car must do without."""


def modules_of_the_car() -> list[str]:
    """Every module that ships to the car, by its dotted name."""
    runtime = ROOT / "runtime"
    return [
        path.relative_to(runtime).with_suffix("").as_posix().replace("/", ".")
        for path in sorted((runtime / "eqrt").rglob("*.py"))
        if path.name not in {"__init__.py", "__main__.py"}
    ]
