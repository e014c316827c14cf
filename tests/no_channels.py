"""For services that read no bus."""

from __future__ import annotations

from eqrt.runtime.bus.health import BusHealth


class NoChannels:
    """None that could be up or down."""

    def health(self) -> list[BusHealth]:
        return []

    def counts(self) -> dict[str, int]:
        return {}
