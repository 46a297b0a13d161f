/* SPDX-License-Identifier: Apache-2.0
 *
 * Every type of FMI 1.0 co-simulation: the output takes the value of the input at the end of a step. The same value
 * references stand for other variables in each type: 0 is the input, 1 the output, 2 a parameter, 3 the steps done.
 * A call in the wrong state (FMI 1.0 CS, 3.6) is an error.
 */
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#include "fmi1Functions.h"
#include "fmu_guid.h"

#if defined __GNUC__
#define EXPORT __attribute__((visibility("default")))
#else
#define EXPORT __declspec(dllexport)
#endif
#define NAME(function) AllTypes1_##function

enum { IN, OUT, PARAMETER, STEPS, COUNT };
enum { INSTANTIATED = 1, INITIALIZED = 2, TERMINATED = 4 };
enum { TEXT_SIZE = 256 };

typedef struct {
    int state;
    char name[TEXT_SIZE];
    fmi1CallbackFunctions functions;
    fmi1Real real[COUNT];
    fmi1Integer integer[COUNT];
    fmi1Boolean boolean[COUNT];
    char string[COUNT][TEXT_SIZE];
} Model;

static fmi1Status fail(Model *m, const char *call)
{
    m->functions.logger(m, m->name, fmi1Error, "error", "%s is not allowed in state %d", call, m->state);
    return fmi1Error;
}

static fmi1Status check(Model *m, int setting, const fmi1ValueReference vr[], size_t n)
{
    if (!(m->state & (setting ? INSTANTIATED | INITIALIZED : INITIALIZED)))
        return fail(m, setting ? "setting a value" : "getting a value");
    for (size_t i = 0; i < n; i++)
        if (vr[i] >= COUNT || (setting && (vr[i] == OUT || vr[i] == STEPS || (vr[i] == PARAMETER && m->state != INSTANTIATED))))
            return fail(m, "this value reference");
    return fmi1OK;
}

