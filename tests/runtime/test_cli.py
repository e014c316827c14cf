"""The `eqrt` command: what it answers before any subcommand does its work."""

from __future__ import annotations

import importlib.metadata
import subprocess
import sys

import pytest

from eqrt import cli
from eqrt.core.errors import UsageError


def test_version_is_that_of_the_installed_package(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"eqrt {importlib.metadata.version('eqrt')}\n"


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["--help"])
    assert ended.value.code == 0
    listed = capsys.readouterr().out
    assert all(f"  {name} " in listed for name in cli.COMMANDS)


def test_without_a_command_the_help_is_shown_and_the_status_says_usage(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main([]) == 2
    assert capsys.readouterr().out.startswith("usage: eqrt")


def test_an_unknown_command_is_refused_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["predict"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert captured.err.startswith("eqrt: there is no command 'predict'; the commands are demo, ")


@pytest.mark.parametrize("wrong", ["serv", "sevre", "server"])
def test_a_command_with_a_slip_of_the_finger_is_guessed(
    wrong: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([wrong]) == 2
    said = f"eqrt: there is no command {wrong!r}; did you mean 'serve'?\n"
    assert capsys.readouterr().err == said


@pytest.mark.parametrize(("command", "actions"), [("can", ["check"]), ("tile", ["info", "build"])])
def test_a_command_with_actions_lists_each_once(
    command: str, actions: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        cli.main([command, "--help"])
    usage, *lines = capsys.readouterr().out.splitlines()
    assert usage == f"usage: eqrt {command} [-h] COMMAND ..."
    for action in actions:
        assert len([line for line in lines if line.startswith(f"    {action} ")]) == 1


def test_python_dash_m_is_the_same_command() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "eqrt", "sevre"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr.startswith("eqrt: there is no command 'sevre'")


@pytest.mark.parametrize(
    ("command", "module", "extra"),
    [("train", "torch", "train"), ("view", "websockets", "view"), ("top", "rich", "view")],
)
def test_a_command_whose_extra_is_missing_says_how_to_install_it(
    command: str,
    module: str,
    extra: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    target = cli.COMMANDS[command][0]
    package = target.rpartition(".")[0]
    for name in [name for name in sys.modules if name.startswith(f"{package}.")]:
        monkeypatch.delitem(sys.modules, name)
    for name in [module, *(name for name in sys.modules if name.startswith(f"{module}."))]:
        monkeypatch.setitem(sys.modules, name, None)  # what makes `import torch` fail everywhere
    assert cli.main([command]) == 2
    captured = capsys.readouterr()
    assert captured.err == (
        f"eqrt: eqrt {command} needs the package {module!r}, which is not installed; "
        f"install it with: pip install 'eqrt[{extra}]'\n"
    )


def test_a_broken_module_of_our_own_is_not_taken_for_a_missing_extra(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(cli.COMMANDS, "broken", ("eqrt.runtime.no_such_module", "never written"))
    with pytest.raises(ModuleNotFoundError, match="no_such_module"):
        cli.main(["broken"])


def test_ctrl_c_ends_with_the_shells_status(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "_run_command", interrupt)
    assert cli.main(["serve"]) == 130


def test_user_errors_carry_their_exit_status() -> None:
    assert cli.missing_extra("eqrt train", "torch", "train").exit_code == 2
    assert UsageError("").exit_code == 2


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["serve"], "--profile, --can; see eqrt serve --help"),
        (["serve", "--can", "x", "--profil", "ars408"], "--profil ars408; see eqrt serve --help"),
        (["serve", "--can", "x", "--profile", "ars408", "--out-id", "z"], "not a CAN id"),
        (["replay", "a.log", "--profile", "ars408"], "give --out FILE, or --diff RUN"),
        (["tile", "build"], "SOURCE, --out; see eqrt tile build --help"),
        (["play", "a.log", "--can", "x", "--fast"], "--fast; see eqrt play --help"),
    ],
)
def test_a_wrong_command_line_is_one_line_too(
    argv: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(argv) == 2
    error = capsys.readouterr().err
    assert error.startswith("eqrt: ")
    assert error.count("\n") == 1
    assert said in error
