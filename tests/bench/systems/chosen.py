"""Which systems stand in the table, and what they are called."""

from __future__ import annotations

import re

SHIPPED = "eqrt-free"
"""Taken as it is; the first, which ratios are to."""
NAIVE = ", naive"
"""Ends the name of a file that `torch.onnx.export` alone has made."""
PAPER = (
    "paper-1-lstm",
    "paper-2-no-map",
    "paper-3-translated-attention",
    "paper-4-rotated-attention",
    "paper-5-translated-transformer",
    "paper-6-rotated-transformer",
    "paper-7-rotated-cnn",
)
WITH_NAIVE = (
    "eqrt-small",
    "eqrt-small-6",
    "paper-2-no-map",
    "paper-4-rotated-attention",
    "paper-6-rotated-transformer",
)
"""Of these there are two files."""


def all_systems() -> list[str]:
    """In the table's order, without the shipped one: names of configurations, or of naive files."""
    names: list[str] = []
    for name in ("eqrt-small", "eqrt-small-6", *PAPER):
        names += [name, name + NAIVE] if name in WITH_NAIVE else [name]
    return names


def config_name(name: str) -> str:
    """Of the configuration that a system's file is from."""
    return name.removesuffix(NAIVE)


def folder_name(name: str) -> str:
    """Of the artifact."""
    return name.replace(", ", "-")


def short_name(name: str) -> str:
    """For the plot."""
    row = re.match(r"paper-(\d)", name)
    return f"paper {row[1]}" if row else name
