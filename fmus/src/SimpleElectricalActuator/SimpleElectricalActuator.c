/* SPDX-License-Identifier: Apache-2.0
 *
 * A voltage-driven DC motor with a gear, and a damper in series with the joint:
 * J w' = k (v - k w) / R - torque / n with torque = d (w / n - jointVelocity) and v the limited input. See
 * docs/models/SimpleElectricalActuator.md.
 */
#include <math.h>

#include "model.h"

struct ModelState {
    double actuator_input; /* V */
    double position;       /* rad, not used */
    double velocity;       /* rad/s */
    double acceleration;   /* rad/s2, not used */
    double torque;         /* N.m */
    double current;        /* A */
    double motor_velocity; /* rad/s */
    double voltage_limit;  /* V */
    double resistance;     /* ohm */
    double motor_constant; /* N.m/A, and V.s/rad */
    double rotor_inertia;  /* kg.m2 */
    double gear_ratio;     /* 1 */
    double damping;        /* N.m.s/rad, at the joint */
};

/* Not fmin and fmax, which would turn NaN into a voltage. */
static double limited(double x, double limit) { return x > limit ? limit : x < -limit ? -limit : x; }

static void calculate(ModelState *s)
{
    const double back_emf = s->motor_constant * s->motor_velocity;

    s->current = (limited(s->actuator_input, s->voltage_limit) - back_emf) / s->resistance;
    s->torque = s->damping * (s->motor_velocity / s->gear_ratio - s->velocity);
}

/* How fast the motor approaches its final speed while the inputs are held, in 1/s. */
static double rate(const ModelState *s)
{
    return (s->motor_constant * s->motor_constant / s->resistance +
            s->damping / (s->gear_ratio * s->gear_ratio)) /
           s->rotor_inertia;
}

static fmi2Status initialise(Instance *instance, ModelState *s, double start_time)
{
    (void)start_time;
    /* Negated, so that NaN is refused as well. */
    if (!(s->voltage_limit >= 0.0))
        return report(instance, fmi2Error, "voltageLimit is %.17g V but must not be negative",
                      s->voltage_limit);
    if (!(s->resistance > 0.0))
        return report(instance, fmi2Error, "resistance is %.17g ohm but has to be greater than 0",
                      s->resistance);
    if (!(s->rotor_inertia > 0.0))
        return report(instance, fmi2Error, "rotorInertia is %.17g kg.m2 but has to be greater than 0",
                      s->rotor_inertia);
    if (!(fabs(s->gear_ratio) > 0.0))
        return report(instance, fmi2Error, "gearRatio is %.17g but must not be 0", s->gear_ratio);
    if (!(s->damping >= 0.0))
        return report(instance, fmi2Error, "damping is %.17g N.m.s/rad but must not be negative", s->damping);
    if (!isfinite(rate(s)))
        return report(instance, fmi2Error,
                      "motorConstant = %.17g N.m/A, resistance = %.17g ohm, rotorInertia = %.17g kg.m2, "
                      "gearRatio = %.17g and damping = %.17g N.m.s/rad give no finite time constant",
                      s->motor_constant, s->resistance, s->rotor_inertia, s->gear_ratio, s->damping);
    return fmi2OK;
}

/* Voltage and joint velocity are held over the step. Then the motor's equation is linear with constant
 * coefficients, and its solution is known: there is no solver error, at any step size. */
static fmi2Status step(Instance *instance, ModelState *s, double time, double step_size)
{
    const double a = rate(s);
    double motor_acceleration;

    (void)instance;
    (void)time;
    calculate(s);
    motor_acceleration = (s->motor_constant * s->current - s->torque / s->gear_ratio) / s->rotor_inertia;
    s->motor_velocity += motor_acceleration * (a > 0.0 ? -expm1(-a * step_size) / a : step_size);
    calculate(s);
    return fmi2OK;
}

static const Variable variables[] = {
    REAL_VARIABLE("actuatorInput", ROLE_INPUT, actuator_input, 0.0),
    REAL_VARIABLE("jointPosition", ROLE_INPUT, position, 0.0),
    REAL_VARIABLE("jointVelocity", ROLE_INPUT, velocity, 0.0),
    REAL_VARIABLE("jointAcceleration", ROLE_INPUT, acceleration, 0.0),
    REAL_VARIABLE("jointTorque", ROLE_CALCULATED, torque, 0.0),
    REAL_VARIABLE("motorCurrent", ROLE_CALCULATED, current, 0.0),
    REAL_VARIABLE("motorVelocity", ROLE_EXACT, motor_velocity, 0.0),
    REAL_VARIABLE("voltageLimit", ROLE_FIXED, voltage_limit, 48.0),
    REAL_VARIABLE("resistance", ROLE_FIXED, resistance, 1.0),
    REAL_VARIABLE("motorConstant", ROLE_FIXED, motor_constant, 0.1),
    REAL_VARIABLE("rotorInertia", ROLE_FIXED, rotor_inertia, 1e-5),
    REAL_VARIABLE("gearRatio", ROLE_FIXED, gear_ratio, 100.0),
    REAL_VARIABLE("damping", ROLE_FIXED, damping, 0.25),
};

const Model model = {
    .state_size = sizeof(ModelState),
    .variables = variables,
    .variable_count = sizeof variables / sizeof variables[0],
    .calculate = calculate,
    .initialise = initialise,
    .step = step,
};
