/* SPDX-License-Identifier: Apache-2.0
 *
 * An integrator that logs 20 messages at every step, as an FMU does whose solver reports each try.
 */
#include "model.h"

struct ModelState {
    double u, y, k;
};

enum { MESSAGES = 20 };

static fmi2Status step(Instance *instance, ModelState *m, double time, double step_size)
{
    for (int n = 0; n < MESSAGES; n++)
        report(instance, fmi2Warning, "step at %g s rejected, trying again, residual %g", time, m->y);
    m->y += step_size * (m->k * m->u);
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
