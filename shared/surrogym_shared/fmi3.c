/* FMI 3.0 for co-simulation around a block that steps at a fixed period (block.h). C99.

Communication steps may have any length. A plant holds its inputs from one sampling instant to the next, and shows the
new outputs there. A controller (BLOCK_ACTS_FIRST) acts at once on the inputs of a sampling instant. */

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define BLOCK_TABLES
#include "block.h"

#ifndef fmi3FunctionTypes_h /* the official header may be included before; the types are the same */
typedef void *fmi3Instance, *fmi3InstanceEnvironment, *fmi3FMUState;
typedef uint32_t fmi3ValueReference;
typedef float fmi3Float32;
typedef double fmi3Float64;
typedef int8_t fmi3Int8;
typedef uint8_t fmi3UInt8, fmi3Byte;
typedef int16_t fmi3Int16;
typedef uint16_t fmi3UInt16;
typedef int32_t fmi3Int32;
typedef uint32_t fmi3UInt32;
typedef int64_t fmi3Int64;
typedef uint64_t fmi3UInt64;
typedef bool fmi3Boolean, fmi3Clock;
typedef const char *fmi3String;
typedef const fmi3Byte *fmi3Binary;
typedef enum { fmi3OK, fmi3Warning, fmi3Discard, fmi3Error, fmi3Fatal } fmi3Status;
typedef enum { fmi3Independent, fmi3Constant, fmi3Fixed, fmi3Tunable, fmi3Discrete, fmi3Dependent } fmi3DependencyKind;
typedef enum { fmi3IntervalNotYetKnown, fmi3IntervalUnchanged, fmi3IntervalChanged } fmi3IntervalQualifier;
typedef void (*fmi3LogMessageCallback)(fmi3InstanceEnvironment, fmi3Status, fmi3String, fmi3String);
typedef void (*fmi3ClockUpdateCallback)(fmi3InstanceEnvironment);
typedef void (*fmi3IntermediateUpdateCallback)(fmi3InstanceEnvironment, fmi3Float64, fmi3Boolean, fmi3Boolean,
                                               fmi3Boolean, fmi3Boolean, fmi3Boolean *, fmi3Float64 *);
typedef void (*fmi3LockPreemptionCallback)(void);
typedef void (*fmi3UnlockPreemptionCallback)(void);
#endif

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define EXPORT __attribute__((visibility("default")))
#else
#define EXPORT
#endif

#define SLACK 1e-3 /* of a period: instants that differ by less are the same */
enum { CREATED, INITIALISING, STEPPING, ENDED };

typedef struct { /* all that a step reads and writes */
    double values[BLOCK_VALUES], held[BLOCK_VALUES]; /* held: the inputs of the last sampling instant */
    double memory[BLOCK_MEMORY];
    double begin, time;
    long long steps;
    int mode, holds; /* holds: whether a period has begun, whose inputs are held */
} State;

typedef struct {
    State state;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
} Instance;

static fmi3Status refused(const Instance *instance, const char *why)
{
    if (instance && instance->log) instance->log(instance->environment, fmi3Error, "logStatusError", why);
    return fmi3Error;
}

/* Report the variable that the block can't use. */
static fmi3Status unusable(const Instance *instance, int value)
{
    char words[300] = "expected a number within the limits of the variable: ";
    strncat(words, block_names[value], sizeof words - strlen(words) - 1);
    return refused(instance, words);
}

static void restart(State *state)
{
    memset(state, 0, sizeof *state);
    memcpy(state->values, block_starts, sizeof state->values);
}

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

EXPORT fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean on, size_t n, const fmi3String categories[])
{
    return fmi3OK; /* errors are always reported, and there is nothing else */
}

EXPORT fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
    fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference required[], size_t n,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update)
{
    Instance *made = calloc(1, sizeof *made);
    if (!made) return NULL;
    made->environment = environment;
    made->log = log;
    restart(&made->state);
    if (!token || strcmp(token, BLOCK_TOKEN)) {
        refused(made, "expected the instantiation token of the model description: the files are not of one FMU");
        free(made);
        return NULL;
    }
    return made;
}

