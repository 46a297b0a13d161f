/* SPDX-License-Identifier: Apache-2.0
 *
 * FMI 1.0 for model exchange: the calling sequence of 2.8. A binary of FMI 1.0 prefixes its functions with the model
 * identifier.
 */
#include <stdlib.h>
#include <string.h>

#include "model.h"
#include "variables.h"

#define JOIN_(a, b) a##_##b
#define JOIN(a, b) JOIN_(a, b)
#define EXPORT(name) JOIN(MODEL_IDENTIFIER, name)

#include "fmi1Functions.h"

typedef enum { INSTANTIATED = 1, INITIALIZED = 2, TERMINATED = 4 } Mode;

static const char *const mode_names[] = {"instantiated", "initialized", "terminated"};

typedef struct {
    char *name;
    fmi1CallbackFunctions functions;
    Mode mode;
    bool time_set;
    bool updating; /* in the middle of an event iteration */
    Model model;
} Instance;

static Instance *called(fmi1Component c, const char *function, unsigned allowed)
{
    Instance *instance = c;
    int k = 0;

    if (instance == NULL) broken(function, "no instance");
    while ((instance->mode >> k) > 1) k++;
    if (!(instance->mode & allowed)) broken(function, mode_names[k]);
    return instance;
}

const char *EXPORT(fmiGetModelTypesPlatform)(void) { return "standard32"; }
const char *EXPORT(fmiGetVersion)(void) { return "1.0"; }

fmi1Component EXPORT(fmiInstantiateModel)(fmi1String name, fmi1String guid, fmi1CallbackFunctions functions,
                                          fmi1Boolean logging)
{
    Instance *instance = calloc(1, sizeof *instance);

    (void)logging;
    if (strcmp(guid, FMU_GUID) != 0) return NULL;
    instance->name = strcpy(calloc(1, strlen(name) + 1), name);
    instance->functions = functions;
    instance->mode = INSTANTIATED;
    model_start(&instance->model);
    return instance;
}

void EXPORT(fmiFreeModelInstance)(fmi1Component c)
{
    Instance *instance = called(c, "fmiFreeModelInstance", INSTANTIATED | INITIALIZED | TERMINATED);

    free(instance->name);
    free(instance);
}

fmi1Status EXPORT(fmiSetDebugLogging)(fmi1Component c, fmi1Boolean on)
{
    (void)c;
    (void)on;
    return fmi1OK;
}

fmi1Status EXPORT(fmiSetTime)(fmi1Component c, fmi1Real time)
{
    Instance *instance = called(c, "fmiSetTime", INSTANTIATED | INITIALIZED);

    instance->time_set = true;
    instance->model.time = time;
    return fmi1OK;
}

static void fill(Instance *instance, Update update, fmi1EventInfo *info)
{
    info->iterationConverged = !update.again;
    info->stateValueReferencesChanged = fmi1False;
    info->stateValuesChanged = update.states_changed;
    info->terminateSimulation = instance->model.terminate;
    info->upcomingTimeEvent = instance->model.next_event_defined;
    info->nextEventTime = instance->model.next_event;
}

fmi1Status EXPORT(fmiInitialize)(fmi1Component c, fmi1Boolean tolerance_controlled, fmi1Real tolerance,
                                 fmi1EventInfo *info)
{
    Instance *instance = called(c, "fmiInitialize", INSTANTIATED);

    (void)tolerance_controlled;
    (void)tolerance;
    if (!instance->time_set) broken("fmiInitialize", "instantiated, before fmiSetTime");
    model_initialize(&instance->model);
    instance->mode = INITIALIZED;
    fill(instance, (Update){false, false, false}, info);
    return fmi1OK;
}

fmi1Status EXPORT(fmiTerminate)(fmi1Component c)
{
    called(c, "fmiTerminate", INITIALIZED)->mode = TERMINATED;
    return fmi1OK;
}

static void check_set(const Instance *instance, Role role)
{
    if (instance->mode == INSTANTIATED ? role < ROLE_FIXED : role < ROLE_TUNABLE)
        broken("fmiSet of this variable", mode_names[instance->mode >> 1]);
}

fmi1Status EXPORT(fmiSetReal)(fmi1Component c, const fmi1ValueReference vr[], size_t n, const fmi1Real value[])
{
    Instance *instance = called(c, "fmiSetReal", INSTANTIATED | INITIALIZED);

    for (size_t k = 0; k < n; k++) {
        check_set(instance, real_roles[vr[k]]);
        instance->model.r[vr[k]] = value[k];
    }
    return fmi1OK;
}

fmi1Status EXPORT(fmiSetInteger)(fmi1Component c, const fmi1ValueReference vr[], size_t n, const fmi1Integer value[])
{
    Instance *instance = called(c, "fmiSetInteger", INSTANTIATED | INITIALIZED);

    for (size_t k = 0; k < n; k++) {
        check_set(instance, integer_roles[vr[k] - FIRST_INTEGER]);
        instance->model.i[vr[k] - FIRST_INTEGER] = value[k];
    }
    return fmi1OK;
}

