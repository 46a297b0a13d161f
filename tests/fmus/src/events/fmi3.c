/* SPDX-License-Identifier: Apache-2.0
 *
 * FMI 3.0, model exchange and co-simulation with event mode, early return and clocks: the state machines of 2.3, 3.2.1
 * and 4.2.1. An input clock is FIRST_CLOCK, an output clock that ticks with each counted event is FIRST_CLOCK + 1.
 */
#include <stdlib.h>
#include <string.h>

#include "fmi3FunctionTypes.h"
#include "model.h"
#include "variables.h"

typedef enum {
    INSTANTIATED = 1,
    INITIALIZATION = 2,
    EVENT = 4,
    CONTINUOUS = 8,
    STEP = 16,
    TERMINATED = 32
} Mode;

static const char *const mode_names[] = {"instantiated",         "initialization mode", "event mode",
                                         "continuous-time mode", "step mode",           "terminated"};

typedef struct {
    char *name;
    fmi3LogMessageCallback log;
    fmi3InstanceEnvironment environment;
    bool co_simulation, event_mode_used, early_return_allowed;
    Mode mode;
    double stop;
    double completed[2]; /* times of the last two completed integrator steps: 3.2.1, fmi3SetTime */
    bool written;        /* values were set since the last step: 4.2.1, fmi3Get{VariableType} */
    bool event_needed;   /* fmi3DoStep has asked for event mode */
    bool ticked;         /* the output clock */
    bool armed;          /* the interval of the input clock has been asked for since it ticked */
    Model model;
} Instance;

#define INITIALIZED (EVENT | CONTINUOUS | STEP)

static Instance *called(fmi3Instance c, const char *function, unsigned allowed)
{
    Instance *instance = c;
    int k = 0;

    if (instance == NULL) broken(function, "no instance");
    while ((instance->mode >> k) > 1) k++;
    if (!(instance->mode & allowed)) broken(function, mode_names[k]);
    return instance;
}

static fmi3Status says(Instance *instance, fmi3Status status, const char *text)
{
    instance->log(instance->environment, status, "logStatus", text);
    return status;
}

const char *fmi3GetVersion(void) { return "3.0"; }

static Instance *new_instance(fmi3String name, fmi3String token, fmi3InstanceEnvironment environment,
                              fmi3LogMessageCallback log)
{
    Instance *instance = calloc(1, sizeof *instance);

    if (strcmp(token, FMU_GUID) != 0) return NULL;
    instance->name = strcpy(calloc(1, strlen(name) + 1), name);
    instance->environment = environment;
    instance->log = log;
    instance->mode = INSTANTIATED;
    model_start(&instance->model);
    return instance;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                          fmi3Boolean logging, fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log)
{
    (void)resources;
    (void)visible;
    (void)logging;
    return new_instance(name, token, environment, log);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean event_mode_used,
                                         fmi3Boolean early_return_allowed, const fmi3ValueReference intermediate[],
                                         size_t n, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update)
{
    Instance *instance = new_instance(name, token, environment, log);

    (void)resources;
    (void)visible;
    (void)logging;
    (void)intermediate;
    (void)n;
    (void)update;
    if (instance == NULL) return NULL;
    instance->co_simulation = true;
    instance->event_mode_used = event_mode_used;
    instance->early_return_allowed = early_return_allowed;
    return instance;
}

fmi3Instance fmi3InstantiateScheduledExecution(void) { return NULL; }

void fmi3FreeInstance(fmi3Instance c)
{
    Instance *instance = called(c, "fmi3FreeInstance", INSTANTIATED | INITIALIZATION | INITIALIZED | TERMINATED);

    free(instance->name);
    free(instance);
}

fmi3Status fmi3Reset(fmi3Instance c)
{
    Instance *instance = called(c, "fmi3Reset", INSTANTIATED | INITIALIZATION | INITIALIZED | TERMINATED);
    const Instance old = *instance;

    memset(instance, 0, sizeof *instance);
    instance->name = old.name;
    instance->log = old.log;
    instance->environment = old.environment;
    instance->co_simulation = old.co_simulation;
    instance->event_mode_used = old.event_mode_used;
    instance->early_return_allowed = old.early_return_allowed;
    instance->mode = INSTANTIATED;
    model_start(&instance->model);
    return fmi3OK;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean tolerance_defined, fmi3Float64 tolerance,
                                       fmi3Float64 start, fmi3Boolean stop_defined, fmi3Float64 stop)
{
    Instance *instance = called(c, "fmi3EnterInitializationMode", INSTANTIATED);

    (void)tolerance_defined;
    (void)tolerance;
    instance->mode = INITIALIZATION;
    instance->model.time = start;
    instance->completed[0] = instance->completed[1] = start;
    instance->stop = stop_defined ? stop : 1e300;
    return fmi3OK;
}

