/* SPDX-License-Identifier: Apache-2.0
 *
 * A Van der Pol oscillator with a force: x' = y, y' = mu (1 - x^2) y - x + u. It counts its steps in a step event each
 * hundred of them, and refuses to be evaluated where |y| > limit.
 */
#include <math.h>

#include "model.h"

enum { X, Y, DER_X, DER_Y, MU, U, LIMIT };
enum { COMPLETED, EVENTS };

void model_start(Model *m)
{
    m->r[X] = 2.0;
    m->r[MU] = 1.0;
    m->r[LIMIT] = 1e300;
}

void model_initialize(Model *m) { (void)m; }

void model_equations(Model *m)
{
    m->r[DER_X] = m->r[Y];
    m->r[DER_Y] = m->r[MU] * (1.0 - m->r[X] * m->r[X]) * m->r[Y] - m->r[X] + m->r[U];
}

void model_indicators(const Model *m, double *z)
{
    (void)m;
    (void)z;
}

Update model_event(Model *m)
{
    m->i[EVENTS]++;
    return (Update){false, false, false};
}

bool model_completed_step(Model *m) { return ++m->i[COMPLETED] % 100 == 0; }

bool model_discards(const Model *m, double step_size)
{
    (void)m;
    (void)step_size;
    return false;
}

bool model_refuses(const Model *m) { return fabs(m->r[Y]) > m->r[LIMIT]; }
