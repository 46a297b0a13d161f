/* SPDX-License-Identifier: Apache-2.0
 *
 * What the files of the skeleton share about one instance. Models do not include this.
 */
#ifndef INSTANCE_H
#define INSTANCE_H

#include "model.h"

/* The states of FMI 2.0.4, 4.2.4. Bits, so that a function can name all the modes it is allowed in. */
typedef enum {
    MODE_INSTANTIATED = 1,
    MODE_INITIALIZATION = 2,
    MODE_STEP_COMPLETE = 4,
    MODE_STEP_FAILED = 8, /* the last fmi2DoStep returned fmi2Discard */
    MODE_TERMINATED = 16,
    MODE_ERROR = 32
} Mode;

#define ANY_MODE                                                                                             \
    (MODE_INSTANTIATED | MODE_INITIALIZATION | MODE_STEP_COMPLETE | MODE_STEP_FAILED | MODE_TERMINATED |     \
     MODE_ERROR)

/* The skeleton's own part of the FMU state. Times in s. */
typedef struct {
    Mode mode;
    bool experiment_defined;
    bool stop_time_defined;
    double start_time;
    double stop_time;
    double time;
} Progress;

struct Instance {
    char *name;
    fmi2CallbackLogger logger;
    fmi2ComponentEnvironment environment;
    bool debug;
    Progress progress;
    ModelState *state;
    void *memory;
    size_t memory_size;
};

/* Returns the instance if `function` may be called now; otherwise reports the error and returns NULL. */
Instance *called(fmi2Component component, const char *function, unsigned allowed_modes);

const char *mode_name(Mode mode);

/* Sets every variable to the start value of the table. */
void apply_start_values(ModelState *state);

#endif
