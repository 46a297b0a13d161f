/* The limit of an environment that a program steps: one FMU with one input and one output, and nothing else.
 *
 *   c_environment WHAT LIBRARY GUID INPUT OUTPUT TIMES STEP_SIZE [COPIES OUTPUT OUTPUT OUTPUT]
 *
 * WHAT is `steps`, `batch`, `state` or `values`; INPUT and OUTPUT are value references. With `steps`, each time sets the input,
 * takes a step and reads the output, whose sign is the next input; `batch` does it for many instances in turn, with four
 * outputs. Otherwise each time goes back to the first point and
 * reads the output: by a state, or by fmi2Reset and an initialization in which OUTPUT has another start value. Prints
 * the time of all in s, and the last output. */
#include "fmi2_library.h"

#include <string.h>

typedef struct {
    fmi2Component component;
    fmi2SetRealTYPE *set;
    fmi2GetRealTYPE *get;
    fmi2DoStepTYPE *step;
    fmi2ResetTYPE *reset;
    fmi2SetupExperimentTYPE *setup;
    fmi2EnterInitializationModeTYPE *enter;
    fmi2ExitInitializationModeTYPE *leave;
    fmi2SetFMUstateTYPE *set_state;
    fmi2ValueReference input, output;
} Instance;

static void initialize(Instance *self, const double *start) {
    check(self->setup(self->component, fmi2False, 0.0, 0.0, fmi2False, 0.0), "fmi2SetupExperiment");
    if (start != NULL) check(self->set(self->component, &self->output, 1, start), "fmi2SetReal");
    check(self->enter(self->component), "fmi2EnterInitializationMode");
    check(self->leave(self->component), "fmi2ExitInitializationMode");
}

static double output(Instance *self) {
    double value;
    check(self->get(self->component, &self->output, 1, &value), "fmi2GetReal");
    return value;
}

static double steps(Instance *self, long times, double step_size) {
    double found = 0.0;
    for (long k = 0; k < times; k++) {
        const double value = found > 0.0 ? -1.0 : 1.0;
        check(self->set(self->component, &self->input, 1, &value), "fmi2SetReal");
        check(self->step(self->component, (double)k * step_size, step_size, fmi2True), "fmi2DoStep");
        found = output(self);
    }
    return found;
}

static double batch(const Instance *first, fmi2Component *copies, long count, long times, double step_size,
                    const fmi2ValueReference *outputs) {
    double(*found)[4] = calloc((size_t)count, sizeof *found), *inputs = calloc((size_t)count, sizeof *inputs);
    if (found == NULL || inputs == NULL) fail("memory");
    for (long k = 0; k < times; k++) {
        for (long i = 0; i < count; i++) inputs[i] = found[i][0] > 0.0 ? -1.0 : 1.0;
        for (long i = 0; i < count; i++) {
            check(first->set(copies[i], &first->input, 1, &inputs[i]), "fmi2SetReal");
            check(first->step(copies[i], (double)k * step_size, step_size, fmi2True), "fmi2DoStep");
            check(first->get(copies[i], outputs, 4, found[i]), "fmi2GetReal");
        }
    }
    return found[count - 1][0];
}

static double states(const Instance *first, fmi2Component *copies, fmi2FMUstate *kept, long count, long times) {
    double found = 0.0;
    for (long k = 0; k < times; k++) {
        check(first->set_state(copies[k % count], kept[k % count]), "fmi2SetFMUstate");
        check(first->get(copies[k % count], &first->output, 1, &found), "fmi2GetReal");
    }
    return found;
}

static double values(Instance *self, long times) {
    double found = 0.0;
    for (long k = 0; k < times; k++) {
        const double start = 0.001 * (double)k;
        check(self->reset(self->component), "fmi2Reset");
        initialize(self, &start);
        found = output(self);
    }
    return found;
}

int main(int argc, char **argv) {
    static const fmi2CallbackFunctions callbacks = {no_message, calloc, free, NULL, NULL};
    struct timespec from, to;
    Instance one;
    if (argc != 8 && argc != 12) fail("arguments");
    void *library = loaded(argv[2]);
    fmi2InstantiateTYPE *instantiate = function(library, "fmi2Instantiate");
    one.component = instantiate("cart", fmi2CoSimulation, argv[3], "", &callbacks, fmi2False, fmi2False);
    if (one.component == NULL) fail("fmi2Instantiate");
    one.set = function(library, "fmi2SetReal"), one.get = function(library, "fmi2GetReal");
    one.step = function(library, "fmi2DoStep"), one.reset = function(library, "fmi2Reset");
    one.setup = function(library, "fmi2SetupExperiment");
    one.enter = function(library, "fmi2EnterInitializationMode");
    one.leave = function(library, "fmi2ExitInitializationMode");
    one.set_state = function(library, "fmi2SetFMUstate");
    one.input = (fmi2ValueReference)atol(argv[4]), one.output = (fmi2ValueReference)atol(argv[5]);
    const long times = atol(argv[6]);
    const double step_size = strtod(argv[7], NULL);
    initialize(&one, NULL);
    const long count = argc == 12 ? atol(argv[8]) : 1;
    fmi2ValueReference outputs[4] = {one.output};
    for (int i = 9; i < argc; i++) outputs[i - 8] = (fmi2ValueReference)atol(argv[i]);
    fmi2Component *copies = calloc((size_t)count, sizeof *copies);
    fmi2FMUstate *kept = calloc((size_t)count, sizeof *kept);
    if (copies == NULL || kept == NULL) fail("memory");
    copies[0] = one.component;
    for (long i = 1; i < count; i++) {
        Instance other = one;
        copies[i] = other.component =
            instantiate("cart", fmi2CoSimulation, argv[3], "", &callbacks, fmi2False, fmi2False);
        if (other.component == NULL) fail("fmi2Instantiate");
        initialize(&other, NULL);
    }
    fmi2GetFMUstateTYPE *get_state = function(library, "fmi2GetFMUstate");
    for (long i = 0; i < count; i++) check(get_state(copies[i], &kept[i]), "fmi2GetFMUstate");
    clock_gettime(CLOCK_MONOTONIC, &from);
    double last;
    if (strcmp(argv[1], "batch") == 0) last = batch(&one, copies, count, times / count, step_size, outputs);
    else if (strcmp(argv[1], "steps") == 0) last = steps(&one, times, step_size);
    else last = strcmp(argv[1], "state") == 0 ? states(&one, copies, kept, count, times) : values(&one, times);
    clock_gettime(CLOCK_MONOTONIC, &to);
    printf("%.9f %a\n", (double)(to.tv_sec - from.tv_sec) + 1e-9 * (double)(to.tv_nsec - from.tv_nsec), last);
    return 0;
}
