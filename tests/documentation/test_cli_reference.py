"""docs/cli.md is what the parsers say."""

from __future__ import annotations

from documentation.cli_reference import PAGE, page
from eqrt import cli


def test_the_page_is_what_the_parsers_say() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "run `make cli-reference`"


def test_every_command_and_option_is_in_it() -> None:
    text = page()
    for name in cli.COMMANDS:
        assert f"\n## eqrt {name}\n" in text
    for part in ("`--can [ROLE=]NAME`", "### eqrt tile build", "### eqrt can check", "`LOG`"):
        assert part in text
