/* SPDX-License-Identifier: Apache-2.0
 *
 * FMI 2.0, model exchange and co-simulation: the state machines of 3.2.3 and 4.2.4.
 */
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"
#include "model.h"
#include "variables.h"

typedef enum {
    INSTANTIATED = 1,
    INITIALIZATION = 2,
    EVENT = 4,
    CONTINUOUS = 8,
    STEP_COMPLETE = 16,
    STEP_FAILED = 32,
    TERMINATED = 64
} Mode;

static const char *const mode_names[] = {"instantiated", "initialization mode", "event mode",
                                         "continuous-time mode", "step complete", "step failed", "terminated"};

typedef struct {
    char *name;
    fmi2CallbackLogger logger;
    fmi2ComponentEnvironment environment;
    fmi2Type type;
    Mode mode;
    bool defined; /* fmi2SetupExperiment was called */
    double stop;
    double completed[2]; /* times of the last two completed integrator steps: 3.2.1, fmi2SetTime */
    bool wants_to_end;
    Model model;
} Instance;

__attribute__((weak)) bool model_refuses_state(const Model *m)
{
    (void)m;
    return false;
}

#define RUNNING (EVENT | CONTINUOUS | STEP_COMPLETE)

static Instance *called(fmi2Component c, const char *function, unsigned allowed)
{
    Instance *instance = c;
    int k = 0;

    if (instance == NULL) broken(function, "no instance");
    while ((instance->mode >> k) > 1) k++;
    if (!(instance->mode & allowed)) broken(function, mode_names[k]);
    return instance;
}

static fmi2Status says(Instance *instance, fmi2Status status, const char *text)
{
    instance->logger(instance->environment, instance->name, status, "logStatus", "%s", text);
    return status;
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return "2.0"; }

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging)
{
    Instance *instance = calloc(1, sizeof *instance);

    (void)resources;
    (void)visible;
    (void)logging;
    if (strcmp(guid, FMU_GUID) != 0) return NULL;
    instance->name = strcpy(calloc(1, strlen(name) + 1), name);
    instance->logger = functions->logger;
    instance->environment = functions->componentEnvironment;
    instance->type = type;
    instance->mode = INSTANTIATED;
    model_start(&instance->model);
    return instance;
}

void fmi2FreeInstance(fmi2Component c)
{
    Instance *instance = called(c, "fmi2FreeInstance", INSTANTIATED | INITIALIZATION | TERMINATED | STEP_FAILED | RUNNING);

    free(instance->name);
    free(instance);
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[])
{
    (void)c;
    (void)on;
    (void)n;
    (void)categories;
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean tolerance_defined, fmi2Real tolerance, fmi2Real start,
                               fmi2Boolean stop_defined, fmi2Real stop)
{
    Instance *instance = called(c, "fmi2SetupExperiment", INSTANTIATED);

    (void)tolerance_defined;
    (void)tolerance;
    instance->defined = true;
    instance->model.time = start;
    instance->completed[0] = instance->completed[1] = start;
    instance->stop = stop_defined ? stop : 1e300;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    Instance *instance = called(c, "fmi2EnterInitializationMode", INSTANTIATED);

    if (!instance->defined) broken("fmi2EnterInitializationMode", "instantiated, before fmi2SetupExperiment");
    instance->mode = INITIALIZATION;
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    Instance *instance = called(c, "fmi2ExitInitializationMode", INITIALIZATION);

    model_initialize(&instance->model);
    if (instance->type == fmi2CoSimulation) {
        while (model_event(&instance->model).again && !instance->model.terminate) continue;
    }
    model_equations(&instance->model);
    instance->mode = instance->type == fmi2CoSimulation ? STEP_COMPLETE : EVENT;
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c)
{
    called(c, "fmi2Terminate", RUNNING | STEP_FAILED)->mode = TERMINATED;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c)
{
    Instance *instance = called(c, "fmi2Reset", INSTANTIATED | INITIALIZATION | TERMINATED | STEP_FAILED | RUNNING);
    const Instance old = *instance;

    memset(instance, 0, sizeof *instance);
    instance->name = old.name;
    instance->logger = old.logger;
    instance->environment = old.environment;
    instance->type = old.type;
    instance->mode = INSTANTIATED;
    model_start(&instance->model);
    return fmi2OK;
}

/* ---- values ---- */

