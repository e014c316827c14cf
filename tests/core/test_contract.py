"""A model contract survives its text, and a bad one is refused in one line."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest

from eqrt.core.contract import SCHEMA, ModelContract
from eqrt.core.errors import ContractError

CONTRACT = ModelContract(
    name="eqrt-test",
    version="1.2.3",
    num_agents=4,
    history_steps=20,
    num_centerlines=10,
    centerline_points=100,
    horizon_steps=30,
    num_modes=6,
    dt_s=0.1,
)
UNCERTAIN = replace(CONTRACT, covariances=True)
SIZES = (
    "num_agents",
    "history_steps",
    "num_centerlines",
    "centerline_points",
    "horizon_steps",
    "num_modes",
)


def refused(text: str) -> str:
    """The one line with which this contract is refused."""
    with pytest.raises(ContractError) as refusal:
        ModelContract.from_json(text, "model.onnx")
    message = str(refusal.value)
    assert "\n" not in message
    return message


def with_field(name: str, value: object) -> str:
    return json.dumps({**json.loads(CONTRACT.to_json()), name: value})


def test_a_contract_comes_back_from_its_json() -> None:
    assert ModelContract.from_json(CONTRACT.to_json(), "model.onnx") == CONTRACT


def test_the_json_says_sizes_units_and_frame_to_other_runtimes() -> None:
    values = json.loads(CONTRACT.to_json())
    assert values["schema"] == SCHEMA == 1
    assert values["units"]["position"] == "m"
    assert "tile" in values["units"]["frame"]
    assert values["inputs"]["history"] == {"type": "float32", "shape": ["B", 4, 20, 2]}
    assert values["outputs"]["trajectories"] == {"type": "float32", "shape": ["B", 6, 30, 2]}


def test_the_tensors_are_those_of_version_one() -> None:
    """Names, order, types and shapes are what every artifact and every other stack relies on."""
    assert list(CONTRACT.inputs.items()) == [
        ("history", ("float32", ("B", 4, 20, 2))),
        ("history_valid", ("bool", ("B", 4, 20))),
        ("heading", ("float32", ("B", 2))),
        ("centerlines", ("float32", ("B", 10, 100, 2))),
        ("centerlines_valid", ("bool", ("B", 10, 100))),
    ]
    assert list(CONTRACT.outputs.items()) == [
        ("trajectories", ("float32", ("B", 6, 30, 2))),
        ("probabilities", ("float32", ("B", 6))),
    ]


def test_a_model_that_knows_its_errors_has_a_third_output() -> None:
    assert list(UNCERTAIN.outputs.items()) == [
        *CONTRACT.outputs.items(),
        ("covariances", ("float32", ("B", 6, 30, 2, 2))),
    ]
    values = json.loads(UNCERTAIN.to_json())
    assert values["covariances"] is True
    assert values["units"]["covariance"] == "m^2"
    assert ModelContract.from_json(UNCERTAIN.to_json(), "model.onnx") == UNCERTAIN


def test_a_contract_from_before_covariances_has_none() -> None:
    values = json.loads(CONTRACT.to_json())
    del values["covariances"]
    assert ModelContract.from_json(json.dumps(values), "model.onnx") == CONTRACT


@pytest.mark.parametrize("value", [0, 1, "true", None, []])
def test_covariances_are_there_or_not(value: object) -> None:
    assert "covariances" in refused(with_field("covariances", value))


def test_only_the_batch_axis_is_dynamic() -> None:
    for _, shape in (*UNCERTAIN.inputs.values(), *UNCERTAIN.outputs.values()):
        assert shape[0] == "B"
        assert all(isinstance(size, int) for size in shape[1:])


def test_unknown_fields_of_a_later_minor_version_are_ignored() -> None:
    text = with_field("trained_on", "NGSIM")
    assert ModelContract.from_json(text, "model.onnx") == CONTRACT


@pytest.mark.parametrize("name", [*SIZES, "name", "version", "dt_s"])
def test_a_missing_field_is_named(name: str) -> None:
    values = json.loads(CONTRACT.to_json())
    del values[name]
    assert re.search(f"model.onnx.*{name}", refused(json.dumps(values)))


@pytest.mark.parametrize("name", SIZES)
@pytest.mark.parametrize("value", [0, -1, 1_000_000, 2.5, True, "20", None, [20]])
def test_a_size_that_cannot_be_is_refused(name: str, value: object) -> None:
    assert name in refused(with_field(name, value))


@pytest.mark.parametrize("value", [0, -0.1, 3600, float("nan"), float("inf"), "0.1", None, True])
def test_a_step_that_cannot_be_is_refused(value: object) -> None:
    assert "dt_s" in refused(with_field("dt_s", value))


@pytest.mark.parametrize("name", ["name", "version"])
def test_a_name_that_is_no_text_is_refused(name: str) -> None:
    assert name in refused(with_field(name, 1))


@pytest.mark.parametrize("schema", [0, 2, "1", None])
def test_another_schema_is_refused_with_what_to_do(schema: object) -> None:
    message = refused(with_field("schema", schema))
    assert str(schema) in message
    assert "re-export" in message


@pytest.mark.parametrize("text", ["", "{", "no json", '{"schema": 1,}'])
def test_what_is_no_json_is_refused(text: str) -> None:
    assert refused(text).startswith("model.onnx: the model contract is not JSON")


@pytest.mark.parametrize("text", ["[]", "1", '"text"', "null"])
def test_json_that_is_no_object_is_refused(text: str) -> None:
    assert refused(text) == "model.onnx: the model contract is not a JSON object"
