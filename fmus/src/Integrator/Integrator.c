/* SPDX-License-Identifier: Apache-2.0
 *
 * y' = k u with u held over the step, so y(t + h) = y(t) + h (k u) has no solver error.
 */
#include "model.h"

struct ModelState {
    double u, y, k;
};

static fmi2Status step(Instance *instance, ModelState *s, double time, double step_size)
{
    (void)instance;
    (void)time;
    s->y += step_size * (s->k * s->u);
    return fmi2OK;
}

static const Variable variables[] = {
    REAL_VARIABLE("u", ROLE_INPUT, u, 0.0),
    REAL_VARIABLE("y", ROLE_EXACT, y, 0.0),
    REAL_VARIABLE("k", ROLE_TUNABLE, k, 1.0),
};

const Model model = {
    .state_size = sizeof(ModelState),
    .variables = variables,
    .variable_count = sizeof variables / sizeof variables[0],
    .step = step,
};
