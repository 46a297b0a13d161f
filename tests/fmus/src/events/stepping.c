/* SPDX-License-Identifier: Apache-2.0
 *
 * Co-simulation of any model here: Runge-Kutta steps of at most 0.1 ms, and events found by bisection. Good to about
 * 1e-12, so that model exchange with a solver can be compared with it.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "model.h"
#include "variables.h"

#define LONGEST 1e-4

void broken(const char *function, const char *state)
{
    fprintf(stderr, "%s is not allowed in the state \"%s\"\n", function, state);
    fflush(stderr);
    abort();
}

/* The inputs in the middle of a step, with their derivatives. */
static void inputs_at(Model *m, const Model *start, double elapsed)
{
    for (int k = 0; k < REALS; k++)
        if (real_roles[k] == ROLE_CONTINUOUS) m->r[k] = start->r[k] + elapsed * start->slope[k];
}

static void evaluate(Model *m, const Model *start, const double *x, const double *dx, double h)
{
    m->time = start->time + h;
    inputs_at(m, start, h);
    for (int k = 0; k < STATES; k++) m->r[k] = x[k] + (dx == NULL ? 0.0 : h * dx[k]);
    model_equations(m);
}

/* One Runge-Kutta step of h from `start`. */
static void runge_kutta(Model *m, const Model *start, double h)
{
    double x[STATES + 1], sum[STATES + 1] = {0.0};
    const double at[4] = {0.0, 0.5, 0.5, 1.0}, weight[4] = {1.0, 2.0, 2.0, 1.0};
    double dx[STATES + 1] = {0.0};

    for (int k = 0; k < STATES; k++) x[k] = start->r[k];
    for (int stage = 0; stage < 4; stage++) {
        evaluate(m, start, x, stage == 0 ? NULL : dx, at[stage] * h);
        if (stage == 0) m->time = start->time;
        for (int k = 0; k < STATES; k++) {
            dx[k] = m->r[STATES + k];
            sum[k] += weight[stage] * dx[k] / 6.0;
        }
    }
    evaluate(m, start, x, sum, h);
}

static bool crossed(const Model *before, const Model *after)
{
    double z0[INDICATORS + 1], z1[INDICATORS + 1];
    bool found = false;

    model_indicators(before, z0);
    model_indicators(after, z1);
    for (int k = 0; k < INDICATORS; k++) found = found || (z0[k] > 0.0) != (z1[k] > 0.0);
    return found;
}

static void handle(Model *m)
{
    while (model_event(m).again && !m->terminate) continue;
    model_equations(m);
}

void advance(Model *m, double time, double step_size, bool stop_at_events, double *reached, bool *event)
{
    const double end = time + step_size;

    *event = false;
    m->time = time;
    while (m->time < end && !m->terminate) {
        const Model start = *m;
        double stop = fmin(end, m->time + LONGEST), low = 0.0, high;
        bool time_event = m->next_event_defined && m->next_event <= stop;

        if (time_event) stop = fmax(m->next_event, m->time);
        high = stop - m->time;
        if (high > 0.0) runge_kutta(m, &start, high);
        m->time = stop;
        if (crossed(&start, m)) {
            for (int k = 0; k < 80 && high > low; k++) {
                const double middle = low + (high - low) / 2.0;
                runge_kutta(m, &start, middle);
                if (crossed(&start, m)) high = middle;
                else low = middle;
            }
            runge_kutta(m, &start, high);
            *event = true;
        } else if (time_event)
            *event = true;
        if (*event && stop_at_events) break;
        if (*event) handle(m);
        *event = false;
    }
    *reached = m->time;
}
