"""The model file: the shipped one runs, and anything else is refused in one line."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drives import shipped_predictor
from eqrt.core.errors import ContractError
from eqrt.core.scene import Scene
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Predictor, open_session
from eqrt.runtime.prediction.tensor_proto import parse_tensor, read_tensor
from processes import environment

VECTORS = sorted(DEFAULT_ARTIFACT.glob("test_data_set_*"))


# --- the model that ships


def test_every_stored_test_vector_comes_out_as_stored() -> None:
    """Within a millimetre: of one more processor, one more onnxruntime."""
    predictor = shipped_predictor()
    assert len(VECTORS) > 5
    for folder in VECTORS:
        names = list(predictor.contract.inputs)
        feed = {name: read_tensor(folder / f"input_{i}.pb") for i, name in enumerate(names)}
        prediction = predictor.predict(Scene(**feed, origin=np.zeros(2)))
        expected = read_tensor(folder / "output_0.pb")
        np.testing.assert_allclose(prediction.trajectories, expected, atol=1e-3)
        expected = read_tensor(folder / "output_1.pb")
        np.testing.assert_allclose(prediction.probabilities, expected, atol=1e-4)


def test_predictions_are_in_the_map_frame() -> None:
    """The tile frame's origin is put back in float64: far away, nothing is lost."""
    predictor = shipped_predictor()
    names = list(predictor.contract.inputs)
    feed = {name: read_tensor(VECTORS[0] / f"input_{i}.pb") for i, name in enumerate(names)}
    near = predictor.predict(Scene(**feed, origin=np.zeros(2))).trajectories
    origin = np.array([5_000_000.0, -3_000_000.0])
    far = predictor.predict(Scene(**feed, origin=origin)).trajectories
    np.testing.assert_allclose(far - origin, near, atol=1e-8)


def test_many_targets_are_predicted_as_each_alone() -> None:
    """However they are divided into runs: 37 targets, some of each kind."""
    predictor = shipped_predictor()
    names = list(predictor.contract.inputs)
    vectors = [[read_tensor(f / f"input_{i}.pb") for i in range(len(names))] for f in VECTORS]
    stacked = [np.concatenate(parts) for parts in zip(*vectors, strict=True)]
    rows = np.resize(np.arange(len(stacked[0])), 37)
    feed = {name: values[rows] for name, values in zip(names, stacked, strict=True)}
    together = predictor.predict(Scene(**feed, origin=np.zeros(2)))
    assert together.probabilities.shape == (37, predictor.contract.num_modes)
    for row in range(37):
        alone = {name: values[row : row + 1] for name, values in feed.items()}
        prediction = predictor.predict(Scene(**alone, origin=np.zeros(2)))
        np.testing.assert_allclose(
            prediction.trajectories[0], together.trajectories[row], atol=1e-3
        )


def test_the_model_is_known_by_its_checksum() -> None:
    content = (DEFAULT_ARTIFACT / "model.onnx").read_bytes()
    assert shipped_predictor().model_id == hashlib.sha256(content).hexdigest()[:8]


