"""The model file, checked and run. The only module that knows onnxruntime.

An artifact is a folder (docs/design.md): `model.onnx`, `SHA256SUMS`, test vectors. Its checksum is
compared before the file is parsed (onnxruntime loads most files with a flipped bit, and some of
those predict something else), then a stored test vector is run.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from eqrt.core.contract import METADATA_KEY, ModelContract
from eqrt.core.errors import ContractError
from eqrt.core.files import read_at_most
from eqrt.core.scene import Scene
from eqrt.runtime.prediction.artifact_limits import MAX_MODEL_BYTES, MAX_TEXT_BYTES
from eqrt.runtime.prediction.model_file import parse_model_file
from eqrt.runtime.prediction.stored_vectors import read_vector, vector_folders

if TYPE_CHECKING:
    import onnxruntime

DEFAULT_ARTIFACT = Path(__file__).parent / "models" / "eqrt-free"
"""The model that ships with eqrt."""
SELF_CHECK_M = 1e-3
"""A test vector must come back within a millimetre (`disagreement`)."""
MAX_BATCH = 16
"""Targets per run: memory stays bounded however many there are, and nothing gets slower."""


@dataclass(frozen=True, slots=True)
class Prediction:
    """Trajectories of B targets."""

    trajectories: NDArray[np.float64]
    """(B, K, H, 2) metres, map frame, most probable mode first."""
    probabilities: NDArray[np.float32]
    """(B, K)"""
    covariances: NDArray[np.float64] | None = None
    """(B, K, H, 2, 2) square metres, map frame; None from a model that predicts none."""


class Predictor:
    """An artifact, loaded and proven by its own test vector."""

    def __init__(
        self,
        session: onnxruntime.InferenceSession,
        contract: ModelContract,
        sha256: str,
        metadata: Mapping[str, str],
    ) -> None:
        self._session = session
        self._loaded_from: tuple[Path, int] | None = None
        self.contract = contract
        self._outputs = list(contract.outputs)
        self.model_id = sha256[:8]
        """First digits of the model file's SHA-256: which model made a prediction."""
        self.license = metadata.get("license", "")
        """Of the weights; empty where the file does not say."""
        self.non_commercial = metadata.get("non_commercial") == "true"
        """Whether the data it was trained on forbids commercial use."""

    @classmethod
    def load(cls, folder: Path, threads: int = 1) -> Self:
        """Check and load an artifact.

        Raises ContractError if a file is missing or damaged, the model has weights in other files,
        the contract is another version, the graph's tensors differ from it, or the test vector
        comes out differently.
        """
        content = _read_checked(folder)
        session = _session(content, folder, threads)
        _check_self_contained(content, folder)
        metadata = session.get_modelmeta().custom_metadata_map
        text = metadata.get(METADATA_KEY)
        if text is None:
            raise ContractError(
                f"{folder / 'model.onnx'}: no {METADATA_KEY!r} metadata, so this is not an eqrt "
                f"model; `eqrt export` writes one"
            )
        contract = ModelContract.from_json(text, str(folder / "model.onnx"))
        _check_tensors(session, contract, folder)
        sha256 = hashlib.sha256(content).hexdigest()
        predictor = cls(session, contract, sha256, metadata)
        predictor._loaded_from = folder, threads
        predictor._self_check(folder)
        return predictor

    def predict(self, scene: Scene) -> Prediction:
        """Predict all targets of the scene, at least one."""
        found = dict(zip(self._outputs, self._run(scene.inputs()), strict=True))
        covariances = found.get("covariances")  # the map frame's axes are the tile's
        return Prediction(
            found["trajectories"] + scene.origin,
            found["probabilities"],
            None if covariances is None else covariances.astype(np.float64),
        )

    def _run(self, inputs: Mapping[str, NDArray[Any]]) -> list[NDArray[np.float32]]:
        """The outputs, MAX_BATCH targets at a time."""
        targets = len(inputs["history"])
        if targets <= MAX_BATCH:
            only: list[NDArray[np.float32]] = self._session.run(self._outputs, inputs)
            return only
        runs = [
            self._session.run(
                self._outputs, {name: rows[at : at + MAX_BATCH] for name, rows in inputs.items()}
            )
            for at in range(0, targets, MAX_BATCH)
        ]
        return [np.concatenate(parts) for parts in zip(*runs, strict=True)]

    def again(self) -> Predictor:
        """The same artifact, loaded anew. Raises ContractError, as `load` does."""
        if self._loaded_from is None:
            raise ContractError(f"{self.contract.name}: not loaded from an artifact")
        return Predictor.load(*self._loaded_from)

    @property
    def license_notice(self) -> str | None:
        """The line to print when the weights may not be used commercially, else None."""
        if not self.non_commercial:
            return None
        return f"model licence: {self.license}, non-commercial ({self.contract.name})"

    def _self_check(self, folder: Path) -> None:
        vectors = vector_folders(folder)
        if not vectors:
            raise ContractError(f"{folder}: no test_data_set_*; export the model again")
        vector = read_vector(vectors[0], self.contract)
        found = self._session.run(self._outputs, vector.scene.inputs())
        for (name, expected), value in zip(vector.outputs.items(), found, strict=True):
            error = disagreement(name, value, expected)
            if not error <= SELF_CHECK_M:
                raise ContractError(
                    f"{vectors[0]}: the model's {name} differ by {error:.4g} from the stored ones "
                    f"(allowed {SELF_CHECK_M}); this file or this onnxruntime is not to be trusted"
                )


