"""Order of the rules. The first rule that applies chooses the real steps that a round requests."""

from surrogym_server.sampling.rules.ends import seek_end
from surrogym_server.sampling.rules.excursions import take_excursion
from surrogym_server.sampling.rules.initial import complete_initial_rollouts
from surrogym_server.sampling.rules.left import leave_to_trials
from surrogym_server.sampling.rules.past import see_the_past
from surrogym_server.sampling.rules.planned import plan_rollouts
from surrogym_server.sampling.rules.repeats import repeat_steps
from surrogym_server.sampling.rules.rule import Rule
from surrogym_server.sampling.rules.trials import try_planner
from surrogym_server.sampling.rules.valued import ask_best_candidates

# Rules for an environment that can be set to any state, whose queries are single steps.
STEP_RULES: tuple[Rule, ...] = (repeat_steps, ask_best_candidates)

# Rules for an environment that can only begin at resets or snapshots, whose queries are action sequences.
ROLLOUT_RULES: tuple[Rule, ...] = (
    take_excursion,
    see_the_past,
    complete_initial_rollouts,
    leave_to_trials,
    seek_end,
    try_planner,
    plan_rollouts,
)
