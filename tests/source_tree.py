"""Where the sources under test stand."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCE_ROOTS = ("runtime", "training", "export")
WORKSTATION_PACKAGES = {
    "foxglove_schemas_protobuf",
    "lanelet2",
    "matplotlib",
    "onnx",
    "onnxscript",
    "rich",
    "rosbags",
    "safetensors",
    "torch",
    "websockets",
    "zenoh",
}
"""What the car must do without."""
VIEWER = "eqrt.runtime.view"
"""Ships to the car too, but needs the extra `view`."""


def modules_of_the_car() -> list[str]:
    """Every module that ships to the car and needs no extra, by its dotted name."""
    runtime = ROOT / "runtime"
    names = [
        path.relative_to(runtime).with_suffix("").as_posix().replace("/", ".")
        for path in sorted((runtime / "eqrt").rglob("*.py"))
        if path.name not in {"__init__.py", "__main__.py"}
    ]
    return [name for name in names if not name.startswith(f"{VIEWER}.")]