static void handle_inside(Instance *instance)
{
    while (model_event(&instance->model).again && !instance->model.terminate) continue;
    model_equations(&instance->model);
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c)
{
    Instance *instance = called(c, "fmi3ExitInitializationMode", INITIALIZATION);

    model_initialize(&instance->model);
    model_equations(&instance->model);
    instance->written = false;
    if (!instance->co_simulation || instance->event_mode_used)
        instance->mode = EVENT;
    else {
        handle_inside(instance);
        instance->mode = STEP;
    }
    return fmi3OK;
}

fmi3Status fmi3EnterEventMode(fmi3Instance c)
{
    Instance *instance = called(c, "fmi3EnterEventMode", CONTINUOUS | STEP);

    if (instance->co_simulation && !instance->event_mode_used)
        broken("fmi3EnterEventMode", "step mode, without event mode");
    instance->mode = EVENT;
    instance->event_needed = false;
    instance->written = false;
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance c)
{
    called(c, "fmi3Terminate", INITIALIZED)->mode = TERMINATED;
    return fmi3OK;
}

/* ---- values ---- */

static void check_set(const Instance *instance, Role role, bool real)
{
    if ((instance->mode & (INSTANTIATED | INITIALIZATION)) && role >= ROLE_FIXED) return;
    if (instance->mode == EVENT && role >= ROLE_TUNABLE) return;
    /* In step mode with event mode, discrete inputs change in event mode only (4.2.1, fmi3EnterEventMode). */
    if (instance->mode == STEP && role >= ROLE_TUNABLE && !(instance->event_mode_used && role == ROLE_DISCRETE)) return;
    if (instance->mode == CONTINUOUS && role == ROLE_CONTINUOUS && real) return;
    broken(real ? "fmi3SetFloat64 of this variable" : "fmi3SetInt32 of this variable",
           instance->mode == CONTINUOUS ? "continuous-time mode"
           : instance->mode == STEP     ? "step mode"
                                        : "its state");
}

fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Float64 value[], size_t m)
{
    Instance *instance = called(c, "fmi3SetFloat64", INSTANTIATED | INITIALIZATION | INITIALIZED);

    if (n != m) broken("fmi3SetFloat64", "another number of values");
    for (size_t k = 0; k < n; k++) {
        check_set(instance, real_roles[vr[k]], true);
        instance->model.r[vr[k]] = value[k];
    }
    instance->written = instance->mode == STEP;
    return fmi3OK;
}

fmi3Status fmi3SetInt32(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Int32 value[], size_t m)
{
    Instance *instance = called(c, "fmi3SetInt32", INSTANTIATED | INITIALIZATION | INITIALIZED);

    if (n != m) broken("fmi3SetInt32", "another number of values");
    for (size_t k = 0; k < n; k++) {
        check_set(instance, integer_roles[vr[k] - FIRST_INTEGER], false);
        instance->model.i[vr[k] - FIRST_INTEGER] = value[k];
    }
    instance->written = instance->mode == STEP;
    return fmi3OK;
}

static Instance *reading(fmi3Instance c, const char *function)
{
    Instance *instance = called(c, function, INITIALIZATION | INITIALIZED | TERMINATED);

    if (instance->written) broken(function, "step mode, after a value was set");
    if (instance->mode & (INITIALIZATION | EVENT | CONTINUOUS)) model_equations(&instance->model);
    instance->model.r[TIME] = instance->model.time;
    return instance;
}

fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 value[], size_t m)
{
    const Instance *instance = reading(c, "fmi3GetFloat64");

    if (n != m) broken("fmi3GetFloat64", "another number of values");
    for (size_t k = 0; k < n; k++) value[k] = instance->model.r[vr[k]];
    return fmi3OK;
}

fmi3Status fmi3GetInt32(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Int32 value[], size_t m)
{
    const Instance *instance = reading(c, "fmi3GetInt32");

    if (n != m) broken("fmi3GetInt32", "another number of values");
    for (size_t k = 0; k < n; k++) value[k] = instance->model.i[vr[k] - FIRST_INTEGER];
    return fmi3OK;
}

fmi3Status fmi3SetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Clock value[])
{
    Instance *instance = called(c, "fmi3SetClock", EVENT);

    for (size_t k = 0; k < n; k++) {
        if (vr[k] != FIRST_CLOCK) broken("fmi3SetClock of this clock", "event mode");
        instance->model.clock = value[k];
        instance->armed = false;
    }
    return fmi3OK;
}

