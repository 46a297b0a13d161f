/* SPDX-License-Identifier: Apache-2.0
 *
 * A viscous damper between a joint and its parent: jointTorque = -d jointVelocity. See docs/models/Damper.md.
 */
#include <math.h>

#include "model.h"

struct ModelState {
    double actuator_input; /* N.m, not used */
    double position;       /* rad, not used */
    double velocity;       /* rad/s */
    double acceleration;   /* rad/s2, not used */
    double torque;         /* N.m */
    double d;              /* N.m.s/rad */
};

static void calculate(ModelState *s) { s->torque = -s->d * s->velocity; }

static fmi2Status initialise(Instance *instance, ModelState *s, double start_time)
{
    (void)start_time;
    /* Negated, so that NaN is refused as well. */
    if (!(s->d >= 0.0 && isfinite(s->d)))
        return report(instance, fmi2Error, "d is %.17g N.m.s/rad but has to be finite and not negative", s->d);
    return fmi2OK;
}

static fmi2Status step(Instance *instance, ModelState *s, double time, double step_size)
{
    (void)instance;
    (void)time;
    (void)step_size;
    calculate(s);
    return fmi2OK;
}

static const Variable variables[] = {
    REAL_VARIABLE("actuatorInput", ROLE_INPUT, actuator_input, 0.0),
    REAL_VARIABLE("jointPosition", ROLE_INPUT, position, 0.0),
    REAL_VARIABLE("jointVelocity", ROLE_INPUT, velocity, 0.0),
    REAL_VARIABLE("jointAcceleration", ROLE_INPUT, acceleration, 0.0),
    REAL_VARIABLE("jointTorque", ROLE_CALCULATED, torque, 0.0),
    REAL_VARIABLE("d", ROLE_FIXED, d, 0.1),
};

const Model model = {
    .state_size = sizeof(ModelState),
    .variables = variables,
    .variable_count = sizeof variables / sizeof variables[0],
    .calculate = calculate,
    .initialise = initialise,
    .step = step,
};
