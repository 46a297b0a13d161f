/* SPDX-License-Identifier: Apache-2.0
 *
 * A path filter for a vehicle on casters: it lets the casters roll before they have to turn. See
 * docs/models/PathFilter.md.
 */
#include <math.h>

#include "model.h"

#define CASTERS 4
/* The internal step is at most this long (s). */
#define LONGEST_STEP 1e-3

static const double pi = 3.14159265358979323846;

/* The estimated motion of the casters; also its rate of change. */
typedef struct {
    double angle[CASTERS];    /* rad; 0 rolls forward */
    double velocity[CASTERS]; /* rad/s; how fast they have rolled since the vehicle stood */
} Casters;

typedef struct {
    double linear;  /* m/s */
    double angular; /* rad/s */
} Twist;

struct ModelState {
    Twist command, filtered;
    bool moving;      /* as the command was in the last step */
    double direction; /* of this motion: 1, or -1 if it is filtered in reverse */
    Casters casters;
    double slope_speed;   /* rad/s */
    double half_length;   /* m */
    double half_width;    /* m */
    double trail;         /* m */
    double wheel_radius;  /* m */
    double time_constant; /* s */
};

/* The pivots: front left, front right, rear left, rear right; x points forward, y to the left. */
static double pivot_x(const ModelState *s, int i) { return i < 2 ? s->half_length : -s->half_length; }
static double pivot_y(const ModelState *s, int i) { return i % 2 == 0 ? s->half_width : -s->half_width; }

/* The angle between -pi and pi. */
static double wrapped(double angle) { return angle - 2.0 * pi * floor((angle + pi) / (2.0 * pi)); }

/* -1 if the commanded motion is that of casters rolling backward, by more than 120 degrees off on the average;
 * then the reversed motion is filtered, and driven backward. */
static double direction_of(const ModelState *s, const Casters *casters)
{
    double rolling = 0.0, speed = 0.0;

    for (int i = 0; i < CASTERS; ++i) {
        const double vx = s->command.linear - s->command.angular * pivot_y(s, i);
        const double vy = s->command.angular * pivot_x(s, i);

        rolling += vx * cos(casters->angle[i]) + vy * sin(casters->angle[i]);
        speed += hypot(vx, vy);
    }
    return rolling < -0.5 * speed ? -1.0 : 1.0;
}

/* The command that moves the casters as equations 1 and 2 of the chapter ask for, in the least squares. */
static Twist filter(const ModelState *s, const Casters *casters)
{
    const double radius = hypot(s->half_length, s->half_width), direction = s->direction;
    Twist result = {0.0, 0.0};

    for (int i = 0; i < CASTERS; ++i) {
        const double x = pivot_x(s, i), y = pivot_y(s, i);
        const double vx = direction * (s->command.linear - s->command.angular * y);
        const double vy = direction * s->command.angular * x;
        const double speed = hypot(vx, vy);
        const double gap = speed > 0.0 ? wrapped(atan2(vy, vx) - casters->angle[i]) : 0.0;
        const double k = fmin(1.0, fabs(casters->velocity[i] / s->slope_speed));
        const double angle = casters->angle[i] + k * gap;
        const double along = direction * speed * cos(angle), across = direction * speed * sin(angle);

        result.linear += along / CASTERS;
        result.angular += (x * across - y * along) / (CASTERS * radius * radius);
    }
    return result;
}

/* Casters that follow the filtered command without slip, and roll with the lag of the drives. */
static Casters rate(const ModelState *s, const Casters *casters)
{
    const Twist twist = filter(s, casters);
    Casters result;

    for (int i = 0; i < CASTERS; ++i) {
        const double vx = twist.linear - twist.angular * pivot_y(s, i), vy = twist.angular * pivot_x(s, i);
        const double sine = sin(casters->angle[i]), cosine = cos(casters->angle[i]);
        const double rolling = s->moving ? fabs(vx * cosine + vy * sine) / s->wheel_radius : 0.0;
        const double rise = (rolling - casters->velocity[i]) / s->time_constant;

        result.angle[i] = (vy * cosine - vx * sine) / s->trail - twist.angular;
        /* What a motion has reached stays in force until the vehicle is to stand. */
        result.velocity[i] = s->moving && rise < 0.0 ? 0.0 : rise;
    }
    return result;
}

static Casters moved(const Casters *from, const Casters *change, double factor)
{
    Casters result;

    for (int i = 0; i < CASTERS; ++i) {
        result.angle[i] = from->angle[i] + factor * change->angle[i];
        result.velocity[i] = from->velocity[i] + factor * change->velocity[i];
    }
    return result;
}

