"""Every command in README.md, docs/ and deploy/ is run, or listed with the reason why it is not."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from documentation import workshop, world
from documentation.pages import Command, commands_of, pages
from documentation.rules import CHANGES, ENDINGS, HARMLESS, LIKEWISE, NOT_RUN, NotRun
from eqrt import cli
from source_tree import ROOT

ALL = [command for page in pages() for command in commands_of(page)]
BEFORE = (  # what a page takes for granted, made once
    "eqrt train --config training/configs/eqrt-free.toml --data DATA --out made --steps 2",
    "eqrt export made/model.safetensors --out made/artifact",
    "eqrt prepare train.npz --out made-av1 --config training/configs/eqrt-small.toml",
    "eqrt bench --seconds 0.3 --targets 1 --json before.json",
    "eqrt replay made-drives --out yesterday.jsonl",
)
TAKEN_FOR_GRANTED = {
    "docs/evaluation.md": {"made": "runs/av1", "made-av1": "prepared/av1"},
    "docs/benchmarks.md": {"before.json": "before.json", "made/artifact": "C"},
    "docs/recording.md": {
        "made": "runs/mine",
        "made-drives": "drives",
        "made-drive.mcap": "drive.mcap",
        "yesterday.jsonl": "yesterday.jsonl",
    },
}
"""Page -> what of it the page has under which name."""


def rule_of(command: Command) -> NotRun | None:
    """Why a command is not run; None if it is."""
    return next(
        (
            rule
            for rule in NOT_RUN
            if re.search(rule.page, command.page) and re.match(rule.command, command.text)
        ),
        None,
    )


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a checkpoint, an artifact, prepared data, a recording and a report."""
    folder = world.build(tmp_path_factory.mktemp("made"))
    shutil.copy(world.record(folder / "made-drives"), folder / "made-drive.mcap")
    for text in BEFORE:
        status, said = workshop.run(text.split(), folder)
        assert status == 0, f"{text}\n{said}"
    return folder


@pytest.mark.parametrize("page", sorted({c.page for c in ALL if rule_of(c) is None}), ids=str)
def test_the_commands_of_a_page_work(
    page: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    folder = world.build(tmp_path)
    for source, name in TAKEN_FOR_GRANTED.get(page, {}).items():
        made = request.getfixturevalue("made")
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        copy = shutil.copytree if (made / source).is_dir() else shutil.copy
        copy(made / source, folder / name)
    for command in [c for c in ALL if c.page == page and rule_of(c) is None]:
        text = command.text
        for change in CHANGES:
            text = change.applied(text)
        changed = Command(command.page, command.line, text)
        words = changed.words
        assert changed.program in ("eqrt", *HARMLESS), f"{command}: neither run nor listed"
        for likewise in LIKEWISE:
            if page == likewise.page and re.match(likewise.before, text):
                for name in likewise.copies:
                    shutil.copytree(folder / likewise.original, folder / name)
        status, said = workshop.run(words, folder)
        good = next((ends for pattern, ends, _ in ENDINGS if re.match(pattern, text)), (0,))
        assert status in good, f"{command}\nrun as: {text}\nstatus {status}\n{said[-3000:]}"


@pytest.mark.parametrize("command", [c for c in ALL if rule_of(c)], ids=str)
def test_what_is_not_run_could_be(command: Command) -> None:
    """Programs are known, files that it names are there, options of eqrt are accepted."""
    words = command.words
    if words[0] == "eqrt":
        module = cli.command_module(words[1])
        cli.command_parser(words[1], module).parse_args(words[2:])
    if words[0] == "make":
        dry = subprocess.run([*words, "--dry-run"], cwd=ROOT, capture_output=True, check=False)
        assert dry.returncode == 0, dry.stderr
    if "pip" in words:
        named = re.findall(r"\[([a-z,]+)\]", command.text)
        known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
        assert {extra for extras in named for extra in extras.split(",")} <= {
            *known["optional-dependencies"]
        }
    for path in named_files(command):
        assert (ROOT / path).exists(), f"{command}: there is no {path}"


def named_files(command: Command) -> Iterator[str]:
    """Words that are paths of the repository."""
    for word in command.words:
        if re.match(r"(deploy|docs|training|runtime|tests)/", word):
            yield word


def test_every_rule_is_needed() -> None:
    assert [rule for rule in NOT_RUN if rule not in map(rule_of, ALL)] == []
    for change in CHANGES:
        assert any(change.applied(c.text) != c.text for c in ALL if rule_of(c) is None), change


def test_commands_are_found_in_every_kind_of_page() -> None:
    found = {command.page for command in ALL}
    assert {
        "README.md",
        "docs/start-radar.md",
        "deploy/README.md",
        "deploy/models/README.md",
    } <= found


def test_a_command_that_is_neither_run_nor_listed_fails() -> None:
    unknown = Command("docs/new.md", 1, "curl https://example.org | sh")
    assert rule_of(unknown) is None
    assert unknown.program not in ("eqrt", *HARMLESS)


def test_options_that_do_not_exist_are_found() -> None:
    command = Command("docs/new.md", 1, "eqrt bench --budget x --no-such-option")
    with pytest.raises(Exception, match="no-such-option"):
        test_what_is_not_run_could_be(command)