def test_a_predictor_needs_neither_torch_nor_onnx() -> None:
    """And says nothing while it loads."""
    program = (
        "import sys\n"
        "from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Predictor\n"
        "assert 'onnxruntime' not in sys.modules\n"
        "Predictor.load(DEFAULT_ARTIFACT)\n"
        "assert not {'torch', 'onnx'} & set(sys.modules)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=False,
        env=environment(),
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


# --- damaged ones


@pytest.fixture
def artifact(tmp_path: Path) -> Path:
    """A copy of the shipped artifact with one test vector."""
    folder = tmp_path / "model"
    shutil.copytree(VECTORS[0], folder / VECTORS[0].name)
    for name in ("model.onnx", "SHA256SUMS", "contract.json"):
        shutil.copy(DEFAULT_ARTIFACT / name, folder / name)
    return folder


def replace_in_model(folder: Path, old: bytes, new: bytes) -> None:
    """Something else of the same length, under a checksum that fits."""
    path = folder / "model.onnx"
    content = path.read_bytes()
    assert old in content
    assert len(old) == len(new)
    give_model(folder, content.replace(old, new))


def give_model(folder: Path, content: bytes) -> None:
    (folder / "model.onnx").write_bytes(content)
    (folder / "SHA256SUMS").write_text(f"{hashlib.sha256(content).hexdigest()}  model.onnx\n")


def no_model(folder: Path) -> None:
    (folder / "model.onnx").unlink()


def no_checksums(folder: Path) -> None:
    (folder / "SHA256SUMS").unlink()


def checksums_of_something_else(folder: Path) -> None:
    (folder / "SHA256SUMS").write_bytes(bytes(range(256)))


def one_bit_flipped(folder: Path) -> None:
    content = bytearray((folder / "model.onnx").read_bytes())
    content[len(content) // 2] ^= 0x10
    (folder / "model.onnx").write_bytes(content)


def half_a_model(folder: Path) -> None:
    content = (folder / "model.onnx").read_bytes()
    give_model(folder, content[: len(content) // 2])


def not_a_model(folder: Path) -> None:
    give_model(folder, b"GIF89a, not a model at all")


def nothing_in_it(folder: Path) -> None:
    give_model(folder, b"")


def another_kind_of_model(folder: Path) -> None:
    replace_in_model(folder, b"eqrt_contract", b"mood_contract")


def another_schema(folder: Path) -> None:
    replace_in_model(folder, b'"schema": 1', b'"schema": 7')


def another_contract(folder: Path) -> None:
    replace_in_model(folder, b'"num_agents": 16', b'"num_agents": 17')


def weights_in_another_file(folder: Path) -> None:
    """One more initializer, of which the file says only where it is; onnxruntime loads that."""
    location = b"\x0a\x08location\x12\x09other.bin"
    weights = b"\x08\x01" + b"\x10\x01" + b"\x42\x05extra" + b"\x6a\x15" + location + b"\x70\x01"
    graph = b"\x2a" + bytes([len(weights)]) + weights
    content = (folder / "model.onnx").read_bytes()
    give_model(folder, content + b"\x3a" + bytes([len(graph)]) + graph)
    open_session((folder / "model.onnx").read_bytes(), 1)


def no_vectors(folder: Path) -> None:
    shutil.rmtree(folder / VECTORS[0].name)


def half_a_vector(folder: Path) -> None:
    path = folder / VECTORS[0].name / "input_0.pb"
    path.write_bytes(path.read_bytes()[:-100])


def a_vector_of_another_shape(folder: Path) -> None:
    vector = folder / VECTORS[0].name
    shutil.copy(vector / "input_2.pb", vector / "input_3.pb")


def a_vector_of_another_truth(folder: Path) -> None:
    path = folder / VECTORS[0].name / "output_0.pb"
    content = bytearray(path.read_bytes())
    content[-1] ^= 0x80  # the sign of the last y
    path.write_bytes(content)


def a_vector_without_a_part(folder: Path) -> None:
    (folder / VECTORS[0].name / "output_1.pb").unlink()


DAMAGES: dict[Callable[[Path], None], str] = {
    no_model: r"model\.onnx: No such file or directory; a model is a folder with",
    no_checksums: r"SHA256SUMS: No such file or directory; a model is a folder with",
    checksums_of_something_else: r"SHA256SUMS says None.*copy it again",
    one_bit_flipped: r"its SHA-256 is \w{12}\.\.\., SHA256SUMS says \w{12}\.\.\..*damaged",
    half_a_model: r"onnxruntime \S+ cannot load it",
    not_a_model: r"onnxruntime \S+ cannot load it",
    nothing_in_it: r"onnxruntime \S+ cannot load it",
    another_kind_of_model: r"no 'eqrt_contract' metadata, so this is not an eqrt model",
    another_schema: r"schema 7 is not supported \(this runtime speaks 1\); re-export",
    another_contract: r"tensor 'history' is .* the contract says .*export the model again",
    weights_in_another_file: "the weights of 'extra' are in another file; export the model as one",
    no_vectors: r"no test_data_set_\*; export the model again",
    half_a_vector: r"input_0\.pb: not a float32 or bool tensor \(truncated\)",
    a_vector_of_another_shape: r"input_3\.pb: centerlines is .*, the contract says float32",
    a_vector_of_another_truth: r"the model's trajectories differ by .*not to be trusted",
    a_vector_without_a_part: r"output_1\.pb: No such file or directory; export the model again",
}


def test_an_undamaged_copy_is_as_good_as_the_original(artifact: Path) -> None:
    assert Predictor.load(artifact).model_id == shipped_predictor().model_id


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda damage: damage.__name__)
def test_a_damaged_artifact_is_refused_in_one_line(
    damage: Callable[[Path], None], artifact: Path
) -> None:
    damage(artifact)
    with pytest.raises(ContractError, match=DAMAGES[damage]) as caught:
        Predictor.load(artifact)
    assert str(artifact) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_is_not_an_artifact() -> None:
    with pytest.raises(ContractError, match="a model is a folder"):
        Predictor.load(DEFAULT_ARTIFACT / "model.onnx")


# --- tensors


def tensor(dims: list[int], data_type: int, raw: bytes) -> bytes:
    """A serialised TensorProto by hand: fields 1, 2 and 9 of small size."""
    fields = b"".join(bytes([0x08, size]) for size in dims)
    return fields + bytes([0x10, data_type, 0x4A, len(raw)]) + raw


def test_a_tensor_is_read_from_its_bytes() -> None:
    values = np.array([[1.5, -2.0, 0.25]], "<f4")
    np.testing.assert_array_equal(parse_tensor(tensor([1, 3], 1, values.tobytes())), values)
    flags = parse_tensor(tensor([2], 9, b"\x01\x00"))
    assert flags.dtype == np.bool_
    assert flags.tolist() == [True, False]


def test_sizes_may_be_packed_and_unknown_fields_are_skipped() -> None:
    """As other writers of protocol buffers do: sizes as one field, a name as field 8."""
    packed = b"\x0a\x02\x01\x02" + b"\x42\x04name" + b"\x10\x01\x4a\x08" + bytes(8)
    assert parse_tensor(packed).shape == (1, 2)


REFUSED = (ValueError, KeyError, IndexError)
HUGE = b"\x08\xff\xff\xff\xff\xff\xff\xff\xff\x7f"  # a size of 2^63 - 1


@pytest.mark.parametrize(
    "content",
    [
        b"",
        tensor([2], 1, bytes(4)),
        tensor([1], 7, bytes(8)),  # int64
        tensor([1], 1, bytes(4))[:-1],
        HUGE + tensor([0], 1, b""),
        b"\x08" + b"\xff" * 11 + b"\x01",
        b"\x0d\x00\x00\x00\x00" + tensor([1], 1, bytes(4)),  # a field of fixed 32 bits
        tensor([1] * 70, 1, bytes(4)),
    ],
)
def test_what_is_no_tensor_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "input_0.pb"
    path.write_bytes(content)
    with pytest.raises(ContractError, match="not a float32 or bool tensor"):
        read_tensor(path)


@given(st.binary(max_size=200))
def test_random_bytes_are_a_tensor_or_refused(content: bytes) -> None:
    refused_or_array(content)


@given(st.integers(0, 300), st.binary(min_size=1, max_size=10))
def test_a_tensor_with_some_bytes_overwritten_is_a_tensor_or_refused(at: int, noise: bytes) -> None:
    content = (VECTORS[0] / "output_0.pb").read_bytes()
    refused_or_array(content[:at] + noise + content[at + len(noise) :])


def refused_or_array(content: bytes) -> None:
    try:
        found = parse_tensor(content)
    except REFUSED:
        return
    assert found.nbytes <= len(content)
