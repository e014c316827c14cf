"""`eqrt verify`: what keeps the contract passes, whoever made it; what does not is told why."""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from eqrt.core.errors import EqrtError, UsageError
from eqrt.core.frames import Pose2
from eqrt.runtime.prediction.model_file import parse_model_file
from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT, Prediction
from eqrt.runtime.prediction.protobuf import fields
from eqrt.runtime.verify import command
from eqrt.runtime.verify.behaviour import MIN_VECTORS
from eqrt.runtime.verify.check import Check, Result
from eqrt.runtime.verify.command import Report, render, verify
from eqrt.runtime.verify.compare import differences
from eqrt.runtime.verify.files import check_files
from eqrt.runtime.verify.predictions import turned
from handmade_model import (
    CONTRACT,
    MADE_VECTORS,
    contract_with,
    external_tensor,
    sign,
    with_initializer,
    write_handmade,
)
from processes import environment, files_of_at_most
from source_tree import ROOT

RESEARCH = ROOT / "deploy/models/eqrt-small-6"


@pytest.fixture
def handmade(tmp_path: Path) -> Path:
    """A small artifact that keeps the contract, and may be damaged."""
    return write_handmade(tmp_path / "handmade")


def check(report: Report, name: str) -> Check:
    return next(check for check in report.checks if check.name == name)


def failed(report: Report) -> set[str]:
    return {check.name for check in report.checks if check.result is Result.FAILED}


# --- what keeps the contract


@pytest.mark.parametrize("folder", [DEFAULT_ARTIFACT, RESEARCH], ids=lambda path: path.name)
def test_our_own_artifacts_are_verified(folder: Path) -> None:
    report = verify(folder)
    assert report.verified, render(report)
    assert render(report).endswith("verified: all 16 checks passed (seed 1)")


def test_an_artifact_that_others_made_for_the_contract_is_verified(handmade: Path) -> None:
    report = verify(handmade, seed=9)
    assert report.verified, render(report)
    assert report.name == "handmade 0.1.0"


def test_the_same_seed_finds_the_same(handmade: Path) -> None:
    assert verify(handmade, seed=4) == verify(handmade, seed=4)


