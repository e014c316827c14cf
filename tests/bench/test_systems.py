"""`make systems-table`, with one small system, and what it keeps of errors."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import onnx
import pytest

from bench.systems.accuracy import Errors, read_errors
from bench.systems.chosen import NAIVE, SHIPPED, all_systems, config_name, folder_name
from bench.systems.exports import export
from bench.systems.origin import is_made_by, origin_of
from bench.systems.pages import ALL, DOCS, EXPORTS, between_markers, left_out, naive_table, plot
from bench.systems.run import CONFIGS, compare, export_all, settings
from eqrt.runtime.bench.side_by_side.report import SideBySide, markdown
from tiny_training import tiny_file

TINY = "tiny"
SECTIONS = ("Trained on 80 % of the packed Argoverse 1 scenes", "The paper's seven systems")
"""Of docs/results.md: their tables are of the same targets."""


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One layer of a network that reads what the shipped one reads, exported in both ways."""
    folder = tmp_path_factory.mktemp("systems")
    sizes = (
        ("num_agents", 3, 16),
        ("num_centerlines", 2, 6),
        ("centerline_points", 8, 21),
        ("width", 16, 96),  # torch.onnx.export folds what is smaller
        ("hidden", 32, 192),
    )
    config = tiny_file(folder, *((f"{n} = {old}", f"{n} = {new}") for n, old, new in sizes))
    for name in (TINY, TINY + NAIVE):
        export(name, config, folder / folder_name(name))
    return folder


def test_the_naive_export_is_the_same_network_left_as_it_is(models: Path) -> None:
    """`export` has compared both files with the network; what eqrt would fold is still there."""
    ours, naive = (
        onnx.load(models / folder_name(name) / "model.onnx").graph for name in (TINY, TINY + NAIVE)
    )
    assert len(naive.node) > len(ours.node)
    assert [one.name for one in naive.input] == [one.name for one in ours.input]
    assert any(node.doc_string or node.metadata_props for node in naive.node)


def test_a_file_is_kept_as_long_as_what_it_is_made_by(models: Path) -> None:
    config, file = models / "tiny.toml", models / TINY / "model.onnx"
    assert is_made_by(origin_of(TINY, config), models / TINY)
    before = file.stat().st_mtime_ns
    export_all([TINY], models, models)
    assert file.stat().st_mtime_ns == before
    config.write_text(config.read_text("utf-8").replace("layers = 1", "layers = 2"), "utf-8")
    assert not is_made_by(origin_of(TINY, config), models / TINY)


@pytest.fixture(scope="module")
def found(models: Path) -> SideBySide:
    kept = read_errors()
    shipped = kept.models[SHIPPED]
    errors = Errors({SHIPPED: shipped, TINY: kept.models["eqrt-small"]}, kept.physics, {})
    return compare([TINY, TINY + NAIVE], models, errors, settings((2,), 0.3))


def test_all_are_measured_in_turns_and_stand_in_the_tables(found: SideBySide) -> None:
    names = [SHIPPED, TINY, TINY + NAIVE, "constant velocity", "constant turn rate"]
    for case in found.cases:
        assert [load.name for load in case.workloads] == [*names, "Kalman filter"]
        assert len({load.samples for load in case.workloads}) == 1
    rows = {line.split(" | ")[0]: line for line in markdown(found).splitlines()}
    assert rows[f"| {TINY + NAIVE}"].endswith("| 1.582 | 3.507 |")
    assert rows["| Kalman filter"].endswith("| 2.492 | 5.675 |")
    assert "paper-7-rotated-cnn." in left_out(found)
    head, _, row, *_ = (line.split(" | ") for line in naive_table(found).splitlines())
    assert len(row) == len(head)
    cells = dict(zip(head, row, strict=True))
    nodes = cells["nodes: naive"], row[head.index("nodes: naive") + 1]
    assert nodes == tuple(f"{model.nodes:,}" for model in found.models[:0:-1])
    place = head.index("2 targets, p50 ms: naive")
    naive_ms, ours_ms, ratio = (float(cell.strip("| ")) for cell in row[place : place + 3])
    assert ratio == pytest.approx(naive_ms / ours_ms, rel=0.02)


def test_the_plot_has_all_but_naive_files(found: SideBySide) -> None:
    root = ElementTree.fromstring(plot(found))
    texts = {part.text for part in root if part.tag.endswith("text")}
    assert {SHIPPED, TINY, "constant velocity", "ms, 2 targets, p50"} <= texts
    assert TINY + NAIVE not in texts


@pytest.mark.parametrize(("page", "name"), [ALL, EXPORTS])
def test_a_table_is_written_between_its_markers_and_nothing_else_changes(
    page: str, name: str
) -> None:
    before = (DOCS / page).read_text(encoding="utf-8")
    after = between_markers(DOCS / page, name, "| a table |")
    assert f"<!-- {name} -->\n| a table |\n\n<!-- end of the {name} -->" in after
    ends = f"<!-- {name} -->", f"<!-- end of the {name} -->"
    assert after.partition(ends[0])[0] == before.partition(ends[0])[0]
    assert after.partition(ends[1])[2] == before.partition(ends[1])[2]
    with pytest.raises(ValueError, match="has no markers"):
        between_markers(DOCS / page, "nothing", "")


# --- errors


def test_kept_errors_are_those_of_the_page() -> None:
    """Every row of the page's tables on these targets, and no other."""
    kept = {row: (one.ade_m, one.fde_m) for row, one in read_errors().rows.items()}
    assert kept == dict(rows_of_the_page())


def test_every_system_has_a_configuration_and_errors() -> None:
    configs = {config_name(name) for name in all_systems()}
    assert set(read_errors().models) == {SHIPPED, *configs}
    assert [name for name in configs if not (CONFIGS / f"{name}.toml").exists()] == []


def rows_of_the_page() -> set[tuple[str, tuple[float, float]]]:
    """First cell, ADE and FDE after 3 s, of each row that was measured."""
    found = set()
    text = (DOCS / "results.md").read_text(encoding="utf-8")
    for title in SECTIONS:
        section = text.partition(f"## {title}\n")[2].partition("\n## ")[0]
        lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in section.splitlines()]
        head: list[str] = []
        for cells in lines:
            head = cells if "ADE 3 s" in cells else head if cells else []
            if head and cells is not head and not set(cells[0]) <= {"-"}:
                errors = dict(zip(head, cells, strict=True))
                if errors["ADE 3 s"] and not cells[0].startswith("aim"):
                    found.add((cells[0], (float(errors["ADE 3 s"]), float(errors["FDE 3 s"]))))
    return found
