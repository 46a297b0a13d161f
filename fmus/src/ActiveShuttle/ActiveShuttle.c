/* SPDX-License-Identifier: Apache-2.0
 *
 * A vehicle with two driven wheels and four casters whose contact patches resist being turned. See
 * docs/models/ActiveShuttle.md.
 */
#include <math.h>

#include "model.h"

#define CASTERS 4
/* The internal step is at most this long (s) ... */
#define LONGEST_STEP 5e-4
/* ... and at most this part of the fastest motion, which is a caster's grip while it hardly turns. */
#define PART_OF_MOTION 0.5
/* Above this rate (1/s) the explicit solver would need more than 200,000 internal steps per 0.1 s. */
#define HIGHEST_RATE 1e6
/* Below this speed (m/s) the rolling resistance fades out. */
#define RESISTANCE_SPEED 0.01

static const double gravity = 9.81; /* m/s2 */

enum { LEFT, RIGHT, SIDES };

/* What moves; also its rate of change. */
typedef struct {
    double x, y, heading;     /* m, m, rad */
    double linear, angular;   /* m/s, rad/s */
    double angle[CASTERS];    /* rad; 0 rolls forward */
    double integrator[SIDES]; /* V */
} Motion;

#define MOTION_SIZE (sizeof(Motion) / sizeof(double))

struct ModelState {
    double linear_command;  /* m/s */
    double angular_command; /* rad/s */
    double current[SIDES];  /* A */
    Motion motion;
    double mass;                 /* kg */
    double yaw_inertia;          /* kg.m2 */
    double half_length;          /* m */
    double half_width;           /* m */
    double trail;                /* m */
    double caster_load;          /* part of the weight */
    double friction_coefficient; /* 1 */
    double contact_radius;       /* m */
    double grip_velocity;        /* rad/s */
    double rolling_resistance;   /* 1 */
    double track;                /* m */
    double drive_radius;         /* m */
    double torque_constant;      /* N.m/A, and V.s/rad */
    double gear_ratio;           /* 1 */
    double resistance;           /* ohm */
    double voltage_limit;        /* V */
    double proportional_gain;    /* V.s/rad, at the wheel */
    double integral_gain;        /* V/rad, at the wheel */
};

/* The pivots: front left, front right, rear left, rear right; x points forward, y to the left. */
static double pivot_x(const ModelState *s, int i) { return i < 2 ? s->half_length : -s->half_length; }
static double pivot_y(const ModelState *s, int i) { return i % 2 == 0 ? s->half_width : -s->half_width; }

static double caster_force(const ModelState *s) { return s->caster_load * s->mass * gravity / CASTERS; }

/* What it takes to turn a caster's contact patch that does not roll, N.m. */
static double bore_torque(const ModelState *s)
{
    return 2.0 / 3.0 * s->friction_coefficient * caster_force(s) * s->contact_radius;
}

/* Not fmin and fmax, which would turn NaN into a voltage. */
static double limited(double x, double limit) { return x > limit ? limit : x < -limit ? -limit : x; }

/* The velocity of a driven wheel (rad/s) in a motion of the vehicle. */
static double drive_velocity(const ModelState *s, int side, double linear, double angular)
{
    return (linear + (side == LEFT ? -0.5 : 0.5) * s->track * angular) / s->drive_radius;
}

/* How much slower a driven wheel is than it should be, rad/s. */
static double velocity_error(const ModelState *s, const Motion *m, int side)
{
    return drive_velocity(s, side, s->linear_command, s->angular_command) -
           drive_velocity(s, side, m->linear, m->angular);
}

/* The current of a motor (A) under its velocity controller, which knows the back electromotive force. */
static double motor_current(const ModelState *s, const Motion *m, int side)
{
    const double constant = s->torque_constant * s->gear_ratio;
    const double wanted = drive_velocity(s, side, s->linear_command, s->angular_command);
    const double voltage =
        limited(s->proportional_gain * velocity_error(s, m, side) + m->integrator[side] + constant * wanted,
                s->voltage_limit);

    return (voltage - constant * drive_velocity(s, side, m->linear, m->angular)) / s->resistance;
}

