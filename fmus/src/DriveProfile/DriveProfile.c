/* SPDX-License-Identifier: Apache-2.0
 *
 * Velocities to drive forward, stop, turn, stop, forward, stop, backward, stop, in trapezoids. See
 * docs/models/DriveProfile.md.
 */
#include <math.h>

#include "model.h"

struct ModelState {
    double linear_velocity;      /* m/s */
    double angular_velocity;     /* rad/s */
    double speed;                /* m/s, forward and backward */
    double turn_rate;            /* rad/s */
    double linear_acceleration;  /* m/s2 */
    double angular_acceleration; /* rad/s2 */
    double hold;                 /* s at full velocity */
    double pause;                /* s at rest before each motion */
    double start_time;           /* s */
};

/* How long one motion takes from rest to rest, s. */
static double duration(const ModelState *s, double velocity, double acceleration)
{
    return 2.0 * (velocity / acceleration) + s->hold;
}

/* The velocity `time` seconds after the begin of a motion that ends `length` seconds after it. */
static double trapezoid(double velocity, double acceleration, double length, double time)
{
    const double distance = fmin(time, length - time);

    return distance > 0.0 ? fmin(velocity, acceleration * distance) : 0.0;
}

static void evaluate(ModelState *s, double time)
{
    const double straight = duration(s, s->speed, s->linear_acceleration);
    const double turn = duration(s, s->turn_rate, s->angular_acceleration);
    const double t = time - s->start_time - s->pause, next_straight = straight + s->pause;
    const double after_turn = next_straight + turn + s->pause;

    s->linear_velocity =
        trapezoid(s->speed, s->linear_acceleration, straight, t) +
        trapezoid(s->speed, s->linear_acceleration, straight, t - after_turn) -
        trapezoid(s->speed, s->linear_acceleration, straight, t - after_turn - next_straight);
    s->angular_velocity = trapezoid(s->turn_rate, s->angular_acceleration, turn, t - next_straight);
}

static fmi2Status initialise(Instance *instance, ModelState *s, double start_time)
{
    const double values[] = {s->speed, s->turn_rate, s->hold, s->pause};
    static const char *const names[] = {"speed", "turnRate", "hold", "pause"};

    for (size_t i = 0; i < sizeof values / sizeof values[0]; ++i) {
        /* Negated, so that NaN is refused as well. */
        if (!(values[i] >= 0.0 && isfinite(values[i])))
            return report(instance, fmi2Error, "%s is %.17g but has to be finite and not negative", names[i],
                          values[i]);
    }
    if (!(s->linear_acceleration > 0.0 && s->angular_acceleration > 0.0))
        return report(instance, fmi2Error,
                      "linearAcceleration is %.17g m/s2 and angularAcceleration %.17g rad/s2 but both have to "
                      "be greater than 0",
                      s->linear_acceleration, s->angular_acceleration);
    s->start_time = start_time;
    evaluate(s, start_time);
    return fmi2OK;
}

static fmi2Status step(Instance *instance, ModelState *s, double time, double step_size)
{
    (void)instance;
    evaluate(s, time + step_size);
    return fmi2OK;
}

static const Variable variables[] = {
    REAL_VARIABLE("linearVelocity", ROLE_CALCULATED, linear_velocity, 0.0),
    REAL_VARIABLE("angularVelocity", ROLE_CALCULATED, angular_velocity, 0.0),
    REAL_VARIABLE("speed", ROLE_FIXED, speed, 0.5),
    REAL_VARIABLE("turnRate", ROLE_FIXED, turn_rate, 1.0),
    REAL_VARIABLE("linearAcceleration", ROLE_FIXED, linear_acceleration, 0.5),
    REAL_VARIABLE("angularAcceleration", ROLE_FIXED, angular_acceleration, 0.5),
    REAL_VARIABLE("hold", ROLE_FIXED, hold, 1.0),
    REAL_VARIABLE("pause", ROLE_FIXED, pause, 1.0),
};

const Model model = {
    .state_size = sizeof(ModelState),
    .variables = variables,
    .variable_count = sizeof variables / sizeof variables[0],
    .initialise = initialise,
    .step = step,
};
