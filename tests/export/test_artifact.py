"""The shipped file and freshly exported ones: clean, equivariant, refused when damaged."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnx.numpy_helper
import pytest
import torch

from eqrt.core.contract import METADATA_KEY, ModelContract
from eqrt.core.errors import ContractError, EqrtError
from eqrt.core.scene import Scene, concatenate
from eqrt.export.artifact import reference, write_artifact
from eqrt.export.to_onnx import FORBIDDEN_OPS, IR_VERSION, OPSET, to_onnx
from eqrt.export.vectors import move, named_scenes, nan_where_invalid
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Predictor, disagreement
from eqrt.training.checkpoint import Card
from eqrt.training.networks.compact import CompactConfig, CompactPredictor
from eqrt.training.networks.config import SceneConfig
from eqrt.training.networks.registry import ModelConfig
from poses import random_pose
from processes import files_of_at_most

SCENE = SceneConfig(
    num_agents=4,
    history_steps=20,
    num_centerlines=4,
    centerline_points=10,
    lane_choice="routes",
    horizon_steps=30,
    num_modes=3,
    dt_s=0.1,
)
NETWORK = CompactConfig(width=16, hidden=32, heads=2, layers=1, dropout=0.1)
CARD = Card(
    name="test",
    data="made up",
    license="Apache-2.0",
    non_commercial=True,
    metrics={"ade_3s": 1.0},
    baseline={"ade_3s": 2.0},
    command="eqrt train",
    config_sha256="0" * 64,
    parameters=12,
    steps=3,
    seed=1,
)


@pytest.fixture(scope="module")
def model() -> CompactPredictor:
    """Three modes, and random weights also where training starts from zero."""
    torch.manual_seed(5)
    model = CompactPredictor(SCENE, NETWORK).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return model


@pytest.fixture(scope="module")
def artifact(model: CompactPredictor, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export") / "artifact"
    assert write_artifact(model, SCENE.contract("test", "1.2.3"), CARD, folder) < 1e-3
    return folder


@pytest.fixture
def copy(artifact: Path, tmp_path: Path) -> Path:
    """An artifact that may be damaged."""
    return Path(shutil.copytree(artifact, tmp_path / "copy"))


@pytest.fixture(scope="module")
def shipped() -> Predictor:
    return Predictor.load(DEFAULT_ARTIFACT)


SHIPPED_SCENES = named_scenes(Predictor.load(DEFAULT_ARTIFACT).contract)


def uncertain_model(modes: int) -> tuple[CompactPredictor, ModelContract]:
    torch.manual_seed(6)
    config = ModelConfig(
        scene=replace(SCENE, num_modes=modes),
        kind="compact",
        network=replace(NETWORK, uncertainty=True),
    )
    model = CompactPredictor(config.scene, config.network).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return model, config.contract("uncertain", "1.0.0")


@pytest.fixture(scope="module")
def uncertain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An artifact of six modes with covariances."""
    folder = tmp_path_factory.mktemp("export") / "uncertain"
    model, contract = uncertain_model(6)
    card = replace(CARD, metrics={"ade_3s": 1.0, "nll": 2.5, "inside_50": 0.5, "inside_90": 0.9})
    assert write_artifact(model, contract, card, folder) < 1e-3
    return folder


def nan_free(scene: Scene) -> Scene:
    return replace(
        scene, history=np.nan_to_num(scene.history), centerlines=np.nan_to_num(scene.centerlines)
    )


@pytest.mark.parametrize("name", SHIPPED_SCENES)
def test_the_shipped_file_is_equivariant_within_a_millimetre(shipped: Predictor, name: str) -> None:
    """float32, anywhere within the kilometre of a tile, at any rotation."""
    rng = np.random.default_rng(11)
    scene = nan_free(SHIPPED_SCENES[name])
    before = shipped.predict(scene)
    for _ in range(50):
        pose = random_pose(rng, 250.0)
        after = shipped.predict(move(scene, pose))
        np.testing.assert_allclose(after.trajectories, pose.apply(before.trajectories), atol=1e-3)
        np.testing.assert_allclose(after.probabilities, before.probabilities, atol=1e-5)


@pytest.mark.parametrize("name", SHIPPED_SCENES)
def test_values_under_false_masks_change_no_bit_of_the_output(
    shipped: Predictor, name: str
) -> None:
    clean = shipped.predict(nan_free(SHIPPED_SCENES[name]))
    dirty = shipped.predict(nan_where_invalid(SHIPPED_SCENES[name]))
    np.testing.assert_array_equal(dirty.trajectories, clean.trajectories)