EXPORT fmi3Instance fmi3InstantiateModelExchange(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    return NULL;
}

EXPORT fmi3Instance fmi3InstantiateScheduledExecution(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3ClockUpdateCallback update,
    fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock)
{
    return NULL;
}

EXPORT void fmi3FreeInstance(fmi3Instance instance) { free(instance); }

EXPORT fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean has_tolerance, fmi3Float64 tolerance,
                                              fmi3Float64 start, fmi3Boolean has_stop, fmi3Float64 stop)
{
    State *state = &((Instance *)instance)->state;
    if (state->mode != CREATED) return refused(instance, "expected an instance that is new or reset");
    state->mode = INITIALISING;
    state->begin = state->time = start;
    return fmi3OK;
}

EXPORT fmi3Status fmi3ExitInitializationMode(fmi3Instance instance)
{
    State *state = &((Instance *)instance)->state;
    if (state->mode != INITIALISING) return refused(instance, "expected an instance in initialization mode");
    const int fault = block_start(state->values, state->memory);
    if (fault) return unusable(instance, fault - 1);
    state->mode = STEPPING;
    return fmi3OK;
}

EXPORT fmi3Status fmi3Terminate(fmi3Instance instance)
{
    ((Instance *)instance)->state.mode = ENDED;
    return fmi3OK;
}

EXPORT fmi3Status fmi3Reset(fmi3Instance instance)
{
    restart(&((Instance *)instance)->state);
    return fmi3OK;
}

/* Time of the sampling instant at which the block steps next. */
static double next_instant(const State *state)
{
    return state->begin + BLOCK_PERIOD * (double)(state->steps + (BLOCK_ACTS_FIRST ? 0 : 1));
}

EXPORT fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 now, fmi3Float64 seconds, fmi3Boolean forward,
                             fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *reached)
{
    State *state = &((Instance *)instance)->state;
    const double slack = SLACK * BLOCK_PERIOD, end = now + seconds;
    const double last = BLOCK_ACTS_FIRST ? end - 2 * slack : end; /* sampling instants up to this time */
    *event = *terminate = *early = false;
    *reached = now;
    if (state->mode != STEPPING) return refused(instance, "expected an instance that is initialised");
    if (!(seconds >= 0.0) || !isfinite(end)) return refused(instance, "expected a time and a step that are finite");
    if (!state->holds || BLOCK_ACTS_FIRST) memcpy(state->held, state->values, sizeof state->held);
    for (; next_instant(state) <= last + slack; state->steps++) {
        const int fault = block_step(state->values, state->held, state->memory);
        if (fault) return unusable(instance, fault - 1);
    }
    state->holds = end > next_instant(state) - BLOCK_PERIOD + slack;
    state->time = *reached = end;
    return fmi3OK;
}

/* Values of variables. Reference 0 is the time, reference i + 1 is the value i. */

static fmi3Status readable(Instance *instance, fmi3ValueReference reference, int kind)
{
    State *state = &instance->state;
    if (reference > BLOCK_VALUES || kind != (reference ? block_kinds[reference - 1] : 0))
        return refused(instance, "expected the reference of a variable of this type");
    if (state->mode == INITIALISING && block_start(state->values, state->memory))
        return refused(instance, "expected start values within the limits of the variables");
    return fmi3OK;
}

static fmi3Status settable(Instance *instance, fmi3ValueReference reference, int kind)
{
    if (!reference || reference > BLOCK_VALUES || kind != block_kinds[reference - 1])
        return refused(instance, "expected the reference of a variable of this type");
    const int may = block_settable[reference - 1];
    if (may == 2 || (may == 1 && instance->state.mode <= INITIALISING)) return fmi3OK;
    return refused(instance, "expected an input, or a start value before the end of the initialisation");
}

