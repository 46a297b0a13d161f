/* SPDX-License-Identifier: Apache-2.0
 *
 * Steps that are not simply taken, in FMI 1.0 or 2.0 (the FMU defines the names): one longer than `longest_step` is
 * discarded up to there, and with `polls` above 0 a step goes on by itself, until it was asked for its status that many
 * times (for ever, if that is below 0), and ends with the status `ends_as`. The output is the
 * input at the end of the step. What the standard forbids is an error: a step past the stop time, if only by rounding, too.
 */
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#include "fmu_guid.h"

#define EXPORT __attribute__((visibility("default")))

enum { U, Y, LONGEST_STEP, REACHED, TOLERANCE, REALS };
enum { POLLS, ENDS_AS, ATTEMPTS, MUTE, INTEGERS };
enum { PENDING = 5 };

typedef struct {
    char name[64];
    Logger logger;
    int running, pending, discarded, polled;
    double accepted, start, size, stop;
    double slope; /* of U, for the next step */
    double r[REALS];
    int i[INTEGERS];
} Model;

static Status fail(Model *m, const char *text)
{
    m->logger(NULL, m->name, Error, "error", "%s", text);
    return Error;
}

static Model *instantiated(const char *name, const char *guid, Logger logger)
{
    Model *m = calloc(1, sizeof *m);

    if (strcmp(guid, FMU_GUID) != 0 || strlen(name) >= sizeof m->name) return NULL;
    strcpy(m->name, name);
    m->logger = logger;
    m->r[LONGEST_STEP] = m->stop = 1e300;
    return m;
}

#define VALUES(Name, Type, array, count)                                                                               \
    EXPORT Status NAME(Get##Name)(Component c, const Reference vr[], size_t n, Type value[])                           \
    {                                                                                                                  \
        Model *m = c;                                                                                                  \
        if (m->pending) return fail(m, "getting a value while a step is pending");                                     \
        for (size_t k = 0; k < n; k++) value[k] = m->array[vr[k] % count];                                             \
        return OK;                                                                                                     \
    }                                                                                                                  \
    EXPORT Status NAME(Set##Name)(Component c, const Reference vr[], size_t n, const Type value[])                     \
    {                                                                                                                  \
        Model *m = c;                                                                                                  \
        if (m->pending) return fail(m, "setting a value while a step is pending");                                     \
        for (size_t k = 0; k < n; k++) m->array[vr[k] % count] = value[k];                                             \
        return OK;                                                                                                     \
    }

VALUES(Real, double, r, REALS)
VALUES(Integer, int, i, INTEGERS)

static Status end(Model *m)
{
    m->pending = 0;
    m->discarded = m->size > m->r[LONGEST_STEP] * (1.0 + 1e-9);
    if (m->discarded) {
        m->accepted = m->start;
        m->logger(NULL, m->name, Discard, "discard", "the step is too long");
        return Discard;
    }
    m->accepted = m->start + m->size;
    m->r[REACHED] = m->accepted;
    m->r[Y] = m->r[U] + m->slope * m->size;
    m->slope = 0.0;
    return (Status)m->i[ENDS_AS];
}

/* `repeats`: in FMI 1.0, that a step repeats the last one; -1 where there is no such thing. */
static Status started(Model *m, double time, double size, int repeats)
{
    if (!m->running || m->pending) return fail(m, "a step in the wrong state");
    if (m->discarded && repeats < 0) return fail(m, "a step after a discarded one");
    if (repeats >= 0 && repeats != m->discarded) return fail(m, "newStep is wrong");
    if (time < m->accepted - 1e-9 || time > m->accepted + 1e-9) return fail(m, "a step from another time");
    if (time + size > m->stop) return fail(m, "a step past the stop time");
    m->i[ATTEMPTS]++;
    m->start = time;
    m->size = size;
    m->polled = 0;
    if (m->i[POLLS] == 0) return end(m);
    m->pending = 1;
    return (Status)PENDING;
}

EXPORT Status NAME(SetRealInputDerivatives)(Component c, const Reference vr[], size_t n, const int order[],
                                            const double value[])
{
    Model *m = c;

    if (!m->running || m->pending || n != 1 || vr[0] != U || order[0] != 1) return fail(m, "these derivatives");
    m->slope = value[0];
    return OK;
}

EXPORT Status NAME(GetStatus)(Component c, const StatusKind kind, Status *value)
{
    Model *m = c;

    if (m->i[MUTE]) return Discard;
    if (!m->pending || kind != DoStepStatus) return fail(m, "GetStatus without a pending step");
    *value = (Status)PENDING;
    if (m->i[POLLS] > 0 && ++m->polled > m->i[POLLS]) *value = end(m);
    return OK;
}

EXPORT Status NAME(GetRealStatus)(Component c, const StatusKind kind, double *value)
{
    Model *m = c;

    if (m->i[MUTE] || kind != LastSuccessfulTime) return Discard;
    if (!m->discarded) return fail(m, "GetRealStatus without a discarded step");
    *value = m->start + m->r[LONGEST_STEP];
    return OK;
}