def test_one_poisoned_target_leaves_the_rest_of_the_batch_alone(shipped: Predictor) -> None:
    scene = SHIPPED_SCENES["driving"]
    poison = replace(scene, history=np.full_like(scene.history, np.inf))
    alone = shipped.predict(scene)
    together = shipped.predict(concatenate([poison, scene, poison]))
    np.testing.assert_allclose(together.trajectories[1:2], alone.trajectories, atol=1e-4)


def test_a_batch_is_its_targets_one_by_one(shipped: Predictor) -> None:
    scenes = [nan_free(scene) for scene in SHIPPED_SCENES.values()]
    together = shipped.predict(concatenate(scenes))
    for row, scene in enumerate(scenes):
        alone = shipped.predict(scene)
        np.testing.assert_allclose(together.trajectories[row], alone.trajectories[0], atol=1e-3)


def test_the_file_is_what_old_and_small_runtimes_load(artifact: Path) -> None:
    proto = onnx.load(artifact / "model.onnx")
    assert proto.ir_version == IR_VERSION
    assert {opset.domain: opset.version for opset in proto.opset_import} == {"": OPSET}
    assert not {node.op_type for node in proto.graph.node} & FORBIDDEN_OPS
    assert not any(tensor.external_data for tensor in proto.graph.initializer)


def test_what_depends_on_weights_alone_was_computed_when_exporting(artifact: Path) -> None:
    """Every operator has something of the scene to work on."""
    graph = onnx.load(artifact / "model.onnx").graph
    constant = {"", *(tensor.name for tensor in graph.initializer)}
    assert graph.node
    assert not [node.name for node in graph.node if constant.issuperset(node.input)]


@pytest.mark.parametrize("folder", [DEFAULT_ARTIFACT, None], ids=["shipped", "exported"])
def test_nothing_of_the_exporting_machine_is_in_the_file(
    folder: Path | None, artifact: Path
) -> None:
    content = ((folder or artifact) / "model.onnx").read_bytes()
    for trace in (b"/root", b"/home", b"site-packages", b".py", b"torch", b"Traceback"):
        assert trace not in content


def test_the_contract_is_in_the_file_and_beside_it(artifact: Path) -> None:
    proto = onnx.load(artifact / "model.onnx")
    inside = {entry.key: entry.value for entry in proto.metadata_props}
    beside = (artifact / "contract.json").read_text(encoding="utf-8")
    assert json.loads(inside[METADATA_KEY]) == json.loads(beside)
    contract = ModelContract.from_json(beside, "contract.json")
    assert contract == SCENE.contract("test", "1.2.3")
    assert inside["license"] == "Apache-2.0"
    assert inside["non_commercial"] == "true"


def test_the_runtime_says_when_a_model_may_not_be_sold(artifact: Path, shipped: Predictor) -> None:
    notice = Predictor.load(artifact).license_notice
    assert notice == "model licence: Apache-2.0, non-commercial (test)"
    assert shipped.license_notice is None


def test_the_same_network_exports_to_the_same_bytes(model: CompactPredictor) -> None:
    contract = SCENE.contract("test", "1.2.3")
    assert to_onnx(model, contract, {}) == to_onnx(model, contract, {})


def test_sha256sum_itself_accepts_the_checksums(artifact: Path) -> None:
    subprocess.run(["sha256sum", "--check", "--quiet", "SHA256SUMS"], cwd=artifact, check=True)


def test_test_vectors_are_what_the_reference_evaluator_computes(artifact: Path) -> None:
    """ONNX's own evaluator, which shares no code with onnxruntime."""
    from onnx.reference import ReferenceEvaluator

    evaluator = ReferenceEvaluator(onnx.load(artifact / "model.onnx"))
    for folder in sorted(artifact.glob("test_data_set_*")):
        names = list(SCENE.contract("test", "1.2.3").inputs)
        feed = dict(zip(names, stored(folder, "input", 5), strict=True))
        found = list(evaluator.run(None, feed))
        trajectories, probabilities = stored(folder, "output", 2)
        np.testing.assert_allclose(found[0], trajectories, atol=1e-3)
        np.testing.assert_allclose(found[1], probabilities, atol=1e-5)


def stored(vector: Path, side: str, count: int) -> list[np.ndarray]:
    """The tensors of one side of a test vector, in order."""
    paths = [vector / f"{side}_{index}.pb" for index in range(count)]
    return [onnx.numpy_helper.to_array(onnx.load_tensor(path)) for path in paths]


