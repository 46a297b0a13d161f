/* SPDX-License-Identifier: Apache-2.0
 *
 * Every type of FMI 3.0: a scalar, and an array of 2 rows and `columns` columns, each as input and output, and a tunable
 * parameter. An output takes the value of its input at the end of a step, and in Initialization Mode at once. `columns`
 * is a structural parameter. A call in the wrong state of the state machine (FMI 3.0, 2.3 and 4.2.1) is an error.
 *
 * A value reference is 100 * type + kind; 1 is `columns`, 2 is `steps`.
 */
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if defined __GNUC__
#define FMI3_Export __attribute__((visibility("default")))
#endif
#include "fmi3Functions.h"
#include "fmu_guid.h"

enum { FLOAT64 = 1, FLOAT32, INT8, UINT8, INT16, UINT16, INT32, UINT32, INT64, UINT64, BOOLEAN, ENUMERATION, STRING,
       BINARY, TYPES };
enum { IN, OUT, ARRAY_IN, ARRAY_OUT, PARAMETER, KINDS };
enum { INSTANTIATED = 1, CONFIGURATION = 2, INITIALIZATION = 4, STEP = 8, TERMINATED = 16 };
enum { MAX_COLUMNS = 8, MAX_ELEMENTS = 2 * MAX_COLUMNS };

typedef struct {
    size_t size; /* of a String without its end */
    char *data;
} Bytes;

typedef union {
    char number[8];
    Bytes bytes;
} Element;

typedef struct {
    int state;
    uint64_t columns, steps;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
    Element values[TYPES][KINDS][MAX_ELEMENTS];
} Model;

static fmi3Status fail(Model *m, const char *format, ...)
{
    char text[200];
    va_list list;
    va_start(list, format);
    vsnprintf(text, sizeof text, format, list);
    va_end(list);
    if (m->log)
        m->log(m->environment, fmi3Error, "logStatusError", text);
    return fmi3Error;
}

#define DEMAND(states, call) \
    if (!(m->state & (states))) \
    return fail(m, "%s is not allowed in state %d", call, m->state)

static size_t elements(const Model *m, int kind)
{
    return kind == ARRAY_IN || kind == ARRAY_OUT ? 2 * m->columns : 1;
}

static void copy(Element *to, const Element *from, int type)
{
    if (type != STRING && type != BINARY) {
        *to = *from;
        return;
    }
    char *data = malloc(from->bytes.size + 1);
    if (from->bytes.size)
        memcpy(data, from->bytes.data, from->bytes.size);
    data[from->bytes.size] = 0;
    free(to->bytes.data);
    to->bytes.data = data;
    to->bytes.size = from->bytes.size;
}

static void calculate(Model *m)
{
    for (int type = FLOAT64; type < TYPES; type++)
        for (int kind = IN; kind <= ARRAY_IN; kind += ARRAY_IN - IN)
            for (size_t i = 0; i < elements(m, kind); i++)
                copy(&m->values[type][kind + 1][i], &m->values[type][kind][i], type);
}

/* ---- values ---- */

static fmi3Status number(Model *m, int setting, const fmi3ValueReference vr[], size_t n, void *values, size_t count,
                         int type, size_t size)
{
    char *place = values;
    size_t used = 0;
    DEMAND(INSTANTIATED | CONFIGURATION | INITIALIZATION | STEP | (setting ? 0 : TERMINATED), "getting or setting");
    if (!setting && m->state == INSTANTIATED)
        return fail(m, "a value cannot be read before Initialization Mode");
    if (m->state == INITIALIZATION && !setting)
        calculate(m);
    for (size_t i = 0; i < n; i++) {
        uint64_t *own = vr[i] == 1 ? &m->columns : vr[i] == 2 ? &m->steps : NULL;
        int of = own ? UINT64 : (int)(vr[i] / 100), kind = (int)(vr[i] % 100);
        size_t wanted = own ? 1 : kind < KINDS ? elements(m, kind) : 0;
        if ((of != type && !(of == ENUMERATION && type == INT64)) || !wanted)
            return fail(m, "value reference %u is of another type", vr[i]);
        if ((used += wanted) > count)
            return fail(m, "%u values are too few", (unsigned)count);
        if (setting && (vr[i] == 1) != (m->state == CONFIGURATION))
            return fail(m, "value reference %u cannot be set in state %d", vr[i], m->state);
        if (setting && !own && (kind == OUT || kind == ARRAY_OUT))
            return fail(m, "the output %u cannot be set", vr[i]);
        for (size_t e = 0; e < wanted; e++, place += size) {
            char *at = own ? (char *)own : m->values[of][kind][e].number;
            memcpy(setting ? at : place, setting ? place : at, size);
        }
        if (setting && vr[i] == 1 && (m->columns < 1 || m->columns > MAX_COLUMNS))
            return fail(m, "columns has to be 1 to %d", MAX_COLUMNS);
    }
    return used == count ? fmi3OK : fail(m, "%u values where %u are expected", (unsigned)count, (unsigned)used);
}

