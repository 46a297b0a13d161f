/* SPDX-License-Identifier: Apache-2.0
 *
 * The integral of an input, and whether the input is above a level: s' = u, above = u > level.
 */
#include "model.h"

enum { S, DER_S, U, LEVEL, Z, LAST };
enum { ABOVE, EVENTS };

void model_start(Model *m) { m->r[LEVEL] = 0.5; }

void model_initialize(Model *m) { m->i[ABOVE] = m->r[U] > m->r[LEVEL]; }

void model_equations(Model *m)
{
    m->r[DER_S] = m->r[U];
    m->r[Z] = m->r[U] - m->r[LEVEL];
}

void model_indicators(const Model *m, double *z) { z[0] = m->r[U] - m->r[LEVEL]; }

Update model_event(Model *m)
{
    const int32_t above = m->r[U] > m->r[LEVEL];

    m->i[EVENTS]++;
    if (above == m->i[ABOVE]) return (Update){false, false, false};
    m->i[ABOVE] = above;
    m->r[LAST] = m->time;
    return (Update){true, false, false};
}

bool model_completed_step(Model *m)
{
    (void)m;
    return false;
}

bool model_discards(const Model *m, double step_size)
{
    (void)m;
    (void)step_size;
    return false;
}

bool model_refuses(const Model *m)
{
    (void)m;
    return false;
}
