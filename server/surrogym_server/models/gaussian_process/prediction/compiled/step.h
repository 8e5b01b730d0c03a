/* One step of a surrogate: the most probable one, and how uncertain the model is about it. */

#ifndef SURROGYM_STEP_H
#define SURROGYM_STEP_H

/* Predict the step from coordinates q (C) under the action u (F).

q_next (C): next coordinates. reward: mean, without the reward of an end. deviation (O): standard deviations of the
outputs, the reward's last. terminated: 1 if the episode ends on arriving there, otherwise 0. */
void surrogym_step(const double *q, const double *u, double *q_next, double *reward, double *deviation,
                   int *terminated);

/* Observation o (D) at coordinates q (C). */
void surrogym_observe(const double *q, double *o);

#endif