#define VALUES_OF(type, kind)                                                                                          \
    EXPORT fmi3Status fmi3Get##type(fmi3Instance instance, const fmi3ValueReference references[], size_t n,            \
                                    fmi3##type values[], size_t m)                                                     \
    {                                                                                                                  \
        Instance *given = instance;                                                                                    \
        for (size_t i = 0; i < n; i++) {                                                                               \
            if (readable(given, references[i], kind) != fmi3OK) return fmi3Error;                                      \
            values[i] = (fmi3##type)(references[i] ? given->state.values[references[i] - 1] : given->state.time);      \
        }                                                                                                              \
        return fmi3OK;                                                                                                 \
    }                                                                                                                  \
    EXPORT fmi3Status fmi3Set##type(fmi3Instance instance, const fmi3ValueReference references[], size_t n,            \
                                    const fmi3##type values[], size_t m)                                               \
    {                                                                                                                  \
        Instance *given = instance;                                                                                    \
        for (size_t i = 0; i < n; i++) {                                                                               \
            if (settable(given, references[i], kind) != fmi3OK) return fmi3Error;                                      \
            given->state.values[references[i] - 1] = (double)values[i];                                                \
        }                                                                                                              \
        return fmi3OK;                                                                                                 \
    }

VALUES_OF(Float64, 0)
VALUES_OF(Int32, 1)
VALUES_OF(Boolean, 2)

/* The whole state. A serialized one begins with the token of its FMU. */

EXPORT fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *kept)
{
    if (!*kept) *kept = malloc(sizeof(State));
    if (!*kept) return refused(instance, "expected memory for a state, got none");
    memcpy(*kept, &((Instance *)instance)->state, sizeof(State));
    return fmi3OK;
}

EXPORT fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState kept)
{
    memcpy(&((Instance *)instance)->state, kept, sizeof(State));
    return fmi3OK;
}

EXPORT fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *kept)
{
    if (kept) free(*kept), *kept = NULL;
    return fmi3OK;
}

EXPORT fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState kept, size_t *size)
{
    *size = sizeof BLOCK_TOKEN + sizeof(State);
    return fmi3OK;
}

EXPORT fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState kept, fmi3Byte bytes[], size_t size)
{
    if (size < sizeof BLOCK_TOKEN + sizeof(State)) return refused(instance, "expected more bytes for a state");
    memcpy(bytes, BLOCK_TOKEN, sizeof BLOCK_TOKEN);
    memcpy(bytes + sizeof BLOCK_TOKEN, kept, sizeof(State));
    return fmi3OK;
}

EXPORT fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte bytes[], size_t size,
                                          fmi3FMUState *kept)
{
    if (size != sizeof BLOCK_TOKEN + sizeof(State) || memcmp(bytes, BLOCK_TOKEN, sizeof BLOCK_TOKEN))
        return refused(instance, "expected a state of this FMU");
    if (!*kept) *kept = malloc(sizeof(State));
    if (!*kept) return refused(instance, "expected memory for a state, got none");
    memcpy(*kept, bytes + sizeof BLOCK_TOKEN, sizeof(State));
    return fmi3OK;
}

/* Functions that these FMUs have no use for. Some importers don't load an FMU that lacks one. */

