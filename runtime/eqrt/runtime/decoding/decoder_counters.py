"""What became of the messages that a decoder was fed."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class DecoderCounters:
    """They only grow; messages = used + other_id + wrong_bus + not_data."""

    messages: int = 0
    """All that were fed."""
    used: int = 0
    """Meant by the profile, on the right bus."""
    other_id: int = 0
    """Not in the profile."""
    wrong_bus: int = 0
    """In the profile, but for another channel."""
    not_data: int = 0
    """In the profile, but an error or remote frame, or with an id of the other length."""
    stray: int = 0
    """Of the used: for a cycle that is not open (its header was lost), or headers without count."""
    short: int = 0
    """Of the used: too short for everything that the profile asks for; what is there counts."""
    bad_checksum: int = 0
    """Of the used: damaged, nothing in them counts."""
    bad_counter: int = 0
    """Messages of another cycle or out of sequence, and cycles whose counter did not follow the
    last one's."""
    cycles: int = 0
    incomplete_cycles: int = 0
    """Of the cycles: closed by a timeout or by the next one."""
    refused_cycles: int = 0
    """Of the cycles: not used, because their sensor was not valid."""
    refused_ego: int = 0
    """What messages told about the ego vehicle and was not used, for the same reason."""
    objects: int = 0
    """Valid ones, in all cycles that were used."""
    invalid_objects: int = 0
    """Left out; of radars with slots, mostly slots that say that they are empty."""
