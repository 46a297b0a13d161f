/* SPDX-License-Identifier: Apache-2.0
 *
 * FMI 3.0 co-simulation with Event Mode and early return: `y` counts the time events, which come at every whole multiple
 * of `interval`; a step that would pass one returns early there. `x` is the time at the end of the last step.
 * `u` is discrete, so it may be set in Event Mode only; `v` takes its value there. Calls in the wrong state are errors.
 * If `announced` is 1, the next event is announced, and a step past it is an error. From `last` on the FMU wants to end.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#if defined __GNUC__
#define FMI3_Export __attribute__((visibility("default")))
#endif
#include "fmi3Functions.h"
#include "fmu_guid.h"

enum { X, Y, U, V, INTERVAL, ANNOUNCED, LAST, TOLERANCE, COUNT };
enum { INSTANTIATED = 1, INITIALIZATION = 2, EVENT = 4, STEP = 8, TERMINATED = 16 };

typedef struct {
    int state;
    double values[COUNT];
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
    int early, due;
} Model;

static fmi3Status refuse(Model *m, const char *why)
{
    if (m->log)
        m->log(m->environment, fmi3Error, "logStatusError", why);
    return fmi3Error;
}

fmi3Status fmi3GetFloat64(fmi3Instance i, const fmi3ValueReference vr[], size_t n, fmi3Float64 values[], size_t count)
{
    Model *m = i;
    if (m->state == INSTANTIATED || count != n)
        return refuse(m, "fmi3GetFloat64 is not allowed now");
    for (size_t k = 0; k < n; k++)
        values[k] = m->values[vr[k]];
    return fmi3OK;
}

fmi3Status fmi3SetFloat64(fmi3Instance i, const fmi3ValueReference vr[], size_t n, const fmi3Float64 values[],
                          size_t count)
{
    Model *m = i;
    if (!(m->state & (INSTANTIATED | INITIALIZATION | EVENT)) || count != n)
        return refuse(m, "u and interval can be set before the start and in Event Mode only");
    for (size_t k = 0; k < n; k++)
        m->values[vr[k]] = values[k];
    return fmi3OK;
}

const char *fmi3GetVersion(void)
{
    return fmi3Version;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early,
                                         const fmi3ValueReference needed[], size_t n,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update)
{
    (void)name, (void)resources, (void)visible, (void)logging, (void)needed, (void)n, (void)update;
    if (strcmp(token, FMU_GUID) != 0 || !events || !early)
        return NULL;
    Model *m = calloc(1, sizeof *m);
    m->state = INSTANTIATED;
    m->values[INTERVAL] = 1.0;
    m->values[LAST] = INFINITY;
    m->environment = environment;
    m->log = log;
    return m;
}

void fmi3FreeInstance(fmi3Instance instance)
{
    free(instance);
}

static fmi3Status go(Model *m, int from, int to, const char *why)
{
    if (!(m->state & from))
        return refuse(m, why);
    m->state = to;
    return fmi3OK;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance i, fmi3Boolean defined, fmi3Float64 tolerance, fmi3Float64 start,
                                       fmi3Boolean stop_defined, fmi3Float64 stop)
{
    (void)stop_defined, (void)stop;
    ((Model *)i)->values[TOLERANCE] = defined ? tolerance : -1.0;
    ((Model *)i)->values[X] = start;
    return go(i, INSTANTIATED, INITIALIZATION, "fmi3EnterInitializationMode is not allowed now");
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance i)
{
    return go(i, INITIALIZATION, EVENT, "fmi3ExitInitializationMode is not allowed now");
}

fmi3Status fmi3EnterEventMode(fmi3Instance i)
{
    return go(i, STEP, EVENT, "fmi3EnterEventMode is not allowed now");
}

fmi3Status fmi3EnterStepMode(fmi3Instance i)
{
    if (((Model *)i)->due)
        return refuse(i, "an event was not handled");
    return go(i, EVENT, STEP, "fmi3EnterStepMode is not allowed now");
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance i, fmi3Boolean *update, fmi3Boolean *terminate,
                                    fmi3Boolean *nominals, fmi3Boolean *values, fmi3Boolean *defined,
                                    fmi3Float64 *time)
{
    Model *m = i;
    if (m->state != EVENT)
        return refuse(m, "fmi3UpdateDiscreteStates is not allowed now");
    *update = m->due; /* once more after an event, as an iteration would */
    if (m->due)
        m->values[Y] += 1.0;
    m->due = 0;
    m->values[V] = m->values[U];
    *terminate = *nominals = *values = fmi3False;
    *defined = m->values[ANNOUNCED] != 0.0;
    *time = (m->values[Y] + 1.0) * m->values[INTERVAL];
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance i, fmi3Float64 time, fmi3Float64 size, fmi3Boolean no_set, fmi3Boolean *event,
                      fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last)
{
    Model *m = i;
    (void)no_set;
    if (m->state != STEP || time != m->values[X] || size <= 0.0)
        return refuse(m, "fmi3DoStep is not allowed now, or not from this time");
    double next = (m->values[Y] + 1.0) * m->values[INTERVAL];
    if (m->values[ANNOUNCED] != 0.0 && next < time + size)
        return refuse(m, "this step passes the event that was announced");
    m->due = next <= time + size;
    *event = m->due;
    *early = next < time + size;
    *last = m->values[X] = *early ? next : time + size;
    *terminate = *last >= m->values[LAST];
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance i)
{
    return go(i, INITIALIZATION | EVENT | STEP, TERMINATED, "fmi3Terminate is not allowed now");
}

#define HAS_EVENT_MODE
#include "fmi3_refused.h"