#define REFUSED(name, ...)                                                                                             \
    EXPORT fmi3Status name(fmi3Instance instance, __VA_ARGS__) { return refused(instance, "not supported: " #name); }
#define REFUSED_ALONE(name)                                                                                            \
    EXPORT fmi3Status name(fmi3Instance instance) { return refused(instance, "not supported: " #name); }
#define REFERENCES const fmi3ValueReference references[], size_t n
#define NO_VALUES_OF(type)                                                                                             \
    REFUSED(fmi3Get##type, REFERENCES, fmi3##type values[], size_t m)                                                  \
    REFUSED(fmi3Set##type, REFERENCES, const fmi3##type values[], size_t m)

NO_VALUES_OF(Float32)
NO_VALUES_OF(Int8)
NO_VALUES_OF(UInt8)
NO_VALUES_OF(Int16)
NO_VALUES_OF(UInt16)
NO_VALUES_OF(UInt32)
NO_VALUES_OF(Int64)
NO_VALUES_OF(UInt64)
NO_VALUES_OF(String)
REFUSED(fmi3GetBinary, REFERENCES, size_t sizes[], fmi3Binary values[], size_t m)
REFUSED(fmi3SetBinary, REFERENCES, const size_t sizes[], const fmi3Binary values[], size_t m)
REFUSED(fmi3GetClock, REFERENCES, fmi3Clock values[])
REFUSED(fmi3SetClock, REFERENCES, const fmi3Clock values[])
REFUSED(fmi3GetNumberOfVariableDependencies, fmi3ValueReference reference, size_t *count)
REFUSED(fmi3GetVariableDependencies, fmi3ValueReference dependent, size_t elements[], fmi3ValueReference independents[],
        size_t others[], fmi3DependencyKind kinds[], size_t count)
REFUSED(fmi3GetDirectionalDerivative, const fmi3ValueReference unknowns[], size_t n, const fmi3ValueReference knowns[],
        size_t m, const fmi3Float64 seed[], size_t s, fmi3Float64 sensitivity[], size_t t)
REFUSED(fmi3GetAdjointDerivative, const fmi3ValueReference unknowns[], size_t n, const fmi3ValueReference knowns[],
        size_t m, const fmi3Float64 seed[], size_t s, fmi3Float64 sensitivity[], size_t t)
REFUSED_ALONE(fmi3EnterConfigurationMode)
REFUSED_ALONE(fmi3ExitConfigurationMode)
REFUSED_ALONE(fmi3EnterEventMode)
REFUSED_ALONE(fmi3EnterStepMode)
REFUSED_ALONE(fmi3EvaluateDiscreteStates)
REFUSED(fmi3GetIntervalDecimal, REFERENCES, fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[])
REFUSED(fmi3GetIntervalFraction, REFERENCES, fmi3UInt64 counters[], fmi3UInt64 resolutions[],
        fmi3IntervalQualifier qualifiers[])
REFUSED(fmi3GetShiftDecimal, REFERENCES, fmi3Float64 shifts[])
REFUSED(fmi3GetShiftFraction, REFERENCES, fmi3UInt64 counters[], fmi3UInt64 resolutions[])
REFUSED(fmi3SetIntervalDecimal, REFERENCES, const fmi3Float64 intervals[])
REFUSED(fmi3SetIntervalFraction, REFERENCES, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
REFUSED(fmi3SetShiftDecimal, REFERENCES, const fmi3Float64 shifts[])
REFUSED(fmi3SetShiftFraction, REFERENCES, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
REFUSED(fmi3UpdateDiscreteStates, fmi3Boolean *again, fmi3Boolean *terminate, fmi3Boolean *nominals,
        fmi3Boolean *states, fmi3Boolean *defined, fmi3Float64 *next)
REFUSED(fmi3GetOutputDerivatives, REFERENCES, const fmi3Int32 orders[], fmi3Float64 values[], size_t m)
REFUSED_ALONE(fmi3EnterContinuousTimeMode)
REFUSED(fmi3CompletedIntegratorStep, fmi3Boolean forward, fmi3Boolean *event, fmi3Boolean *terminate)
REFUSED(fmi3SetTime, fmi3Float64 time)
REFUSED(fmi3SetContinuousStates, const fmi3Float64 states[], size_t n)
REFUSED(fmi3GetContinuousStateDerivatives, fmi3Float64 derivatives[], size_t n)
REFUSED(fmi3GetEventIndicators, fmi3Float64 indicators[], size_t n)
REFUSED(fmi3GetContinuousStates, fmi3Float64 states[], size_t n)
REFUSED(fmi3GetNominalsOfContinuousStates, fmi3Float64 nominals[], size_t n)
REFUSED(fmi3GetNumberOfEventIndicators, size_t *n)
REFUSED(fmi3GetNumberOfContinuousStates, size_t *n)
REFUSED(fmi3ActivateModelPartition, fmi3ValueReference clock, fmi3Float64 time)
