"""Options from the command line and from a file: one set, and who says what."""

from __future__ import annotations

import argparse
import re
import tomllib
from pathlib import Path

import pytest

from eqrt.cli import Parser
from eqrt.core.errors import ConfigError, UsageError
from eqrt.runtime import serve_options
from eqrt.runtime.settings import COMMAND_LINE, DEFAULT, Setting, as_toml, line_of, namespace
from processes import eqrt
from source_tree import ROOT

NEEDED = '[serve]\nprofile = "ars408"\ncan = ["can0"]\n'
EXAMPLE = ROOT / "deploy/eqrt.toml"


def resolved(*argv: str) -> list[Setting]:
    """What `eqrt serve` would do with these arguments."""
    parser = Parser(prog="eqrt serve", allow_abbrev=False)
    serve_options.add_arguments(parser)
    args = parser.parse_args(argv)
    found: list[Setting] = args.settings.resolve(args)
    return found


def options(*argv: str) -> argparse.Namespace:
    return namespace(resolved(*argv))


def written(folder: Path, text: str) -> Path:
    path = folder / "eqrt.toml"
    path.write_text(text, encoding="utf-8")
    return path


def every_setting() -> list[Setting]:
    return resolved("--profile", "ars408", "--can", "can0")


def test_every_flag_is_a_key_and_every_key_a_flag(tmp_path: Path) -> None:
    """Given in the file and given on the command line, each comes out the same."""
    values = {
        "profile": "generic",
        "model": "/m",
        "tile": "/t",
        "can": ["a", "b"],
        "can_interface": "virtual",
        "fd": False,
        "out_can": "none",
        "out_id": 0x18FF0000,
        "out_modes": 3,
        "datagrams": ["127.0.0.1:1"],
        "log_format": "json",
        "log_level": "error",
        "metrics": "127.0.0.1:2",
        "record": "/r",
        "record_limit": "3G",
        "record_keep_free": "2G",
        "record_when_full": "delete-oldest",
        "record_file_size": "3M",
        "realtime_priority": 7,
        "realtime_cpus": "0,2-3",
    }
    for setting in every_setting():
        option = setting.option
        value = values.get(option.action.dest, True)
        if isinstance(value, bool):
            argv = [option.flag if value else f"--no-{option.flag[2:]}"]
        else:
            several = value if isinstance(value, list) else [value]
            argv = [part for one in several for part in (option.flag, str(one))]
        shown = f'"{value}"' if isinstance(value, str) else str(value).lower().replace("'", '"')
        needed = "".join(
            f"{line}\n" for line in NEEDED.splitlines() if not line.startswith(f"{option.key} =")
        )
        path = written(
            tmp_path,
            f"{needed}\n[{option.table}]\n{option.key} = {shown}\n"
            if option.table != "serve"
            else f"{needed}{option.key} = {shown}\n",
        )
        by_file = options("--config", str(path))
        by_flag = (
            options("--profile", "ars408", "--can", "can0", *argv)
            if option.key not in ("profile", "can")
            else options("--config", str(written(tmp_path, NEEDED)), *argv)
        )
        assert getattr(by_file, option.action.dest) == getattr(by_flag, option.action.dest)
        assert getattr(by_file, option.action.dest) != setting.value or option.key == "profile"


def test_the_command_line_goes_before_the_file_and_the_file_before_the_defaults(
    tmp_path: Path,
) -> None:
    path = written(tmp_path, f"{NEEDED}quiet = true\nout_modes = 2\n")
    found = {s.option.key: s for s in resolved("--config", str(path), "--can=x", "--no-quiet")}
    assert (found["can"].value, found["can"].source) == (["x"], COMMAND_LINE)
    assert (found["quiet"].value, found["quiet"].source) == (False, COMMAND_LINE)
    assert (found["out_modes"].value, found["out_modes"].source) == (2, f"{path}:5")
    assert (found["tile"].value, found["tile"].source) == (None, DEFAULT)


def test_paths_in_a_file_begin_at_its_folder(tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    path = written(
        tmp_path / "etc", '[serve]\nprofile = "mine.toml"\ncan = ["c"]\ntile = "../t.tile"\n'
    )
    found = options("--config", str(path), "--model", "here")
    assert found.profile == str(tmp_path / "etc/mine.toml")
    assert found.tile.resolve() == tmp_path / "t.tile"
    assert found.model == Path("here")


def test_the_name_of_a_profile_is_not_taken_for_a_file(tmp_path: Path) -> None:
    assert options("--config", str(written(tmp_path, NEEDED))).profile == "ars408"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (
            "[serve]\ntyle = 'x'\n",
            r"line 2: unknown key 'tyle' in \[serve\]; did you mean 'tile'\?",
        ),
        ("[serve]\nzzz = 1\n", r"line 2: unknown key 'zzz' in \[serve\]; known are profile, "),
        ("\n\n[realtym]\n", r"line 3: unknown table 'realtym'; did you mean 'realtime'\?"),
        (
            "profile = 'a'\n",
            r"line 1: unknown table 'profile'; known are serve, recording, realtime",
        ),
        ("serve = 1\n", r"line 1: serve is a table: write \[serve\]"),
        ("[serve]\n# can\ncan = 'c'\n", r"line 3: can is \"c\", expected a list of strings"),
        ("[serve]\ncan = [\n'c', 1]\n", r"line 2: can is \[.*\], expected a list of strings"),
        ("[serve]\nquiet = 1\n", r"line 2: quiet is 1, expected true or false"),
        ("[serve]\nout_modes = true\n", r"line 2: out_modes is true, expected an integer"),
        ("[serve]\nout_modes = 0\n", r"line 2: out_modes: '0' is not a number of modes; give 1"),
        ("[serve]\nout_modes = -1\n", r"line 2: out_modes: '-1' is not a number of modes"),
        ("[serve]\nout_modes = '1'\n", r"line 2: out_modes is \"1\", expected an integer"),
        ("[serve]\nout_id = 'z'\n", r"line 2: out_id: 'z' is not a CAN id"),
        ("[serve]\ntile = 3\n", r"line 2: tile is 3, expected a string"),
        ('[serve]\ntile = "a\\u0000"\n', r"line 2: tile holds a null character"),
        ("[serve]\nlog_format = 'xml'\n", r"line 2: log_format is \"xml\", expected \"text\" or"),
        ("[realtime]\n\npriority = 100\n", r"line 3: priority: '100' is not a priority from 1"),
        ("[realtime]\ncpus = '3-1'\n", r"line 2: cpus: '3-1' names no cores"),
        ("[serve]\nfd = \n", r"is not TOML: .*line 2"),
        ("[serve]\nfd = true\nfd = true\n", r"is not TOML: .*line 3"),
    ],
)
def test_a_wrong_file_is_refused_with_the_line(text: str, problem: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=problem) as caught:
        options("--config", str(written(tmp_path, text)))
    assert "\n" not in str(caught.value)
    assert "eqrt.toml" in str(caught.value)


