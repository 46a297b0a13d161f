/* SPDX-License-Identifier: Apache-2.0
 *
 * y(t + h) = u until one of its faults strikes. The times are compared with the end of the step, t + h >
 * fault.
 */
#define _POSIX_C_SOURCE 200809L

#include <stdlib.h>
#include <time.h>
#include <unistd.h>

#include "model.h"

#define NEVER 1e300

struct ModelState {
    double u, y;
    double fail_at, crash_at, hang_at, discard_at; /* s */
    double slow;                                   /* s of real time per step */
    int fail_in_init;
};

static double seconds_now(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static void keep_busy(double seconds)
{
    const double end = seconds_now() + seconds;
    while (seconds_now() < end) continue;
}

static void hang(void)
{
    for (;;) sleep(1000);
}

static void calculate(ModelState *s) { s->y = s->u; }

static fmi2Status initialise(Instance *instance, ModelState *s, double start_time)
{
    (void)start_time;
    return s->fail_in_init ? report(instance, fmi2Error, "the reactor does not start") : fmi2OK;
}

static fmi2Status step(Instance *instance, ModelState *s, double time, double step_size)
{
    const double end = time + step_size;

    if (s->slow > 0.0) keep_busy(s->slow);
    if (end > s->crash_at) abort();
    if (end > s->hang_at) hang();
    if (end > s->fail_at) return report(instance, fmi2Error, "the reactor is empty");
    if (end > s->discard_at) return report(instance, fmi2Discard, "the step does not converge");
    calculate(s);
    return fmi2OK;
}

static const Variable variables[] = {
    REAL_VARIABLE("u", ROLE_INPUT, u, 0.0),
    REAL_VARIABLE("y", ROLE_CALCULATED, y, 0.0),
    REAL_VARIABLE("fail_at", ROLE_TUNABLE, fail_at, NEVER),
    REAL_VARIABLE("crash_at", ROLE_TUNABLE, crash_at, NEVER),
    REAL_VARIABLE("hang_at", ROLE_TUNABLE, hang_at, NEVER),
    REAL_VARIABLE("discard_at", ROLE_TUNABLE, discard_at, NEVER),
    REAL_VARIABLE("slow", ROLE_TUNABLE, slow, 0.0),
    BOOLEAN_VARIABLE("fail_in_init", ROLE_FIXED, fail_in_init, fmi2False),
};

const Model model = {
    .state_size = sizeof(ModelState),
    .variables = variables,
    .variable_count = sizeof variables / sizeof variables[0],
    .calculate = calculate,
    .initialise = initialise,
    .step = step,
};
