"""Errors of new samples are those of the model's predictions, and leave out what they should."""

import torch

from surrogym_server.environment.samples import Samples, increments, saturated
from surrogym_server.sampling.surprises import surprises_of


def test_errors_of_new_samples_are_their_values_less_the_means(model, unseen):
    free = unseen.at(~saturated(model.definition, unseen.q_next))
    errors = torch.tensor(surprises_of(model, free), dtype=torch.float64).T
    truth = torch.cat([increments(model.definition, free), free.reward[:, None]], -1)
    torch.testing.assert_close(errors, truth - model.means(free.q, free.u))


def test_neither_clipped_increments_nor_rewards_of_steps_that_end_an_episode_count(model, unseen):
    cut = saturated(model.definition, unseen.q_next)
    assert 0 < int(cut.sum()) < len(unseen)
    ended = Samples(unseen.q, unseen.u, unseen.q_next, unseen.reward, torch.arange(len(unseen)) < 7)
    counts = [len(output) for output in surprises_of(model, ended)]
    assert counts == [int((~cut).sum())] * 2 + [len(unseen) - 7]