def test_covariances_are_the_third_output_of_an_artifact_that_has_them(
    uncertain: Path, shipped: Predictor
) -> None:
    predictor = Predictor.load(uncertain)
    model, contract = uncertain_model(6)
    assert predictor.contract == contract
    assert contract.covariances
    scene = named_scenes(contract)["driving"]
    found = predictor.predict(replace(scene, origin=np.array([4e6, -3e6])))
    assert found.covariances is not None
    assert found.covariances.dtype == np.float64
    expected = reference(model, scene)[2].astype(np.float64)
    assert disagreement("covariances", found.covariances, expected) < 1e-4
    assert shipped.predict(SHIPPED_SCENES["driving"]).covariances is None


def test_one_uncertain_mode_is_exported_like_six(tmp_path: Path) -> None:
    model, contract = uncertain_model(1)
    assert write_artifact(model, contract, CARD, tmp_path / "one") < 1e-3
    scene = concatenate(list(named_scenes(contract).values()))
    covariances = Predictor.load(tmp_path / "one").predict(scene).covariances
    assert covariances is not None
    assert covariances.shape == (len(scene.history), 1, 30, 2, 2)


def test_covariances_of_the_file_turn_with_the_world(uncertain: Path) -> None:
    predictor, rng = Predictor.load(uncertain), np.random.default_rng(12)
    for scene in named_scenes(predictor.contract).values():
        before = predictor.predict(nan_free(scene)).covariances
        pose = random_pose(rng, 250.0)
        after = predictor.predict(move(nan_free(scene), pose)).covariances
        assert before is not None
        assert after is not None
        turn = pose.rotate(np.eye(2)).T  # its columns are where x and y go
        assert disagreement("covariances", after, turn @ before @ turn.T) < 1e-2


def test_the_reference_evaluator_computes_the_same_covariances(uncertain: Path) -> None:
    from onnx.reference import ReferenceEvaluator

    contract = uncertain_model(6)[1]
    evaluator = ReferenceEvaluator(onnx.load(uncertain / "model.onnx"))
    folder = uncertain / "test_data_set_0"
    feed = dict(zip(contract.inputs, stored(folder, "input", 5), strict=True))
    found = list(evaluator.run(None, feed))
    assert disagreement("covariances", found[2], stored(folder, "output", 3)[2]) < 1e-3


def test_covariances_that_come_out_differently_are_refused(uncertain: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(uncertain, tmp_path / "copy"))
    path = copy / "test_data_set_0" / "output_2.pb"
    tensor = onnx.load_tensor(path)
    values = 1.01 * onnx.numpy_helper.to_array(tensor)
    path.write_bytes(onnx.numpy_helper.from_array(values, tensor.name).SerializeToString())
    with pytest.raises(ContractError, match=r"the model's covariances differ by 0\.0"):
        Predictor.load(copy)


def test_the_model_card_says_how_well_the_model_knows_its_errors(uncertain: Path) -> None:
    """Constant velocity does not say it, so its column stays empty."""
    card = (uncertain / "README.md").read_text(encoding="utf-8")
    assert "| NLL, nats | 2.500 |  |" in card
    assert "| truth inside the 90 % ellipse, share | 0.900 |  |" in card
    assert "| `covariances` | float32 | (B, 6, 30, 2, 2) |" in card


def test_the_model_card_says_whether_the_model_is_equivariant(
    artifact: Path, tmp_path: Path
) -> None:
    promise = "shifting that frame turns or shifts the prediction and nothing else"
    assert promise in (artifact / "README.md").read_text(encoding="utf-8")
    torch.manual_seed(5)
    upright = CompactPredictor(SCENE, replace(NETWORK, frame="translated")).eval()
    write_artifact(upright, SCENE.contract("upright", "1.0.0"), CARD, tmp_path / "upright")
    card = (tmp_path / "upright" / "README.md").read_text(encoding="utf-8")
    assert promise not in card
    assert re.search(r"the model is not equivariant: .* predicts up to \d", card)


def test_a_network_with_other_outputs_than_its_contract_is_not_exported(tmp_path: Path) -> None:
    model, contract = uncertain_model(1)
    certain = replace(contract, covariances=False)
    with pytest.raises(ValueError, match="the network has 3 outputs, the contract has trajec"):
        write_artifact(model, certain, CARD, tmp_path / "none")
    assert not list(tmp_path.iterdir())