def test_verifying_needs_neither_torch_nor_onnx() -> None:
    program = (
        "import sys\n"
        "from eqrt.runtime.prediction.predictor import DEFAULT_ARTIFACT\n"
        "from eqrt.runtime.verify.command import verify\n"
        "assert verify(DEFAULT_ARTIFACT).verified\n"
        "assert not {'torch', 'onnx'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, env=environment())


# --- promises that are broken: one flaw each


@pytest.mark.parametrize(
    ("flaw", "name", "line"),
    [
        ("wind", "equivariance", r"turned by .* degrees and shifted by .* m: trajectories differ"),
        ("batch", "batch", r"in a batch of \d+: trajectories differ by"),
        ("second agent", "order of neighbours", r"trajectories differ by .* m, allowed 0.001"),
        ("first line", "order of lines", r"trajectories differ by .* m, allowed 0.001"),
        (
            "measured",
            "heading",
            r"heading 210 degrees: trajectories differ by .* m, allowed 0.001",
        ),
        ("unmasked", "padding", r"nan under False masks changes the prediction, allowed is no bit"),
        ("not finite", "finite", "standing: trajectories are not finite"),
        ("random", "determinism", "the second run differs from the first, allowed is no bit"),
    ],
)
def test_a_broken_promise_is_found(flaw: str, name: str, line: str, tmp_path: Path) -> None:
    found = check(verify(write_handmade(tmp_path / "flawed", flaw=flaw)), name)
    assert found.result is Result.FAILED
    assert any(matches(line, failure) for failure in found.failures), found.failures[:3]
    assert not any("\n" in failure for failure in found.failures)


def matches(pattern: str, text: str) -> bool:
    return re.search(pattern, text) is not None


def test_a_model_that_does_not_turn_with_the_world_is_called_that(tmp_path: Path) -> None:
    report = verify(write_handmade(tmp_path / "flawed", flaw="wind"))
    assert failed(report) == {"equivariance"}
    assert check(report, "equivariance").figure.startswith("not equivariant: 2 m")


def test_the_order_of_lines_may_matter_where_the_contract_sorts_them(tmp_path: Path) -> None:
    """The paper's systems read the lines side by side, the nearest first."""
    nearest = replace(CONTRACT, lane_choice="nearest")
    report = verify(write_handmade(tmp_path / "n", flaw="first line", contract=nearest))
    assert check(report, "order of lines").result is Result.NOTED
    assert check(report, "order of lines").figure.startswith("depends on it: ")


def test_probabilities_must_add_up(tmp_path: Path) -> None:
    report = verify(write_handmade(tmp_path / "unsure", sure=0.9))
    assert failed(report) == {"finite"}
    assert (
        "plain: probabilities add up to 0.9, allowed 1 +- 0.0001"
        in check(report, "finite").failures
    )


def test_a_graph_for_one_batch_size_breaks_the_contract(tmp_path: Path) -> None:
    report = verify(write_handmade(tmp_path / "one", batch=1))
    assert "contract" in failed(report)
    assert "input 'history' takes 1 targets only, not any B" in render(report)
    assert "onnxruntime failed on" in check(report, "batch").failures[0]


def test_versions_that_some_runtime_cannot_load_are_refused(tmp_path: Path) -> None:
    report = verify(write_handmade(tmp_path / "new", opset=19, ir_version=9))
    assert failed(report) == {"format"}
    assert "IR version 9, allowed 1 to 8" in render(report)
    assert "opset 19, allowed 17 or 18" in render(report)


# --- damaged folders


def flip(path: Path, at: int, bit: int) -> None:
    content = bytearray(path.read_bytes())
    content[at] ^= 1 << bit
    path.write_bytes(content)


def one_bit_flipped(folder: Path) -> None:
    flip(folder / "model.onnx", 1000, 3)


def cut_short(folder: Path) -> None:
    path = folder / "model.onnx"
    path.write_bytes(path.read_bytes()[:1500])
    sign(folder)


def nothing_in_it(folder: Path) -> None:
    (folder / "model.onnx").write_bytes(b"")
    sign(folder)


def no_model(folder: Path) -> None:
    (folder / "model.onnx").unlink()


def swapped(folder: Path) -> None:
    shutil.copy(DEFAULT_ARTIFACT / "model.onnx", folder / "model.onnx")
    sign(folder)


def swapped_for_one_of_the_same_contract(folder: Path) -> None:
    other = write_handmade(folder.parent / "other", flaw="wind")
    shutil.copy(other / "model.onnx", folder / "model.onnx")
    sign(folder)


def another_contract_version(folder: Path) -> None:
    path = folder / "model.onnx"
    path.write_bytes(path.read_bytes().replace(b'"schema": 1', b'"schema": 2'))
    sign(folder)


def another_contract_beside(folder: Path) -> None:
    text = contract_with(CONTRACT, dt_s=0.2)
    (folder / "contract.json").write_text(text, encoding="utf-8")
    sign(folder)


def no_contract_beside(folder: Path) -> None:
    (folder / "contract.json").unlink()
    sign(folder)


def a_wrong_checksum(folder: Path) -> None:
    flip(folder / "SHA256SUMS", 5, 0)


def no_checksums(folder: Path) -> None:
    (folder / "SHA256SUMS").unlink()


def a_checksum_of_a_file_elsewhere(folder: Path) -> None:
    with (folder / "SHA256SUMS").open("a", encoding="utf-8") as sums:
        sums.write(f"{'0' * 64}  ../../etc/passwd\n")


def a_file_too_many(folder: Path) -> None:
    (folder / "setup.exe").write_bytes(b"MZ")


def a_vector_is_gone(folder: Path) -> None:
    (folder / "test_data_set_3" / "output_1.pb").unlink()
    sign(folder)


def few_vectors(folder: Path) -> None:
    for index in range(MIN_VECTORS - 1, MADE_VECTORS):
        shutil.rmtree(folder / f"test_data_set_{index}")
    sign(folder)


def weights_elsewhere(folder: Path) -> None:
    path = folder / "model.onnx"
    path.write_bytes(with_initializer(path.read_bytes(), external_tensor("w", "/etc/hostname")))
    sign(folder)


def a_path_of_its_maker(folder: Path) -> None:
    (folder / "README.md").write_text("trained in /home/jane/runs\n", encoding="utf-8")
    sign(folder)


DAMAGES: dict[Callable[[Path], None], tuple[str, str]] = {
    one_bit_flipped: ("files", r"model\.onnx: its SHA-256 is \w{12}\.\.\., SHA256SUMS says"),
    cut_short: ("format", r"not an ONNX file, or a damaged one \(truncated\); copy it again"),
    nothing_in_it: ("format", r"IR version 0, allowed 1 to 8"),
    no_model: ("files", r"model\.onnx'?: No such file or directory, but listed"),
    swapped: ("contract", r"contract\.json: name is 'handmade', model\.onnx says 'eqrt-free'"),
    swapped_for_one_of_the_same_contract: ("loads", r"the model's trajectories differ by"),
    another_contract_version: ("contract", r"contract schema 2 is not supported"),
    another_contract_beside: ("contract", r"contract\.json: dt_s is 0\.2, model\.onnx says 0\.1"),
    no_contract_beside: ("contract", r"contract\.json: No such file or directory"),
    a_wrong_checksum: ("files", r"SHA256SUMS says|SHA256SUMS, line 1"),
    no_checksums: ("files", r"SHA256SUMS: No such file or directory"),
    a_checksum_of_a_file_elsewhere: ("files", r"'\.\./\.\./etc/passwd' lies outside the folder"),
    a_file_too_many: ("files", r"setup\.exe: there, but not listed in SHA256SUMS"),
    a_vector_is_gone: ("test vectors", r"output_1\.pb: No such file or directory"),
    few_vectors: ("test vectors", r"19 test vectors, allowed at least 20"),
    weights_elsewhere: ("format", r"the values of tensor 'w' lie in another file"),
    a_path_of_its_maker: ("host paths", r"README\.md: holds the path of a machine, /home/j"),
}


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda damage: damage.__name__)
def test_a_damaged_artifact_is_refused_with_a_reason(
    damage: Callable[[Path], None], handmade: Path
) -> None:
    damage(handmade)
    report = verify(handmade)
    name, reason = DAMAGES[damage]
    assert not report.verified
    assert any(matches(reason, line) for line in check(report, name).failures), render(report)
    assert "NOT VERIFIED: " in render(report)