static Motion rate(const ModelState *s, const Motion *m)
{
    const double torque = bore_torque(s), resistance = s->rolling_resistance * caster_force(s);
    const double ratio = s->torque_constant * s->gear_ratio / s->drive_radius;
    const double left = ratio * motor_current(s, m, LEFT), right = ratio * motor_current(s, m, RIGHT);
    double force = left + right, moment = 0.5 * s->track * (right - left);
    Motion result;

    for (int i = 0; i < CASTERS; ++i) {
        const double x = pivot_x(s, i), y = pivot_y(s, i);
        const double sine = sin(m->angle[i]), cosine = cos(m->angle[i]);
        const double vx = m->linear - m->angular * y, vy = m->angular * x;
        const double rolling = vx * cosine + vy * sine;            /* m/s */
        const double turning = (vy * cosine - vx * sine) / s->trail; /* rad/s, against the ground */
        /* The patch is renewed by rolling: friction that turns it fades with rolling over contact radius. */
        const double renewal = rolling / s->contact_radius;
        const double grip = sqrt(turning * turning + renewal * renewal + s->grip_velocity * s->grip_velocity);
        const double across = torque * turning / grip / s->trail; /* N, at the pivot */
        const double along = resistance * rolling / hypot(rolling, RESISTANCE_SPEED);

        force += across * sine - along * cosine;
        moment -= across * (y * sine + x * cosine) + along * (x * sine - y * cosine);
        result.angle[i] = turning - m->angular;
    }
    result.x = m->linear * cos(m->heading);
    result.y = m->linear * sin(m->heading);
    result.heading = m->angular;
    result.linear = force / s->mass;
    result.angular = moment / s->yaw_inertia;
    for (int side = LEFT; side < SIDES; ++side)
        result.integrator[side] = s->integral_gain * velocity_error(s, m, side);
    return result;
}

static Motion moved(const Motion *from, const Motion *change, double factor)
{
    Motion result;
    double *to = (double *)&result;
    const double *start = (const double *)from, *difference = (const double *)change;

    for (size_t i = 0; i < MOTION_SIZE; ++i) to[i] = start[i] + factor * difference[i];
    return result;
}

/* One step of the classical Runge-Kutta method of order 4. */
static void runge_kutta(ModelState *s, double h)
{
    const Motion start = s->motion, k1 = rate(s, &start);
    const Motion second = moved(&start, &k1, 0.5 * h), k2 = rate(s, &second);
    const Motion third = moved(&start, &k2, 0.5 * h), k3 = rate(s, &third);
    const Motion fourth = moved(&start, &k3, h), k4 = rate(s, &fourth);

    s->motion = moved(&s->motion, &k1, h / 6.0);
    s->motion = moved(&s->motion, &k2, h / 3.0);
    s->motion = moved(&s->motion, &k3, h / 3.0);
    s->motion = moved(&s->motion, &k4, h / 6.0);
}

static void calculate(ModelState *s)
{
    for (int side = LEFT; side < SIDES; ++side) s->current[side] = motor_current(s, &s->motion, side);
}

/* How fast the fastest part moves, 1/s: a caster's grip at rest, the drives, a caster's turn at 1 m/s. */
static double highest_rate(const ModelState *s)
{
    const double square = s->half_length * s->half_length + s->half_width * s->half_width;
    const double inertia = fmin(s->mass, s->yaw_inertia / square);
    const double grip = CASTERS * bore_torque(s) / (s->grip_velocity * s->trail * s->trail * inertia);
    const double constant = s->torque_constant * s->gear_ratio / s->drive_radius;
    const double gain = s->proportional_gain / s->drive_radius + constant;
    const double drive =
        2.0 * constant * gain / s->resistance / fmin(s->mass, 4.0 * s->yaw_inertia / (s->track * s->track));

    return grip + drive + 1.0 / s->trail;
}

static fmi2Status initialise(Instance *instance, ModelState *s, double start_time)
{
    const double sizes[] = {s->mass,         s->yaw_inertia,    s->half_length,   s->half_width,
                            s->trail,        s->contact_radius, s->grip_velocity, s->track,
                            s->drive_radius, s->resistance};
    static const char *const names[] = {"mass",        "yawInertia",    "halfLength",   "halfWidth",
                                        "trail",       "contactRadius", "gripVelocity", "track",
                                        "driveRadius", "resistance"};

    (void)start_time;
    for (size_t i = 0; i < sizeof sizes / sizeof sizes[0]; ++i) {
        /* Negated, so that NaN is refused as well. */
        if (!(sizes[i] > 0.0 && isfinite(sizes[i])))
            return report(instance, fmi2Error, "%s is %.17g but has to be finite and greater than 0", names[i],
                          sizes[i]);
    }
    if (!(s->caster_load >= 0.0 && s->caster_load <= 1.0))
        return report(instance, fmi2Error, "casterLoad is %.17g but has to be between 0 and 1", s->caster_load);
    if (!(s->friction_coefficient >= 0.0 && s->rolling_resistance >= 0.0 && s->voltage_limit >= 0.0))
        return report(instance, fmi2Error,
                      "frictionCoefficient is %.17g, rollingResistance %.17g and voltageLimit %.17g V but none "
                      "may be negative",
                      s->friction_coefficient, s->rolling_resistance, s->voltage_limit);
    if (!(highest_rate(s) <= HIGHEST_RATE))
        return report(instance, fmi2Error,
                      "these parameters move faster than %g 1/s; a greater gripVelocity or mass, or smaller "
                      "gains, make it slower",
                      HIGHEST_RATE);
    return fmi2OK;
}

