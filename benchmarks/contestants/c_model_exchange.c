/* The limit of model exchange: two oscillators in a chain in one process, with the solver of the project (`SOLVER` is its
 * C file) and nothing else.
 *
 *   c_model_exchange LIBRARY GUID U X POINTS STEP_SIZE TOLERANCE
 *
 * U and X are value references of the input and of an output. The second instance takes its step to point k + 1 with the
 * value that the first one has there. Prints the time of all steps in s, and both outputs at the end. */
#include "fmi2_library.h"

#include SOLVER

enum { N = 2, EACH = 12 };

typedef struct {
    Equations equations;
    Call set;
    fmi2GetRealTYPE *get;
    double memory[EACH * N], input, held, output;
    char none[8];
    fmi2ValueReference u, x;
} Instance;

/* Point the equations to their memory and to the functions of the FMU. */
static void connect(Equations *own, void *library, Instance *self) {
    static const char *const names[] = {
        "fmi2SetTime", "fmi2SetContinuousStates", "fmi2GetContinuousStates", "fmi2GetNominalsOfContinuousStates",
        "fmi2GetDerivatives", "fmi2GetEventIndicators", "fmi2CompletedIntegratorStep", "fmi2EnterEventMode",
        "fmi2NewDiscreteStates", "fmi2EnterContinuousTimeMode"};
    void **functions = &own->set_time; /* in the same order */
    double **arrays[] = {&own->states, &own->weights, &own->ends, &own->stage, &own->sixth, &own->slopes};
    for (int i = 0; i < 10; i++) functions[i] = function(library, names[i]);
    for (int i = 0; i < 6; i++) *arrays[i] = self->memory + i * N;
    own->indicators = own->first_indicators = own->last_indicators = own->next_indicators = (double *)self->none;
    own->row = (const char *)&self->input, own->held = (char *)&self->held;
    own->setters = &self->set;
}

static void make(Instance *self, char **argv, int is_fed) {
    static const fmi2CallbackFunctions callbacks = {no_message, calloc, free, NULL, NULL};
    void *library = loaded(argv[0]);
    const double tolerance = atof(argv[6]); /* without the name of the program */
    Equations *own = &self->equations;
    connect(own, library, self);
    own->component = ((fmi2InstantiateTYPE *)function(library, "fmi2Instantiate"))(
        "instance", fmi2ModelExchange, argv[1], NULL, &callbacks, fmi2False, fmi2False);
    if (own->component == NULL) fail("fmi2Instantiate");
    self->u = (fmi2ValueReference)atol(argv[2]), self->x = (fmi2ValueReference)atol(argv[3]);
    self->get = function(library, "fmi2GetReal");
    self->set = (Call){function(library, "fmi2SetReal"), &self->u, 1, 0, (int64_t)(intptr_t)&self->input, -1};
    own->kind = FMI2, own->n_states = N, own->n_setters = is_fed, own->row_bytes = is_fed ? 8 : 0;
    own->tolerance = tolerance, own->longest = __builtin_inf(), own->tells = 1;
    check(((fmi2SetupExperimentTYPE *)function(library, "fmi2SetupExperiment"))(own->component, fmi2True, tolerance, 0.0,
                                                                               fmi2False, 0.0), "fmi2SetupExperiment");
    typedef fmi2Status (*Mode)(fmi2Component);
    check(((Mode)function(library, "fmi2EnterInitializationMode"))(own->component), "fmi2EnterInitializationMode");
}

static void start(Instance *self, void *leave) {
    int again = 1, ends = 0;
    check(((fmi2Status (*)(fmi2Component))leave)(self->equations.component), "fmi2ExitInitializationMode");
    while (again && !ends) check(update(&self->equations, &again, &ends), "fmi2NewDiscreteStates");
    check(call_mode(&self->equations, 0, self->equations.enter_continuous_time_mode), "fmi2EnterContinuousTimeMode");
    check((int)equations_restart(&self->equations), "fmi2GetContinuousStates");
}

static void read_output(Instance *self) {
    check(self->get(self->equations.component, &self->x, 1, &self->output), "fmi2GetReal");
}

/* A step event is all that may happen besides. */
static void advance(Instance *self, double end) {
    Equations *own = &self->equations;
    while (equations_step(own, end) != 0) {
        if (own->result == GO_ON && own->time >= end) break;
        if (own->result != AT_EVENT) fail("the solver");
        if (set_held(own) != AT_STOP) fail("an event");
    }
    read_output(self);
}

int main(int argc, char **argv) {
    static Instance both[2];
    struct timespec from, to;
    if (argc != 8) fail("arguments");
    void *leave = NULL;
    for (int i = 0; i < 2; i++) make(&both[i], argv + 1, i);
    leave = function(dlopen(argv[1], RTLD_NOW | RTLD_NOLOAD), "fmi2ExitInitializationMode");
    read_output(&both[0]);
    both[1].input = both[0].output;
    check(set(&both[1].equations, &both[1].set), "fmi2SetReal");
    for (int i = 0; i < 2; i++) start(&both[i], leave);
    const long points = atol(argv[5]);
    const double step_size = atof(argv[6]);
    clock_gettime(CLOCK_MONOTONIC, &from);
    for (long point = 1; point <= points; point++) {
        advance(&both[0], (double)point * step_size);
        both[1].input = both[0].output;
        advance(&both[1], (double)point * step_size);
    }
    clock_gettime(CLOCK_MONOTONIC, &to);
    printf("%.9f %a %a\n", (double)(to.tv_sec - from.tv_sec) + 1e-9 * (double)(to.tv_nsec - from.tv_nsec),
           both[0].output, both[1].output);
    return 0;
}
