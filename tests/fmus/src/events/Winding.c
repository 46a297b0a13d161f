/* SPDX-License-Identifier: Apache-2.0
 *
 * The electrical part of a DC motor: L I' = U - R I - k w, and the torque M = k I.
 */
#include "model.h"

enum { I, DER_I, M, R, L, K, U, W };

void model_start(Model *m)
{
    m->r[R] = 1.0;
    m->r[L] = 0.001;
    m->r[K] = 0.1;
}

void model_initialize(Model *m) { (void)m; }

void model_equations(Model *m)
{
    m->r[DER_I] = (m->r[U] - m->r[R] * m->r[I] - m->r[K] * m->r[W]) / m->r[L];
    m->r[M] = m->r[K] * m->r[I];
}

void model_indicators(const Model *m, double *z)
{
    (void)m;
    (void)z;
}

Update model_event(Model *m)
{
    (void)m;
    return (Update){false, false, false};
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
