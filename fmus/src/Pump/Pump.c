/* SPDX-License-Identifier: Apache-2.0
 *
 * A centrifugal pump by the affinity laws, and the temperature of its motor. See docs/models/Pump.md.
 */
#include <math.h>

#include "model.h"

struct ModelState {
    double speed;            /* rad/s */
    double ambient;          /* degC */
    double flow;             /* m3/s */
    double power;            /* W */
    double temperature;      /* degC */
    double forecast;         /* degC */
    double rated_speed;      /* rad/s */
    double rated_flow;       /* m3/s */
    double rated_power;      /* W */
    double temperature_rise; /* K */
    double time_constant;    /* s */
    double horizon;          /* s */
};

/* The temperature after `duration` (s) with speed and ambient temperature as they are. */
static double temperature_after(const ModelState *s, double duration)
{
    const double part = fabs(s->speed / s->rated_speed);
    const double final = s->ambient + s->temperature_rise * (part * part * part);

    return s->temperature + (s->temperature - final) * expm1(-duration / s->time_constant);
}

static void calculate(ModelState *s)
{
    const double part = s->speed / s->rated_speed;

    s->flow = s->rated_flow * part;
    s->power = s->rated_power * fabs(part * part * part);
    s->forecast = temperature_after(s, s->horizon);
}

static fmi2Status initialise(Instance *instance, ModelState *s, double start_time)
{
    (void)start_time;
    /* Negated, so that NaN is refused as well. */
    if (!(s->rated_speed > 0.0 && isfinite(s->rated_speed)))
        return report(instance, fmi2Error,
                      "rated_speed is %.17g rad/s but has to be finite and greater than 0", s->rated_speed);
    if (!(s->time_constant > 0.0 && isfinite(s->time_constant)))
        return report(instance, fmi2Error,
                      "time_constant is %.17g s but has to be finite and greater than 0", s->time_constant);
    if (!(s->horizon >= 0.0 && isfinite(s->horizon)))
        return report(instance, fmi2Error, "horizon is %.17g s but has to be finite and not negative",
                      s->horizon);
    return fmi2OK;
}

static fmi2Status step(Instance *instance, ModelState *s, double time, double step_size)
{
    (void)instance;
    (void)time;
    s->temperature = temperature_after(s, step_size);
    calculate(s);
    return fmi2OK;
}

static const Variable variables[] = {
    REAL_VARIABLE("speed", ROLE_INPUT, speed, 0.0),
    REAL_VARIABLE("ambient", ROLE_INPUT, ambient, 20.0),
    REAL_VARIABLE("flow", ROLE_CALCULATED, flow, 0.0),
    REAL_VARIABLE("power", ROLE_CALCULATED, power, 0.0),
    REAL_VARIABLE("temperature", ROLE_EXACT, temperature, 20.0),
    REAL_VARIABLE("forecast", ROLE_CALCULATED, forecast, 0.0),
    REAL_VARIABLE("rated_speed", ROLE_FIXED, rated_speed, 300.0),
    REAL_VARIABLE("rated_flow", ROLE_FIXED, rated_flow, 0.01),
    REAL_VARIABLE("rated_power", ROLE_FIXED, rated_power, 4000.0),
    REAL_VARIABLE("temperature_rise", ROLE_FIXED, temperature_rise, 60.0),
    REAL_VARIABLE("time_constant", ROLE_FIXED, time_constant, 600.0),
    REAL_VARIABLE("horizon", ROLE_FIXED, horizon, 600.0),
};

const Model model = {
    .state_size = sizeof(ModelState),
    .variables = variables,
    .variable_count = sizeof variables / sizeof variables[0],
    .calculate = calculate,
    .initialise = initialise,
    .step = step,
};