static void check_set(const Instance *instance, Role role, bool real)
{
    const bool before = instance->mode & (INSTANTIATED | INITIALIZATION);
    const bool between = instance->mode & (EVENT | STEP_COMPLETE);

    if (before && role >= ROLE_FIXED) return;
    if (between && role >= ROLE_TUNABLE) return;
    if (instance->mode == CONTINUOUS && role == ROLE_CONTINUOUS && real) return;
    broken(real ? "fmi2SetReal of this variable" : "fmi2SetInteger of this variable",
           instance->mode == CONTINUOUS ? "continuous-time mode" : "its state");
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[])
{
    Instance *instance = called(c, "fmi2SetReal", INSTANTIATED | INITIALIZATION | RUNNING);

    for (size_t k = 0; k < n; k++) {
        check_set(instance, real_roles[vr[k]], true);
        instance->model.r[vr[k]] = value[k];
        instance->model.slope[vr[k]] = 0.0;
    }
    return fmi2OK;
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer value[])
{
    Instance *instance = called(c, "fmi2SetInteger", INSTANTIATED | INITIALIZATION | RUNNING);

    for (size_t k = 0; k < n; k++) {
        check_set(instance, integer_roles[vr[k] - FIRST_INTEGER], false);
        instance->model.i[vr[k] - FIRST_INTEGER] = value[k];
    }
    return fmi2OK;
}

#define READABLE (INITIALIZATION | RUNNING | STEP_FAILED | TERMINATED)

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[])
{
    Instance *instance = called(c, "fmi2GetReal", READABLE);

    if (instance->mode & (INITIALIZATION | EVENT | CONTINUOUS)) model_equations(&instance->model);
    for (size_t k = 0; k < n; k++) value[k] = instance->model.r[vr[k]];
    return fmi2OK;
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Integer value[])
{
    Instance *instance = called(c, "fmi2GetInteger", READABLE);

    for (size_t k = 0; k < n; k++) value[k] = instance->model.i[vr[k] - FIRST_INTEGER];
    return fmi2OK;
}

#define NO_SUCH(signature)                                                                                             \
    fmi2Status signature                                                                                               \
    {                                                                                                                  \
        (void)c;                                                                                                       \
        (void)vr;                                                                                                      \
        (void)n;                                                                                                       \
        (void)value;                                                                                                   \
        return fmi2Error;                                                                                              \
    }

NO_SUCH(fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Boolean value[]))
NO_SUCH(fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2String value[]))
NO_SUCH(fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Boolean value[]))
NO_SUCH(fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2String value[]))

/* ---- the FMU state ---- */

#define ANY (INSTANTIATED | INITIALIZATION | RUNNING | STEP_FAILED | TERMINATED)

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    Instance *instance = called(c, "fmi2GetFMUstate", ANY);

    if (*state == NULL) *state = calloc(1, sizeof *instance);
    memcpy(*state, instance, sizeof *instance);
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state)
{
    Instance *instance = called(c, "fmi2SetFMUstate", ANY);

    if (model_refuses_state(&instance->model)) return fmi2Error;
    memcpy(instance, state, sizeof(Instance));
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    (void)c;
    free(*state);
    *state = NULL;
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size)
{
    (void)c;
    (void)state;
    *size = sizeof(Mode) + sizeof(Model);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size)
{
    const Instance *stored = state;

    (void)c;
    if (size != sizeof(Mode) + sizeof(Model)) return fmi2Error;
    memcpy(bytes, &stored->mode, sizeof(Mode));
    memcpy(bytes + sizeof(Mode), &stored->model, sizeof(Model));
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state)
{
    Instance *stored;

    if (size != sizeof(Mode) + sizeof(Model)) return fmi2Error;
    if (*state == NULL) *state = calloc(1, sizeof *stored);
    stored = memcpy(*state, c, sizeof *stored);
    memcpy(&stored->mode, bytes, sizeof(Mode));
    memcpy(&stored->model, bytes + sizeof(Mode), sizeof(Model));
    stored->completed[0] = stored->completed[1] = stored->model.time;
    return fmi2OK;
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference a[], size_t n,
                                        const fmi2ValueReference b[], size_t m, const fmi2Real x[], fmi2Real y[])
{
    (void)a;
    (void)n;
    (void)b;
    (void)m;
    (void)x;
    (void)y;
    return c == NULL ? fmi2Fatal : fmi2Error;
}

/* ---- model exchange ---- */

