"""Action sequence from a reset to a declared termination that no sample has shown, such as a goal far away."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from surrogym_server.environment.samples import Samples
from surrogym_server.models.port import DynamicsModel
from surrogym_server.planning.sequences import policy_sequences
from surrogym_server.sampling.rollouts import (
    STARTS,
    Sequences,
    best_rollout,
    predict_paths,
    predictability,
    start_points,
)
from surrogym_shared.nouns import Query

# A path counts only if its end can be predicted at least this well, from 0 to 1. Otherwise a long sequence would
# probably lead elsewhere.
RELIABLE = 0.9
# A sequence is worth its real steps only if it ends the episode from at least this share of the starts.
LIKELY = 0.5


def way_to_end(model: DynamicsModel, samples: Samples, room: int, rng: np.random.Generator) -> Query | None:
    """Return the sequence of at most ``room`` actions that ends the episode with the greatest probability per step.

    Return None if the environment does not need it (it has snapshots or can be set to any state, or a sample has ended
    an episode), if it declares no termination, or if the model predicts no such sequence reliably.
    """
    definition = model.definition
    longest = min(definition.max_rollout or 0, room)
    if longest < 1 or definition.snapshots or definition.learns_termination or bool(samples.terminated.any()):
        return None
    tried = policy_sequences(model, start_points(definition, STARTS, rng), longest, seek_end=True)
    if tried is None:
        return None
    likely = 0.0

    def worth(starts: Tensor, sequences: Sequences) -> tuple[Tensor, Tensor]:
        nonlocal likely
        count, lanes = starts.shape[:2]
        actions = torch.from_numpy(sequences).repeat_interleave(lanes, 0)
        paths = predict_paths(model, starts.flatten(0, 1), actions)
        # A path that comes too close to a declared limit does not run on to the end.
        ended = (paths.ended * paths.running).cummax(1).values * (predictability(paths) > RELIABLE)
        share, cost = (x.reshape(count, lanes, -1).mean(1) for x in (ended, paths.running.cumsum(1)))
        likely = max(likely, float(share.max()))
        best = (torch.where(share >= LIKELY, share, 0.0) / cost).max(1)
        return best.values, best.indices + 1

    query = best_rollout(definition, worth, longest, {}, rng, tried)
    return query if likely >= LIKELY else None