fmi1Status EXPORT(fmiGetReal)(fmi1Component c, const fmi1ValueReference vr[], size_t n, fmi1Real value[])
{
    Instance *instance = called(c, "fmiGetReal", INITIALIZED | TERMINATED);

    model_equations(&instance->model);
    for (size_t k = 0; k < n; k++) value[k] = instance->model.r[vr[k]];
    return fmi1OK;
}

fmi1Status EXPORT(fmiGetInteger)(fmi1Component c, const fmi1ValueReference vr[], size_t n, fmi1Integer value[])
{
    Instance *instance = called(c, "fmiGetInteger", INITIALIZED | TERMINATED);

    for (size_t k = 0; k < n; k++) value[k] = instance->model.i[vr[k] - FIRST_INTEGER];
    return fmi1OK;
}

#define NO_SUCH(signature)                                                                                             \
    fmi1Status signature                                                                                               \
    {                                                                                                                  \
        (void)c;                                                                                                       \
        (void)vr;                                                                                                      \
        (void)n;                                                                                                       \
        (void)value;                                                                                                   \
        return fmi1Error;                                                                                              \
    }

NO_SUCH(EXPORT(fmiSetBoolean)(fmi1Component c, const fmi1ValueReference vr[], size_t n, const fmi1Boolean value[]))
NO_SUCH(EXPORT(fmiSetString)(fmi1Component c, const fmi1ValueReference vr[], size_t n, const fmi1String value[]))
NO_SUCH(EXPORT(fmiGetBoolean)(fmi1Component c, const fmi1ValueReference vr[], size_t n, fmi1Boolean value[]))
NO_SUCH(EXPORT(fmiGetString)(fmi1Component c, const fmi1ValueReference vr[], size_t n, fmi1String value[]))

fmi1Status EXPORT(fmiSetContinuousStates)(fmi1Component c, const fmi1Real x[], size_t n)
{
    Instance *instance = called(c, "fmiSetContinuousStates", INITIALIZED);

    if (n != STATES) broken("fmiSetContinuousStates", "another number of states");
    memcpy(instance->model.r, x, n * sizeof *x);
    return fmi1OK;
}

fmi1Status EXPORT(fmiCompletedIntegratorStep)(fmi1Component c, fmi1Boolean *call_event_update)
{
    Instance *instance = called(c, "fmiCompletedIntegratorStep", INITIALIZED);

    *call_event_update = model_completed_step(&instance->model);
    return fmi1OK;
}

fmi1Status EXPORT(fmiGetDerivatives)(fmi1Component c, fmi1Real dx[], size_t n)
{
    Instance *instance = called(c, "fmiGetDerivatives", INITIALIZED);

    if (instance->updating) broken("fmiGetDerivatives", "the middle of an event iteration");
    if (model_refuses(&instance->model)) return fmi1Discard;
    model_equations(&instance->model);
    memcpy(dx, instance->model.r + STATES, n * sizeof *dx);
    return fmi1OK;
}

fmi1Status EXPORT(fmiGetEventIndicators)(fmi1Component c, fmi1Real z[], size_t n)
{
    Instance *instance = called(c, "fmiGetEventIndicators", INITIALIZED);

    if (n != INDICATORS) broken("fmiGetEventIndicators", "another number of indicators");
    model_equations(&instance->model);
    model_indicators(&instance->model, z);
    return fmi1OK;
}

fmi1Status EXPORT(fmiEventUpdate)(fmi1Component c, fmi1Boolean intermediate, fmi1EventInfo *info)
{
    Instance *instance = called(c, "fmiEventUpdate", INITIALIZED);
    const Update update = model_event(&instance->model);

    (void)intermediate;
    instance->updating = update.again && !instance->model.terminate;
    fill(instance, update, info);
    return fmi1OK;
}

fmi1Status EXPORT(fmiGetContinuousStates)(fmi1Component c, fmi1Real x[], size_t n)
{
    memcpy(x, called(c, "fmiGetContinuousStates", INITIALIZED)->model.r, n * sizeof *x);
    return fmi1OK;
}

fmi1Status EXPORT(fmiGetNominalContinuousStates)(fmi1Component c, fmi1Real x[], size_t n)
{
    called(c, "fmiGetNominalContinuousStates", INITIALIZED);
    for (size_t k = 0; k < n; k++) x[k] = 1.0;
    return fmi1OK;
}

fmi1Status EXPORT(fmiGetStateValueReferences)(fmi1Component c, fmi1ValueReference vr[], size_t n)
{
    called(c, "fmiGetStateValueReferences", INITIALIZED);
    for (size_t k = 0; k < n; k++) vr[k] = (fmi1ValueReference)k;
    return fmi1OK;
}
