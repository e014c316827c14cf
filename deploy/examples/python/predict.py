"""Predict a recorded scene with an eqrt artifact: numpy and onnxruntime, no eqrt.

python predict.py ARTIFACT SCENE.json   print where everybody will be
python predict.py --check ARTIFACT...   run the artifact's test vectors; status 1 if one is missed
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Run = Callable[[Mapping[str, Array]], Sequence[Array]]
"""Inputs by name -> outputs in the contract's order."""

LIMIT_M = 1e-3
"""How far a position may be from the stored one."""
PROBABILITY, COVARIANCE = 1e-4, 1e-3
"""Likewise; covariances as a share of the largest, or of 1 m^2."""


def main(arguments: Sequence[str], load: Callable[[Path], Run] | None = None) -> int:
    """`load` makes another runtime of it than onnxruntime."""
    load = load or load_onnxruntime
    match arguments:
        case ["--check", *artifacts] if artifacts:
            return max([check(Path(artifact), load) for artifact in artifacts])
        case [artifact, scene] if not artifact.startswith("-"):
            return show(Path(artifact), Path(scene), load)
    print(__doc__, file=sys.stderr)
    return 2


def load_onnxruntime(artifact: Path) -> Run:
    """The model in onnxruntime."""
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"  # read when onnxruntime is imported
    import onnxruntime  # noqa: PLC0415 (so that the line above comes first)

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # small models gain nothing from more
    session = onnxruntime.InferenceSession(
        str(artifact / "model.onnx"), options, providers=["CPUExecutionProvider"]
    )
    names = list(read_contract(artifact)["outputs"])
    return lambda inputs: session.run(names, dict(inputs))


def read_contract(artifact: Path) -> Any:
    """Sizes, units, and the tensors' names in order."""
    return json.loads((artifact / "contract.json").read_text(encoding="utf-8"))


# --- a scene: tracks and lanes become tensors, tensors become trajectories


def show(artifact: Path, path: Path, load: Callable[[Path], Run]) -> int:
    """Print where the targets of the scene are predicted to be."""
    contract, scene = read_contract(artifact), json.loads(path.read_text(encoding="utf-8"))
    trajectories, probabilities = load(artifact)(pack(scene, contract))[:2]
    for target, modes, shares in zip(scene["targets"], trajectories, probabilities, strict=True):
        x, y = scene["agents"][target["agent"]][-1]
        print(f"agent {target['agent']} at ({x:.2f}, {y:.2f})")
        for mode, share in zip(modes, shares, strict=True):
            print(f"  {share:4.0%}" + "".join(places(mode, contract["dt_s"])))
        print(missed_by(modes[0], target["future"]))
    return 0


def pack(scene: Any, contract: Any) -> dict[str, Array]:
    """The scene as the five inputs, sized for the model. What is not seen stays False."""
    if abs(scene["dt_s"] - contract["dt_s"]) > 1e-6:
        raise SystemExit(f"a step is {scene['dt_s']} s, the model wants {contract['dt_s']} s")
    tensors = {
        name: np.zeros(
            (len(scene["targets"]), *spec["shape"][1:]), np.dtype(spec["type"].replace("bool", "?"))
        )
        for name, spec in contract["inputs"].items()
    }
    steps, points = contract["history_steps"], contract["centerline_points"]
    for b, target in enumerate(scene["targets"]):
        for n, agent in enumerate(nearest(scene["agents"], target["agent"])):
            if n < contract["num_agents"]:
                recent = scene["agents"][agent][-steps:]
                fill(tensors, "history", (b, n), [None] * (steps - len(recent)) + recent)
        for q, line in enumerate(target["centerlines"][: contract["num_centerlines"]]):
            fill(tensors, "centerlines", (b, q), resampled(line, points))
        tensors["heading"][b] = target["heading"]
    return tensors


def nearest(agents: Any, target: int) -> list[int]:
    """Indices of all agents: the target, then the others by their distance from it now."""
    now = np.array([agent[-1] for agent in agents])
    return [int(i) for i in np.argsort(((now - now[target]) ** 2).sum(axis=1), kind="stable")]


def resampled(line: Any, count: int) -> list[Any]:
    """`count` points at equal distances over the whole line; None where it is not known."""
    places = np.linspace(0.0, len(line) - 1.0, count)
    return [between(line[int(at)], line[int(np.ceil(at))], at % 1.0) for at in places]


def between(a: Any, b: Any, share: float) -> Any:
    """The place a share of the way from a to b, if both are known."""
    return None if a is None or b is None else np.array(a) * (1 - share) + np.array(b) * share


