/* SPDX-License-Identifier: Apache-2.0
 *
 * A counter that goes up at each time event, by an input; it asks to end the simulation at a last count. Its
 * co-simulation discards steps that are too long, and its event iteration can be told never to converge.
 */
#include "model.h"

enum { PERIOD, LONGEST, LAST, TICK };
enum { COUNTER, INCREMENT, END, FOREVER, EVENTS };

void model_start(Model *m)
{
    m->r[PERIOD] = 1.0;
    m->r[LONGEST] = 1e300;
    m->i[INCREMENT] = 1;
    m->i[END] = 1000000;
}

void model_initialize(Model *m)
{
    m->next_event_defined = true;
    m->next_event = m->time + m->r[PERIOD];
}

void model_equations(Model *m) { (void)m; }

void model_indicators(const Model *m, double *z)
{
    (void)m;
    (void)z;
}

Update model_event(Model *m)
{
    m->i[EVENTS]++;
    if (m->clock) {
        m->clock = false;
        m->i[COUNTER] += 100;
        m->r[TICK] = m->time;
    }
    if (m->time >= m->next_event) {
        m->i[COUNTER] += m->i[INCREMENT];
        m->r[LAST] = m->time;
        m->next_event += m->r[PERIOD];
        m->terminate = m->i[COUNTER] >= m->i[END];
        return (Update){true, false, false};
    }
    return (Update){m->i[FOREVER] != 0, false, false};
}

bool model_completed_step(Model *m)
{
    (void)m;
    return false;
}

bool model_discards(const Model *m, double step_size) { return step_size > m->r[LONGEST]; }

bool model_refuses(const Model *m)
{
    (void)m;
    return false;
}
