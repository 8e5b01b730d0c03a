"""Training where episodes are long and nothing ends them: short episodes from anywhere, and more steps."""

from __future__ import annotations

from dataclasses import replace

from surrogym_trainer.training.search import MAX_STEPS, SearchTask

LONG = 5  # rollouts of an episode; the lanes of a shorter one start often enough
SHORTER = 5  # times: a training episode
MORE = 3  # times as many steps if nobody chose their number
SIGHT = 1 / 2  # horizon of the discount, 1 / (1 - gamma), as a share of a training episode
NOISE = 0.6  # of its first value: least standard deviation of an action in these trainings


def with_short_episodes(task: SearchTask, rollout: int) -> SearchTask:
    """Return the task with short training episodes from anywhere, and more steps, if its episodes are long.

    If nothing ends long episodes, each lane has few starts in a whole training. Its lanes are then mostly where the
    policy ends up, and it hardly sees the other states. The last reward of a truncated episode includes the critic's
    value of its last state, so short episodes don't change what is optimal. Policies are still compared over whole
    episodes from the declared starts. The task is unchanged if the user chose starts or a time limit.

    Episodes from anywhere begin near states that are paid as well. What is learned there, such as to balance, needs
    little noise, and the noise is the same in all states. So it would fall before the way to these states is found.
    In the additional steps it keeps ``NOISE`` of its first value.

    The discount has a horizon of ``SIGHT`` of a training episode. What lies further ahead is hardly seen in an episode,
    so the critic guesses it. In some tasks the guess is good, and the longer horizon finds the way from more starts. So
    in a training whose steps nobody chose, a second network follows with the discount of whole episodes.

    Args:
        task: a task.
        rollout: steps of each lane in a rollout.
    """
    spec, settings = task.port.spec(), task.settings
    ways = settings.start_box, settings.start_visited, settings.horizon
    chosen = any(way is not None for way in ways) or not {"time_limit", "start_box"}.isdisjoint(settings.session)
    limit = spec.time_limit or 0
    if chosen or spec.termination != () or limit <= LONG * rollout or not spec.preset.adapts_training:
        return task
    length = limit // SHORTER
    session = {**settings.session, "time_limit": length}
    steps, noise = (min(MORE * task.steps, MAX_STEPS), NOISE) if task.prolong else (task.steps, 0.0)
    short = replace(settings, start_box=1.0, session=session, judge=settings.judging)
    gamma = 1 - 1 / (SIGHT * length)
    return replace(task, settings=short, steps=steps, patient=True, gamma=gamma, noise=noise)