def fill(tensors: Mapping[str, Array], name: str, row: tuple[int, int], places: Any) -> None:
    """Write places, and which of them are known, into `name` and its mask."""
    for i, place in enumerate(places):
        if place is not None:
            tensors[name][(*row, i)] = place
            tensors[f"{name}_valid"][(*row, i)] = True


def places(mode: Array, dt_s: float) -> Iterator[str]:
    """A third and two thirds of the way, and the end."""
    for part in (1, 2, 3):
        step = max(1, len(mode) * part // 3)
        x, y = mode[step - 1]
        yield f"  {step * dt_s:.1f} s ({x:.2f}, {y:.2f})"


def missed_by(mode: Array, future: Any) -> str:
    """How far the last position that is known was from the one predicted."""
    last = min(len(mode), len(future)) - 1
    x, y = future[last]
    return f"  was at ({x:.2f}, {y:.2f}): {np.hypot(*(mode[last] - future[last])):.2f} m away"


# --- the artifact's test vectors


def check(artifact: Path, load: Callable[[Path], Run]) -> int:
    """Compare every test vector; 0 if all come out as stored."""
    contract = read_contract(artifact)
    run = load(artifact)
    folders = sorted(artifact.glob("test_data_set_*"))
    worst, good = 0.0, bool(folders)
    for folder in folders:
        inputs = {n: read_tensor(folder, "input", i) for i, n in enumerate(contract["inputs"])}
        expected = [read_tensor(folder, "output", i) for i in range(len(contract["outputs"]))]
        apart_m, agrees = compare(run(inputs), expected)
        worst, good = max(worst, apart_m), good and agrees
    verdict = "ok" if good else "FAILED"
    print(f"{contract['name']}: {len(folders)} vectors, worst {1e3 * worst:.4f} mm, {verdict}")
    return 0 if good else 1


def read_tensor(folder: Path, side: str, index: int) -> Array:
    """A serialised TensorProto of float32 or bool: dims (1), data_type (2), raw_data (9)."""
    content = (folder / f"{side}_{index}.pb").read_bytes()
    dims: list[int] = []
    kind, raw, at = 0, b"", 0
    while at < len(content):
        key, at = varint(content, at)
        value, at = varint(content, at)  # of a field of bytes, its length
        field, is_bytes = key >> 3, key & 7 == 2
        data, at = (content[at : at + value], at + value) if is_bytes else (b"", at)
        if field == 1:
            dims += [value] if not is_bytes else list(packed(data))
        elif field == 2:
            kind = value
        elif field == 9:
            raw = data
    return np.frombuffer(raw, {1: "<f4", 9: "?"}[kind]).reshape(dims)


def packed(content: bytes) -> Iterator[int]:
    """Numbers one after the other."""
    at = 0
    while at < len(content):
        value, at = varint(content, at)
        yield value


def varint(content: bytes, at: int) -> tuple[int, int]:
    """A number of protocol buffers at `at`, and where the next thing begins."""
    value = shift = 0
    while True:
        byte, at = content[at], at + 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7


def compare(found: Sequence[Array], expected: Sequence[Array]) -> tuple[float, bool]:
    """How far positions are apart, metres, and whether all outputs agree.

    Modes that are as probable as each other may change places.
    """
    if [a.shape for a in found] != [b.shape for b in expected]:
        return np.inf, False
    if not all(np.isfinite(a).all() for a in [*found, *expected]):
        return np.inf, False
    worst, good = 0.0, True
    for b, shares in enumerate(expected[1]):
        free = set(range(len(shares)))
        for k, share in enumerate(shares):
            level = [m for m in free if abs(found[1][b, m] - share) <= PROBABILITY]
            apart = {m: float(np.abs(found[0][b, m] - expected[0][b, k]).max()) for m in level}
            mode = min(apart, key=lambda m: apart[m], default=k)
            free.discard(mode)
            worst = max(worst, float(np.abs(found[0][b, mode] - expected[0][b, k]).max()))
            good = good and bool(apart) and covariances_agree(found, expected, b, mode, k)
    return worst, good and worst <= LIMIT_M


def covariances_agree(
    found: Sequence[Array], expected: Sequence[Array], b: int, mode: int, k: int
) -> bool:
    """Of one mode, if the model gives any: the third output."""
    for mine, theirs in zip(found[2:], expected[2:], strict=True):
        scale = np.maximum(np.abs(theirs[b, k]).max(axis=(-2, -1), keepdims=True), 1.0)
        if (np.abs(mine[b, mode] - theirs[b, k]) / scale).max() > COVARIANCE:
            return False
    return True


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
