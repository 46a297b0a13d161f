/* SPDX-License-Identifier: Apache-2.0
 *
 * An integrator that a benchmark can watch from outside, whatever tool runs it. In a file in shared memory it counts the
 * instances that have done their first step, and in one step it waits until the benchmark has looked at all processes.
 * `benchmarks/first_step.py` has the same structure, and builds this file with the path of the shared file.
 */
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdint.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

#include "model.h"
#include "shared_file.h"

struct ModelState {
    double u, y, k;
    int64_t steps;
};

typedef struct {
    int64_t hold_at;       /* the step in which an instance waits; 0: none */
    int64_t released;      /* not 0: nobody waits any more */
    int64_t started;       /* instances that have done their first step */
    int64_t last_first_ns; /* when the last of them had done it */
    int64_t held_since_ns; /* when the first instance began to wait */
} Shared;

enum { MILLISECOND_NS = 1000000, MOST_MILLISECONDS = 30000 };

static Shared *shared(void)
{
    static Shared *mapped;
    int file;

    if (mapped == NULL && (file = open(SHARED_FILE, O_RDWR | O_CLOEXEC)) >= 0) {
        void *memory = mmap(NULL, sizeof *mapped, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);

        if (memory != MAP_FAILED) mapped = memory;
        close(file);
    }
    return mapped;
}

static int64_t now(void)
{
    struct timespec time;

    clock_gettime(CLOCK_MONOTONIC, &time);
    return (int64_t)time.tv_sec * 1000000000 + time.tv_nsec;
}

static void tell_first_step(Shared *s)
{
    int64_t time = now(), seen = __atomic_load_n(&s->last_first_ns, __ATOMIC_SEQ_CST);

    while (time > seen &&
           !__atomic_compare_exchange_n(&s->last_first_ns, &seen, time, 0, __ATOMIC_SEQ_CST, __ATOMIC_SEQ_CST))
        continue;
    __atomic_fetch_add(&s->started, 1, __ATOMIC_SEQ_CST);
}

static void hold(Shared *s)
{
    const struct timespec pause = {0, MILLISECOND_NS};
    int64_t nobody = 0;

    __atomic_compare_exchange_n(&s->held_since_ns, &nobody, now(), 0, __ATOMIC_SEQ_CST, __ATOMIC_SEQ_CST);
    for (int i = 0; i < MOST_MILLISECONDS && !__atomic_load_n(&s->released, __ATOMIC_SEQ_CST); i++)
        nanosleep(&pause, NULL);
}

static fmi2Status step(Instance *instance, ModelState *m, double time, double step_size)
{
    Shared *s = shared();

    (void)instance;
    (void)time;
    m->y += step_size * (m->k * m->u);
    m->steps += 1;
    if (s != NULL && m->steps == 1) tell_first_step(s);
    if (s != NULL && m->steps == s->hold_at) hold(s);
    return fmi2OK;
}

static const Variable variables[] = {
    REAL_VARIABLE("u", ROLE_INPUT, u, 0.0),
    REAL_VARIABLE("y", ROLE_EXACT, y, 0.0),
    REAL_VARIABLE("k", ROLE_TUNABLE, k, 1.0),
};

const Model model = {
    .state_size = sizeof(ModelState),
    .variables = variables,
    .variable_count = sizeof variables / sizeof variables[0],
    .step = step,
};
