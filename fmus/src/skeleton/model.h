/* SPDX-License-Identifier: Apache-2.0
 *
 * The border between a model and the skeleton.
 *
 * A model is one C file. It defines `struct ModelState` (plain data, no pointers), a table of its variables
 * and three functions, and bundles them in the constant `model`. The skeleton owns everything FMI: the
 * calling sequence, get and set, messages, the FMU state. A model never sees an fmi2 function.
 */
#ifndef MODEL_H
#define MODEL_H

#include <stdbool.h>
#include <stddef.h>

#include "fmi2Functions.h"

/* Room for one String value with its terminating zero. A longer value is refused, never cut. */
#define TEXT_SIZE 1024

#if defined __GNUC__
#define PRINTF_LIKE(text, first) __attribute__((format(printf, text, first)))
#else
#define PRINTF_LIKE(text, first)
#endif

typedef struct Instance Instance;
typedef struct ModelState ModelState;

/* An Enumeration is an Integer in FMI 2.0. */
typedef enum { TYPE_REAL, TYPE_INTEGER, TYPE_BOOLEAN, TYPE_STRING } ValueType;

/* What FMI 2.0 lets an importer do with a variable; it follows from causality, variability and initial. */
typedef enum {
    ROLE_FIXED,     /* parameter, fixed: set up to the end of initialization mode */
    ROLE_TUNABLE,   /* parameter, tunable: set between steps as well */
    ROLE_INPUT,     /* set between steps as well */
    ROLE_EXACT,     /* output or local with initial="exact": set up to the end of initialization mode */
    ROLE_CALCULATED /* output or local with initial="calculated": never set */
} Role;

typedef struct {
    const char *name;
    ValueType type;
    Role role;
    size_t offset; /* of the value in ModelState */
    double real_start;
    int integer_start; /* for Boolean too */
    const char *text_start;
} Variable;

/* One row of the table. The position in the table is the value reference. */
#define REAL_VARIABLE(name, role, field, start)                                                              \
    {name, TYPE_REAL, role, offsetof(ModelState, field), start, 0, NULL}
#define INTEGER_VARIABLE(name, role, field, start)                                                           \
    {name, TYPE_INTEGER, role, offsetof(ModelState, field), 0.0, start, NULL}
#define BOOLEAN_VARIABLE(name, role, field, start)                                                           \
    {name, TYPE_BOOLEAN, role, offsetof(ModelState, field), 0.0, start, NULL}
#define STRING_VARIABLE(name, role, field, start)                                                            \
    {name, TYPE_STRING, role, offsetof(ModelState, field), 0.0, 0, start}

typedef struct {
    size_t state_size;
    const Variable *variables;
    size_t variable_count;

    /* Computes every calculated variable from the others; called before values are read in initialization
     * mode. NULL where there are none. */
    void (*calculate)(ModelState *state);

    /* Checks the parameters and prepares the first step; called at the end of initialization mode. NULL where
     * there is nothing to do. */
    fmi2Status (*initialise)(Instance *instance, ModelState *state, double start_time);

    /* Advances from `time` to `time + step_size` (s, step_size > 0) and computes the outputs there. */
    fmi2Status (*step)(Instance *instance, ModelState *state, double time, double step_size);
} Model;

/* Defined by the model. */
extern const Model model;

/* Sends a message to the importer and returns `status`, so that a model can `return report(...)`. */
fmi2Status report(Instance *instance, fmi2Status status, const char *format, ...) PRINTF_LIKE(3, 4);

/* Memory that may grow while the model runs; it belongs to the FMU state as ModelState does. Resizing keeps
 * the content and moves the address. Where no memory is left it returns false and changes nothing. */
void *instance_memory(const Instance *instance);
size_t instance_memory_size(const Instance *instance);
bool resize_instance_memory(Instance *instance, size_t size);

#endif
