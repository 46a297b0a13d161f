/* SPDX-License-Identifier: Apache-2.0
 *
 * A room with a heater, which switches itself on below a temperature and off above another one: T' = F - T, and the
 * heat F follows the power with a time constant: F' = (power + u - F) / tau. The time constant is 0.5 s, and from a time
 * event on another one, which may make the model stiff. It refuses to be evaluated from another time on.
 */
#include "model.h"

enum { T, F, DER_T, DER_F, TAU, LATE, LOW, HIGH, REFUSED, LAST, Z, U };
enum { ON, SWITCHES, COMPLETED };

void model_start(Model *m)
{
    m->r[T] = 0.5;
    m->r[TAU] = 1e-5;
    m->r[LOW] = 0.4;
    m->r[HIGH] = 0.6;
    m->r[REFUSED] = 1e300;
    m->i[ON] = 1;
}

void model_initialize(Model *m)
{
    m->next_event_defined = m->r[LATE] > m->time;
    m->next_event = m->r[LATE];
}

void model_equations(Model *m)
{
    const double tau = m->next_event_defined ? 0.5 : m->r[TAU];

    m->r[DER_T] = m->r[F] - m->r[T];
    m->r[DER_F] = (m->i[ON] + m->r[U] - m->r[F]) / tau;
    m->r[Z] = m->i[ON] ? m->r[HIGH] - m->r[T] : m->r[T] - m->r[LOW];
}

void model_indicators(const Model *m, double *z) { z[0] = m->i[ON] ? m->r[HIGH] - m->r[T] : m->r[T] - m->r[LOW]; }

Update model_event(Model *m)
{
    double z;

    if (m->next_event_defined && m->time >= m->next_event) m->next_event_defined = false;
    model_indicators(m, &z);
    if (z > 0.0) return (Update){false, false, false};
    m->i[ON] = !m->i[ON];
    m->i[SWITCHES]++;
    m->r[LAST] = m->time;
    return (Update){true, false, false};
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

bool model_refuses(const Model *m) { return m->time > m->r[REFUSED]; }
