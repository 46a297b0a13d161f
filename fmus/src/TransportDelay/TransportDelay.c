/* SPDX-License-Identifier: Apache-2.0
 *
 * A transport delay: y(t) = x(t - d), and y(t) = x(start) before start + d. See
 * docs/models/TransportDelay.md.
 */
#include <math.h>

#include "model.h"

#define FIRST_CAPACITY 16

struct ModelState {
    double x, y;
    double d;            /* s */
    size_t first, count; /* the samples in use, in the ring that is the instance memory */
};

typedef struct {
    double time; /* s */
    double value;
} Sample;

static size_t capacity(const Instance *instance) { return instance_memory_size(instance) / sizeof(Sample); }

static Sample *sample(const Instance *instance, const ModelState *s, size_t i)
{
    return (Sample *)instance_memory(instance) + (s->first + i) % capacity(instance);
}

static bool grow(Instance *instance, const ModelState *s)
{
    const size_t old = capacity(instance);
    Sample *ring;

    if (!resize_instance_memory(instance, (old == 0 ? FIRST_CAPACITY : 2 * old) * sizeof(Sample)))
        return false;
    /* What had wrapped around to the front now follows the old end. */
    ring = instance_memory(instance);
    for (size_t i = 0; i < s->first; ++i) ring[old + i] = ring[i];
    return true;
}

static fmi2Status append(Instance *instance, ModelState *s, double time, double value)
{
    /* A step shorter than the tolerance of communication points may end before the last one ended. */
    if (s->count > 0 && time <= sample(instance, s, s->count - 1)->time) {
        sample(instance, s, s->count - 1)->value = value;
        return fmi2OK;
    }
    if (s->count == capacity(instance) && !grow(instance, s))
        return report(instance, fmi2Error, "no memory for more than %zu samples of x", s->count);
    s->count += 1;
    *sample(instance, s, s->count - 1) = (Sample){time, value};
    return fmi2OK;
}

/* The value of x at `time`; forgets what is older, so call it with rising times. */
static double value_at(const Instance *instance, ModelState *s, double time)
{
    const Sample *left, *right;

    while (s->count > 1 && sample(instance, s, 1)->time <= time) {
        s->first = (s->first + 1) % capacity(instance);
        s->count -= 1;
    }
    left = sample(instance, s, 0);
    if (s->count == 1 || time <= left->time) return left->value;
    right = sample(instance, s, 1);
    return left->value + (right->value - left->value) * ((time - left->time) / (right->time - left->time));
}

static void calculate(ModelState *s) { s->y = s->x; }

static fmi2Status initialise(Instance *instance, ModelState *s, double start_time)
{
    if (!(s->d >= 0.0 && isfinite(s->d)))
        return report(instance, fmi2Error, "d is %.17g s but has to be finite and not negative", s->d);
    return append(instance, s, start_time, s->x);
}

/* x counts as the value at the end of the step; see the page of this model for why. */
static fmi2Status step(Instance *instance, ModelState *s, double time, double step_size)
{
    const double end = time + step_size;

    if (append(instance, s, end, s->x) != fmi2OK) return fmi2Error;
    s->y = value_at(instance, s, end - s->d);
    return fmi2OK;
}

static const Variable variables[] = {
    REAL_VARIABLE("x", ROLE_INPUT, x, 0.0),
    REAL_VARIABLE("y", ROLE_CALCULATED, y, 0.0),
    REAL_VARIABLE("d", ROLE_FIXED, d, 1.0),
};

const Model model = {
    .state_size = sizeof(ModelState),
    .variables = variables,
    .variable_count = sizeof variables / sizeof variables[0],
    .calculate = calculate,
    .initialise = initialise,
    .step = step,
};
