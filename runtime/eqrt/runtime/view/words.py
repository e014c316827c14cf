"""Modes, classes and counters in words that need no manual; page and terminal say the same."""

from __future__ import annotations

from collections.abc import Mapping

from eqrt.runtime.decoding.detections import ObjectClass
from eqrt.runtime.output.forecasts import Mode

GOOD, LIMITED, BAD = "good", "limited", "bad"

LEVELS = {
    Mode.RUN: GOOD,
    Mode.NO_MAP: LIMITED,
    Mode.NO_POSE: LIMITED,
    Mode.PARTIAL: LIMITED,
    Mode.LATE: LIMITED,
    Mode.FALLBACK: BAD,
    Mode.SILENT: BAD,
}
"""How much of the service there is."""
AGENT_LEVELS = {Mode.RUN: GOOD, Mode.PARTIAL: LIMITED, Mode.LATE: BAD, Mode.FALLBACK: BAD}

MODE_WORDS = {
    Mode.RUN: "Full service: model, map and ego motion",
    Mode.NO_MAP: "No map here: predicting without lanes",
    Mode.NO_POSE: "No map pose: predicting without lanes",
    Mode.LATE: "Late: predictions come late, or not all from the model",
    Mode.FALLBACK: "Without the model: constant turn rate and speed",
    Mode.SILENT: "No input from the sensor: earlier predictions are void",
}
AGENT_WORDS = {
    Mode.RUN: "predicted by the model, from a full history",
    Mode.PARTIAL: "predicted from a short history",
    Mode.LATE: "predicted at constant turn rate and speed: no time for the model",
    Mode.FALLBACK: "predicted at constant turn rate and speed: the model failed",
}
AGENT_STANDS = "not predicted: nothing tells how it moves"
"""Of a target that physics leaves where it was seen (`ForecastSet.is_standstill_assumed`)."""
AGENT_BRIEF = {
    Mode.RUN: "full history",
    Mode.PARTIAL: "short history",
    Mode.LATE: "no time",
    Mode.FALLBACK: "no model",
}

CLASS_WORDS = {kind: kind.name.lower() for kind in ObjectClass} | {ObjectClass.UNKNOWN: "object"}

DROPS = {
    "can_failed": "predictions that the CAN bus did not take",
    "datagrams_failed": "datagrams that could not be sent",
    "decoder_bad_checksum": "messages with a wrong checksum",
    "decoder_short": "messages too short",
    "decoder_stray": "messages without their header",
    "decoder_incomplete_cycles": "object lists incomplete",
    "ego_refused": "ego values that are not possible",
    "tracks_refused": "measurements that are not possible",
    "tracks_dropped": "tracks dropped: too many",
    "tracks_resets": "all tracks forgotten",
    "pipeline_shed": "predictions without the model: no time",
    "pipeline_fallbacks": "predictions without the model: it failed",
    "pipeline_model_restarts": "model loaded anew",
}
"""Counter of the service (docs/output.md) -> what it counts. All are 0 when all is well."""


def mode_words(mode: Mode, num_targets: int) -> str:
    """What the mode of a cycle means for whoever watches."""
    if mode is Mode.NO_POSE and not num_targets:
        return "No ego motion: nothing is predicted"
    return MODE_WORDS.get(mode, mode.name)


def class_words(number: int) -> str:
    """Of an `ObjectClass`, also of one that this version does not know."""
    return CLASS_WORDS[ObjectClass(number)] if number in CLASS_WORDS else "object"


def drops(totals: Mapping[str, int]) -> dict[str, int]:
    """What went wrong since the start, in words: only what did."""
    counted = {words: totals.get(name, 0) for name, words in DROPS.items()}
    return {words: count for words, count in counted.items() if count}
