/* The limit: a chain or a cycle of FMUs without any tool, in one process, or with a process for each instance.
 *
 *   c_program PROCESSES memory|tcp LEAD POINTS STEP_SIZE INSTANCE...
 *   INSTANCE: LIBRARY GUID RESOURCES SOURCE INPUT OUTPUT INITIAL COUNT, and COUNT times REFERENCE VALUE
 *
 * SOURCE is the number of the instance that feeds this one, or -1. An instance takes its step from point k with the
 * value of its source at point k + LEAD. Prints the time from the first to the last point in s, and the last outputs.
 *
 * Each instance writes its outputs into a ring in shared memory, and counts them. Who waits for a counter spins, and
 * lets other processes run from time to time. It never sleeps. With `tcp`, each output goes to its target through a
 * socket, eight bytes at a time, and who waits for it spins as well; memory then has the first and the last outputs.
 */
#include "fmi2_library.h"

#include <stdatomic.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/wait.h>

#include "sockets.h"

enum { ROWS = 4096, SPINS = 60, MOST = 16 };

typedef struct { /* what the others see of an instance */
    _Alignas(64) _Atomic long point; /* its output is there up to this point */
    _Alignas(64) double rows[ROWS];
} Output;

typedef struct {
    _Atomic long ready;
    double begin[MOST], end[MOST]; /* of each process, in s */
    Output outputs[MOST];
} Shared;

typedef struct {
    fmi2Component component;
    fmi2SetRealTYPE *set;
    fmi2DoStepTYPE *step;
    fmi2GetRealTYPE *get;
    fmi2ValueReference input, output;
    Output *own, *source, *target;       /* target: whom it feeds */
    long source_point, target_point;     /* what is known of them, so that their counters are rarely read */
    int to_source, to_target;            /* sockets, where memory carries nothing */
} Instance;

static long wait_for(_Atomic long *counter, long goal) {
    for (int round = 0;; round++) {
        long value = atomic_load_explicit(counter, memory_order_acquire);
        if (value >= goal) return value;
        if (round < SPINS) {
#if defined(__x86_64__)
            __builtin_ia32_pause();
#endif
        } else {
            sched_yield();
        }
    }
}

/* ---- an FMU */

/* Read one instance from the arguments; returns how many arguments that were. */
static int instantiate(Instance *self, char **argv, double stop_time, Output *outputs, int is_mine) {
    static const fmi2CallbackFunctions callbacks = {no_message, calloc, free, NULL, NULL};
    int source = atoi(argv[3]), count = atoi(argv[7]);
    if (source >= 0) self->source = &outputs[source];
    if (!is_mine) return 8 + 2 * count;
    void *library = loaded(argv[0]);
    fmi2InstantiateTYPE *make = function(library, "fmi2Instantiate");
    fmi2SetupExperimentTYPE *setup = function(library, "fmi2SetupExperiment");
    fmi2EnterInitializationModeTYPE *enter = function(library, "fmi2EnterInitializationMode");
    fmi2ExitInitializationModeTYPE *leave = function(library, "fmi2ExitInitializationMode");
    self->set = function(library, "fmi2SetReal");
    self->step = function(library, "fmi2DoStep");
    self->get = function(library, "fmi2GetReal");
    self->input = (fmi2ValueReference)atol(argv[4]);
    self->output = (fmi2ValueReference)atol(argv[5]);
    self->component = make("instance", fmi2CoSimulation, argv[1], argv[2], &callbacks, fmi2False, fmi2False);
    if (self->component == NULL) fail("fmi2Instantiate");
    check(setup(self->component, fmi2False, 0.0, 0.0, fmi2True, stop_time), "fmi2SetupExperiment");
    for (int i = 0; i < count; i++) {
        fmi2ValueReference reference = (fmi2ValueReference)atol(argv[8 + 2 * i]);
        double value = strtod(argv[9 + 2 * i], NULL);
        check(self->set(self->component, &reference, 1, &value), "fmi2SetReal");
    }
    check(enter(self->component), "fmi2EnterInitializationMode");
    if (source >= 0) {
        double initial = strtod(argv[6], NULL);
        check(self->set(self->component, &self->input, 1, &initial), "fmi2SetReal");
    }
    check(leave(self->component), "fmi2ExitInitializationMode");
    check(self->get(self->component, &self->output, 1, &self->own->rows[0]), "fmi2GetReal");
    return 8 + 2 * count;
}

