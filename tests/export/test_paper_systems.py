"""The paper's seven systems as ONNX files: the same answers, for any batch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from torch import nn

from eqrt.core.scene import concatenate
from eqrt.export.artifact import AGREEMENT_M, reference
from eqrt.export.to_onnx import to_onnx
from eqrt.export.vectors import nan_where_invalid
from eqrt.training.networks.eqmotion import EqMotionConfig
from eqrt.training.networks.lstm import LstmConfig
from paper_systems import SCENE, SCENES, SYSTEMS, nan_free, small_system

CONTRACT = SCENE.contract("test", "0.0.0")


@pytest.fixture(scope="module", params=SYSTEMS)
def pair(request: pytest.FixtureRequest) -> tuple[nn.Module, bytes]:
    """A network, and the file made from it."""
    model = small_system(one_layer(SYSTEMS[request.param]))
    return model, to_onnx(model, CONTRACT, {})


def one_layer(config: EqMotionConfig | LstmConfig) -> EqMotionConfig | LstmConfig:
    """The exporter's time goes by the number of nodes, and every layer has the same."""
    return config if isinstance(config, LstmConfig) else replace(config, layers=1)


def session(content: bytes) -> ort.InferenceSession:
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    return ort.InferenceSession(content, options, providers=["CPUExecutionProvider"])


def test_the_file_answers_as_the_network_does(pair: tuple[nn.Module, bytes]) -> None:
    model, content = pair
    run = session(content)
    for name, scene in SCENES.items():
        found = run.run(None, dict(scene.inputs()))
        trajectories, probabilities = reference(model, scene)
        np.testing.assert_allclose(found[0], trajectories, atol=AGREEMENT_M, rtol=0, err_msg=name)
        np.testing.assert_allclose(found[1], probabilities, atol=1e-5)


def test_a_batch_of_any_size_is_its_scenes_one_by_one(pair: tuple[nn.Module, bytes]) -> None:
    run = session(pair[1])
    scenes = [nan_free(scene) for scene in SCENES.values()]
    alone = [run.run(None, dict(scene.inputs()))[0][0] for scene in scenes]
    together, probabilities = run.run(None, dict(concatenate(scenes).inputs()))
    np.testing.assert_allclose(together, alone, atol=AGREEMENT_M, rtol=0)
    assert probabilities.shape == (len(scenes), 1)


def test_nan_under_false_masks_changes_no_bit(pair: tuple[nn.Module, bytes]) -> None:
    run = session(pair[1])
    for scene in SCENES.values():
        clean = run.run(None, dict(nan_free(scene).inputs()))[0]
        dirty = run.run(None, dict(nan_where_invalid(scene).inputs()))[0]
        np.testing.assert_array_equal(dirty, clean)


def test_the_file_has_the_contracts_inputs_also_those_it_does_not_read(
    pair: tuple[nn.Module, bytes],
) -> None:
    graph = onnx.load_from_string(pair[1]).graph
    assert [value.name for value in graph.input] == list(CONTRACT.inputs)


def test_several_modes_export_in_order() -> None:
    scene = replace(SCENE, num_modes=3)
    model = small_system(one_layer(SYSTEMS["no_map"]), scene)
    run = session(to_onnx(model, scene.contract("test", "0.0.0"), {}))
    found = run.run(None, dict(SCENES["driving"].inputs()))
    trajectories, probabilities = reference(model, SCENES["driving"])
    np.testing.assert_allclose(found[0], trajectories, atol=AGREEMENT_M, rtol=0)
    np.testing.assert_allclose(found[1], probabilities, atol=1e-5)
