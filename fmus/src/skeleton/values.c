/* SPDX-License-Identifier: Apache-2.0
 *
 * Get and set by value reference, driven by the model's table of variables.
 */
#include <string.h>

#include "instance.h"

static const char *type_name(ValueType type)
{
    static const char *const names[] = {"Real", "Integer", "Boolean", "String"};
    return names[type];
}

static const char *role_name(Role role)
{
    static const char *const names[] = {"a fixed parameter", "a tunable parameter", "an input",
                                        "a variable with initial=exact", "a calculated variable"};
    return names[role];
}

/* FMI 2.0.4, 4.2.4, the table of functions, notes 1, 3 and 6 of fmi2SetXXX. */
static unsigned modes_to_set(Role role)
{
    switch (role) {
    case ROLE_FIXED:
    case ROLE_EXACT: return MODE_INSTANTIATED | MODE_INITIALIZATION;
    case ROLE_TUNABLE:
    case ROLE_INPUT: return MODE_INSTANTIATED | MODE_INITIALIZATION | MODE_STEP_COMPLETE;
    case ROLE_CALCULATED: return 0;
    }
    return 0;
}

static void *address_of(ModelState *state, const Variable *variable)
{
    return (char *)state + variable->offset;
}

static void store_text(ModelState *state, const Variable *variable, const char *text)
{
    char *to = address_of(state, variable);

    /* Zeros up to the end: equal values have to give equal bytes in a stored FMU state. */
    memset(to, 0, TEXT_SIZE);
    strncpy(to, text, TEXT_SIZE - 1);
}

void apply_start_values(ModelState *state)
{
    for (size_t i = 0; i < model.variable_count; ++i) {
        const Variable *variable = &model.variables[i];
        switch (variable->type) {
        case TYPE_REAL: *(double *)address_of(state, variable) = variable->real_start; break;
        case TYPE_INTEGER:
        case TYPE_BOOLEAN: *(int *)address_of(state, variable) = variable->integer_start; break;
        case TYPE_STRING: store_text(state, variable, variable->text_start); break;
        }
    }
}

static const Variable *find(Instance *instance, const char *function, fmi2ValueReference reference,
                            ValueType type)
{
    const Variable *variable;

    if (reference >= model.variable_count) {
        report(instance, fmi2Error, "%s: unknown value reference %u (the highest is %u)", function, reference,
               (unsigned)model.variable_count - 1);
        return NULL;
    }
    variable = &model.variables[reference];
    if (variable->type != type) {
        report(instance, fmi2Error, "%s: value reference %u is \"%s\", which is a %s", function, reference,
               variable->name, type_name(variable->type));
        return NULL;
    }
    return variable;
}

static Instance *called_with_arrays(fmi2Component c, const char *function, unsigned modes, size_t count,
                                    const void *references, const void *values)
{
    Instance *instance = called(c, function, modes);

    if (instance != NULL && count > 0 && (references == NULL || values == NULL)) {
        report(instance, fmi2Error, "%s: a null pointer in place of %zu values", function, count);
        return NULL;
    }
    return instance;
}

/* ---- get ---- */

#define MODES_TO_GET                                                                                         \
    (MODE_INITIALIZATION | MODE_STEP_COMPLETE | MODE_STEP_FAILED | MODE_TERMINATED | MODE_ERROR)

static void load(const void *from, ValueType type, void *values, size_t i)
{
    switch (type) {
    case TYPE_REAL: ((fmi2Real *)values)[i] = *(const double *)from; break;
    case TYPE_INTEGER:
    case TYPE_BOOLEAN: ((fmi2Integer *)values)[i] = *(const int *)from; break;
    case TYPE_STRING: ((fmi2String *)values)[i] = from; break;
    }
}

static fmi2Status get(fmi2Component c, const char *function, ValueType type,
                      const fmi2ValueReference references[], size_t count, void *values)
{
    Instance *instance = called_with_arrays(c, function, MODES_TO_GET, count, references, values);

    if (instance == NULL) return fmi2Error;
    if (instance->progress.mode == MODE_INITIALIZATION && model.calculate != NULL)
        model.calculate(instance->state);
    for (size_t i = 0; i < count; ++i) {
        const Variable *variable = find(instance, function, references[i], type);
        if (variable == NULL) return fmi2Error;
        load(address_of(instance->state, variable), type, values, i);
    }
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Real value[])
{
    return get(c, "fmi2GetReal", TYPE_REAL, vr, nvr, value);
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Integer value[])
{
    return get(c, "fmi2GetInteger", TYPE_INTEGER, vr, nvr, value);
}

fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Boolean value[])
{
    return get(c, "fmi2GetBoolean", TYPE_BOOLEAN, vr, nvr, value);
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2String value[])
{
    return get(c, "fmi2GetString", TYPE_STRING, vr, nvr, value);
}

/* ---- set ---- */

#define MODES_TO_SET (MODE_INSTANTIATED | MODE_INITIALIZATION | MODE_STEP_COMPLETE)

static fmi2Status store(Instance *instance, const char *function, const Variable *variable,
                        const void *values, size_t i)
{
    void *to = address_of(instance->state, variable);

    switch (variable->type) {
    case TYPE_REAL: *(double *)to = ((const fmi2Real *)values)[i]; break;
    case TYPE_INTEGER: *(int *)to = ((const fmi2Integer *)values)[i]; break;
    case TYPE_BOOLEAN: *(int *)to = ((const fmi2Boolean *)values)[i] != 0; break;
    case TYPE_STRING: {
        const char *text = ((const fmi2String *)values)[i];
        if (text == NULL)
            return report(instance, fmi2Error, "%s: \"%s\" is a null pointer", function, variable->name);
        if (strlen(text) >= TEXT_SIZE)
            return report(instance, fmi2Error, "%s: \"%s\" takes at most %d bytes", function, variable->name,
                          TEXT_SIZE - 1);
        store_text(instance->state, variable, text);
    }
    }
    return fmi2OK;
}

static fmi2Status set(fmi2Component c, const char *function, ValueType type,
                      const fmi2ValueReference references[], size_t count, const void *values)
{
    Instance *instance = called_with_arrays(c, function, MODES_TO_SET, count, references, values);

    if (instance == NULL) return fmi2Error;
    for (size_t i = 0; i < count; ++i) {
        const Variable *variable = find(instance, function, references[i], type);
        if (variable == NULL) return fmi2Error;
        if ((modes_to_set(variable->role) & instance->progress.mode) == 0)
            return report(instance, fmi2Error,
                          "%s: \"%s\" (value reference %u) is %s and cannot be set in the state \"%s\"",
                          function, variable->name, references[i], role_name(variable->role),
                          mode_name(instance->progress.mode));
        if (store(instance, function, variable, values, i) != fmi2OK) return fmi2Error;
    }
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Real value[])
{
    return set(c, "fmi2SetReal", TYPE_REAL, vr, nvr, value);
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                          const fmi2Integer value[])
{
    return set(c, "fmi2SetInteger", TYPE_INTEGER, vr, nvr, value);
}

fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                          const fmi2Boolean value[])
{
    return set(c, "fmi2SetBoolean", TYPE_BOOLEAN, vr, nvr, value);
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2String value[])
{
    return set(c, "fmi2SetString", TYPE_STRING, vr, nvr, value);
}