def disagreement(name: str, found: NDArray[Any], expected: NDArray[Any]) -> float:
    """How far an output tensor is from what it should be; infinite if the shapes differ.

    Metres for `trajectories`, probability for `probabilities`. A covariance may be many square
    metres: its difference is taken as a share of the expected one, or of 1 m^2 if that is more.
    """
    if found.shape != expected.shape:
        return np.inf
    with np.errstate(invalid="ignore", over="ignore"):  # a damaged vector may hold anything
        difference = np.abs(found - expected)
        if name == "covariances":
            largest = np.abs(expected).max(axis=(-2, -1), keepdims=True)
            difference = difference / np.maximum(largest, 1.0)
        return float(difference.max())


def _read_checked(folder: Path) -> bytes:
    """The bytes of `model.onnx`, after comparing them with SHA256SUMS."""
    try:
        content = read_at_most(MAX_MODEL_BYTES, folder / "model.onnx")
        sums = read_at_most(MAX_TEXT_BYTES, folder / "SHA256SUMS").decode("utf-8", "replace")
    except OSError as error:
        raise ContractError(
            f"{error.filename}: {error.strerror}; a model is a folder with model.onnx and "
            f"SHA256SUMS, as `eqrt export` writes it"
        ) from error
    listed = {line[66:]: line[:64] for line in sums.splitlines()}  # the format of sha256sum
    found = hashlib.sha256(content).hexdigest()
    if listed.get("model.onnx") != found:
        raise ContractError(
            f"{folder / 'model.onnx'}: its SHA-256 is {found[:12]}..., SHA256SUMS says "
            f"{str(listed.get('model.onnx'))[:12]}...; the file is damaged: copy it again"
        )
    return content


def open_session(
    content: bytes, threads: int, *, profile: Path | None = None, prepack: bool = True
) -> onnxruntime.InferenceSession:
    """A model file's bytes as the car runs them; raises whatever onnxruntime does.

    `profile`: what the name of a file of the time in every node begins with, written when the
    session's `end_profiling` is called. `prepack`: bring weights into the order they are used in.
    """
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"  # read when onnxruntime is first imported
    import onnxruntime  # noqa: PLC0415 (so that the line above comes first)

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.disable_prepacking", "0" if prepack else "1")
    options.log_severity_level = 3
    if profile is not None:
        options.enable_profiling = True
        options.profile_file_prefix = str(profile)
    session = onnxruntime.InferenceSession(
        content,
        options,
        providers=["CPUExecutionProvider"],
        disabled_optimizers=["SkipLayerNormFusion"],  # slower on a CPU than Add + LayerNorm
    )
    session._model_bytes = None  # the whole file, kept to begin anew elsewhere than on the CPU
    return session


def _session(content: bytes, folder: Path, threads: int) -> onnxruntime.InferenceSession:
    try:
        return open_session(content, threads)
    except Exception as error:  # onnxruntime raises its own classes, with no common base
        import onnxruntime  # noqa: PLC0415 (as above)

        first_line = str(error).splitlines()[0]
        raise ContractError(
            f"{folder / 'model.onnx'}: onnxruntime {onnxruntime.__version__} cannot load it "
            f"({first_line})"
        ) from error


def _check_self_contained(content: bytes, folder: Path) -> None:
    """Weights in other files, which onnxruntime would read, are not covered by the checksum."""
    path = folder / "model.onnx"
    try:
        external = parse_model_file(content).external
    except (ValueError, IndexError, RecursionError) as error:
        raise ContractError(
            f"{path}: cannot tell what is in it ({error}); copy it again"
        ) from error
    if external:
        raise ContractError(
            f"{path}: the weights of {external[0]!r} are in another file; export the model as one"
        )


def _check_tensors(session: Any, contract: ModelContract, folder: Path) -> None:
    found = {t.name: (t.type, t.shape) for t in [*session.get_inputs(), *session.get_outputs()]}
    for name, (kind, shape) in (contract.inputs | contract.outputs).items():
        onnx_kind = f"tensor({'float' if kind == 'float32' else kind})"
        actual = found.pop(name, None)
        fits = actual is not None and actual[0] == onnx_kind and list(actual[1][1:]) == [*shape[1:]]
        if not fits:
            raise ContractError(
                f"{folder / 'model.onnx'}: tensor {name!r} is {actual}, the contract says "
                f"{onnx_kind} {list(shape)}; export the model again"
            )
    if found:
        raise ContractError(
            f"{folder / 'model.onnx'}: tensor {next(iter(found))!r} is not in the contract"
        )
