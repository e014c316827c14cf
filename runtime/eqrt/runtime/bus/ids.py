"""Which messages are wanted."""

from __future__ import annotations

from collections.abc import Collection

Ids = Collection[tuple[int, bool]]
"""Arbitration ids, and whether each is an extended one."""