static fmi2Status step(Instance *instance, ModelState *s, double time, double step_size)
{
    const double longest = fmin(LONGEST_STEP, PART_OF_MOTION / highest_rate(s));
    /* Not one internal step more because 0.002 s came as 0.0020000000000000018 s. */
    const double count = fmax(1.0, ceil(step_size / longest * (1.0 - 1e-9)));

    (void)instance;
    (void)time;
    for (double i = 0.0; i < count; i += 1.0) runge_kutta(s, step_size / count);
    calculate(s);
    return fmi2OK;
}

static const Variable variables[] = {
    REAL_VARIABLE("linearVelocityCommand", ROLE_INPUT, linear_command, 0.0),
    REAL_VARIABLE("angularVelocityCommand", ROLE_INPUT, angular_command, 0.0),
    REAL_VARIABLE("currentLeft", ROLE_CALCULATED, current[LEFT], 0.0),
    REAL_VARIABLE("currentRight", ROLE_CALCULATED, current[RIGHT], 0.0),
    REAL_VARIABLE("x", ROLE_EXACT, motion.x, 0.0),
    REAL_VARIABLE("y", ROLE_EXACT, motion.y, 0.0),
    REAL_VARIABLE("heading", ROLE_EXACT, motion.heading, 0.0),
    REAL_VARIABLE("linearVelocity", ROLE_EXACT, motion.linear, 0.0),
    REAL_VARIABLE("angularVelocity", ROLE_EXACT, motion.angular, 0.0),
    REAL_VARIABLE("casterAngle[1]", ROLE_EXACT, motion.angle[0], 0.0),
    REAL_VARIABLE("casterAngle[2]", ROLE_EXACT, motion.angle[1], 0.0),
    REAL_VARIABLE("casterAngle[3]", ROLE_EXACT, motion.angle[2], 0.0),
    REAL_VARIABLE("casterAngle[4]", ROLE_EXACT, motion.angle[3], 0.0),
    REAL_VARIABLE("mass", ROLE_FIXED, mass, 200.0),
    REAL_VARIABLE("yawInertia", ROLE_FIXED, yaw_inertia, 20.0),
    REAL_VARIABLE("halfLength", ROLE_FIXED, half_length, 0.35),
    REAL_VARIABLE("halfWidth", ROLE_FIXED, half_width, 0.2),
    REAL_VARIABLE("trail", ROLE_FIXED, trail, 0.03),
    REAL_VARIABLE("casterLoad", ROLE_FIXED, caster_load, 0.6),
    REAL_VARIABLE("frictionCoefficient", ROLE_FIXED, friction_coefficient, 0.89),
    REAL_VARIABLE("contactRadius", ROLE_FIXED, contact_radius, 0.015),
    REAL_VARIABLE("gripVelocity", ROLE_FIXED, grip_velocity, 0.1),
    REAL_VARIABLE("rollingResistance", ROLE_FIXED, rolling_resistance, 0.015),
    REAL_VARIABLE("track", ROLE_FIXED, track, 0.45),
    REAL_VARIABLE("driveRadius", ROLE_FIXED, drive_radius, 0.08),
    REAL_VARIABLE("torqueConstant", ROLE_FIXED, torque_constant, 0.06),
    REAL_VARIABLE("gearRatio", ROLE_FIXED, gear_ratio, 20.0),
    REAL_VARIABLE("resistance", ROLE_FIXED, resistance, 0.5),
    REAL_VARIABLE("voltageLimit", ROLE_FIXED, voltage_limit, 24.0),
    REAL_VARIABLE("proportionalGain", ROLE_FIXED, proportional_gain, 20.0),
    REAL_VARIABLE("integralGain", ROLE_FIXED, integral_gain, 40.0),
};

const Model model = {
    .state_size = sizeof(ModelState),
    .variables = variables,
    .variable_count = sizeof variables / sizeof variables[0],
    .calculate = calculate,
    .initialise = initialise,
    .step = step,
};
