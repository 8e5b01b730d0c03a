/* A surrogate as a block: inputs, coordinates, observation, deviations, reward and end are its values, in this order. */

#include <math.h>

#include "block.h"
#include "step.h"
#include "twin.h"

enum {
    STATE = ACTIONS,
    OBSERVATION = STATE + COORDINATES,
    DEVIATION = OBSERVATION + OBSERVATIONS,
    REWARD = DEVIATION + OUTPUTS,
    TERMINATED
};

int block_start(double *values, double *memory)
{
    (void)memory;
    for (int c = 0; c < COORDINATES; c++)
        if (!(values[STATE + c] >= state_low[c] && values[STATE + c] <= state_high[c])) return STATE + c + 1;
    surrogym_observe(values + STATE, values + OBSERVATION);
    for (int v = DEVIATION; v <= TERMINATED; v++) values[v] = 0.0; /* of no step yet */
    return 0;
}

int block_step(double *values, const double *held, double *memory)
{
    double u[ACTIONS], next[COORDINATES], reward, deviation[OUTPUTS];
    int terminated;
    (void)memory;
    for (int f = 0; f < ACTIONS; f++) { /* limits in float32 may round to just outside */
        const double slack = 1e-6 * (action_high[f] - action_low[f]);
        if (!(held[f] >= action_low[f] - slack && held[f] <= action_high[f] + slack)) return f + 1;
        u[f] = fmin(fmax(held[f], action_low[f]), action_high[f]);
    }
    surrogym_step(values + STATE, u, next, &reward, deviation, &terminated);
    for (int c = 0; c < COORDINATES; c++) values[STATE + c] = next[c];
    for (int o = 0; o < OUTPUTS; o++) values[DEVIATION + o] = deviation[o];
    surrogym_observe(next, values + OBSERVATION);
    values[REWARD] = fmin(fmax(reward + (terminated ? TERMINAL_REWARD : 0.0), REWARD_LOW), REWARD_HIGH);
    values[TERMINATED] = terminated;
    return 0;
}
