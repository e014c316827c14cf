"""The runtimes: how each gets its environment, and how it is asked to check an artifact.

All but one do it with an example of deploy/examples: what the table says, a reader can run.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from browser import PROGRAMS, Browser
from conformance.environments import FOLDER, need, oldest_dependencies, python_with, run
from conformance.readme import README, served
from source_tree import ROOT

EXAMPLES = README.parent
PYTHON_EXAMPLE = EXAMPLES / "python/predict.py"
OLDEST_FOR_THE_FILE = ("onnxruntime==1.15.0", "numpy<2")
"""The oldest wheel for the oldest Python that eqrt supports."""
OLDEST_PYTHON = "3.11"
COLORS = {"history": "#333333", "truth": "#0072b2", "prediction": "#d55e00", "lanes": "#c9c9c9"}
"""What must be on the page's picture."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a runtime made of an artifact's test vectors."""

    good: bool
    worst_mm: float
    line: str
    """As the example printed it."""

    def __str__(self) -> str:
        return self.line


@dataclass(frozen=True, slots=True, kw_only=True)
class Runtime:
    """One row of the table."""

    name: str
    version: str
    how: str
    """In which language or surroundings."""
    check: Callable[[Path], Outcome]
    show: Callable[[Path], str] | None = None
    """What the example prints about the recorded scene, if this is the row to say it."""


def outcome_of(line: str) -> Outcome:
    """Read an example's line. Raises RuntimeError if it is another."""
    match = re.fullmatch(r"\S+: (\d+) vectors, worst (\S+) mm, (ok|FAILED)", line.strip())
    if match is None or match[1] == "0":
        raise RuntimeError(f"not what an example prints of its check: {line!r}")
    return Outcome(match[3] == "ok", float(match[2].replace("Infinity", "inf")), line.strip())


def all_runtimes() -> Iterator[Runtime]:
    """One after the other; a runtime may be used until the next one is asked for."""
    yield _onnxruntime("file-oldest", OLDEST_FOR_THE_FILE, "Python; eqrt itself needs a newer one")
    yield _onnxruntime("oldest", oldest_dependencies(), "Python; the oldest that eqrt supports")
    newest = EXAMPLES / "build/python/bin/python"
    yield _python(newest, "onnxruntime", "Python; the newest tried", PYTHON_EXAMPLE, scene=True)
    pins = ("-c", str(EXAMPLES / "constraints.txt"))
    reference = python_with("reference", [*pins, "onnx", "numpy"])
    program = ROOT / "tests/conformance/reference_evaluator.py"
    yield _python(reference, "onnx", "Python; the reference evaluator", program)
    yield _openvino()
    yield _node()
    yield from _browser()


def verify_with_the_oldest(artifact: Path) -> str:
    """`eqrt verify` with every dependency in the oldest version allowed: its last line."""
    python = python_with("oldest", oldest_dependencies(), OLDEST_PYTHON)
    done = subprocess.run(
        [python, "-m", "eqrt", "verify", artifact],
        env=os.environ | {"PYTHONPATH": str(ROOT / "runtime")},
        capture_output=True,
        text=True,
        check=False,
    )
    return (done.stdout + done.stderr).strip().splitlines()[-1]


def _onnxruntime(name: str, packages: tuple[str, ...] | list[str], how: str) -> Runtime:
    python = python_with(name, packages, OLDEST_PYTHON)
    return _python(python, "onnxruntime", how, PYTHON_EXAMPLE)


def _python(python: Path, package: str, how: str, program: Path, *, scene: bool = False) -> Runtime:
    version = f"import importlib.metadata as m; print(m.version({package!r}))"
    return _program(
        [str(python), str(program)],
        name=package,
        version=run([str(python), "-c", version]).strip(),
        how=how,
        scene=scene,
    )


def _openvino() -> Runtime:
    (metadata,) = (EXAMPLES / "build/openvino").glob("openvino-*.dist-info")
    version = metadata.name.removeprefix("openvino-").removesuffix(".dist-info")
    command = [str(EXAMPLES / "build/cpp/predict")]
    how = "C++, CPU; float32 must be asked for"
    return _program(command, name="OpenVINO", version=version, how=how, scene=True)


def _node() -> Runtime:
    command = ["node", str(EXAMPLES / "javascript/predict.mjs")]
    version = _npm_version("onnxruntime-node")
    return _program(command, name="onnxruntime-node", version=version, how="Node.js", scene=True)


def _browser() -> Iterator[Runtime]:
    need(*PROGRAMS)
    with served(README) as page, Browser() as browser:
        yield Runtime(
            name="onnxruntime-web",
            version=_npm_version("onnxruntime-web"),
            how="WebAssembly, one thread, in Chromium",
            check=lambda artifact: _check_page(browser, page, artifact),
            show=lambda artifact: _show_page(browser, page, artifact),
        )


def _program(command: list[str], *, name: str, version: str, how: str, scene: bool) -> Runtime:
    def check(artifact: Path) -> Outcome:
        done = subprocess.run(
            [*command, "--check", artifact],
            env=os.environ | {"PYTHONPATH": str(ROOT / "tests")},
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode not in (0, 1) or not done.stdout:
            raise RuntimeError(f"{' '.join(command)}: {done.stderr.strip()[-500:]}")
        outcome = outcome_of(done.stdout)
        if outcome.good != (done.returncode == 0):
            raise RuntimeError(f"{' '.join(command)}: {outcome.line}, status {done.returncode}")
        return outcome

    def show(artifact: Path) -> str:
        return run([*command, str(artifact), str(EXAMPLES / "scene.json")])

    return Runtime(name=name, version=version, how=how, check=check, show=show if scene else None)


def _check_page(browser: Browser, page: str, artifact: Path) -> Outcome:
    _open_page(browser, page, artifact)
    browser.click("#check")
    return outcome_of(browser.wait_for("#verdict", "vectors", "#error"))


def _show_page(browser: Browser, page: str, artifact: Path) -> str:
    """What the page says, once its picture shows everything."""
    said = _open_page(browser, page, artifact)
    browser.screenshot(FOLDER / f"page-{artifact.name}.png")
    for what, color in COLORS.items():
        if browser.evaluate(_HAS_COLOR % json.dumps(color)) is not True:
            raise RuntimeError(f"the page's picture shows no {what} ({color})")
    return said


def _open_page(browser: Browser, page: str, artifact: Path) -> str:
    browser.open(f"{page}?artifact=/{artifact.resolve().relative_to(ROOT)}")
    return browser.wait_for("#model", "on average", "#error")


_HAS_COLOR = """
const color = %s;
const canvas = document.querySelector("#picture");
const {data} = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
const wanted = [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16));
for (let i = 0; i < data.length; i += 4) {
  if (wanted.every((value, j) => data[i + j] === value) && data[i + 3] === 255) return true;
}
return false;
"""


def _npm_version(package: str) -> str:
    path = EXAMPLES / "javascript/node_modules" / package / "package.json"
    return str(json.loads(path.read_text(encoding="utf-8"))["version"])
