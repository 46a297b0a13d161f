/* SPDX-License-Identifier: Apache-2.0
 *
 * A damped gravity pendulum: a'' = -(g/l) sin(a) - d a'. See docs/models/DampedPendulum.md.
 */
#include <math.h>

#include "model.h"

/* The internal step is at most this long (s) ... */
#define LONGEST_STEP 1e-3
/* ... and at most this part of the fastest motion, 1 / (sqrt(g/l) + d), so that short pendulums stay
 * accurate. */
#define PART_OF_MOTION 4e-3
/* Above this rate (1/s) the explicit solver would need more than 250,000 internal steps per 0.1 s. */
#define HIGHEST_RATE 1e4

struct ModelState {
    double a;            /* rad */
    double velocity;     /* rad/s */
    double acceleration; /* rad/s2 */
    double l;            /* m */
    double d;            /* 1/s */
    double g;            /* m/s2 */
};

static double acceleration(const ModelState *s, double a, double velocity)
{
    return -(s->g / s->l) * sin(a) - s->d * velocity;
}

static double rate(const ModelState *s) { return sqrt(fabs(s->g) / s->l) + fabs(s->d); }

static void calculate(ModelState *s) { s->acceleration = acceleration(s, s->a, s->velocity); }

static fmi2Status initialise(Instance *instance, ModelState *s, double start_time)
{
    (void)start_time;
    /* Negated, so that NaN is refused as well. */
    if (!(s->l > 0.0)) return report(instance, fmi2Error, "l is %.17g m but has to be greater than 0", s->l);
    if (!(rate(s) <= HIGHEST_RATE))
        return report(instance, fmi2Error,
                      "l = %.17g m, d = %.17g 1/s and g = %.17g m/s2 move faster than %g 1/s", s->l, s->d,
                      s->g, HIGHEST_RATE);
    return fmi2OK;
}

/* One step of the classical Runge-Kutta method of order 4. */
static void runge_kutta(ModelState *s, double h)
{
    const double a = s->a, v = s->velocity;
    const double k1 = acceleration(s, a, v);
    const double v2 = v + 0.5 * h * k1, k2 = acceleration(s, a + 0.5 * h * v, v2);
    const double v3 = v + 0.5 * h * k2, k3 = acceleration(s, a + 0.5 * h * v2, v3);
    const double v4 = v + h * k3, k4 = acceleration(s, a + h * v3, v4);

    s->a = a + h / 6.0 * (v + 2.0 * (v2 + v3) + v4);
    s->velocity = v + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4);
}

static fmi2Status step(Instance *instance, ModelState *s, double time, double step_size)
{
    const double longest = fmin(LONGEST_STEP, PART_OF_MOTION / rate(s));
    /* Not one internal step more because 0.002 s came as 0.0020000000000000018 s. */
    const double count = fmax(1.0, ceil(step_size / longest * (1.0 - 1e-9)));

    (void)instance;
    (void)time;
    for (double i = 0.0; i < count; i += 1.0) runge_kutta(s, step_size / count);
    calculate(s);
    return fmi2OK;
}

static const Variable variables[] = {
    REAL_VARIABLE("a", ROLE_EXACT, a, 1.5),
    REAL_VARIABLE("der(a)", ROLE_EXACT, velocity, 0.0),
    REAL_VARIABLE("der(a,2)", ROLE_CALCULATED, acceleration, 0.0),
    REAL_VARIABLE("l", ROLE_FIXED, l, 1.0),
    REAL_VARIABLE("d", ROLE_FIXED, d, 0.1),
    REAL_VARIABLE("g", ROLE_FIXED, g, 9.81),
};

const Model model = {
    .state_size = sizeof(ModelState),
    .variables = variables,
    .variable_count = sizeof variables / sizeof variables[0],
    .calculate = calculate,
    .initialise = initialise,
    .step = step,
};
