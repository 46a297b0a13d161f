/* SPDX-License-Identifier: Apache-2.0
 *
 * y(t + h) = k u. As cheap as a step can be: it measures the mesh, not the model.
 */
#include "model.h"

struct ModelState {
    double u, y, k;
};

static void calculate(ModelState *s) { s->y = s->k * s->u; }

static fmi2Status step(Instance *instance, ModelState *s, double time, double step_size)
{
    (void)instance;
    (void)time;
    (void)step_size;
    calculate(s);
    return fmi2OK;
}

static const Variable variables[] = {
    REAL_VARIABLE("u", ROLE_INPUT, u, 0.0),
    REAL_VARIABLE("y", ROLE_CALCULATED, y, 0.0),
    REAL_VARIABLE("k", ROLE_TUNABLE, k, 1.0),
};

const Model model = {
    .state_size = sizeof(ModelState),
    .variables = variables,
    .variable_count = sizeof variables / sizeof variables[0],
    .calculate = calculate,
    .step = step,
};
