/* SPDX-License-Identifier: Apache-2.0
 *
 * A part of a coupled linear system. Of order 1: x' = a x + b u + e w, y = c x + d u + f w. With `masses` 1, a mass that
 * is pushed: x' = v, v' = -a x - b v + u. With `masses` 2, one that is coupled by a spring and a damper of its own to a
 * mass at u with the velocity w: v' = -a x - b v - y, y = e (x - u) + c (v - w). With `stays`, it goes back to no state
 * after 0.055 s.
 */
#include "model.h"

enum { X, V, DER_X, DER_V, Y, A, B, E, C, D, F, U, W };
enum { MASSES, STAYS };

void model_start(Model *m) { (void)m; }

void model_initialize(Model *m) { (void)m; }

void model_equations(Model *m)
{
    double *const r = m->r;

    if (m->i[MASSES] == 0) {
        r[Y] = r[C] * r[X] + r[D] * r[U] + r[F] * r[W];
        r[DER_X] = r[A] * r[X] + r[B] * r[U] + r[E] * r[W];
        r[DER_V] = 0.0;
        return;
    }
    r[Y] = m->i[MASSES] == 2 ? r[E] * (r[X] - r[U]) + r[C] * (r[V] - r[W]) : 0.0;
    r[DER_X] = r[V];
    r[DER_V] = -r[A] * r[X] - r[B] * r[V] + (m->i[MASSES] == 2 ? -r[Y] : r[U]);
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

bool model_refuses_state(const Model *m) { return m->i[STAYS] != 0 && m->time > 0.055; }

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