def flip_a_bit(folder: Path) -> None:
    content = bytearray((folder / "model.onnx").read_bytes())
    content[len(content) // 2] ^= 4
    (folder / "model.onnx").write_bytes(content)


def cut_it_short(folder: Path) -> None:
    content = (folder / "model.onnx").read_bytes()
    (folder / "model.onnx").write_bytes(content[: len(content) // 2])


def remove_the_checksums(folder: Path) -> None:
    (folder / "SHA256SUMS").unlink()


def remove_the_model(folder: Path) -> None:
    (folder / "model.onnx").unlink()


def remove_the_vectors(folder: Path) -> None:
    for vector in folder.glob("test_data_set_*"):
        shutil.rmtree(vector)


def change_a_vector(folder: Path) -> None:
    path = folder / "test_data_set_0" / "output_0.pb"
    tensor = onnx.load_tensor(path)
    values = onnx.numpy_helper.to_array(tensor) + np.float32(0.01)
    path.write_bytes(onnx.numpy_helper.from_array(values, tensor.name).SerializeToString())


def sign(folder: Path) -> None:
    digest = hashlib.sha256((folder / "model.onnx").read_bytes()).hexdigest()
    (folder / "SHA256SUMS").write_text(f"{digest}  model.onnx\n", encoding="utf-8")


def put_something_else_there(folder: Path) -> None:
    (folder / "model.onnx").write_bytes(b"not a model at all")
    sign(folder)


def take_the_contract_out(folder: Path) -> None:
    proto = onnx.load(folder / "model.onnx")
    del proto.metadata_props[:]
    onnx.save(proto, folder / "model.onnx")
    sign(folder)


def speak_another_schema(folder: Path) -> None:
    proto = onnx.load(folder / "model.onnx")
    entry = next(e for e in proto.metadata_props if e.key == METADATA_KEY)
    entry.value = entry.value.replace('"schema": 1', '"schema": 2')
    onnx.save(proto, folder / "model.onnx")
    sign(folder)


def promise_other_sizes(folder: Path) -> None:
    proto = onnx.load(folder / "model.onnx")
    entry = next(e for e in proto.metadata_props if e.key == METADATA_KEY)
    entry.value = entry.value.replace('"num_agents": 4', '"num_agents": 5')
    onnx.save(proto, folder / "model.onnx")
    sign(folder)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (flip_a_bit, "is damaged"),
        (cut_it_short, "is damaged"),
        (remove_the_checksums, "SHA256SUMS"),
        (remove_the_model, "No such file"),
        (remove_the_vectors, "no test_data_set"),
        (change_a_vector, "differ by 0.01"),
        (put_something_else_there, "cannot load it"),
        (take_the_contract_out, "not an eqrt model"),
        (speak_another_schema, "schema 2 is not supported"),
        (promise_other_sizes, "'history'"),
    ],
)
def test_a_damaged_artifact_is_refused_in_one_line(copy: Path, damage, said: str) -> None:  # type: ignore[no-untyped-def]
    damage(copy)
    with pytest.raises(ContractError) as refused:
        Predictor.load(copy)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_failed_export_leaves_the_old_artifact_alone(
    model: CompactPredictor, copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = (copy / "SHA256SUMS").read_bytes()
    monkeypatch.setattr("eqrt.export.artifact.AGREEMENT_M", -1.0)  # nothing agrees that well
    with pytest.raises(EqrtError, match="differ"):
        write_artifact(model, SCENE.contract("test", "2.0.0"), CARD, copy, "Other weights.")
    assert (copy / "SHA256SUMS").read_bytes() == before
    assert sorted(path.name for path in copy.parent.iterdir()) == [copy.name]


def test_an_export_that_the_disk_does_not_take_leaves_the_old_artifact_alone(
    model: CompactPredictor, copy: Path
) -> None:
    before = (copy / "SHA256SUMS").read_bytes()
    contract = SCENE.contract("test", "2.0.0")
    cannot = rf"{copy.name}: cannot be written \(File too large\)"
    with files_of_at_most(1 << 10), pytest.raises(EqrtError, match=cannot):
        write_artifact(model, contract, CARD, copy, "Other weights.")
    assert (copy / "SHA256SUMS").read_bytes() == before
    assert sorted(path.name for path in copy.parent.iterdir()) == [copy.name]


def test_the_folder_of_a_training_is_not_exported_over(
    model: CompactPredictor, tmp_path: Path
) -> None:
    (tmp_path / "model.safetensors").write_text("precious")
    with pytest.raises(EqrtError, match="not empty, and not an artifact; choose another --out"):
        write_artifact(model, SCENE.contract("test", "1.0.0"), CARD, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["model.safetensors"]


def test_exporting_to_a_link_replaces_what_it_leads_to(
    model: CompactPredictor, copy: Path, tmp_path: Path
) -> None:
    (tmp_path / "current").symlink_to(copy.name)
    contract = SCENE.contract("test", "1.3.0")
    write_artifact(model, contract, CARD, tmp_path / "current", "Nothing.")
    assert (tmp_path / "current").is_symlink()
    assert Predictor.load(copy).contract.version == "1.3.0"
