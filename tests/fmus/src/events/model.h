/* SPDX-License-Identifier: Apache-2.0
 *
 * What the event test FMUs share: one model behind the functions of FMI 1.0, 2.0 or 3.0.
 *
 * A model owns its equations and knows nothing of FMI; `fmi1.c`, `fmi2.c` and `fmi3.c` own the state machine of their
 * version and abort the process on a call that it forbids. `variables.h` is written by `tests/fmus/event_fmus.py`
 * from the same table as the model description.
 */
#ifndef MODEL_H
#define MODEL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define REALS 16
#define INTEGERS 16
#define FIRST_INTEGER 100 /* value references of Integer variables start here */
#define FIRST_CLOCK 200
#define TIME (REALS - 1) /* the independent variable of FMI 3.0 */

/* How a variable may be set; it follows from causality, variability and initial. */
typedef enum {
    ROLE_NONE,       /* no such variable */
    ROLE_READ,       /* never set */
    ROLE_FIXED,      /* up to the end of initialization */
    ROLE_TUNABLE,    /* at events and between steps as well */
    ROLE_DISCRETE,   /* a discrete input: the same */
    ROLE_CONTINUOUS, /* a continuous input: in continuous-time mode as well */
} Role;

/* Plain data: copying it is getting or setting the FMU state. Continuous state k is `r[k]`, its derivative
 * `r[STATES + k]`. */
typedef struct {
    double time;
    double r[REALS];
    double slope[REALS]; /* time derivatives of inputs, for co-simulation */
    int32_t i[INTEGERS];
    bool clock;
    bool next_event_defined;
    double next_event;
    bool terminate;
} Model;

typedef struct {
    bool again; /* the event iteration has to go on */
    bool states_changed;
    bool nominals_changed;
} Update;

void model_start(Model *m);                      /* start values */
void model_initialize(Model *m);                 /* at the end of initialization */
void model_equations(Model *m);                  /* derivatives and continuous outputs, from time, states and inputs */
void model_indicators(const Model *m, double *z);
Update model_event(Model *m);                    /* one event iteration */
bool model_completed_step(Model *m);             /* whether a step event happened */
bool model_discards(const Model *m, double step_size);
bool model_refuses(const Model *m);              /* whether the derivatives cannot be computed here */
bool model_refuses_state(const Model *m);        /* whether it cannot go back to a state (FMI 2.0); most can */

/* Advances by at most `step_size`, to `*reached`: to the end, or to an event that the importer shall handle. Without
 * `stop_at_events` all events are handled inside. */
void advance(Model *m, double time, double step_size, bool stop_at_events, double *reached, bool *event);

/* Ends the process: the importer has broken the rules. */
void broken(const char *function, const char *state);

#endif
