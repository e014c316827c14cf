"""Another tile and model while the service runs: loaded beside the loop, exchanged in it.

The files are read and checked in a thread of their own; the loop goes on with what it has. If all
is well, both are exchanged between two cycles; if one of them is bad, both stay as they were.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from eqrt.core.errors import EqrtError
from eqrt.core.scene import CenterlineSource
from eqrt.runtime.operation.event_log import EventLog, Level
from eqrt.runtime.operation.realtime import stand_back
from eqrt.runtime.pipeline import Pipeline, lanes_for
from eqrt.runtime.prediction.predictor import Predictor
from eqrt.runtime.prediction.tiles import Tile, load_tile
from eqrt.runtime.prediction.watched import Model


@dataclass(frozen=True, slots=True)
class _Loaded:
    predictor: Predictor
    tile: Tile | None
    lanes: CenterlineSource | None


class Reloader:
    """To be called between cycles (`service.Chore`); costs a comparison when there is nothing."""

    def __init__(
        self,
        pipeline: Pipeline,
        model: Path,
        tile: Path | None,
        *,
        is_asked: Callable[[], bool],
        log: EventLog,
        tell: Callable[[bool], None] = lambda _: None,
        exchanged: Callable[[], None] = lambda: None,
    ) -> None:
        """`is_asked` tells once for every time that somebody asked to load the files anew.

        `exchanged` is called when the pipeline has got another tile or model.
        `tell(True)` is called when loading begins, `tell(False)` when it has ended.
        """
        self._pipeline = pipeline
        self._model, self._tile = model, tile
        self._is_asked = is_asked
        self._log = log
        self._tell = tell
        self._exchanged = exchanged
        self._thread: threading.Thread | None = None
        self._result: _Loaded | str = ""

    def __call__(self) -> None:
        """Begin to load if asked to; exchange if it is loaded."""
        if self._thread is None:
            if self._is_asked():
                self._tell(True)
                self._thread = threading.Thread(target=self._load, name="reload", daemon=True)
                self._thread.start()
        elif not self._thread.is_alive():
            self._thread = None
            self._finish(self._result)
            self._tell(False)

    def _load(self) -> None:
        stand_back()
        try:
            predictor = Predictor.load(self._model)
            tile = load_tile(self._tile) if self._tile else None
            self._result = _Loaded(predictor, tile, lanes_for(tile, predictor))
        except EqrtError as error:
            self._result = str(error)
        except Exception as error:  # whatever it is, the service has a tile and a model that work
            self._result = f"{type(error).__name__}: {error}"

    def _finish(self, result: _Loaded | str) -> None:
        if isinstance(result, str):
            self._log.say(
                Level.ERROR, "reload-failed", f"reload failed, tile and model stay: {result}"
            )
            return
        before = identity(self._pipeline.predictor, self._pipeline.tile)
        after = identity(result.predictor, result.tile)
        if after == before:
            self._log.say(Level.INFO, "reload", f"reloaded: unchanged, {after}")
            return
        self._pipeline.exchange(result.predictor, result.tile, result.lanes)
        self._exchanged()
        self._log.say(Level.INFO, "reload", f"reloaded: {after}, before {before}")
        if notice := result.predictor.license_notice:
            self._log.say(Level.WARNING, "license", notice)


def identity(predictor: Model, tile: Tile | None) -> str:
    """What predicts, in a line."""
    name = f"model {predictor.contract.name} {predictor.model_id}"
    return f"{name}, tile {tile.info.tile_id if tile else 'none'}"
