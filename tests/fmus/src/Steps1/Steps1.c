/* SPDX-License-Identifier: Apache-2.0 */
#include <stddef.h>

#include "fmi1Functions.h"

typedef fmi1Component Component;
typedef fmi1ValueReference Reference;
typedef fmi1Status Status;
typedef fmi1StatusKind StatusKind;
typedef fmi1CallbackLogger Logger;
#define OK fmi1OK
#define Discard fmi1Discard
#define Error fmi1Error
#define DoStepStatus fmi1DoStepStatus
#define LastSuccessfulTime fmi1LastSuccessfulTime
#define NAME(function) Steps1_fmi##function

#include "steps.h"

EXPORT const char *NAME(GetTypesPlatform)(void) { return "standard32"; }
EXPORT const char *NAME(GetVersion)(void) { return "1.0"; }

EXPORT Component NAME(InstantiateSlave)(fmi1String name, fmi1String guid, fmi1String location, fmi1String type,
                                        fmi1Real timeout, fmi1Boolean visible, fmi1Boolean interactive,
                                        fmi1CallbackFunctions functions, fmi1Boolean logging)
{
    (void)location, (void)type, (void)timeout, (void)visible, (void)interactive, (void)logging;
    return instantiated(name, guid, functions.logger);
}

EXPORT Status NAME(InitializeSlave)(Component c, fmi1Real start, fmi1Boolean stop_defined, fmi1Real stop)
{
    Model *m = c;

    if (stop_defined) m->stop = stop;
    m->running = 1;
    m->accepted = m->r[REACHED] = start;
    return fmi1OK;
}

EXPORT Status NAME(DoStep)(Component c, fmi1Real time, fmi1Real size, fmi1Boolean new_step)
{
    return started(c, time, size, !new_step);
}

EXPORT Status NAME(TerminateSlave)(Component c)
{
    ((Model *)c)->running = 0;
    return fmi1OK;
}

EXPORT void NAME(FreeSlaveInstance)(Component c) { free(c); }

/* What a library of FMI 1.0 must have, and nobody should call. */
#define REFUSED(function, ...)                                                                                         \
    EXPORT Status NAME(function)(Component c, __VA_ARGS__) { return fail(c, #function); }

#pragma GCC diagnostic ignored "-Wunused-parameter"
REFUSED(GetBoolean, const Reference vr[], size_t n, fmi1Boolean value[])
REFUSED(SetBoolean, const Reference vr[], size_t n, const fmi1Boolean value[])
REFUSED(GetString, const Reference vr[], size_t n, fmi1String value[])
REFUSED(SetString, const Reference vr[], size_t n, const fmi1String value[])
REFUSED(SetDebugLogging, fmi1Boolean on)
REFUSED(GetRealOutputDerivatives, const Reference vr[], size_t n, const fmi1Integer order[], fmi1Real value[])
REFUSED(GetIntegerStatus, const StatusKind kind, fmi1Integer *value)
REFUSED(GetBooleanStatus, const StatusKind kind, fmi1Boolean *value)
REFUSED(GetStringStatus, const StatusKind kind, fmi1String *value)

EXPORT Status NAME(ResetSlave)(Component c) { return fail(c, "ResetSlave"); }
EXPORT Status NAME(CancelStep)(Component c) { return fail(c, "CancelStep"); }