#define NUMBER(Name, Type) \
    fmi3Status fmi3Get##Name(fmi3Instance i, const fmi3ValueReference vr[], size_t n, fmi3##Name values[], size_t count) \
    { \
        return number(i, 0, vr, n, values, count, Type, sizeof(fmi3##Name)); \
    } \
    fmi3Status fmi3Set##Name(fmi3Instance i, const fmi3ValueReference vr[], size_t n, const fmi3##Name values[], \
                             size_t count) \
    { \
        return number(i, 1, vr, n, (void *)values, count, Type, sizeof(fmi3##Name)); \
    }

NUMBER(Float64, FLOAT64)
NUMBER(Float32, FLOAT32)
NUMBER(Int8, INT8)
NUMBER(UInt8, UINT8)
NUMBER(Int16, INT16)
NUMBER(UInt16, UINT16)
NUMBER(Int32, INT32)
NUMBER(UInt32, UINT32)
NUMBER(Int64, INT64)
NUMBER(UInt64, UINT64)
NUMBER(Boolean, BOOLEAN)

static fmi3Status text(Model *m, int setting, const fmi3ValueReference vr[], size_t n, size_t sizes[],
                       const char *values[], size_t count, int type)
{
    size_t used = 0;
    DEMAND(INSTANTIATED | INITIALIZATION | STEP | (setting ? 0 : TERMINATED), "getting or setting");
    if (m->state == INITIALIZATION && !setting)
        calculate(m);
    for (size_t i = 0; i < n; i++) {
        int kind = (int)(vr[i] % 100);
        if ((int)(vr[i] / 100) != type || kind >= KINDS || used + elements(m, kind) > count)
            return fail(m, "value reference %u is of another type, or there are too few values", vr[i]);
        if (setting && (kind == OUT || kind == ARRAY_OUT))
            return fail(m, "the output %u cannot be set", vr[i]);
        for (size_t e = 0; e < elements(m, kind); e++, used++) {
            Element *own = &m->values[type][kind][e];
            if (setting) {
                Element from = {.bytes = {sizes ? sizes[used] : strlen(values[used]), (char *)values[used]}};
                copy(own, &from, type);
            } else {
                values[used] = own->bytes.data ? own->bytes.data : "";
                if (sizes)
                    sizes[used] = own->bytes.size;
            }
        }
    }
    return used == count ? fmi3OK : fail(m, "%u values where %u are expected", (unsigned)count, (unsigned)used);
}

fmi3Status fmi3GetString(fmi3Instance i, const fmi3ValueReference vr[], size_t n, fmi3String values[], size_t count)
{
    return text(i, 0, vr, n, NULL, values, count, STRING);
}

fmi3Status fmi3SetString(fmi3Instance i, const fmi3ValueReference vr[], size_t n, const fmi3String values[],
                         size_t count)
{
    return text(i, 1, vr, n, NULL, (const char **)values, count, STRING);
}

fmi3Status fmi3GetBinary(fmi3Instance i, const fmi3ValueReference vr[], size_t n, size_t sizes[], fmi3Binary values[],
                         size_t count)
{
    return text(i, 0, vr, n, sizes, (const char **)values, count, BINARY);
}

fmi3Status fmi3SetBinary(fmi3Instance i, const fmi3ValueReference vr[], size_t n, const size_t sizes[],
                         const fmi3Binary values[], size_t count)
{
    return text(i, 1, vr, n, (size_t *)sizes, (const char **)values, count, BINARY);
}

/* ---- the state machine ---- */

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
    (void)name, (void)resources, (void)visible, (void)logging, (void)events, (void)early, (void)needed, (void)n;
    (void)update;
    if (strcmp(token, FMU_GUID) != 0)
        return NULL;
    Model *m = calloc(1, sizeof *m);
    m->state = INSTANTIATED;
    m->columns = 3;
    m->environment = environment;
    m->log = log;
    int64_t one = 1;
    for (int kind = 0; kind < KINDS; kind++)
        for (int e = 0; e < MAX_ELEMENTS; e++)
            memcpy(m->values[ENUMERATION][kind][e].number, &one, sizeof one);
    return m;
}

void fmi3FreeInstance(fmi3Instance instance)
{
    Model *m = instance;
    for (int type = STRING; type <= BINARY; type++)
        for (int kind = 0; kind < KINDS; kind++)
            for (int e = 0; e < MAX_ELEMENTS; e++)
                free(m->values[type][kind][e].bytes.data);
    free(m);
}

static fmi3Status go(Model *m, int from, int to, const char *call)
{
    DEMAND(from, call);
    m->state = to;
    return fmi3OK;
}

fmi3Status fmi3EnterConfigurationMode(fmi3Instance i)
{
    return go(i, INSTANTIATED, CONFIGURATION, "fmi3EnterConfigurationMode");
}

fmi3Status fmi3ExitConfigurationMode(fmi3Instance i)
{
    return go(i, CONFIGURATION, INSTANTIATED, "fmi3ExitConfigurationMode");
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance i, fmi3Boolean defined, fmi3Float64 tolerance, fmi3Float64 start,
                                       fmi3Boolean stop_defined, fmi3Float64 stop)
{
    (void)defined, (void)tolerance, (void)start, (void)stop_defined, (void)stop;
    return go(i, INSTANTIATED, INITIALIZATION, "fmi3EnterInitializationMode");
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance i)
{
    calculate(i);
    return go(i, INITIALIZATION, STEP, "fmi3ExitInitializationMode");
}

fmi3Status fmi3DoStep(fmi3Instance i, fmi3Float64 time, fmi3Float64 size, fmi3Boolean no_set, fmi3Boolean *event,
                      fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last)
{
    Model *m = i;
    (void)no_set;
    DEMAND(STEP, "fmi3DoStep");
    calculate(m);
    m->steps++;
    *event = *terminate = *early = fmi3False;
    *last = time + size;
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance i)
{
    return go(i, INITIALIZATION | STEP, TERMINATED, "fmi3Terminate");
}

#define HAS_ALL_TYPES
#define HAS_CONFIGURATION_MODE
#include "fmi3_refused.h"
