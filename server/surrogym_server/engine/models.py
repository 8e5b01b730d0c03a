"""Loaded models by surrogate and version, the most recently used ones kept."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from threading import Lock

from surrogym_server.surrogate.model import SurrogateModel

CAPACITY = 64


class ModelCache:
    """Models of all surrogates. Any thread may call; a model is loaded when it is first asked for."""

    def __init__(
        self,
        load: Callable[[str, int], SurrogateModel],
        newest: Callable[[str], int],
        capacity: int = CAPACITY,
    ) -> None:
        """
        Args:
            load: the model of a surrogate's version; raises ``UnknownModel``.
            newest: the newest version of a surrogate; raises ``NoModel``.
            capacity: how many models are kept.
        """
        self._load = load
        self._newest = newest
        self._capacity = capacity
        self._models: OrderedDict[tuple[str, int], SurrogateModel] = OrderedDict()
        self._latest: dict[str, int] = {}
        self._lock = Lock()

    def get(self, surrogate: str, version: int) -> SurrogateModel:
        """The model of a version. Raises ``UnknownModel`` or ``UnknownSurrogate``."""
        with self._lock:
            if model := self._models.get((surrogate, version)):
                self._models.move_to_end((surrogate, version))
                return model
        model = self._load(surrogate, version)
        self._keep(surrogate, version, model)
        return model

    def latest(self, surrogate: str) -> int:
        """The newest version. Raises ``NoModel`` or ``UnknownSurrogate``."""
        with self._lock:
            if version := self._latest.get(surrogate):
                return version
        return self.publish(surrogate, self._newest(surrogate))

    def publish(self, surrogate: str, version: int) -> int:
        """Let lanes move to a version when they reset, unless a newer one is known; returns the newest."""
        self.get(surrogate, version)
        with self._lock:
            self._latest[surrogate] = max(version, self._latest.get(surrogate, 0))
            return self._latest[surrogate]

    def forget(self, surrogate: str) -> None:
        """Drop all of a surrogate that was deleted."""
        with self._lock:
            self._latest.pop(surrogate, None)
            for key in [key for key in self._models if key[0] == surrogate]:
                del self._models[key]

    def _keep(self, surrogate: str, version: int, model: SurrogateModel) -> None:
        with self._lock:
            self._models[surrogate, version] = model
            while len(self._models) > self._capacity:
                self._models.popitem(last=False)
