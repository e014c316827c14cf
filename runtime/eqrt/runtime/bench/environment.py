"""What figures hold for: processor, cores, kernel, versions, model."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from eqrt.core.errors import UsageError
from eqrt.runtime.bench.cooling import cooling

_FLAGS = re.compile(r"(avx2|fma|f16c|avx512\w*|avx_vnni|amx\w*|asimd\w*|sve\w*|i8mm|bf16)")
_CPU = Path("/sys/devices/system/cpu")


@dataclass(frozen=True, slots=True, kw_only=True)
class Environment:
    """The machine and the software on it."""

    cpu: str
    flags: tuple[str, ...]
    """Of the instruction set, those that matrix code uses."""
    cores_present: int
    cores_allowed: tuple[int, ...]
    governor: str | None
    """Of the clock frequency; None where the kernel does not say."""
    hypervisor: bool
    kernel: str
    python: str
    numpy: str
    onnxruntime: str
    eqrt: str
    cooling: float | None = None
    """`eqrt.runtime.bench.cooling`; None in a report from before it was measured."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelIdentity:
    """Which model was measured."""

    name: str
    version: str
    sha256: str
    """Of `model.onnx`."""


def require_linux() -> None:
    """Raises UsageError elsewhere."""
    if sys.platform != "linux":
        raise UsageError("eqrt bench reads /proc, so it needs Linux; measure on the target")


def read_environment() -> Environment:
    """Of this process, now."""
    cpu, flags, hypervisor = parse_cpuinfo(Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    cores = allowed_cores()
    return Environment(
        cpu=cpu or platform.machine(),
        flags=flags,
        cores_present=os.cpu_count() or 1,
        cores_allowed=cores,
        governor=_line(_CPU / f"cpu{cores[0]}/cpufreq/scaling_governor"),
        hypervisor=hypervisor,
        kernel=platform.release(),
        python=platform.python_version(),
        numpy=importlib.metadata.version("numpy"),
        onnxruntime=importlib.metadata.version("onnxruntime"),
        eqrt=importlib.metadata.version("eqrt"),
        cooling=cooling(),
    )


def parse_cpuinfo(text: str) -> tuple[str, tuple[str, ...], bool]:
    """Name, the flags that matter, and whether there is a hypervisor, from /proc/cpuinfo."""
    fields = {
        key.strip(): value.strip()
        for key, colon, value in (line.partition(":") for line in text.splitlines())
        if colon
    }
    flags = fields.get("flags", fields.get("Features", "")).split()
    matter = tuple(flag for flag in flags if _FLAGS.fullmatch(flag))
    return fields.get("model name", fields.get("Model", "")), matter, "hypervisor" in flags


def allowed_cores() -> tuple[int, ...]:
    """The cores that this process may run on."""
    return tuple(sorted(os.sched_getaffinity(0)))


def allow_cores(cores: Iterable[int]) -> None:
    """Stay on these cores, and all processes started from now on. Raises UsageError."""
    try:
        os.sched_setaffinity(0, cores)
    except (OSError, ValueError) as error:
        raise UsageError(
            f"--cpus {','.join(map(str, cores))}: not cores of this machine that may be used; "
            f"these may: {','.join(map(str, allowed_cores()))}"
        ) from error


def parse_cores(text: str) -> tuple[int, ...]:
    """`0,2-3` -> (0, 2, 3). Raises UsageError."""
    cores: set[int] = set()
    for part in text.split(","):
        found = re.fullmatch(r"(\d{1,4})(?:-(\d{1,4}))?", part.strip())
        if not found or int(found[2] or found[1]) < int(found[1]):
            raise UsageError(f"--cpus {text!r}: give cores as in 0 or 0,2-3")
        cores.update(range(int(found[1]), int(found[2] or found[1]) + 1))
    return tuple(sorted(cores))


def _line(path: Path) -> str | None:
    try:
        return path.read_text(encoding="ascii").strip()
    except OSError:
        return None
