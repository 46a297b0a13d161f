/* SPDX-License-Identifier: Apache-2.0
 *
 * A plain master over the DLLs of FMUs for FMI 2.0 co-simulation, without anything of the mesh: the reference for what
 * Windows FMUs compute in a mesh. It reads a plan from its standard input and writes a row for each point. All numbers
 * are the 64 bits of a double in hexadecimal digits, so that no library rounds them.
 *
 *   grid START STEP_SIZE LAST_POINT
 *   unit DLL GUID POINTS              in the order in which they step; each step takes so many points of the grid
 *   value UNIT REFERENCE VALUE        a start value; a unit is its place among the units
 *   pipe UNIT REFERENCE UNIT REFERENCE DELAY
 *   record UNIT REFERENCE
 */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <windows.h>

#include "fmi2FunctionTypes.h"

#define MOST 64

typedef struct {
    fmi2Component component;
    fmi2SetRealTYPE *set;
    fmi2GetRealTYPE *get;
    fmi2DoStepTYPE *step;
    fmi2EnterInitializationModeTYPE *enter;
    fmi2ExitInitializationModeTYPE *leave;
    int points;
} Unit;

typedef struct {
    unsigned unit, reference, target, target_reference, delay;
    double *values; /* one for each step of the unit, and one for the start */
} Pipe;

static Unit units[MOST];
static Pipe pipes[MOST], records[MOST];
static unsigned unit_count, pipe_count, record_count;
static double start, step_size;
static int last_point;

static void check(int good, const char *what)
{
    if (!good) {
        fprintf(stderr, "%s failed\n", what);
        exit(1);
    }
}

static double number(const char *digits)
{
    const uint64_t bits = strtoull(digits, NULL, 16);
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static void write_number(double value, char after)
{
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    printf("%016llx%c", (unsigned long long)bits, after);
}

static void discard_message(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status, fmi2String category,
                            fmi2String message, ...)
{
    (void)environment, (void)name, (void)status, (void)category, (void)message;
}

static void load(Unit *unit, const char *path, const char *guid)
{
    static const fmi2CallbackFunctions callbacks = {discard_message, calloc, free, NULL, NULL};
    const HMODULE library = LoadLibraryA(path);
    check(library != NULL, path);
    fmi2InstantiateTYPE *instantiate = (fmi2InstantiateTYPE *)GetProcAddress(library, "fmi2Instantiate");
    fmi2SetupExperimentTYPE *setup = (fmi2SetupExperimentTYPE *)GetProcAddress(library, "fmi2SetupExperiment");
    unit->set = (fmi2SetRealTYPE *)GetProcAddress(library, "fmi2SetReal");
    unit->get = (fmi2GetRealTYPE *)GetProcAddress(library, "fmi2GetReal");
    unit->step = (fmi2DoStepTYPE *)GetProcAddress(library, "fmi2DoStep");
    unit->enter = (fmi2EnterInitializationModeTYPE *)GetProcAddress(library, "fmi2EnterInitializationMode");
    unit->leave = (fmi2ExitInitializationModeTYPE *)GetProcAddress(library, "fmi2ExitInitializationMode");
    unit->component = instantiate("unit", fmi2CoSimulation, guid, "", &callbacks, fmi2False, fmi2False);
    check(unit->component != NULL, "fmi2Instantiate");
    check(setup(unit->component, fmi2False, 0.0, start, fmi2False, 0.0) == fmi2OK, "fmi2SetupExperiment");
}

static void read_plan(void)
{
    char word[16], path[512], guid[128], value[32], other[32];
    while (scanf("%15s", word) == 1) {
        if (strcmp(word, "grid") == 0) {
            check(scanf("%31s %31s %d", value, other, &last_point) == 3, word);
            start = number(value), step_size = number(other);
        } else if (strcmp(word, "unit") == 0) {
            Unit *unit = &units[unit_count++];
            check(scanf("%511s %127s %d", path, guid, &unit->points) == 3, word);
            load(unit, path, guid);
        } else if (strcmp(word, "value") == 0) {
            unsigned unit, reference;
            check(scanf("%u %u %31s", &unit, &reference, value) == 3, word);
            const double given = number(value);
            check(units[unit].set(units[unit].component, &reference, 1, &given) == fmi2OK, "fmi2SetReal");
        } else {
            const int connects = strcmp(word, "pipe") == 0;
            Pipe *pipe = connects ? &pipes[pipe_count++] : &records[record_count++];
            check(scanf("%u %u", &pipe->unit, &pipe->reference) == 2, word);
            if (connects)
                check(scanf("%u %u %u", &pipe->target, &pipe->target_reference, &pipe->delay) == 3, word);
            pipe->values = calloc((size_t)last_point + 1, sizeof(double));
        }
    }
}

static void get(Pipe *pipe, int point)
{
    const Unit *unit = &units[pipe->unit];
    check(unit->get(unit->component, &pipe->reference, 1, &pipe->values[point / unit->points]) == fmi2OK, "fmi2GetReal");
}

static void set(const Pipe *pipe, int point)
{
    const Unit *unit = &units[pipe->target];
    const double *value = &pipe->values[point / units[pipe->unit].points];
    check(unit->set(unit->component, &pipe->target_reference, 1, value) == fmi2OK, "fmi2SetReal");
}

static void write_row(int point)
{
    write_number(start + point * step_size, ' ');
    for (unsigned i = 0; i < record_count; i++)
        write_number(records[i].values[point / units[records[i].unit].points], i + 1 < record_count ? ' ' : '\n');
}

int main(void)
{
    read_plan();
    for (unsigned i = 0; i < unit_count; i++) check(units[i].enter(units[i].component) == fmi2OK, "entering");
    for (unsigned round = 0; round < unit_count; round++) /* so many times at most is a value handed on */
        for (unsigned i = 0; i < pipe_count; i++) get(&pipes[i], 0), set(&pipes[i], 0);
    for (unsigned i = 0; i < unit_count; i++) check(units[i].leave(units[i].component) == fmi2OK, "leaving");
    for (unsigned i = 0; i < pipe_count; i++) get(&pipes[i], 0);
    for (unsigned i = 0; i < record_count; i++) get(&records[i], 0);
    write_row(0);
    for (int end = 1; end <= last_point; end++) {
        for (unsigned own = 0; own < unit_count; own++) {
            const Unit *unit = &units[own];
            const int begin = end - unit->points;
            if (end % unit->points != 0) continue;
            for (unsigned i = 0; i < pipe_count; i++)
                if (pipes[i].target == own) set(&pipes[i], pipes[i].delay ? begin : end);
            check(unit->step(unit->component, start + begin * step_size, unit->points * step_size, fmi2True) == fmi2OK,
                  "fmi2DoStep");
            for (unsigned i = 0; i < pipe_count; i++)
                if (pipes[i].unit == own) get(&pipes[i], end);
            for (unsigned i = 0; i < record_count; i++)
                if (records[i].unit == own) get(&records[i], end);
        }
        write_row(end);
    }
    return fflush(stdout) == 0 ? 0 : 1;
}