#define VALUES(Name, Type, array) \
    EXPORT fmi1Status NAME(fmiGet##Name)(fmi1Component c, const fmi1ValueReference vr[], size_t n, Type value[]) \
    { \
        Model *m = c; \
        if (check(m, 0, vr, n) != fmi1OK) \
            return fmi1Error; \
        for (size_t i = 0; i < n; i++) \
            value[i] = m->array[vr[i]]; \
        return fmi1OK; \
    } \
    EXPORT fmi1Status NAME(fmiSet##Name)(fmi1Component c, const fmi1ValueReference vr[], size_t n, const Type value[]) \
    { \
        Model *m = c; \
        if (check(m, 1, vr, n) != fmi1OK) \
            return fmi1Error; \
        for (size_t i = 0; i < n; i++) \
            m->array[vr[i]] = value[i]; \
        return fmi1OK; \
    }

VALUES(Real, fmi1Real, real)
VALUES(Integer, fmi1Integer, integer)
VALUES(Boolean, fmi1Boolean, boolean)

EXPORT fmi1Status NAME(fmiGetString)(fmi1Component c, const fmi1ValueReference vr[], size_t n, fmi1String value[])
{
    Model *m = c;
    if (check(m, 0, vr, n) != fmi1OK)
        return fmi1Error;
    for (size_t i = 0; i < n; i++)
        value[i] = m->string[vr[i]];
    return fmi1OK;
}

EXPORT fmi1Status NAME(fmiSetString)(fmi1Component c, const fmi1ValueReference vr[], size_t n, const fmi1String value[])
{
    Model *m = c;
    if (check(m, 1, vr, n) != fmi1OK)
        return fmi1Error;
    for (size_t i = 0; i < n; i++) {
        if (strlen(value[i]) >= TEXT_SIZE)
            return fail(m, "so long a text");
        strcpy(m->string[vr[i]], value[i]);
    }
    return fmi1OK;
}

static void calculate(Model *m)
{
    m->real[OUT] = m->real[IN];
    m->integer[OUT] = m->integer[IN];
    m->boolean[OUT] = m->boolean[IN];
    strcpy(m->string[OUT], m->string[IN]);
}

EXPORT const char *NAME(fmiGetTypesPlatform)(void)
{
    return "standard32";
}

EXPORT const char *NAME(fmiGetVersion)(void)
{
    return "1.0";
}

static void start(Model *m)
{
    m->state = INSTANTIATED;
    m->real[PARAMETER] = 2.5;
    strcpy(m->string[PARAMETER], "start");
}

EXPORT fmi1Component NAME(fmiInstantiateSlave)(fmi1String name, fmi1String guid, fmi1String location, fmi1String type,
                                               fmi1Real timeout, fmi1Boolean visible, fmi1Boolean interactive,
                                               fmi1CallbackFunctions functions, fmi1Boolean logging)
{
    (void)location, (void)type, (void)timeout, (void)visible, (void)interactive, (void)logging;
    if (strcmp(guid, FMU_GUID) != 0 || strlen(name) >= TEXT_SIZE)
        return NULL;
    Model *m = functions.allocateMemory(1, sizeof *m);
    strcpy(m->name, name);
    m->functions = functions;
    start(m);
    return m;
}

EXPORT fmi1Status NAME(fmiResetSlave)(fmi1Component c)
{
    Model *m = c;
    if (m->state != INITIALIZED)
        return fail(m, "fmiResetSlave");
    const Model old = *m;
    memset(m, 0, sizeof *m);
    strcpy(m->name, old.name);
    m->functions = old.functions;
    start(m);
    return fmi1OK;
}

EXPORT fmi1Status NAME(fmiInitializeSlave)(fmi1Component c, fmi1Real start, fmi1Boolean stop_defined, fmi1Real stop)
{
    Model *m = c;
    (void)start, (void)stop_defined, (void)stop;
    if (m->state != INSTANTIATED)
        return fail(m, "fmiInitializeSlave");
    m->state = INITIALIZED;
    calculate(m);
    return fmi1OK;
}

EXPORT fmi1Status NAME(fmiDoStep)(fmi1Component c, fmi1Real time, fmi1Real size, fmi1Boolean new_step)
{
    Model *m = c;
    (void)time;
    if (m->state != INITIALIZED || size <= 0.0 || new_step != fmi1True)
        return fail(m, "fmiDoStep");
    calculate(m);
    m->integer[STEPS] += 1;
    return fmi1OK;
}

EXPORT fmi1Status NAME(fmiTerminateSlave)(fmi1Component c)
{
    Model *m = c;
    if (m->state != INITIALIZED)
        return fail(m, "fmiTerminateSlave");
    m->state = TERMINATED;
    return fmi1OK;
}

EXPORT void NAME(fmiFreeSlaveInstance)(fmi1Component c)
{
    ((Model *)c)->functions.freeMemory(c);
}

#define REFUSED(...) \
    { \
        (void)c, __VA_ARGS__; \
        return fmi1Error; \
    }

EXPORT fmi1Status NAME(fmiSetDebugLogging)(fmi1Component c, fmi1Boolean on) REFUSED((void)on)
EXPORT fmi1Status NAME(fmiCancelStep)(fmi1Component c) REFUSED((void)c)
EXPORT fmi1Status NAME(fmiSetRealInputDerivatives)(fmi1Component c, const fmi1ValueReference vr[], size_t n,
                                                   const fmi1Integer order[], const fmi1Real value[])
    REFUSED((void)vr, (void)n, (void)order, (void)value)
EXPORT fmi1Status NAME(fmiGetRealOutputDerivatives)(fmi1Component c, const fmi1ValueReference vr[], size_t n,
                                                    const fmi1Integer order[], fmi1Real value[])
    REFUSED((void)vr, (void)n, (void)order, (void)value)
EXPORT fmi1Status NAME(fmiGetStatus)(fmi1Component c, const fmi1StatusKind s, fmi1Status *v) REFUSED((void)s, (void)v)
EXPORT fmi1Status NAME(fmiGetRealStatus)(fmi1Component c, const fmi1StatusKind s, fmi1Real *v) REFUSED((void)s, (void)v)
EXPORT fmi1Status NAME(fmiGetIntegerStatus)(fmi1Component c, const fmi1StatusKind s, fmi1Integer *v)
    REFUSED((void)s, (void)v)
EXPORT fmi1Status NAME(fmiGetBooleanStatus)(fmi1Component c, const fmi1StatusKind s, fmi1Boolean *v)
    REFUSED((void)s, (void)v)
EXPORT fmi1Status NAME(fmiGetStringStatus)(fmi1Component c, const fmi1StatusKind s, fmi1String *v)
    REFUSED((void)s, (void)v)
