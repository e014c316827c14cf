"""`make cli-reference`: docs/cli.md from the parsers of the commands, word for word."""

from __future__ import annotations

import argparse
import inspect
import sys
from collections.abc import Iterator, Sequence

from eqrt import cli
from source_tree import ROOT

PAGE = ROOT / "docs/cli.md"
_HEAD = """\
# Commands

Made by `make cli-reference` from the parsers themselves; `eqrt COMMAND --help` says the same.
Exit status: 0 done, 1 something that you can fix, 2 wrong usage or a missing extra, 3 a budget is
broken or something became slower. An error is one line, without a traceback.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Print the page, or write it with --write."""
    parser = argparse.ArgumentParser(prog="make cli-reference", description=__doc__)
    parser.add_argument("--write", action="store_true", help="into docs/cli.md")
    if parser.parse_args(argv).write:
        PAGE.write_text(page(), encoding="utf-8")
    else:
        print(page(), end="")
    return 0


def page() -> str:
    """The whole page."""
    overview = [
        f"| [`eqrt {name}`](#eqrt-{name}) | {text} |" for name, (_, text) in cli.COMMANDS.items()
    ]
    table = "\n".join(["| command | |", "| --- | --- |", *overview])
    return "\n\n".join([_HEAD.rstrip(), table, *map(_command, cli.COMMANDS)]) + "\n"


def _command(name: str) -> str:
    module = cli.command_module(name)
    parser = cli.command_parser(name, module)
    said = inspect.cleandoc(module.__doc__ or "")
    return "\n\n".join([f"## eqrt {name}", _prose(said), *_parts(parser)])


def _prose(docstring: str) -> str:
    """Paragraphs on one line each; indented ones are examples and stay as they are."""
    paragraphs = []
    for paragraph in docstring.split("\n\n"):
        indented = paragraph.startswith("    ")
        paragraphs.append(paragraph if indented else " ".join(paragraph.split()))
    return "\n\n".join(paragraphs)


def _parts(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Usage and options of a parser, then those of its own subcommands."""
    actions = [action for action in parser._actions if not isinstance(action, argparse._HelpAction)]
    nested = [a for a in actions if isinstance(a, argparse._SubParsersAction)]
    own = [
        action for action in actions if action not in nested and action.help != argparse.SUPPRESS
    ]
    if not nested:
        yield f"```text\n{_usage(parser, own)}\n```"
    if own:
        yield "\n".join(["| option | |", "| --- | --- |", *(_row(parser, one) for one in own)])
    if parser.epilog:
        yield _cell(parser.epilog)
    for choices in nested:
        for child in choices.choices.values():
            yield f"### {child.prog}"
            yield from _parts(child)


def _usage(parser: argparse.ArgumentParser, actions: Sequence[argparse.Action]) -> str:
    """On one line: what must be given, then that there are options."""
    needed = [_spelled(action) for action in actions if action.required and action.option_strings]
    positional = [_positional(action) for action in actions if not action.option_strings]
    rest = ["[OPTIONS]"] if any(not a.required and a.option_strings for a in actions) else []
    return " ".join([parser.prog, *positional, *needed, *rest])


def _positional(action: argparse.Action) -> str:
    name = _metavar(action)
    return {None: name, "?": f"[{name}]", "*": f"[{name} ...]", "+": f"{name} ..."}[action.nargs]  # type: ignore[index]  # nargs may be a number; ours are none


def _spelled(action: argparse.Action) -> str:
    if not action.option_strings:
        return _positional(action)
    names = ", ".join(action.option_strings)
    return names if action.nargs == 0 else f"{names} {_metavar(action)}"


def _metavar(action: argparse.Action) -> str:
    if isinstance(action.metavar, str):
        name = action.metavar
    elif action.choices is not None:
        name = "|".join(map(str, action.choices))
    else:
        name = action.dest.upper()
    return f"{name} ..." if action.nargs in ("*", "+") and action.option_strings else name


def _row(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    text = (action.help or "") % (vars(action) | {"prog": parser.prog})
    must = "**required.** " if action.required and action.option_strings else ""
    name = _spelled(action).replace("|", "\\|")
    return f"| `{name}` | {must}{_cell(text)} |"


def _cell(text: str) -> str:
    """Help as Markdown: what would be a tag or a column stays text."""
    for sign in "|<>*_":
        text = text.replace(sign, f"\\{sign}")
    return text


if __name__ == "__main__":
    sys.exit(main())
