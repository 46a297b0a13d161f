/* SPDX-License-Identifier: Apache-2.0
 *
 * The mechanical part of a DC motor: J w' = M_A + M_B - d w.
 */
#include "model.h"

enum { W, DER_W, J, D, M_A, M_B };

void model_start(Model *m) { m->r[J] = 0.001; }

void model_initialize(Model *m) { (void)m; }

void model_equations(Model *m)
{
    m->r[DER_W] = (m->r[M_A] + m->r[M_B] - m->r[D] * m->r[W]) / m->r[J];
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
