"""Loaded models by surrogate and version, the most recently used ones kept.

A surrogate is known by its id: a name may be deleted and given anew, here or by another server of the database.
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
    """Models of all surrogates. Any thread may call; a model is loaded when it is first asked for."""

    def __init__(
        self,
        load: Callable[[int, int], DynamicsModel],
        newest: Callable[[], Mapping[int, int]],
        capacity: int = CAPACITY,
    ) -> None:
        """
        Args:
            load: the model of a surrogate's version; raises ``UnknownModel``, ``UnknownSurrogate`` or ``Damaged``.
            newest: the newest stored version of each surrogate that has any; not one that ``load`` has set aside.
            capacity: how many models are kept; one on another device than the CPU counts again.
        """
        self._load = load
        self._newest = newest
        self._capacity = capacity
        self._models: OrderedDict[tuple[int, int, torch.device], DynamicsModel] = OrderedDict()
        self._latest: dict[int, int] = {}
        self._lock = Lock()

    def get(self, surrogate: int, version: int, device: torch.device = CPU) -> DynamicsModel:
        """The model of a version, on a device. Raises ``UnknownModel``, ``UnknownSurrogate`` or ``Damaged``."""
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
                self._latest.pop(surrogate, None)  # it may have been this one
            raise

    def latest(self, surrogate: int) -> int:
        """The newest version that is known here. Raises ``NoModel`` or ``UnknownSurrogate``."""
        with self._lock:
            if version := self._latest.get(surrogate):
                return version
        return self.refresh(surrogate)

    def refresh(self, surrogate: int) -> int:
        """The newest version that is stored and sound, another server's too.

        Raises:
            NoModel, UnknownSurrogate: as the classes say.
            Damaged: it can't be read, and was not set aside.
        """
        while (version := self._newest().get(surrogate)) is not None:
            try:
                return self.publish(surrogate, version)
            except Damaged:
                if self._newest().get(surrogate) == version:
                    raise
        raise NoModel("expected a surrogate with a model, but no model has been fitted yet")

    def look(self) -> list[int]:
        """Publish what other servers have stored of the surrogates that are in use here, and forget those that are
        gone; returns the latter."""
        with self._lock:
            known = list(self._latest.items())
        if not known:
            return []
        newest = self._newest()
        gone = [surrogate for surrogate, _ in known if surrogate not in newest]
        for surrogate in gone:
            self.forget(surrogate)
        for surrogate, version in known:
            if newest.get(surrogate, version) > version:
                self.publish(surrogate, newest[surrogate])
        return gone

    def publish(self, surrogate: int, version: int) -> int:
        """Let lanes move to a version when they reset, unless a newer one is known; returns the newest."""
        self.get(surrogate, version)
        with self._lock:
            self._latest[surrogate] = max(version, self._latest.get(surrogate, 0))
            return self._latest[surrogate]

    def forget(self, surrogate: int) -> None:
        """Drop all of a surrogate that was deleted."""
        with self._lock:
            self._latest.pop(surrogate, None)
            for key in [key for key in self._models if key[0] == surrogate]:
                del self._models[key]

    def _keep(self, key: tuple[int, int, torch.device], model: DynamicsModel) -> None:
        with self._lock:
            self._models[key] = model
            while len(self._models) > self._capacity:
                self._models.popitem(last=False)
