"""Every parser that takes what others wrote. A new parser gets a Target in one of these modules."""

from __future__ import annotations

from fuzz import artifacts, decoding, logs, profiles, recordings, tiles, words
from fuzz.target import Target

ALL: dict[str, Target] = {
    target.name: target
    for module in (decoding, logs, recordings, profiles, tiles, artifacts, words)
    for target in module.TARGETS
}
"""By name."""