fmi2Status fmi2EnterEventMode(fmi2Component c)
{
    called(c, "fmi2EnterEventMode", CONTINUOUS)->mode = EVENT;
    return fmi2OK;
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info)
{
    Instance *instance = called(c, "fmi2NewDiscreteStates", EVENT);
    const Update update = model_event(&instance->model);

    info->newDiscreteStatesNeeded = update.again;
    info->terminateSimulation = instance->model.terminate;
    info->nominalsOfContinuousStatesChanged = update.nominals_changed;
    info->valuesOfContinuousStatesChanged = update.states_changed;
    info->nextEventTimeDefined = instance->model.next_event_defined;
    info->nextEventTime = instance->model.next_event;
    return fmi2OK;
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c)
{
    called(c, "fmi2EnterContinuousTimeMode", EVENT)->mode = CONTINUOUS;
    return fmi2OK;
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean no_set_state, fmi2Boolean *enter_event_mode,
                                       fmi2Boolean *terminate)
{
    Instance *instance = called(c, "fmi2CompletedIntegratorStep", CONTINUOUS);

    (void)no_set_state;
    instance->completed[0] = instance->completed[1];
    instance->completed[1] = instance->model.time;
    *enter_event_mode = model_completed_step(&instance->model);
    *terminate = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time)
{
    Instance *instance = called(c, "fmi2SetTime", CONTINUOUS | EVENT);

    if (time < instance->completed[0]) broken("fmi2SetTime to before the second last step", "continuous-time mode");
    if (time > instance->stop) broken("fmi2SetTime past the stop time", "continuous-time mode");
    instance->model.time = time;
    return fmi2OK;
}

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n)
{
    Instance *instance = called(c, "fmi2SetContinuousStates", CONTINUOUS);

    if (n != STATES) broken("fmi2SetContinuousStates", "another number of states");
    memcpy(instance->model.r, x, n * sizeof *x);
    return fmi2OK;
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t n)
{
    Instance *instance = called(c, "fmi2GetDerivatives", EVENT | CONTINUOUS);

    if (model_refuses(&instance->model)) return says(instance, fmi2Discard, "y is out of its range");
    model_equations(&instance->model);
    memcpy(dx, instance->model.r + STATES, n * sizeof *dx);
    return fmi2OK;
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real z[], size_t n)
{
    Instance *instance = called(c, "fmi2GetEventIndicators", EVENT | CONTINUOUS);

    if (n != INDICATORS) broken("fmi2GetEventIndicators", "another number of indicators");
    model_equations(&instance->model);
    model_indicators(&instance->model, z);
    return fmi2OK;
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n)
{
    memcpy(x, called(c, "fmi2GetContinuousStates", EVENT | CONTINUOUS)->model.r, n * sizeof *x);
    return fmi2OK;
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x[], size_t n)
{
    called(c, "fmi2GetNominalsOfContinuousStates", EVENT | CONTINUOUS);
    for (size_t k = 0; k < n; k++) x[k] = 1.0;
    return fmi2OK;
}

/* ---- co-simulation ---- */

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                       const fmi2Integer order[], const fmi2Real value[])
{
    Instance *instance = called(c, "fmi2SetRealInputDerivatives", STEP_COMPLETE);

    for (size_t k = 0; k < n; k++) {
        if (order[k] != 1 || real_roles[vr[k]] != ROLE_CONTINUOUS)
            broken("fmi2SetRealInputDerivatives of this variable or order", "step complete");
        instance->model.slope[vr[k]] = value[k];
    }
    return fmi2OK;
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                        const fmi2Integer order[], fmi2Real value[])
{
    (void)c;
    (void)vr;
    (void)n;
    (void)order;
    (void)value;
    return fmi2Error;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real step_size, fmi2Boolean no_set_state)
{
    Instance *instance = called(c, "fmi2DoStep", STEP_COMPLETE);
    double reached;
    bool event;

    (void)no_set_state;
    if (time != instance->model.time && !(time - instance->model.time < 1e-9 && instance->model.time - time < 1e-9))
        broken("fmi2DoStep from another time", "step complete");
    if (step_size <= 0.0 || time + step_size > instance->stop) broken("fmi2DoStep past the stop time", "running");
    if (model_discards(&instance->model, step_size)) {
        instance->mode = STEP_FAILED;
        return says(instance, fmi2Discard, "the step is too long");
    }
    advance(&instance->model, time, step_size, false, &reached, &event);
    if (instance->model.terminate) { /* at the end of the step, too */
        instance->mode = STEP_FAILED;
        return says(instance, fmi2Discard, "the last stair");
    }
    return fmi2OK;
}

fmi2Status fmi2CancelStep(fmi2Component c)
{
    (void)c;
    return fmi2Error;
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind s, fmi2Status *value)
{
    (void)c;
    (void)s;
    (void)value;
    return fmi2Discard;
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind s, fmi2Real *value)
{
    if (s != fmi2LastSuccessfulTime) return fmi2Discard;
    *value = called(c, "fmi2GetRealStatus", STEP_FAILED)->model.time;
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind s, fmi2Integer *value)
{
    (void)c;
    (void)s;
    (void)value;
    return fmi2Discard;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind s, fmi2Boolean *value)
{
    if (s != fmi2Terminated) return fmi2Discard;
    *value = called(c, "fmi2GetBooleanStatus", STEP_COMPLETE | STEP_FAILED)->model.terminate;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind s, fmi2String *value)
{
    (void)c;
    (void)s;
    (void)value;
    return fmi2Discard;
}
