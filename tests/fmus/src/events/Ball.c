/* SPDX-License-Identifier: Apache-2.0
 *
 * A bouncing ball: h' = v, v' = -g + u; where h becomes 0 the velocity is turned and multiplied by e, and below 0.05 m/s
 * the ball stays on the ground.
 */
#include <float.h>

#include "model.h"

enum { H, V, DER_H, DER_V, G, E, LAST, Z, U };
enum { BOUNCES, EVENTS, COMPLETED, RESTING };

void model_start(Model *m)
{
    m->r[H] = 1.0;
    m->r[G] = 9.81;
    m->r[E] = 0.7;
}

void model_initialize(Model *m) { (void)m; }

void model_equations(Model *m)
{
    m->r[DER_H] = m->r[V];
    m->r[DER_V] = m->i[RESTING] ? 0.0 : -m->r[G] + m->r[U];
    m->r[Z] = m->r[H];
}

void model_indicators(const Model *m, double *z) { z[0] = m->r[H]; }

Update model_event(Model *m)
{
    m->i[EVENTS]++;
    if (m->r[H] > 0.0 || m->r[V] >= 0.0) return (Update){false, false, false};
    m->r[H] = DBL_MIN;
    m->r[V] = -m->r[E] * m->r[V];
    m->i[RESTING] = m->r[V] < 0.05;
    if (m->i[RESTING]) m->r[V] = 0.0;
    m->r[LAST] = m->time;
    m->i[BOUNCES]++;
    return (Update){true, true, false};
}

bool model_completed_step(Model *m)
{
    m->i[COMPLETED]++;
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
