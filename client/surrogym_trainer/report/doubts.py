"""The sections of the report about untested points and next steps. Each sentence follows from stored data."""

from __future__ import annotations

from surrogym_client.surrogates.advice import advice
from surrogym_sampler.original.loading import env_option, is_known, sample_command
from surrogym_shared.wire import EvaluationView, PolicyView
from surrogym_shared.words import counted
from surrogym_trainer.report.known import PREFERRED, Known
from surrogym_trainer.report.prediction import outcome_of
from surrogym_trainer.report.wording import starts_of

FEW = 30  # the report says that an average over fewer episodes than this is unreliable


def tested(known: Known) -> str:
    """Return a sentence about the starts and machines with which the controller was tested; empty without real
    episodes."""
    evaluations = [] if known.policy is None else known.policy.evaluations
    most: dict[str, int] = {}
    for one in evaluations:
        if one.controller == "policy":
            most[starts_of(one)] = max(most.get(starts_of(one), 0), one.episodes)
    own = [f"{starts} ({counted(episodes, 'episode')})" for starts, episodes in most.items()]
    return f"Tested were: {'; '.join(own)}. Not tested were:" if own else ""


def untested(known: Known) -> list[str]:
    """Return sentences about what the real episodes do not cover."""
    policy, real = known.policy, known.real
    if policy is None:
        return ["Everything: there is no controller yet."]
    if real is None:
        return ["The controller itself: no real episode was run with it in its own environment."]
    found = []
    if real.episodes < FEW:
        said = f"{counted(real.episodes, 'episode')} say{'s' if real.episodes == 1 else ''} little of an average"
        found.append(f"Many starts: {said}; {FEW} or more would.")
    if not _other_starts(policy):
        found.append("Starts outside the declared ones.")
    if not _other_machines(policy):
        found.append("Another unit of the machine, or a worn one: its physical parameters were as they are.")
    limit = known.view.spec.time_limit
    if limit is not None:
        found.append(f"Episodes longer than {limit} steps.")
    if policy.audit is None:
        found.append("The model's prediction, by an audit before the test.")
    if not any(one.controller == "reference" for one in policy.evaluations):
        found.append("A controller of reference, such as the one in use today.")
    found.append("Disturbances, faults of sensors, and everything outside the declared ranges of the coordinates.")
    return found


def next_steps(known: Known) -> list[str]:
    """Return recommended next steps, the most urgent first."""
    view, policy, real = known.view, known.policy, known.real
    name = view.name
    if policy is None:
        start = sample_command(name, view.environment)
        return [
            f"Train a controller: surrogym train {name}"
            if known.models
            else f"Let a sampler answer the first queries: {start}"
        ]
    run = f"surrogym evaluate policy.zip{_where(known)}"
    fetch = f"Fetch its file for the next commands: surrogym policy get {name}@{policy.version} --out policy.zip"
    if policy.drifted_at is not None:
        return ["Don't use it: the machine has changed. Register it under another name, and begin again."]
    if real is None:
        return [fetch, f"Test it in reality: {run} --compare zero", *_of_the_model(known)]
    found = []
    judged = outcome_of(known)
    if policy.trusted is False or (judged is not None and judged.verdict == "worse"):
        found.append("Don't use it yet: the model was wrong, or not sure, where this controller goes.")
        found.append(f"Ask for real steps on its way, and train again: surrogym train {name} --improve 8")
    elif real.success_rate is not None and real.success_rate < 1:
        found.append("Look at the worst episode above before it is used: not every start succeeded.")
    elif real.success_rate is None:
        found.append("Look at the worst episode above, and decide whether it is good enough: no success was declared.")
    tests = _tests(known, policy, real, run)
    found += [fetch, *tests] if tests else []
    if real.promise_kept and policy.trusted is not False and PREFERRED not in policy.aliases:
        found.append(f"If that is good enough, name it: surrogym policy alias {name}@{policy.version} {PREFERRED}")
    return found + _of_the_model(known)


def _where(known: Known) -> str:
    """Return the option ``--env`` for a suggested command; empty if the command finds the environment without it."""
    return env_option(known.view.environment)


def _tests(known: Known, policy: PolicyView, real: EvaluationView, run: str) -> list[str]:
    """Return the tests in reality that are still missing, with their commands; ``run`` is the command of an
    evaluation."""
    found = []
    if real.episodes < FEW:
        found.append(f"Run more episodes: {run} --episodes {FEW}")
    if known.without is None:
        found.append(f"Run the same starts without it: {run} --compare random")
    if not any(one.controller == "reference" for one in policy.evaluations):
        found.append(f"Compare it with the controller in use today: {run} --reference module:Class")
    if not _other_starts(policy):
        found.append(f"See how it does from other starts: {run} --wide")
    if not _other_machines(policy):
        changed = f": {run} --perturb 0.1" if is_known(known.view.environment) else ", in a machine that you changed"
        found.append(f"Find out how much change of the machine it stands{changed}")
    return found


def _other_starts(policy: PolicyView) -> bool:
    """Return whether the policy was tested from starts outside the declared ones."""
    own = [one.note for one in policy.evaluations if one.controller == "policy"]
    return any("anywhere" in note or "times as far" in note for note in own)


def _other_machines(policy: PolicyView) -> bool:
    """Return whether the policy was tested in an environment other than its own, or in a changed one."""
    own = [one for one in policy.evaluations if one.controller == "policy"]
    return any(not one.own or "changed by" in one.note for one in own)


def _of_the_model(known: Known) -> list[str]:
    said = advice(known.view, known.models)
    return [f"To make the model surer: {said}"] if said else []
