/* SPDX-License-Identifier: Apache-2.0
 *
 * Drag, lift and moment of a plate-like body, quadratic in the velocity through the medium. See
 * docs/models/FluidDynamics.md.
 */
#include <math.h>

#include "model.h"

enum { X, Y, Z, AXES };

struct ModelState {
    double velocity[AXES];    /* m/s */
    double force[AXES];       /* N */
    double moment[AXES];      /* N.m */
    double density;           /* kg/m3 */
    double area;              /* m2 */
    double length;            /* m */
    double drag_coefficient;  /* along the plate */
    double plate_coefficient; /* added to it across the plate */
    double lift_coefficient;
    double moment_coefficient;
};

/* With n the plate's normal (z), V the speed and sin(a) = -w / V the angle of attack. Written without a
 * division by anything but V, so that every direction is regular. */
static void calculate(ModelState *s)
{
    const double u = s->velocity[X], v = s->velocity[Y], w = s->velocity[Z];
    const double speed = sqrt(u * u + v * v + w * w);
    const double sine = speed > 0.0 ? -w / speed : -w;
    const double pressure_area = 0.5 * s->density * s->area;
    const double drag = pressure_area * speed * (s->drag_coefficient + s->plate_coefficient * sine * sine);
    const double lift = pressure_area * speed * s->lift_coefficient * 2.0 * sine;
    const double moment = pressure_area * s->length * speed * s->moment_coefficient * 2.0 * sine;

    s->force[X] = -drag * u + lift * sine * u;
    s->force[Y] = -drag * v + lift * sine * v;
    s->force[Z] = -drag * w + lift * (speed + sine * w);
    s->moment[X] = -moment * v;
    s->moment[Y] = moment * u;
    s->moment[Z] = 0.0;
}

static fmi2Status initialise(Instance *instance, ModelState *s, double start_time)
{
    const double sizes[] = {s->density, s->area, s->length, s->drag_coefficient, s->plate_coefficient};
    static const char *const names[] = {"density", "area", "length", "dragCoefficient", "plateCoefficient"};

    (void)start_time;
    for (size_t i = 0; i < sizeof sizes / sizeof sizes[0]; ++i) {
        /* Negated, so that NaN is refused as well. */
        if (!(sizes[i] >= 0.0 && isfinite(sizes[i])))
            return report(instance, fmi2Error, "%s is %.17g but has to be finite and not negative", names[i],
                          sizes[i]);
    }
    if (!isfinite(s->lift_coefficient) || !isfinite(s->moment_coefficient))
        return report(instance, fmi2Error,
                      "liftCoefficient is %.17g and momentCoefficient %.17g but both have to be finite",
                      s->lift_coefficient, s->moment_coefficient);
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
    REAL_VARIABLE("density", ROLE_FIXED, density, 1.225),
    REAL_VARIABLE("area", ROLE_FIXED, area, 1.0),
    REAL_VARIABLE("length", ROLE_FIXED, length, 1.0),
    REAL_VARIABLE("dragCoefficient", ROLE_FIXED, drag_coefficient, 0.05),
    REAL_VARIABLE("plateCoefficient", ROLE_FIXED, plate_coefficient, 1.1),
    REAL_VARIABLE("liftCoefficient", ROLE_FIXED, lift_coefficient, 0.8),
    REAL_VARIABLE("momentCoefficient", ROLE_FIXED, moment_coefficient, 0.2),
};

const Model model = {
    .state_size = sizeof(ModelState),
    .variables = variables,
    .variable_count = sizeof variables / sizeof variables[0],
    .calculate = calculate,
    .initialise = initialise,
    .step = step,
};