/* One step of the classical Runge-Kutta method of order 4. */
static void runge_kutta(ModelState *s, double h)
{
    const Casters start = s->casters, k1 = rate(s, &start);
    const Casters second = moved(&start, &k1, 0.5 * h), k2 = rate(s, &second);
    const Casters third = moved(&start, &k2, 0.5 * h), k3 = rate(s, &third);
    const Casters fourth = moved(&start, &k3, h), k4 = rate(s, &fourth);

    s->casters = moved(&s->casters, &k1, h / 6.0);
    s->casters = moved(&s->casters, &k2, h / 3.0);
    s->casters = moved(&s->casters, &k3, h / 3.0);
    s->casters = moved(&s->casters, &k4, h / 6.0);
}

/* A motion begins when the command leaves 0, and keeps its direction to its end. */
static void follow_command(ModelState *s)
{
    const bool moving = s->command.linear != 0.0 || s->command.angular != 0.0;

    if (!s->moving) s->direction = direction_of(s, &s->casters);
    s->moving = moving;
}

static void calculate(ModelState *s)
{
    s->moving = false;
    follow_command(s);
    s->filtered = filter(s, &s->casters);
}

static fmi2Status initialise(Instance *instance, ModelState *s, double start_time)
{
    const double values[] = {s->slope_speed, s->half_length,  s->half_width,
                             s->trail,       s->wheel_radius, s->time_constant};
    static const char *const names[] = {"slopeSpeed", "halfLength",  "halfWidth",
                                        "trail",      "wheelRadius", "timeConstant"};

    (void)start_time;
    for (size_t i = 0; i < sizeof values / sizeof values[0]; ++i) {
        /* Negated, so that NaN is refused as well. */
        if (!(values[i] > 0.0 && isfinite(values[i])))
            return report(instance, fmi2Error, "%s is %.17g but has to be finite and greater than 0", names[i],
                          values[i]);
    }
    if (s->time_constant < LONGEST_STEP)
        return report(instance, fmi2Error, "timeConstant is %.17g s but has to be %g s or more",
                      s->time_constant, LONGEST_STEP);
    calculate(s);
    return fmi2OK;
}

static fmi2Status step(Instance *instance, ModelState *s, double time, double step_size)
{
    /* Not one internal step more because 0.002 s came as 0.0020000000000000018 s. */
    const double count = fmax(1.0, ceil(step_size / LONGEST_STEP * (1.0 - 1e-9)));

    (void)instance;
    (void)time;
    follow_command(s);
    for (double i = 0.0; i < count; i += 1.0) runge_kutta(s, step_size / count);
    s->filtered = filter(s, &s->casters);
    return fmi2OK;
}

static const Variable variables[] = {
    REAL_VARIABLE("linearVelocity", ROLE_INPUT, command.linear, 0.0),
    REAL_VARIABLE("angularVelocity", ROLE_INPUT, command.angular, 0.0),
    REAL_VARIABLE("filteredLinearVelocity", ROLE_CALCULATED, filtered.linear, 0.0),
    REAL_VARIABLE("filteredAngularVelocity", ROLE_CALCULATED, filtered.angular, 0.0),
    REAL_VARIABLE("casterAngle[1]", ROLE_EXACT, casters.angle[0], 0.0),
    REAL_VARIABLE("casterAngle[2]", ROLE_EXACT, casters.angle[1], 0.0),
    REAL_VARIABLE("casterAngle[3]", ROLE_EXACT, casters.angle[2], 0.0),
    REAL_VARIABLE("casterAngle[4]", ROLE_EXACT, casters.angle[3], 0.0),
    REAL_VARIABLE("casterVelocity[1]", ROLE_EXACT, casters.velocity[0], 0.0),
    REAL_VARIABLE("casterVelocity[2]", ROLE_EXACT, casters.velocity[1], 0.0),
    REAL_VARIABLE("casterVelocity[3]", ROLE_EXACT, casters.velocity[2], 0.0),
    REAL_VARIABLE("casterVelocity[4]", ROLE_EXACT, casters.velocity[3], 0.0),
    REAL_VARIABLE("slopeSpeed", ROLE_FIXED, slope_speed, 4.0),
    REAL_VARIABLE("halfLength", ROLE_FIXED, half_length, 0.35),
    REAL_VARIABLE("halfWidth", ROLE_FIXED, half_width, 0.2),
    REAL_VARIABLE("trail", ROLE_FIXED, trail, 0.03),
    REAL_VARIABLE("wheelRadius", ROLE_FIXED, wheel_radius, 0.05),
    REAL_VARIABLE("timeConstant", ROLE_FIXED, time_constant, 0.05),
};

const Model model = {
    .state_size = sizeof(ModelState),
    .variables = variables,
    .variable_count = sizeof variables / sizeof variables[0],
    .calculate = calculate,
    .initialise = initialise,
    .step = step,
};
