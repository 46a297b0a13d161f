/* SPDX-License-Identifier: Apache-2.0
 *
 * Drag in proportion to the velocity through the medium: force = -gain relativeVelocity, no moment. See
 * docs/models/LinearFluidDrag.md.
 */
#include <math.h>

#include "model.h"

enum { X, Y, Z, AXES };

struct ModelState {
    double velocity[AXES]; /* m/s */
    double force[AXES];    /* N */
    double moment[AXES];   /* N.m */
    double gain;           /* N.s/m */
};

static void calculate(ModelState *s)
{
    for (int axis = X; axis < AXES; ++axis) s->force[axis] = -s->gain * s->velocity[axis];
}

static fmi2Status initialise(Instance *instance, ModelState *s, double start_time)
{
    (void)start_time;
    /* Negated, so that NaN is refused as well. */
    if (!(s->gain >= 0.0 && isfinite(s->gain)))
        return report(instance, fmi2Error, "gain is %.17g N.s/m but has to be finite and not negative",
                      s->gain);
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
    REAL_VARIABLE("relativeVelocity_x", ROLE_INPUT, velocity[X], 0.0),
    REAL_VARIABLE("relativeVelocity_y", ROLE_INPUT, velocity[Y], 0.0),
    REAL_VARIABLE("relativeVelocity_z", ROLE_INPUT, velocity[Z], 0.0),
    REAL_VARIABLE("fluidDynamicForce_x", ROLE_CALCULATED, force[X], 0.0),
    REAL_VARIABLE("fluidDynamicForce_y", ROLE_CALCULATED, force[Y], 0.0),
    REAL_VARIABLE("fluidDynamicForce_z", ROLE_CALCULATED, force[Z], 0.0),
    REAL_VARIABLE("fluidDynamicMoment_x", ROLE_CALCULATED, moment[X], 0.0),
    REAL_VARIABLE("fluidDynamicMoment_y", ROLE_CALCULATED, moment[Y], 0.0),
    REAL_VARIABLE("fluidDynamicMoment_z", ROLE_CALCULATED, moment[Z], 0.0),
    REAL_VARIABLE("gain", ROLE_FIXED, gain, 10.0),
};

const Model model = {
    .state_size = sizeof(ModelState),
    .variables = variables,
    .variable_count = sizeof variables / sizeof variables[0],
    .calculate = calculate,
    .initialise = initialise,
    .step = step,
};
