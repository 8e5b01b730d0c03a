"""Cache of loaded models, which keeps the most recently used ones.

Surrogates are identified by their ids, because a name may be used again after its surrogate was deleted.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping
from threading import Lock

import torch

from surrogym_server.errors import Damaged, NoModel
from surrogym_server.models.port import DynamicsModel
from surrogym_server.tensors import CPU

CAPACITY = 64


class ModelCache:
    """Cache of the models of all surrogates. A model is loaded when it is first needed. Thread-safe."""

    def __init__(
        self,
        load: Callable[[int, int], DynamicsModel],
        newest: Callable[[], Mapping[int, int]],
        capacity: int = CAPACITY,
    ) -> None:
        """Create an empty cache.

        Args:
            load: loads a model, given a surrogate's id and a version; raises ``UnknownModel``, ``UnknownSurrogate`` or
                ``Damaged``.
            newest: returns for each surrogate's id the newest version of its stored models, damaged ones that were set
                aside not counted.
            capacity: number of models to keep; the copy of a model on a GPU counts as one more.
        """
        self._load = load
        self._newest = newest
        self._capacity = capacity
        self._models: OrderedDict[tuple[int, int, torch.device], DynamicsModel] = OrderedDict()
        self._latest: dict[int, int] = {}
        self._lock = Lock()

    def get(self, surrogate: int, version: int, device: torch.device = CPU) -> DynamicsModel:
        """Return a surrogate's model of version ``version`` on ``device``.

        Raises ``UnknownModel``, ``UnknownSurrogate`` or ``Damaged``.
        """
        key = (surrogate, version, device)
        with self._lock:
            if model := self._models.get(key):
                self._models.move_to_end(key)
                return model
        model = self._loaded(surrogate, version) if device == CPU else self.get(surrogate, version).on(device)
        self._keep(key, model)
        return model

    def _loaded(self, surrogate: int, version: int) -> DynamicsModel:
        try:
            return self._load(surrogate, version)
        except Damaged:
            with self._lock:
                # The version cached as the newest may be the damaged one. Without it, ``latest`` asks the storage.
                self._latest.pop(surrogate, None)
            raise

    def latest(self, surrogate: int) -> int:
        """Return the newest model version that this process knows. Raises ``NoModel`` or ``UnknownSurrogate``."""
        with self._lock:
            if version := self._latest.get(surrogate):
                return version
        return self.refresh(surrogate)

    def refresh(self, surrogate: int) -> int:
        """Load the newest undamaged model of a surrogate from the storage, and return its version.

        Raises:
            NoModel, UnknownSurrogate: the surrogate has no model, or does not exist.
            Damaged: the newest model can't be read, and could not be set aside.
        """
        while (version := self._newest().get(surrogate)) is not None:
            try:
                return self.publish(surrogate, version)
            except Damaged:
                if self._newest().get(surrogate) == version:
                    raise
        raise NoModel(
            "the surrogate has no model yet: start surrogym sample or import a log, and wait for the first fit"
        )

    def look(self) -> list[int]:
        """For each surrogate in this cache, load its newest model if another server has stored a newer one.

        Returns:
            The ids of surrogates that were deleted. Their models stay in the cache until ``forget``.
        """
        with self._lock:
            versions = list(self._latest.items())
        if not versions:
            return []
        newest = self._newest()
        for surrogate, version in versions:
            if newest.get(surrogate, version) > version:
                self.publish(surrogate, newest[surrogate])
        return [surrogate for surrogate, _ in versions if surrogate not in newest]

    def publish(self, surrogate: int, version: int) -> int:
        """Load a model, and make its version the newest unless a newer one is known. Return the newest version."""
        self.get(surrogate, version)
        with self._lock:
            self._latest[surrogate] = max(version, self._latest.get(surrogate, 0))
            return self._latest[surrogate]

    def forget(self, surrogate: int) -> None:
        """Remove the models of a deleted surrogate from the cache."""
        with self._lock:
            self._latest.pop(surrogate, None)
            for key in [key for key in self._models if key[0] == surrogate]:
                del self._models[key]

    def _keep(self, key: tuple[int, int, torch.device], model: DynamicsModel) -> None:
        with self._lock:
            self._models[key] = model
            while len(self._models) > self._capacity:
                self._models.popitem(last=False)
