/* The limit of a sweep: a pendulum that feeds a delay, run for many values of a start value, in several processes.
 *
 *   c_sweep PROCESSES VARIANTS FIRST STEP POINTS STEP_SIZE INSTANCE INSTANCE
 *   INSTANCE: LIBRARY GUID RESOURCES INPUT OUTPUT COUNT, and COUNT times REFERENCE VALUE
 *
 * The variant number k sets the INPUT of the first instance to FIRST + k * STEP before Initialization Mode; the INPUT of
 * the second one is fed by the OUTPUT of the first one. Each process loads the libraries once, and each variant has new
 * instances, whose rows it keeps; at the end it takes the largest first output. Prints the time from the start of the
 * processes to their end in s, and one value for each variant.
 */
#include "fmi2_library.h"

#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/wait.h>

typedef struct {
    fmi2InstantiateTYPE *make;
    fmi2SetupExperimentTYPE *setup;
    fmi2EnterInitializationModeTYPE *enter;
    fmi2ExitInitializationModeTYPE *leave;
    fmi2SetRealTYPE *set;
    fmi2DoStepTYPE *step;
    fmi2GetRealTYPE *get;
    fmi2TerminateTYPE *terminate;
    fmi2FreeInstanceTYPE *free;
    const char *guid, *resources;
    fmi2ValueReference input, output;
    int count;
    fmi2ValueReference *references; /* of the start values */
    double *values;
    fmi2Component component;
} Instance;

/* Load the library of an instance; returns how many arguments describe the instance. */
static int load(Instance *self, char **argv) {
    void *library = loaded(argv[0]);
    self->make = function(library, "fmi2Instantiate");
    self->setup = function(library, "fmi2SetupExperiment");
    self->enter = function(library, "fmi2EnterInitializationMode");
    self->leave = function(library, "fmi2ExitInitializationMode");
    self->set = function(library, "fmi2SetReal");
    self->step = function(library, "fmi2DoStep");
    self->get = function(library, "fmi2GetReal");
    self->terminate = function(library, "fmi2Terminate");
    self->free = function(library, "fmi2FreeInstance");
    self->guid = argv[1], self->resources = argv[2];
    self->input = (fmi2ValueReference)atol(argv[3]), self->output = (fmi2ValueReference)atol(argv[4]);
    self->count = atoi(argv[5]);
    self->references = calloc((size_t)self->count, sizeof *self->references);
    self->values = calloc((size_t)self->count, sizeof *self->values);
    if (self->count && (self->references == NULL || self->values == NULL)) fail("memory");
    for (int i = 0; i < self->count; i++) {
        self->references[i] = (fmi2ValueReference)atol(argv[6 + 2 * i]);
        self->values[i] = strtod(argv[7 + 2 * i], NULL);
    }
    return 6 + 2 * self->count;
}

static void begin(Instance *self, double stop_time) {
    static const fmi2CallbackFunctions callbacks = {no_message, calloc, free, NULL, NULL};
    self->component = self->make("instance", fmi2CoSimulation, self->guid, self->resources, &callbacks, 0, 0);
    if (self->component == NULL) fail("fmi2Instantiate");
    check(self->setup(self->component, fmi2False, 0.0, 0.0, fmi2True, stop_time), "fmi2SetupExperiment");
    check(self->set(self->component, self->references, (size_t)self->count, self->values), "fmi2SetReal");
}

static void end(Instance *self) {
    check(self->terminate(self->component), "fmi2Terminate");
    self->free(self->component);
}

/* One variant; returns the largest output of the first instance. */
static double run(Instance *first, Instance *second, double parameter, long points, double step_size, double *rows) {
    begin(first, (double)points * step_size);
    begin(second, (double)points * step_size);
    check(first->set(first->component, &first->input, 1, &parameter), "fmi2SetReal");
    check(first->enter(first->component), "fmi2EnterInitializationMode");
    check(second->enter(second->component), "fmi2EnterInitializationMode");
    check(first->get(first->component, &first->output, 1, rows), "fmi2GetReal");
    check(second->set(second->component, &second->input, 1, rows), "fmi2SetReal");
    check(first->leave(first->component), "fmi2ExitInitializationMode");
    check(second->leave(second->component), "fmi2ExitInitializationMode");
    check(first->get(first->component, &first->output, 1, rows), "fmi2GetReal");
    check(second->get(second->component, &second->output, 1, rows + 1), "fmi2GetReal");
    for (long point = 0; point < points; point++) {
        double time = (double)point * step_size, *row = rows + 2 * (point + 1);
        check(first->step(first->component, time, step_size, fmi2True), "fmi2DoStep");
        check(first->get(first->component, &first->output, 1, row), "fmi2GetReal");
        check(second->set(second->component, &second->input, 1, row), "fmi2SetReal");
        check(second->step(second->component, time, step_size, fmi2True), "fmi2DoStep");
        check(second->get(second->component, &second->output, 1, row + 1), "fmi2GetReal");
    }
    end(first);
    end(second);
    double largest = rows[0];
    for (long point = 1; point <= points; point++)
        if (rows[2 * point] > largest) largest = rows[2 * point];
    return largest;
}

int main(int argc, char **argv) {
    if (argc < 7 + 12) return 2;
    const long processes = atol(argv[1]), variants = atol(argv[2]), points = atol(argv[5]);
    const double first_value = strtod(argv[3], NULL), step = strtod(argv[4], NULL), step_size = strtod(argv[6], NULL);
    double *found = mmap(NULL, (size_t)variants * sizeof *found, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (found == MAP_FAILED) fail("mmap");
    const double began = clock_s();
    for (long process = 0; process < processes; process++) {
        pid_t child = fork();
        if (child < 0) fail("fork");
        if (child > 0) continue;
        prctl(PR_SET_PDEATHSIG, SIGKILL);
        Instance first, second;
        int used = load(&first, argv + 7);
        load(&second, argv + 7 + used);
        double *rows = malloc(2 * (size_t)(points + 1) * sizeof *rows);
        if (rows == NULL) fail("memory");
        for (long k = process; k < variants; k += processes)
            found[k] = run(&first, &second, first_value + (double)k * step, points, step_size, rows);
        _exit(0);
    }
    for (long process = 0; process < processes; process++) {
        int status;
        if (wait(&status) < 0 || status != 0) fail("a process has failed");
    }
    printf("%.9f\n", clock_s() - began);
    for (long k = 0; k < variants; k++) printf("%a\n", found[k]);
    return 0;
}
