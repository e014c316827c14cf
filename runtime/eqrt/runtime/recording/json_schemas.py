"""JSON schemas of our own messages, as viewers want them."""

from __future__ import annotations

import msgspec


def json_schema(kind: type) -> bytes:
    """The schema of a struct; its top level is an object with properties, not a reference."""
    (schema,), components = msgspec.json.schema_components([kind], ref_template="#/$defs/{name}")
    definitions = dict(components)
    top = definitions.pop(schema["$ref"].rpartition("/")[2])
    return msgspec.json.encode(top | {"$defs": definitions})
