"""What stands in a recording: its topics, and how their messages are written (docs/recording.md).

The recorder and its writer, which is another process and imports little but this and the writer's
library, share this table.
"""

from __future__ import annotations

import struct
from enum import IntEnum

PROFILE = "eqrt"
"""The MCAP profile: `FORMAT_VERSION` and what belongs to it."""
FORMAT_VERSION = 1
IDENTITY = "eqrt"
"""Name of the metadata record that says what the recording is of."""
PROFILE_FILES = "profile/"
"""Attachments under it are the profile and its DBCs, named as the profile names them, be it by a
path: these are names, and never become files."""
TILE_FILE = "tile"
"""The attachment that is the tile."""


class Topic(IntEnum):
    """Topics by their number on the way to the writer."""

    CAN = 0
    """A message, as the pipeline was given it (`Step`)."""
    POLL = 1
    """A moment at which the pipeline was asked without a message (`Step`)."""
    CLOCK = 2
    """What the pipeline's clock said during the step before: a list of float."""
    FORECASTS = 3
    """Predictions of one cycle (`exact_forecasts`)."""
    STATUS = 4
    """`ServiceStatus`, once a second."""
    LOST = 5
    """How much is missing here, because it could not be written in time (`Lost`)."""
    RUNS = 6
    """What became of the model's runs during the step before, unless all were answered: a list of
    int (`runs.Outcome`)."""


NAMES = {
    Topic.CAN: "/can",
    Topic.POLL: "/eqrt/poll",
    Topic.CLOCK: "/eqrt/clock",
    Topic.FORECASTS: "/eqrt/forecasts",
    Topic.STATUS: "/eqrt/status",
    Topic.LOST: "/eqrt/lost",
    Topic.RUNS: "/eqrt/runs",
}
"""As the recording calls them."""
JSON_TOPICS = frozenset({Topic.STATUS, Topic.LOST})
"""Written as JSON with a schema, which viewers show as it is; the others are msgpack."""

DESCRIPTION = 0xFF
"""First byte of a piece that is no batch: a msgpack map (`order.Description`) of what the run goes
on with. A new file begins there."""

LENGTH = struct.Struct("<I")
"""What goes to the writer is pieces, each led by its length: first one msgpack map (`Order`), then
batches of entries that belong together."""
ENTRY = struct.Struct("<BQQI")
"""Head of an entry in a batch: topic, time of recording, time of publishing (ns since 1970),
bytes that follow."""