/* ---- stepping */

static void set_input(Instance *self, long row) {
    double value;
    if (self->to_source != 0 && row > 0) { /* the initial row is in memory */
        if (!receive_spinning(self->to_source, &value, sizeof value)) fail("recv");
    } else {
        if (self->source_point < row) self->source_point = wait_for(&self->source->point, row);
        value = self->source->rows[row % ROWS];
    }
    check(self->set(self->component, &self->input, 1, &value), "fmi2SetReal");
}

static void step(Instance *self, long point, long lead, double step_size) {
    if (self->source != NULL) set_input(self, point + lead);
    check(self->step(self->component, (double)point * step_size, step_size, fmi2True), "fmi2DoStep");
    /* The target may still need the row of its own point. */
    if (self->target != NULL && self->to_target == 0 && self->target_point < point + 2 - ROWS)
        self->target_point = wait_for(&self->target->point, point + 2 - ROWS);
    double *value = &self->own->rows[(point + 1) % ROWS];
    check(self->get(self->component, &self->output, 1, value), "fmi2GetReal");
    if (self->to_target != 0 && send(self->to_target, value, sizeof *value, MSG_NOSIGNAL) != sizeof *value)
        fail("send");
    atomic_store_explicit(&self->own->point, point + 1, memory_order_release);
}

int main(int argc, char **argv) {
    Instance instances[MOST] = {0};
    if (argc < 6) return 2;
    const long processes = atol(argv[1]), lead = atol(argv[3]), points = atol(argv[4]);
    const int by_tcp = strcmp(argv[2], "tcp") == 0;
    const double step_size = strtod(argv[5], NULL);
    if (processes < 1 || processes > MOST) fail("too many processes");
    int links[MOST][2]; /* from each instance to the next one, and from the last to the first */
    for (long i = 0; by_tcp && i < processes; i++) {
        /* Two in a cycle have one connection, as two hosts would. */
        if (i == 1 && processes == 2) links[1][0] = links[0][1], links[1][1] = links[0][0];
        else if (!tcp_pair(links[i])) fail("sockets");
    }
    Shared *shared = mmap(NULL, sizeof *shared, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (shared == MAP_FAILED) fail("mmap");

    pid_t children[MOST], first_process = getpid();
    long process = 0;
    for (long i = 1; i < processes && process == 0; i++) {
        children[i] = fork();
        if (children[i] < 0) fail("fork");
        if (children[i] == 0) {
            prctl(PR_SET_PDEATHSIG, SIGKILL);
            if (getppid() != first_process) _exit(1); /* it has ended before the line above */
            parent = first_process;
            process = i;
        }
    }

    int n = 0;
    for (int next = 6; next < argc; n++) {
        if (n == MOST || next + 8 > argc) fail("arguments");
        instances[n].own = &shared->outputs[n];
        next += instantiate(&instances[n], argv + next, (double)points * step_size, shared->outputs,
                            processes == 1 || n == process);
    }
    if (processes != 1 && processes != n) fail("one process, or one for each instance");
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            if (instances[j].source == instances[i].own) {
                instances[i].target = instances[j].own;
                if (by_tcp) instances[i].to_target = links[i][0], instances[j].to_source = links[i][1];
            }

    const int first = processes == 1 ? 0 : (int)process, end = processes == 1 ? n : first + 1;
    atomic_fetch_add(&shared->ready, 1);
    wait_for(&shared->ready, processes);
    shared->begin[process] = clock_s();
    for (long point = 0; point < points; point++)
        for (int i = first; i < end; i++) step(&instances[i], point, lead, step_size);
    shared->end[process] = clock_s();
    if (process != 0) _exit(0);

    double began = shared->begin[0], ended = shared->end[0];
    for (long i = 1; i < processes; i++) {
        int status;
        if (waitpid(children[i], &status, 0) < 0 || status != 0) fail("a process has failed");
        if (shared->begin[i] < began) began = shared->begin[i];
        if (shared->end[i] > ended) ended = shared->end[i];
    }
    printf("%.9f\n", ended - began);
    for (int i = 0; i < n; i++) printf("%a\n", shared->outputs[i].rows[points % ROWS]);
    return 0;
}
