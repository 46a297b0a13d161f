/* SPDX-License-Identifier: Apache-2.0
 *
 * A pole on a cart that a force pushes along a track, without friction. See docs/models/CartPole.md.
 */
#include <math.h>

#include "model.h"

/* The internal step is at most this long (s) ... */
#define LONGEST_STEP 2e-3
/* ... and at most this part of the fastest fall, 1 / sqrt(g/l), so that short poles stay accurate. */
#define PART_OF_MOTION 1e-2
/* Above this rate (1/s) the explicit solver would need more than 100,000 internal steps per 0.1 s. */
#define HIGHEST_RATE 1e4

struct ModelState {
    double force;            /* N */
    double x;                /* m */
    double velocity;         /* m/s */
    double theta;            /* rad */
    double angular_velocity; /* rad/s */
    double cart_mass;        /* kg */
    double pole_mass;        /* kg */
    double l;                /* m */
    double g;                /* m/s2 */
};

/* What changes with time, and its rate of change. */
typedef struct {
    double x, v, theta, omega;
} Motion;

static Motion derivative(const ModelState *s, Motion m)
{
    const double mass = s->cart_mass + s->pole_mass, sine = sin(m.theta), cosine = cos(m.theta);
    const double push = (s->force + s->pole_mass * s->l * m.omega * m.omega * sine) / mass;
    const double turn = (s->g * sine - cosine * push) /
                        (s->l * (4.0 / 3.0 - s->pole_mass * cosine * cosine / mass));
    const Motion rates = {m.v, push - s->pole_mass * s->l * turn * cosine / mass, m.omega, turn};

    return rates;
}

static Motion moved(Motion m, double h, Motion rates)
{
    const Motion next = {m.x + h * rates.x, m.v + h * rates.v, m.theta + h * rates.theta,
                         m.omega + h * rates.omega};

    return next;
}

/* One step of the classical Runge-Kutta method of order 4. */
static Motion runge_kutta(const ModelState *s, Motion m, double h)
{
    const Motion k1 = derivative(s, m), k2 = derivative(s, moved(m, 0.5 * h, k1));
    const Motion k3 = derivative(s, moved(m, 0.5 * h, k2)), k4 = derivative(s, moved(m, h, k3));
    const Motion mean = {(k1.x + 2.0 * (k2.x + k3.x) + k4.x) / 6.0, (k1.v + 2.0 * (k2.v + k3.v) + k4.v) / 6.0,
                         (k1.theta + 2.0 * (k2.theta + k3.theta) + k4.theta) / 6.0,
                         (k1.omega + 2.0 * (k2.omega + k3.omega) + k4.omega) / 6.0};

    return moved(m, h, mean);
}

static double rate(const ModelState *s) { return sqrt(fabs(s->g) / s->l); }

/* The parameters are tunable, so every step checks them. Negated, so that NaN is refused as well. */
static fmi2Status check(Instance *instance, const ModelState *s)
{
    if (!(s->cart_mass > 0.0))
        return report(instance, fmi2Error, "cart_mass is %.17g kg but has to be greater than 0", s->cart_mass);
    if (!(s->pole_mass >= 0.0))
        return report(instance, fmi2Error, "pole_mass is %.17g kg but must not be negative", s->pole_mass);
    if (!(s->l > 0.0)) return report(instance, fmi2Error, "l is %.17g m but has to be greater than 0", s->l);
    if (!(rate(s) <= HIGHEST_RATE))
        return report(instance, fmi2Error, "l = %.17g m and g = %.17g m/s2 move faster than %g 1/s", s->l, s->g,
                      HIGHEST_RATE);
    return fmi2OK;
}

static fmi2Status initialise(Instance *instance, ModelState *s, double start_time)
{
    (void)start_time;
    return check(instance, s);
}

static fmi2Status step(Instance *instance, ModelState *s, double time, double step_size)
{
    Motion m = {s->x, s->velocity, s->theta, s->angular_velocity};
    double longest, count;

    (void)time;
    if (check(instance, s) != fmi2OK) return fmi2Error;
    longest = fmin(LONGEST_STEP, PART_OF_MOTION / rate(s));
    /* Not one internal step more because 0.002 s came as 0.0020000000000000018 s. */
    count = fmax(1.0, ceil(step_size / longest * (1.0 - 1e-9)));
    for (double i = 0.0; i < count; i += 1.0) m = runge_kutta(s, m, step_size / count);
    s->x = m.x;
    s->velocity = m.v;
    s->theta = m.theta;
    s->angular_velocity = m.omega;
    return fmi2OK;
}

static const Variable variables[] = {
    REAL_VARIABLE("force", ROLE_INPUT, force, 0.0),
    REAL_VARIABLE("x", ROLE_EXACT, x, 0.0),
    REAL_VARIABLE("der(x)", ROLE_EXACT, velocity, 0.0),
    REAL_VARIABLE("theta", ROLE_EXACT, theta, 0.0),
    REAL_VARIABLE("der(theta)", ROLE_EXACT, angular_velocity, 0.0),
    REAL_VARIABLE("cart_mass", ROLE_TUNABLE, cart_mass, 1.0),
    REAL_VARIABLE("pole_mass", ROLE_TUNABLE, pole_mass, 0.1),
    REAL_VARIABLE("l", ROLE_TUNABLE, l, 0.5),
    REAL_VARIABLE("g", ROLE_TUNABLE, g, 9.81),
};

const Model model = {
    .state_size = sizeof(ModelState),
    .variables = variables,
    .variable_count = sizeof variables / sizeof variables[0],
    .initialise = initialise,
    .step = step,
};
