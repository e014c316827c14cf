"""`eqrt info`: one screen, read from the files alone."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import pytest

from eqrt.core.errors import ContractError
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT
from eqrt.runtime.verify import info
from handmade_model import write_handmade
from source_tree import ROOT

RESEARCH = ROOT / "deploy/models/eqrt-small-6"


def run(*arguments: str) -> int:
    parser = argparse.ArgumentParser()
    info.add_arguments(parser)
    return info.run(parser.parse_args(arguments))


def test_one_screen_says_what_the_shipped_model_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert run() == 0
    printed = capsys.readouterr().out
    for part in (
        "model     eqrt-free 2.",
        "CC-BY-SA-4.0",
        "parameters, ",
        "ONNX opset 18, IR 8, by eqrt, as SHA256SUMS lists it",
        "sizes     N 16, T 20, Q 6, L 21, H 30, K 1, dt 0.1 s",
        "lanes     routes",
        "history            float32  (B, 16, 20, 2)",
        "ADE 3 s",
    ):
        assert part in printed
    assert "NON-COMMERCIAL" not in printed
    assert printed.count("\n") < 50


def test_a_licence_that_forbids_commercial_use_is_said_plainly(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(str(RESEARCH)) == 0
    printed = capsys.readouterr().out
    assert "CC-BY-NC-SA-4.0 -- NON-COMMERCIAL: not for commercial use" in printed
    assert "in 6 modes" in printed


def test_json_holds_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(str(DEFAULT_ARTIFACT), "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["contract"]["num_agents"] == 16
    assert facts["inputs"]["history"] == ["float32", ["B", 16, 20, 2]]
    assert facts["as_listed"] is True
    assert len(facts["model_id"]) == 8


def test_an_artifact_with_nothing_but_its_model_can_be_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No card, no licence, no checksum that fits: each is said, none is an error."""
    folder = write_handmade(tmp_path / "handmade")
    (folder / "SHA256SUMS").write_text("")
    assert run(str(folder)) == 0
    printed = capsys.readouterr().out
    assert "licence   not stated" in printed
    assert "NOT as SHA256SUMS lists it" in printed
    assert "15 parameters, 18 nodes" in printed  # no card to count them
    assert "model card" not in printed


def test_what_is_no_model_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ContractError, match=r"model\.onnx: No such file or directory"):
        run(str(tmp_path))
    (tmp_path / "model.onnx").write_bytes(b"GIF89a, not a model")
    with pytest.raises(ContractError, match="not an ONNX file, or a damaged one"):
        run(str(tmp_path))
    (tmp_path / "model.onnx").write_bytes(b"")
    with pytest.raises(ContractError, match="not an eqrt model"):
        run(str(tmp_path))