def test_no_flipped_bit_is_accepted(tmp_path: Path) -> None:
    """1,000 at random places of the shipped artifact: half in the model, half in anything else."""
    folder = Path(shutil.copytree(DEFAULT_ARTIFACT, tmp_path / "copy"))
    rng = np.random.default_rng(12)
    others = sorted(path for path in folder.rglob("*") if path.is_file())
    for trial in range(1_000):
        path = folder / "model.onnx" if trial % 2 else others[rng.integers(len(others))]
        at, bit = int(rng.integers(path.stat().st_size)), int(rng.integers(8))
        flip(path, at, bit)
        assert check_files(folder).result is Result.FAILED, (path, at, bit)
        flip(path, at, bit)
    assert check_files(folder).result is Result.OK


def test_the_vectors_find_broken_weights_under_a_new_checksum(tmp_path: Path) -> None:
    """The highest bit of an exponent: most weights become 1e38 times as large."""
    folder = Path(shutil.copytree(DEFAULT_ARTIFACT, tmp_path / "copy"))
    whole = (folder / "model.onnx").read_bytes()
    rng = np.random.default_rng(13)
    refused = 0
    for at in rng.choice(places_of_weights(whole), 6, replace=False):
        (folder / "model.onnx").write_bytes(whole)
        flip(folder / "model.onnx", int(at) + 3, 6)
        sign(folder)
        refused += not verify(folder).verified
    assert refused >= 5


def places_of_weights(model: bytes) -> NDArray[np.intp]:
    """Where the numbers of the largest initializer begin, those between 0.01 and 1 in size."""
    graph = nested(model, 7)[0]
    stored = [bytes(raw) for tensor in nested(graph, 5) for raw in nested(tensor, 9)]
    largest = max(stored, key=len)
    size = np.abs(np.frombuffer(largest, "<f4"))
    return np.asarray(model.index(largest) + 4 * np.flatnonzero((size > 0.01) & (size < 1.0)))