def test_a_file_may_begin_with_a_byte_order_mark_and_end_its_lines_as_windows_does(
    tmp_path: Path,
) -> None:
    path = tmp_path / "eqrt.toml"
    path.write_bytes(NEEDED.replace("\n", "\r\n").encode("utf-8-sig") + b"quiet = true\r\n")
    assert options("--config", str(path)).quiet is True
    path.write_bytes(path.read_bytes() + b"fd = 1\r\n")
    last = path.read_bytes().count(b"\n")
    with pytest.raises(ConfigError, match=rf"line {last}: fd is 1, expected true or false"):
        options("--config", str(path))


def test_a_file_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"cannot read the configuration .*nothing\.toml: No such"
    ):
        options("--config", str(tmp_path / "nothing.toml"))
    (tmp_path / "eqrt.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match="is not TOML"):
        options("--config", str(tmp_path / "eqrt.toml"))


def test_what_is_required_may_stand_in_either_and_is_missed_in_both(tmp_path: Path) -> None:
    path = written(tmp_path, '[serve]\nprofile = "ars408"\n')
    assert options("--config", str(path), "--can", "c").can == ["c"]
    with pytest.raises(UsageError, match=r"required \(or in .*eqrt\.toml\): --can; see eqrt serve"):
        options("--config", str(path))


def test_the_line_of_a_key_is_found_however_it_is_written() -> None:
    text = 'a.x = 1\n# b\n\n[b]\ny = """\nz = 1\n"""\n"z" = {q = [\n1]}\n[c]\n'
    assert [line_of(text, place) for place in (["a", "x"], ["b", "y"], ["b", "z"], ["c"])] == [
        1,
        5,
        8,
        10,
    ]


def test_what_is_printed_is_a_file_that_says_the_same(tmp_path: Path) -> None:
    path = written(tmp_path, f'{NEEDED}tile = "t"\nout_id = 0x18ff0000\n[realtime]\ncpus = "0"\n')
    first = resolved("--config", str(path), "--datagrams", "h:1", "--no-fd", "--log-level=error")
    text = as_toml(first)
    tomllib.loads(text)
    (tmp_path / "elsewhere").mkdir()
    second = resolved("--config", str(written(tmp_path / "elsewhere", text)))
    assert namespace(second) == namespace(first)
    assert 'can = ["can0"]' in text
    assert f"out_id = 0x18ff0000  # {path}:5" in text
    assert "fd = false  # command line" in text
    assert "# metrics is not set" in text
    assert "stationary = false  # default" in text


def test_the_example_is_the_defaults_with_every_key_explained() -> None:
    """Read as it is, and with every key that is commented out."""
    text = EXAMPLE.read_text(encoding="utf-8")
    found = resolved("--config", str(EXAMPLE))
    assert {s.option.key for s in found if s.source != DEFAULT} == {
        "profile",
        "can",
        "wait_for_bus",
    }
    told = tomllib.loads(text.replace("\n#", "\n").replace("\n ", "\n# "))
    keys = {(s.option.table, s.option.key) for s in found}
    assert {(table, key) for table, values in told.items() for key in values} == keys


def test_the_documentation_has_every_key_with_what_it_takes() -> None:
    """A row for each, and no row for another."""
    text = (ROOT / "docs/operations.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `\[(\w+)\]` `(\w+)` \| `(--[\w-]+)` \| (.+?) \|", text, re.MULTILINE)
    assert rows == [
        (o.table, o.key, o.flag, o.expected.removesuffix(', as in ["..."]'))
        for o in (setting.option for setting in every_setting())
    ]


def test_serve_prints_its_configuration_and_ends(tmp_path: Path) -> None:
    path = written(tmp_path, NEEDED)
    done = eqrt("serve", "--config", str(path), "--print-config", "--quiet")
    assert (done.returncode, done.stderr) == (0, "")
    assert tomllib.loads(done.stdout)["serve"]["quiet"] is True
    done = eqrt("serve", "--config", str(written(tmp_path, "[serve]\ncann = 1\n")))
    assert done.returncode == 2
    assert "line 2: unknown key 'cann' in [serve]; did you mean 'can'?" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("count", ["0", "-1", "1.5", "many"])
def test_a_number_of_modes_that_is_none_is_refused(count: str) -> None:
    """In one line, before anything is opened."""
    done = eqrt("serve", "--can", "can0", "--profile", "ars408", "--out-modes", count)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("eqrt: argument --out-modes: ")
    assert "is not a number of modes; give 1 or more" in done.stderr
    assert done.stderr.count("\n") == 1
