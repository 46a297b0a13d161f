/* SPDX-License-Identifier: Apache-2.0
 *
 * y(t + h) = u1 + u2.
 */
#include "model.h"

struct ModelState {
    double u1, u2, y;
};

static void calculate(ModelState *s) { s->y = s->u1 + s->u2; }

static fmi2Status step(Instance *instance, ModelState *s, double time, double step_size)
{
    (void)instance;
    (void)time;
    (void)step_size;
    calculate(s);
    return fmi2OK;
}

static const Variable variables[] = {
    REAL_VARIABLE("u1", ROLE_INPUT, u1, 0.0),
    REAL_VARIABLE("u2", ROLE_INPUT, u2, 0.0),
    REAL_VARIABLE("y", ROLE_CALCULATED, y, 0.0),
};

const Model model = {
    .state_size = sizeof(ModelState),
    .variables = variables,
    .variable_count = sizeof variables / sizeof variables[0],
    .calculate = calculate,
    .step = step,
};