def nested(message: bytes | memoryview, wanted: int) -> list[memoryview]:
    found = (value for number, value in fields(message) if number == wanted)
    return [value for value in found if isinstance(value, memoryview)]


# --- comparing


def test_modes_of_equal_probability_may_change_places() -> None:
    left, right = np.zeros((1, 1, 5, 2)), np.ones((1, 1, 5, 2))
    even, uneven = np.array([[0.5, 0.5]], np.float32), np.array([[0.6, 0.4]], np.float32)
    one, other = np.concatenate([left, right], 1), np.concatenate([right, left], 1)
    (same,) = differences(["even"], Prediction(one, even), Prediction(other, even))
    (swapped_,) = differences(["uneven"], Prediction(one, uneven), Prediction(other, uneven))
    assert same.failures == []
    assert swapped_.failures == ["uneven: trajectories differ by 1 m, allowed 0.001 m"]


def test_covariances_turn_with_the_world() -> None:
    """A car whose place is unsure by 3 m along x is unsure along y after a quarter turn."""
    along_x = np.array([[9.0, 0.0], [0.0, 1.0]]).reshape(1, 1, 1, 2, 2)
    prediction = Prediction(np.zeros((1, 1, 1, 2)), np.ones((1, 1), np.float32), along_x)
    after = turned(prediction, Pose2(5.0, 0.0, np.pi / 2))
    assert after.covariances is not None
    np.testing.assert_allclose(after.covariances[0, 0, 0], [[1.0, 0.0], [0.0, 9.0]], atol=1e-12)
    (found,) = differences(["turned"], after, turned(prediction, Pose2(5.0)))
    assert found.failures == ["turned: covariances differ by a share of 0.889, allowed 0.01"]


def test_nonsense_is_not_excused_by_its_size() -> None:
    far = Prediction(np.full((1, 1, 5, 2), 1e30), np.ones((1, 1), np.float32))
    (found,) = differences(["far"], far, Prediction(far.trajectories * 1.001, far.probabilities))
    assert found.allowed_m < 2e-3


# --- the command


def run(*arguments: str) -> int:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.run(parser.parse_args(arguments))


def test_the_command_prints_a_table_and_a_verdict(
    handmade: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(str(handmade), "--json", str(tmp_path / "report.json")) == 0
    printed = capsys.readouterr().out
    assert "\nequivariance         ok" in printed
    assert printed.endswith("verified: all 16 checks passed (seed 1)\n")
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["verified"] is True
    assert {check["result"] for check in report["checks"]} == {"ok", "note"}


def test_the_status_is_1_if_anything_failed(
    handmade: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a_file_too_many(handmade)
    assert run(str(handmade), "--json", str(tmp_path / "report.json")) == 1
    assert "NOT VERIFIED: 1 of 16 checks failed" in capsys.readouterr().out
    assert json.loads((tmp_path / "report.json").read_text())["verified"] is False


def test_findings_that_do_not_fit_on_the_disk_are_printed_and_the_old_file_stays(
    handmade: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = tmp_path / "report.json"
    report.write_text("yesterday's")
    with files_of_at_most(1 << 10), pytest.raises(EqrtError, match="File too large"):
        run(str(handmade), "--json", str(report))
    assert "verified: all 16 checks passed" in capsys.readouterr().out
    assert report.read_text() == "yesterday's"


def test_what_is_no_folder_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(EqrtError, match="no such folder; an artifact is one"):
        run(str(tmp_path / "nothing"))


def test_a_seed_below_zero_is_refused() -> None:
    with pytest.raises(UsageError, match="--seed is -1; give 0 or more"):
        run("--seed", "-1")


def test_a_model_file_is_read_without_the_onnx_package(handmade: Path) -> None:
    model = parse_model_file((handmade / "model.onnx").read_bytes())
    assert list(model.inputs) == list(CONTRACT.inputs)
    assert model.inputs["history"] == ("float32", ("B", 3, 5, 2))
    assert (model.ir_version, model.opsets, model.external) == (8, {"": 18}, [])