fmi3Status fmi3GetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Clock value[])
{
    Instance *instance = called(c, "fmi3GetClock", EVENT);

    for (size_t k = 0; k < n; k++) {
        if (vr[k] != FIRST_CLOCK + 1) broken("fmi3GetClock of this clock", "event mode");
        value[k] = instance->ticked;
        instance->ticked = false;
    }
    return fmi3OK;
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *again, fmi3Boolean *terminate, fmi3Boolean *nominals,
                                    fmi3Boolean *states, fmi3Boolean *next_defined, fmi3Float64 *next)
{
    Instance *instance = called(c, "fmi3UpdateDiscreteStates", EVENT);
    const Update update = model_event(&instance->model);

    instance->ticked = instance->ticked || update.again;
    *again = update.again;
    *terminate = instance->model.terminate;
    *nominals = update.nominals_changed;
    *states = update.states_changed;
    *next_defined = instance->model.next_event_defined;
    *next = instance->model.next_event;
    return fmi3OK;
}

#define INTERVAL 0.3
#define SHIFT 0.1

fmi3Status fmi3GetIntervalDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 interval[],
                                  fmi3IntervalQualifier qualifier[])
{
    Instance *instance = called(c, "fmi3GetIntervalDecimal", INITIALIZATION | EVENT);

    if (n != 1 || vr[0] != FIRST_CLOCK) broken("fmi3GetIntervalDecimal of this clock", "event mode");
    interval[0] = INTERVAL;
    qualifier[0] = instance->armed ? fmi3IntervalUnchanged : fmi3IntervalChanged;
    instance->armed = true;
    return fmi3OK;
}

fmi3Status fmi3GetShiftDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 shift[])
{
    called(c, "fmi3GetShiftDecimal", INITIALIZATION);
    if (n != 1 || vr[0] != FIRST_CLOCK) broken("fmi3GetShiftDecimal of this clock", "initialization mode");
    shift[0] = SHIFT;
    return fmi3OK;
}

/* ---- the FMU state ---- */

#define ANY (INSTANTIATED | INITIALIZATION | INITIALIZED | TERMINATED)

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state)
{
    Instance *instance = called(c, "fmi3GetFMUState", ANY);

    if (*state == NULL) *state = calloc(1, sizeof *instance);
    memcpy(*state, instance, sizeof *instance);
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state)
{
    memcpy(called(c, "fmi3SetFMUState", ANY), state, sizeof(Instance));
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state)
{
    (void)c;
    free(*state);
    *state = NULL;
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size)
{
    (void)c;
    (void)state;
    *size = sizeof(Mode) + sizeof(Model);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size)
{
    const Instance *stored = state;

    (void)c;
    if (size != sizeof(Mode) + sizeof(Model)) return fmi3Error;
    memcpy(bytes, &stored->mode, sizeof(Mode));
    memcpy(bytes + sizeof(Mode), &stored->model, sizeof(Model));
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size, fmi3FMUState *state)
{
    Instance *stored;

    if (size != sizeof(Mode) + sizeof(Model)) return fmi3Error;
    if (*state == NULL) *state = calloc(1, sizeof *stored);
    stored = memcpy(*state, c, sizeof *stored);
    memcpy(&stored->mode, bytes, sizeof(Mode));
    memcpy(&stored->model, bytes + sizeof(Mode), sizeof(Model));
    stored->completed[0] = stored->completed[1] = stored->model.time;
    return fmi3OK;
}

/* ---- model exchange ---- */

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c)
{
    Instance *instance = called(c, "fmi3EnterContinuousTimeMode", EVENT);

    if (instance->co_simulation) broken("fmi3EnterContinuousTimeMode", "co-simulation");
    instance->mode = CONTINUOUS;
    return fmi3OK;
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no_set_state, fmi3Boolean *enter_event_mode,
                                       fmi3Boolean *terminate)
{
    Instance *instance = called(c, "fmi3CompletedIntegratorStep", CONTINUOUS);

    (void)no_set_state;
    instance->completed[0] = instance->completed[1];
    instance->completed[1] = instance->model.time;
    *enter_event_mode = model_completed_step(&instance->model);
    *terminate = false;
    return fmi3OK;
}

fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 time)
{
    Instance *instance = called(c, "fmi3SetTime", CONTINUOUS);

    if (time < instance->completed[0]) broken("fmi3SetTime to before the second last step", "continuous-time mode");
    if (time > instance->stop) broken("fmi3SetTime past the stop time", "continuous-time mode");
    instance->model.time = time;
    return fmi3OK;
}

fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n)
{
    Instance *instance = called(c, "fmi3SetContinuousStates", CONTINUOUS);

    if (n != STATES) broken("fmi3SetContinuousStates", "another number of states");
    memcpy(instance->model.r, x, n * sizeof *x);
    return fmi3OK;
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 dx[], size_t n)
{
    Instance *instance = called(c, "fmi3GetContinuousStateDerivatives", INITIALIZATION | EVENT | CONTINUOUS);

    if (model_refuses(&instance->model)) return says(instance, fmi3Discard, "y is out of its range");
    model_equations(&instance->model);
    memcpy(dx, instance->model.r + STATES, n * sizeof *dx);
    return fmi3OK;
}

fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 z[], size_t n)
{
    Instance *instance = called(c, "fmi3GetEventIndicators", INITIALIZATION | EVENT | CONTINUOUS);

    if (n != INDICATORS) broken("fmi3GetEventIndicators", "another number of indicators");
    model_equations(&instance->model);
    model_indicators(&instance->model, z);
    return fmi3OK;
}

fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n)
{
    memcpy(x, called(c, "fmi3GetContinuousStates", INITIALIZATION | EVENT | CONTINUOUS)->model.r, n * sizeof *x);
    return fmi3OK;
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n)
{
    called(c, "fmi3GetNominalsOfContinuousStates", EVENT | CONTINUOUS);
    for (size_t k = 0; k < n; k++) x[k] = 1.0;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n)
{
    called(c, "fmi3GetNumberOfEventIndicators", ANY);
    *n = INDICATORS;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n)
{
    called(c, "fmi3GetNumberOfContinuousStates", ANY);
    *n = STATES;
    return fmi3OK;
}

/* ---- co-simulation ---- */

fmi3Status fmi3EnterStepMode(fmi3Instance c)
{
    Instance *instance = called(c, "fmi3EnterStepMode", EVENT);

    if (!instance->co_simulation) broken("fmi3EnterStepMode", "model exchange");
    instance->mode = STEP;
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 time, fmi3Float64 step_size, fmi3Boolean no_set_state,
                      fmi3Boolean *event_needed, fmi3Boolean *terminate, fmi3Boolean *early_return,
                      fmi3Float64 *last_time)
{
    Instance *instance = called(c, "fmi3DoStep", STEP);
    bool event = false;

    (void)no_set_state;
    if (time - instance->model.time > 1e-9 || instance->model.time - time > 1e-9)
        broken("fmi3DoStep from another time", "step mode");
    if (instance->event_needed) broken("fmi3DoStep", "step mode, where event mode is needed");
    if (step_size <= 0.0 || time + step_size > instance->stop) broken("fmi3DoStep past the stop time", "step mode");
    if (model_discards(&instance->model, step_size)) return says(instance, fmi3Discard, "the step is too long");
    advance(&instance->model, time, step_size, instance->event_mode_used && instance->early_return_allowed, last_time,
            &event);
    instance->written = false;
    *terminate = instance->model.terminate;
    *event_needed = instance->event_needed = event;
    *early_return = *last_time < time + step_size;
    return fmi3OK;
}

/* ---- what the model description denies; FMPy loads all functions of FMI 3.0 ---- */

#define DENIED(name)                                                                                                   \
    fmi3Status name(void) { return fmi3Error; }

DENIED(fmi3SetDebugLogging)
DENIED(fmi3GetFloat32)
DENIED(fmi3GetInt8)
DENIED(fmi3GetUInt8)
DENIED(fmi3GetInt16)
DENIED(fmi3GetUInt16)
DENIED(fmi3GetUInt32)
DENIED(fmi3GetInt64)
DENIED(fmi3GetUInt64)
DENIED(fmi3GetBoolean)
DENIED(fmi3GetString)
DENIED(fmi3GetBinary)
DENIED(fmi3SetFloat32)
DENIED(fmi3SetInt8)
DENIED(fmi3SetUInt8)
DENIED(fmi3SetInt16)
DENIED(fmi3SetUInt16)
DENIED(fmi3SetUInt32)
DENIED(fmi3SetInt64)
DENIED(fmi3SetUInt64)
DENIED(fmi3SetBoolean)
DENIED(fmi3SetString)
DENIED(fmi3SetBinary)
DENIED(fmi3GetNumberOfVariableDependencies)
DENIED(fmi3GetVariableDependencies)
DENIED(fmi3GetDirectionalDerivative)
DENIED(fmi3GetAdjointDerivative)
DENIED(fmi3EnterConfigurationMode)
DENIED(fmi3ExitConfigurationMode)
DENIED(fmi3GetIntervalFraction)
DENIED(fmi3GetShiftFraction)
DENIED(fmi3SetIntervalDecimal)
DENIED(fmi3SetIntervalFraction)
DENIED(fmi3SetShiftDecimal)
DENIED(fmi3SetShiftFraction)
DENIED(fmi3EvaluateDiscreteStates)
DENIED(fmi3GetOutputDerivatives)
DENIED(fmi3ActivateModelPartition)
