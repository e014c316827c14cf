"""What a setup lacks, each in one line that ends with what to do."""

from __future__ import annotations

from collections.abc import Iterable

from eqrt.runtime.decoding.can_io import Decoder
from eqrt.runtime.decoding.profile import Profile
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.tiles import Tile

_EGO = "ego "  # what the names of sources about the ego vehicle begin with


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


def taken_to_stand(profile: Profile, *, stationary: bool) -> str | None:
    """That nothing will tell how the car moves; None if something may, or it is said to stand."""
    if profile.has_ego or stationary or not profile.sensors:
        return None
    return (
        f"the profile {profile.name!r} has no [[ego]], so the sensor is taken to stand still, and "
        "in a car that moves all predictions are wrong; add one (docs/start-radar.md), or say "
        "--stationary"
    )


def without_motion(missing: Iterable[str]) -> str:
    """What to do where nothing tells how the car moves. `missing`: names of the profile's sources
    that tell nothing; those about the car are named.
    """
    names = [name.removeprefix(_EGO) for name in missing if name.startswith(_EGO)]
    absent = f" ({', '.join(names)} not on the bus)" if names else ""
    return (
        f"nothing tells the car's speed and yaw rate{absent}: have them sent, add an [[ego]] that "
        "reads the car's own, or say --stationary if the sensor stands still"
    )


def never_came(decoder: Decoder) -> list[str]:
    """Names of sources of which nothing came that could be used."""
    return [source.name for source in decoder.sources if not source.right]


def no_predictions(pipeline: Pipeline) -> str:
    """Why nothing came out of all that a pipeline was fed."""
    decoded, profile = pipeline.decoder.counters, pipeline.profile
    if not decoded.used:
        of_others = (
            f"none of the {decoded.messages} messages is one that the profile {profile.name!r} "
            "reads; another --profile or --can? `eqrt can check` says what is there"
        )
        return of_others if decoded.messages else "there are no messages in it"
    if not profile.sensors:
        return f"the profile {profile.name!r} has no [[sensor]], so there is nothing to predict"
    if not decoded.cycles:
        return "no object list came; `eqrt can check` says which messages are missing"
    if not decoded.objects:
        return "all object lists are empty; `eqrt can check` says what was decoded"
    if pipeline.tracks.counters.without_ego and not pipeline.tracks.counters.tracks:
        return f"NO_POSE: {without_motion(never_came(pipeline.decoder))}"
    return "no object was seen while it could be predicted; `eqrt can check` says what was decoded"
