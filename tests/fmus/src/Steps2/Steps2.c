/* SPDX-License-Identifier: Apache-2.0 */
#include "fmi2FunctionTypes.h"

typedef fmi2Component Component;
typedef fmi2ValueReference Reference;
typedef fmi2Status Status;
typedef fmi2StatusKind StatusKind;
typedef fmi2CallbackLogger Logger;
#define OK fmi2OK
#define Discard fmi2Discard
#define Error fmi2Error
#define DoStepStatus fmi2DoStepStatus
#define LastSuccessfulTime fmi2LastSuccessfulTime
#define NAME(function) fmi2##function

#include "steps.h"

EXPORT const char *NAME(GetTypesPlatform)(void) { return fmi2TypesPlatform; }
EXPORT const char *NAME(GetVersion)(void) { return "2.0"; }

EXPORT Component NAME(Instantiate)(fmi2String name, fmi2Type type, fmi2String guid, fmi2String location,
                                   const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging)
{
    (void)type, (void)location, (void)visible, (void)logging;
    return instantiated(name, guid, functions->logger);
}

EXPORT Status NAME(SetupExperiment)(Component c, fmi2Boolean tolerance_defined, fmi2Real tolerance, fmi2Real start,
                                    fmi2Boolean stop_defined, fmi2Real stop)
{
    Model *m = c;

    if (stop_defined) m->stop = stop;
    m->r[TOLERANCE] = tolerance_defined ? tolerance : -1.0;
    m->accepted = m->r[REACHED] = start;
    return fmi2OK;
}

EXPORT Status NAME(EnterInitializationMode)(Component c)
{
    (void)c;
    return fmi2OK;
}

EXPORT Status NAME(ExitInitializationMode)(Component c)
{
    ((Model *)c)->running = 1;
    return fmi2OK;
}

EXPORT Status NAME(DoStep)(Component c, fmi2Real time, fmi2Real size, fmi2Boolean no_set_state)
{
    (void)no_set_state;
    return started(c, time, size, -1);
}

/* The state is all that there is. */
EXPORT Status NAME(GetFMUstate)(Component c, fmi2FMUstate *state)
{
    if (*state == NULL) *state = malloc(sizeof(Model));
    memcpy(*state, c, sizeof(Model));
    return fmi2OK;
}

EXPORT Status NAME(SetFMUstate)(Component c, fmi2FMUstate state)
{
    const int attempts = ((Model *)c)->i[ATTEMPTS];

    memcpy(c, state, sizeof(Model));
    ((Model *)c)->i[ATTEMPTS] = attempts;
    return fmi2OK;
}

EXPORT Status NAME(FreeFMUstate)(Component c, fmi2FMUstate *state)
{
    (void)c;
    free(*state);
    *state = NULL;
    return fmi2OK;
}

EXPORT Status NAME(GetBooleanStatus)(Component c, const StatusKind kind, fmi2Boolean *value)
{
    (void)c, (void)kind;
    *value = fmi2False;
    return fmi2OK;
}

EXPORT Status NAME(Terminate)(Component c)
{
    ((Model *)c)->running = 0;
    return fmi2OK;
}

EXPORT void NAME(FreeInstance)(Component c) { free(c); }

/* What a library of FMI 2.0 must have, and nobody should call. */
#define REFUSED(function, ...)                                                                                         \
    EXPORT Status NAME(function)(Component c, __VA_ARGS__) { return fail(c, #function); }

#pragma GCC diagnostic ignored "-Wunused-parameter"
REFUSED(GetBoolean, const Reference vr[], size_t n, fmi2Boolean value[])
REFUSED(SetBoolean, const Reference vr[], size_t n, const fmi2Boolean value[])
REFUSED(GetString, const Reference vr[], size_t n, fmi2String value[])
REFUSED(SetString, const Reference vr[], size_t n, const fmi2String value[])
REFUSED(SetDebugLogging, fmi2Boolean on, size_t n, const fmi2String categories[])
REFUSED(SerializedFMUstateSize, fmi2FMUstate state, size_t *size)
REFUSED(SerializeFMUstate, fmi2FMUstate state, fmi2Byte bytes[], size_t size)
REFUSED(DeSerializeFMUstate, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state)
REFUSED(GetDirectionalDerivative, const Reference unknown[], size_t n, const Reference known[], size_t m,
        const fmi2Real seed[], fmi2Real value[])
REFUSED(GetRealOutputDerivatives, const Reference vr[], size_t n, const fmi2Integer order[], fmi2Real value[])
REFUSED(GetIntegerStatus, const StatusKind kind, fmi2Integer *value)
REFUSED(GetStringStatus, const StatusKind kind, fmi2String *value)

EXPORT Status NAME(Reset)(Component c) { return fail(c, "Reset"); }
EXPORT Status NAME(CancelStep)(Component c) { return fail(c, "CancelStep"); }
