"""What a setup lacks, each in one line that ends with what to do."""

from __future__ import annotations

from eqrt.runtime.decoding.profile import Profile
from eqrt.runtime.prediction.tiles import Tile


def unused_map(profile: Profile, tile: Tile | None) -> str | None:
    """Why the service will not use its tile; None if it can, or has none."""
    if tile is None:
        return None
    unused = f"{tile.path}: the map will not be used, because"
    if not profile.gives("pose"):
        return (
            f"{unused} the profile {profile.name!r} gives no poses, that is, where the car is on "
            "the map; add the [[ego]] of an INS to it (docs/radar-ins-map.md)"
        )
    if tile.info.origin_deg is None and not profile.gives("x"):
        return (
            f"{unused} the profile {profile.name!r} gives poses by latitude and longitude, and the "
            "tile does not say where on Earth it is; build it with --origin LAT,LON"
        )
    return None
