/* The library of an FMU that runs in WebAssembly: for everybody else it is an ordinary one, with the functions of FMI.
 *
 * It is compiled for each FMU, beside `guest.c`: -DFMI=2 or 3, -DPREFIX="" or "name_", -DIDENTITY="a hash", and
 * `module.bin` is its module as wasmtime has compiled it. A call copies its arguments into the memory of the guest, calls
 * it, and copies the results back. Nothing that the guest says is believed: its pointers are compared with its memory.
 *
 * A state is that memory from the end of the stack on, without pages of zeros. The stack comes first in it and is empty
 * between calls; there are no other variables outside of it, since nothing here is compiled with threads.
 *
 * Who meets here: threads that call instances, each of them its own; and one thread that advances the clock of wasmtime, by
 * which a call ends that does not return (ADR 101). It is joined before the library is unloaded. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <pthread.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

/* ---- wasmtime 50, as far as it is used: `wasmtime.h` and `wasm.h` */

typedef struct Engine Engine;
typedef struct Config Config;
typedef struct Module Module;
typedef struct Store Store;
typedef struct Context Context;
typedef struct Linker Linker;
typedef struct Trap Trap;
typedef struct Error Error;
typedef struct Type Type;
typedef struct { size_t size; char *data; } Bytes;
typedef struct { size_t size; Type **data; } Types;
typedef union { int32_t i; double d; uint8_t all[16]; } Raw;
typedef struct { uint64_t store; void *own; } Function;
typedef struct { struct { uint64_t store; uint32_t own1; } first; uint32_t own2; } Memory;
typedef struct { uint64_t store; size_t own; } Instance;
typedef struct { uint64_t store; uint32_t own[3]; } Global;
typedef struct { uint8_t kind; union { Function function; Memory memory; Global global; void *all[3]; } of; } Extern;
typedef struct { uint8_t kind; union { int32_t i; uint64_t all[3]; } of; } Value;
enum { I32, IS_MEMORY = 3, STACK_FULL = 0, OUT_OF_BOUNDS = 1, BAD_FUNCTION = 5, DIVIDED = 7, UNREACHABLE = 9, INTERRUPT };

Config *wasm_config_new(void);
void wasmtime_config_epoch_interruption_set(Config *, bool);
Engine *wasm_engine_new_with_config(Config *);
void wasm_engine_delete(Engine *);
void wasmtime_engine_increment_epoch(Engine *);
Error *wasmtime_module_deserialize(Engine *, const uint8_t *, size_t, Module **);
void wasmtime_module_delete(Module *);
Linker *wasmtime_linker_new(Engine *);
void wasmtime_linker_delete(Linker *);
Error *wasmtime_linker_define_wasi(Linker *);
void wasmtime_linker_allow_shadowing(Linker *, bool);
typedef Trap *Import(void *, void *caller, Raw *, size_t);
Error *wasmtime_linker_define_func_unchecked(Linker *, const char *, size_t, const char *, size_t, const Type *, Import *,
                                             void *, void (*)(void *));
Error *wasmtime_linker_instantiate(Linker *, Context *, const Module *, Instance *, Trap **);
Type *wasm_functype_new(Types *, Types *);
void wasm_functype_delete(Type *);
Type *wasm_valtype_new(uint8_t);
void wasm_valtype_vec_new_uninitialized(Types *, size_t);
Store *wasmtime_store_new(Engine *, void *, void (*)(void *));
void wasmtime_store_delete(Store *);
void wasmtime_store_limiter(Store *, int64_t memory, int64_t, int64_t, int64_t, int64_t);
Context *wasmtime_store_context(Store *);
void *wasmtime_context_get_data(Context *);
Context *wasmtime_caller_context(void *);
Error *wasmtime_context_set_wasi(Context *, void *);
void *wasi_config_new(void);
void wasmtime_context_set_epoch_deadline(Context *, uint64_t);
bool wasmtime_instance_export_get(Context *, const Instance *, const char *, size_t, Extern *);
Error *wasmtime_func_call_unchecked(Context *, const Function *, Raw *, size_t, Trap **);
uint8_t *wasmtime_memory_data(Context *, const Memory *);
size_t wasmtime_memory_data_size(Context *, const Memory *);
Error *wasmtime_memory_grow(Context *, const Memory *, uint64_t, uint64_t *);
void wasmtime_global_get(Context *, const Global *, Value *);
Error *wasmtime_global_set(Context *, const Global *, const Value *);
bool wasmtime_trap_code(const Trap *, uint8_t *);
Trap *wasmtime_trap_new(const char *, size_t);
void wasm_trap_message(const Trap *, Bytes *);
void wasm_trap_delete(Trap *);
bool wasmtime_error_exit_status(const Error *, int *);
void wasmtime_error_message(const Error *, Bytes *);
void wasmtime_error_delete(Error *);
void wasm_byte_vec_delete(Bytes *);

/* ---- what all instances of this FMU have in common */

#define OURS __attribute__((visibility("default")))
enum { OK, WARNING, ERROR = 3, PAGE = 65536, PART = 4096, SLOTS = 96, TICKS = 16 };

static const uint8_t module_bytes[] = {
#embed "module.bin"
};
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t ends;
static pthread_t clock_thread;
static pid_t ticking; /* the process of that thread: a fork has none */
static Engine *engine;
static Module *module;
static Linker *linker;
static int64_t memory_limit = 1 << 30;
static double call_s = 45.0, step_s = 60.0, tick_s = 60.0 / TICKS;

/* How much memory a guest may have, in bytes, and how long a call may take before and after initialization, in s. */
OURS void fmu_mesh_guest_limits(int64_t memory, double call, double step)
{
    memory_limit = memory, call_s = call, step_s = step, tick_s = (step < call ? step : call) / TICKS;
}

static void *advance(void *unused)
{
    struct timespec next;

    clock_gettime(CLOCK_MONOTONIC, &next);
    pthread_mutex_lock(&lock);
    while (ticking != 0) {
        int64_t ns = next.tv_nsec + (int64_t)(tick_s * 1e9);
        next.tv_sec += ns / 1000000000, next.tv_nsec = ns % 1000000000;
        while (ticking != 0 && pthread_cond_timedwait(&ends, &lock, &next) == 0) {}
        wasmtime_engine_increment_epoch(engine);
        clock_gettime(CLOCK_MONOTONIC, &next); /* a host that was suspended does not count */
    }
    pthread_mutex_unlock(&lock);
    return unused;
}

__attribute__((destructor)) static void finish(void)
{
    bool joins;

    pthread_mutex_lock(&lock);
    joins = ticking == getpid();
    ticking = 0;
    pthread_cond_signal(&ends);
    pthread_mutex_unlock(&lock);
    if (joins) pthread_join(clock_thread, NULL);
    if (linker != NULL) wasmtime_linker_delete(linker);
    if (module != NULL) wasmtime_module_delete(module);
    if (engine != NULL) wasm_engine_delete(engine);
}

/* ---- one instance */

typedef void Log(void *environment, const char *name, int status, const char *category, const char *text, ...);
typedef void Log3(void *environment, int status, const char *category, const char *text);

typedef struct {
    Store *store;
    Context *context;
    Instance instance;
    Memory memory;
    Global stack;
    uint8_t *base;
    Function functions[SLOTS];
    int32_t stack_top, component, room, room_size;
    bool is_lost, is_running; /* after Initialization Mode, when calls have another deadline */
    uint64_t ticks;
    char why[256], *name, **texts;
    void *logger, *environment;
} Guest;

static void runs(Guest *g, bool is_running)
{
    g->is_running = is_running;
    g->ticks = (uint64_t)((is_running ? step_s : call_s) / tick_s) - 1;
}

static void tell(const Guest *g, int status, const char *category, const char *text)
{
    if (g->logger == NULL) return;
    if (FMI == 2) ((Log *)g->logger)(g->environment, g->name, status, category, "%s", text);
    else ((Log3 *)g->logger)(g->environment, status, category, text);
}

/* The instance can be used no longer, but freed, or set to an earlier state. */
static int32_t lost(Guest *g, const char *function, Error *error, Trap *trap)
{
    char text[512];
    Bytes said = {0, NULL};
    uint8_t code = 255;
    int status;

    if (trap != NULL) wasmtime_trap_code(trap, &code), wasm_trap_message(trap, &said);
    else if (error != NULL) wasmtime_error_message(error, &said);
    if (g->why[0] != 0) {
    } else if (error != NULL && wasmtime_error_exit_status(error, &status))
        snprintf(g->why, sizeof g->why, "it called exit(%d)", status);
    else if (code == INTERRUPT)
        snprintf(g->why, sizeof g->why, "it did not return within %g s (`timeouts.%s`)",
                 g->is_running ? step_s : call_s, g->is_running ? "step" : "call");
    else if (code == OUT_OF_BOUNDS) strcpy(g->why, "it used memory that it does not have (a wild pointer)");
    else if (code == STACK_FULL) strcpy(g->why, "its calls are nested too deeply: the stack is full");
    else if (code == BAD_FUNCTION) strcpy(g->why, "it called a function by a pointer to a function of another type");
    else if (code == DIVIDED) strcpy(g->why, "it divided an integer by zero");
    else if (code == UNREACHABLE) strcpy(g->why, "it ended itself (abort, or a failed assertion)");
    else snprintf(g->why, sizeof g->why, "%.*s", (int)said.size, said.data != NULL ? said.data : "");
    snprintf(text, sizeof text, "%s was stopped in its sandbox: %s", function, g->why);
    tell(g, ERROR, "sandbox", text);
    if (said.data != NULL) wasm_byte_vec_delete(&said);
    if (trap != NULL) wasm_trap_delete(trap);
    if (error != NULL) wasmtime_error_delete(error);
    g->is_lost = true;
    g->why[0] = 0;
    return ERROR;
}

static int32_t refuse(Guest *g, const char *function, const char *why)
{
    snprintf(g->why, sizeof g->why, "%s", why);
    return lost(g, function, NULL, NULL);
}

/* `size` bytes of the guest from an address that it has given; NULL if it has none there. */
static void *at(Guest *g, int32_t address, size_t size)
{
    size_t all = wasmtime_memory_data_size(g->context, &g->memory), first = (uint32_t)address;

    return first <= all && size <= all - first ? g->base + first : NULL;
}

/* A text of the guest; NULL if it has no end. */
static const char *text_at(Guest *g, int32_t address)
{
    const char *text = address != 0 ? at(g, address, 0) : NULL;
    size_t left = wasmtime_memory_data_size(g->context, &g->memory) - (uint32_t)address;

    return text != NULL && memchr(text, 0, left) != NULL ? text : NULL;
}

static Function *function_of(Guest *g, int slot, const char *name)
{
    Function *own = &g->functions[slot];
    Extern found;
    char full[256];

    if (own->store != 0) return own;
    snprintf(full, sizeof full, "%s%s", strncmp(name, "fmi", 3) == 0 ? PREFIX : "", name);
    if (!wasmtime_instance_export_get(g->context, &g->instance, full, strlen(full), &found)) return NULL;
    *own = found.of.function;
    return own;
}

/* Call a function with `n` arguments; its result is in their place. Whether it has returned. */
static bool called(Guest *g, int slot, const char *name, Raw *arguments, size_t n)
{
    Trap *trap = NULL;
    Error *error;
    Function *function = function_of(g, slot, name);

    if (function == NULL) return refuse(g, name, "it does not have this function"), false;
    wasmtime_context_set_epoch_deadline(g->context, g->ticks);
    error = wasmtime_func_call_unchecked(g->context, function, arguments, n > 0 ? n : 1, &trap);
    return (error == NULL && trap == NULL) || (lost(g, name, error, trap), false);
}

/* Whether there is room for so many bytes of arguments. */
static bool has_room(Guest *g, const char *name, size_t size)
{
    Raw answer = {.i = (int32_t)size};
    enum { ROOM = SLOTS - 1 };

    if (size <= (size_t)g->room_size) return true;
    if (size > INT32_MAX / 2) return refuse(g, name, "its arguments are too large for its sandbox"), false;
    if (!called(g, ROOM, "fmu_mesh_room", &answer, 1)) return false;
    if (at(g, answer.i, size) == NULL || answer.i == 0) return refuse(g, name, "its memory is damaged"), false;
    g->room = answer.i, g->room_size = (int32_t)size;
    return true;
}

typedef struct {
    enum { IN, OUT, NUMBER, REAL } kind;
    void *place;
    size_t bytes;
    int32_t number;
    double real;
} Argument;

#define ALIGNED(SIZE) (((SIZE) + 7) & ~(size_t)7)

/* Call a function of FMI: `component` and these arguments, those of IN and OUT by their addresses in the guest. Inline:
 * it takes most of the time of a short call. */
static inline __attribute__((always_inline)) int32_t pass(Guest *g, int slot, const char *name, const Argument *arguments, size_t n)
{
    Raw raw[16];
    size_t all = 0, used = 0;

    if (g->is_lost) return ERROR;
    for (size_t i = 0; i < n; ++i) all += ALIGNED(arguments[i].bytes);
    if (!has_room(g, name, all)) return ERROR;
    raw[0].i = g->component;
    for (size_t i = 0; i < n; ++i) {
        const Argument *own = &arguments[i];
        if (own->kind == NUMBER) raw[i + 1].i = own->number;
        else if (own->kind == REAL) raw[i + 1].d = own->real;
        else {
            raw[i + 1].i = own->place != NULL ? g->room + (int32_t)used : 0;
            if (own->bytes > 0) memcpy(g->base + (uint32_t)g->room + used, own->place, own->bytes);
            used += ALIGNED(own->bytes);
        }
    }
    if (!called(g, slot, name, raw, n + 1)) return ERROR;
    used = 0;
    for (size_t i = 0; i < n; ++i) {
        if (arguments[i].kind == OUT && arguments[i].bytes > 0)
            memcpy(arguments[i].place, g->base + (uint32_t)g->room + used, arguments[i].bytes);
        used += ALIGNED(arguments[i].bytes);
    }
    return raw[0].i;
}

/* Set texts, or blocks of bytes of these sizes. */
static int32_t set_blocks(Guest *g, int slot, const char *name, const void *references, size_t n, const size_t *sizes,
                          const void *const *values, size_t count)
{
    size_t bytes = count * 4, used = bytes, first = ALIGNED(n * 4) + (sizes != NULL ? ALIGNED(count * 4) : 0);
    uint32_t short_sizes[count + 1], *block;
    Argument arguments[5] = {{IN, (void *)references, n * 4, 0, 0}, {NUMBER, NULL, 0, (int32_t)n, 0}};
    size_t number = 2;
    int32_t status;

    for (size_t i = 0; i < count; ++i) {
        short_sizes[i] = (uint32_t)(sizes != NULL ? sizes[i] : strlen(values[i]) + 1);
        bytes += short_sizes[i];
    }
    if (g->is_lost || !has_room(g, name, first + ALIGNED(bytes))) return ERROR;
    if ((block = malloc(bytes + 1)) == NULL) return refuse(g, name, "there is no memory for its arguments");
    for (size_t i = 0; i < count; used += short_sizes[i], ++i) {
        block[i] = (uint32_t)(g->room + (int32_t)(first + used));
        memcpy((char *)block + used, values[i], short_sizes[i]);
    }
    if (sizes != NULL) arguments[number++] = (Argument){IN, short_sizes, count * 4, 0, 0};
    arguments[number++] = (Argument){IN, block, bytes, 0, 0};
    if (FMI == 3) arguments[number++] = (Argument){NUMBER, NULL, 0, (int32_t)count, 0};
    status = pass(g, slot, name, arguments, number);
    free(block);
    return status;
}

/* Get texts, or blocks of bytes and their sizes: they stay where they are until the next call. */
static int32_t get_blocks(Guest *g, int slot, const char *name, const void *references, size_t n, size_t *sizes,
                          const void **values, size_t count)
{
    uint32_t found[count + 1], short_sizes[count + 1];
    Argument arguments[5] = {{IN, (void *)references, n * 4, 0, 0}, {NUMBER, NULL, 0, (int32_t)n, 0}};
    size_t used = 2;
    int32_t status;

    if (sizes != NULL) arguments[used++] = (Argument){OUT, short_sizes, count * 4, 0, 0};
    arguments[used++] = (Argument){OUT, found, count * 4, 0, 0};
    if (FMI == 3) arguments[used++] = (Argument){NUMBER, NULL, 0, (int32_t)count, 0};
    if ((status = pass(g, slot, name, arguments, used)) > WARNING) return status;
    for (size_t i = 0; i < count; ++i) {
        values[i] = sizes != NULL ? at(g, (int32_t)found[i], short_sizes[i]) : text_at(g, (int32_t)found[i]);
        if (sizes != NULL) sizes[i] = short_sizes[i];
        if (values[i] == NULL) return refuse(g, name, "it gave a value that is not in its memory");
    }
    return status;
}

/* ---- what the guest calls */

static Trap *log_from(void *unused, void *caller, Raw *arguments, size_t n)
{
    Guest *g = wasmtime_context_get_data(wasmtime_caller_context(caller));
    const char *category, *text;

    (void)unused, (void)n;
    category = text_at(g, arguments[1].i), text = text_at(g, arguments[2].i);
    tell(g, arguments[0].i, category != NULL ? category : "", text != NULL ? text : "");
    return NULL;
}

static Trap *out_of_memory_from(void *unused, void *caller, Raw *arguments, size_t n)
{
    Guest *g = wasmtime_context_get_data(wasmtime_caller_context(caller));

    (void)unused, (void)n;
    snprintf(g->why, sizeof g->why,
             "it asked for %.1f MiB more than the %.0f MiB that it may have: raise `process.memory` (4 GiB at most)",
             (uint32_t)arguments[0].i / 1048576.0, (double)memory_limit / 1048576.0);
    return wasmtime_trap_new("memory", 6);
}

/* ---- its life */

/* To sleep is no call that the clock of wasmtime could end. */
static Trap *no_sleep(void *unused, void *caller, Raw *arguments, size_t n)
{
    enum { NOT_SUPPORTED = 58 };

    (void)unused, (void)caller, (void)n;
    arguments[0].i = NOT_SUPPORTED;
    return NULL;
}

static Error *imported(const char *from, const char *name, size_t n, size_t n_results, Import *function)
{
    Types types, results;
    Error *error;

    wasm_valtype_vec_new_uninitialized(&types, n);
    for (size_t i = 0; i < n; ++i) types.data[i] = wasm_valtype_new(I32);
    wasm_valtype_vec_new_uninitialized(&results, n_results);
    for (size_t i = 0; i < n_results; ++i) results.data[i] = wasm_valtype_new(I32);
    Type *type = wasm_functype_new(&types, &results); /* takes them */
    error = wasmtime_linker_define_func_unchecked(linker, from, strlen(from), name, strlen(name), type, function, NULL, NULL);
    wasm_functype_delete(type);
    return error;
}

static Error *begin(void)
{
    Config *config;
    Error *error = NULL;

    if (engine == NULL) {
        Dl_info there; /* a library with handlers of signals is never unloaded */
        if (dladdr((void *)wasm_config_new, &there)) dlopen(there.dli_fname, RTLD_NOW | RTLD_NODELETE);
        config = wasm_config_new();
        wasmtime_config_epoch_interruption_set(config, true);
        engine = wasm_engine_new_with_config(config);
        linker = wasmtime_linker_new(engine);
        wasmtime_linker_allow_shadowing(linker, true);
        (void)((error = wasmtime_linker_define_wasi(linker)) ||
               (error = imported("wasi_snapshot_preview1", "poll_oneoff", 4, 1, no_sleep)) ||
               (error = imported("fmu_mesh", "log", 3, 0, log_from)) ||
               (error = imported("fmu_mesh", "out_of_memory", 1, 0, out_of_memory_from)));
    }
    if (error == NULL && module == NULL)
        error = wasmtime_module_deserialize(engine, module_bytes, sizeof module_bytes, &module);
    if (ticking != getpid()) {
        pthread_condattr_t monotonic;
        pthread_condattr_init(&monotonic);
        pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
        pthread_cond_init(&ends, &monotonic);
        ticking = getpid();
        if (pthread_create(&clock_thread, NULL, advance, NULL) != 0) ticking = 0;
    }
    return error;
}

static void release(Guest *g)
{
    if (g->store != NULL) wasmtime_store_delete(g->store);
    free(g->name);
    free(g);
}

static bool is_ready(Guest *g, const char *function)
{
    Extern found;
    Value value;
    Trap *trap = NULL;
    Error *error;

    pthread_mutex_lock(&lock);
    error = begin();
    pthread_mutex_unlock(&lock);
    if (error == NULL) {
        g->store = wasmtime_store_new(engine, g, NULL);
        g->context = wasmtime_store_context(g->store);
        wasmtime_store_limiter(g->store, memory_limit, -1, -1, -1, -1);
        error = wasmtime_context_set_wasi(g->context, wasi_config_new());
    }
    if (error == NULL) {
        wasmtime_context_set_epoch_deadline(g->context, TICKS);
        error = wasmtime_linker_instantiate(linker, g->context, module, &g->instance, &trap);
    }
    if (error != NULL || trap != NULL) return lost(g, function, error, trap), false;
    wasmtime_instance_export_get(g->context, &g->instance, "memory", 6, &found);
    g->memory = found.of.memory;
    g->base = wasmtime_memory_data(g->context, &g->memory);
    wasmtime_instance_export_get(g->context, &g->instance, "__stack_pointer", 15, &found);
    g->stack = found.of.global;
    wasmtime_global_get(g->context, &g->stack, &value);
    g->stack_top = value.of.i;
    return called(g, SLOTS - 2, "_initialize", (Raw[1]){0}, 0);
}

static Guest *made(const char *function, const char *name, const char *token, const char *resources, void *logger,
                   void *environment, const int32_t *numbers, size_t n)
{
    Guest *g = calloc(1, sizeof *g);
    const char *texts[] = {name, token, resources != NULL ? resources : ""};
    size_t sizes[3], used = 0;
    Raw raw[8];

    if (g == NULL) return NULL;
    g->logger = logger, g->environment = environment, g->name = strdup(name);
    runs(g, false);
    for (int i = 0; i < 3; ++i) used += sizes[i] = strlen(texts[i]) + 1;
    if (!is_ready(g, function) || !has_room(g, function, used)) return release(g), NULL;
    used = 0;
    raw[0].i = numbers[0];
    for (int i = 0; i < 3; used += sizes[i], ++i) {
        raw[i + 1].i = g->room + (int32_t)used;
        memcpy(g->base + (uint32_t)g->room + used, texts[i], sizes[i]);
    }
    for (size_t i = 1; i < n; ++i) raw[i + 3].i = numbers[i];
    if (!called(g, SLOTS - 3, "fmu_mesh_instantiate", raw, n + 3) || raw[0].i == 0) return release(g), NULL;
    g->component = raw[0].i;
    return g;
}

/* ---- states */

typedef struct {
    char identity[64];
    uint64_t size, memory, parts; /* of the whole state in bytes, the memory in bytes, and how many parts follow */
    int32_t component, room, room_size, is_running;
} State; /* then the parts: eight bytes with the place of each, and its bytes */

static State *state_of(Guest *g)
{
    static const char zeros[PART];
    uint64_t memory = wasmtime_memory_data_size(g->context, &g->memory);
    uint64_t first = (uint64_t)g->stack_top / PART, last = memory / PART, parts = 0;
    State *own;
    char *to;

    for (uint64_t i = first; i < last; ++i) parts += memcmp(g->base + i * PART, zeros, PART) != 0;
    uint64_t size = sizeof *own + parts * (8 + PART);
    if ((own = malloc(size)) == NULL) return NULL;
    *own = (State){IDENTITY, size, memory, parts, g->component, g->room, g->room_size, g->is_running};
    to = (char *)(own + 1);
    for (uint64_t i = first; i < last; ++i) {
        if (memcmp(g->base + i * PART, zeros, PART) == 0) continue;
        memcpy(to, &i, 8);
        memcpy(to + 8, g->base + i * PART, PART);
        to += 8 + PART;
    }
    return own;
}

static bool is_sound(const State *own, size_t size)
{
    return size >= sizeof *own && strncmp(own->identity, IDENTITY, sizeof own->identity) == 0 && own->size == size &&
           own->memory % PAGE == 0 && own->parts == (size - sizeof *own) / (8 + PART) &&
           size == sizeof *own + own->parts * (8 + PART);
}

static int32_t set_state(Guest *g, const State *own)
{
    uint64_t memory = wasmtime_memory_data_size(g->context, &g->memory), before, place;
    uint64_t first = (uint64_t)g->stack_top / PART * PART;
    const char *from = (const char *)(own + 1);
    Error *error = NULL;

    if (own->memory > memory) {
        if ((error = wasmtime_memory_grow(g->context, &g->memory, (own->memory - memory) / PAGE, &before)) != NULL)
            return lost(g, "setting a state", error, NULL);
        memory = own->memory;
    }
    memset(g->base + first, 0, memory - first);
    for (uint64_t i = 0; i < own->parts; ++i, from += 8 + PART) {
        memcpy(&place, from, 8);
        if (place >= memory / PART || place < first / PART) return refuse(g, "setting a state", "the state is damaged");
        memcpy(g->base + place * PART, from + 8, PART);
    }
    (void)wasmtime_global_set(g->context, &g->stack, &(Value){I32, {.i = g->stack_top}});
    g->component = own->component, g->room = own->room, g->room_size = own->room_size;
    if (g->room_size < 0 || at(g, g->room, (size_t)g->room_size) == NULL) g->room_size = 0;
    runs(g, own->is_running);
    g->is_lost = false;
    return OK;
}

static int32_t give(Guest *g, const char *function, State *own, State **state)
{
    if (own == NULL) return tell(g, ERROR, "sandbox", function), ERROR;
    free(*state);
    *state = own;
    return OK;
}

/* ---- the functions of FMI */

#define I(X) {NUMBER, NULL, 0, (int32_t)(X), 0}
#define D(X) {REAL, NULL, 0, 0, (X)}
#define IN(P, BYTES) {IN, (void *)(P), (BYTES), 0, 0}
#define OUT(P, BYTES) {OUT, (P), (BYTES), 0, 0}
#define TO(P) OUT(P, sizeof *(P))
#define LIST(...) (const Argument[]){__VA_ARGS__}, sizeof((const Argument[]){__VA_ARGS__}) / sizeof(Argument)
#define FUNCTION(NAME, PARAMETERS, ...) \
    enum { SLOT_##NAME = __COUNTER__ }; \
    OURS int32_t NAME PARAMETERS { return pass(g, SLOT_##NAME, #NAME, LIST(__VA_ARGS__)); }
#define NAMED(NAME, PARAMETERS, ...) FUNCTION(NAME, PARAMETERS, __VA_ARGS__)
#define REFERENCES Guest *g, const uint32_t *r, size_t n
#define R IN(r, n * 4), I(n)
#if FMI == 2
#define F(NAME) fmi2##NAME
#define STATE(VERB) fmi2##VERB##FMUstate
#else
#define F(NAME) fmi3##NAME
#define STATE(VERB) fmi3##VERB##FMUState
#endif

#define VECTOR(NAME, HOW, C) NAMED(NAME, (Guest *g, C double *x, size_t n), HOW(x, n * 8), I(n))
#if FMI == 2
#define VALUES(TYPE, C) \
    FUNCTION(fmi2Get##TYPE, (REFERENCES, C *x), R, OUT(x, n * sizeof *x)) \
    FUNCTION(fmi2Set##TYPE, (REFERENCES, const C *x), R, IN(x, n * sizeof *x))
#define STATUS(TYPE, C) FUNCTION(fmi2Get##TYPE##Status, (Guest *g, int32_t kind, C *x), I(kind), TO(x))

VALUES(Real, double)
VALUES(Integer, int32_t)
VALUES(Boolean, int32_t)
STATUS(, int32_t)
STATUS(Real, double)
STATUS(Integer, int32_t)
STATUS(Boolean, int32_t)
FUNCTION(fmi2SetupExperiment, (Guest *g, int32_t has, double tolerance, double start, int32_t ends, double end), I(has),
         D(tolerance), D(start), I(ends), D(end))
FUNCTION(fmi2EnterInitializationMode, (Guest *g))
FUNCTION(fmi2DoStep, (Guest *g, double time, double step, int32_t is_last), D(time), D(step), I(is_last))
FUNCTION(fmi2CancelStep, (Guest *g))
FUNCTION(fmi2SetRealInputDerivatives, (REFERENCES, const int32_t *orders, const double *x), R, IN(orders, n * 4),
         IN(x, n * 8))
FUNCTION(fmi2GetRealOutputDerivatives, (REFERENCES, const int32_t *orders, double *x), R, IN(orders, n * 4), OUT(x, n * 8))
FUNCTION(fmi2GetDirectionalDerivative,
         (REFERENCES, const uint32_t *known, size_t n_known, const double *seed, double *x), R, IN(known, n_known * 4),
         I(n_known), IN(seed, n_known * 8), OUT(x, n * 8))
FUNCTION(fmi2NewDiscreteStates, (Guest *g, void *info), OUT(info, 32))
FUNCTION(fmi2CompletedIntegratorStep, (Guest *g, int32_t kept, int32_t *event, int32_t *ends), I(kept), TO(event), TO(ends))
VECTOR(fmi2GetDerivatives, OUT, )
#else
#define VALUES(TYPE, C) \
    FUNCTION(fmi3Get##TYPE, (REFERENCES, C *x, size_t m), R, OUT(x, m * sizeof *x), I(m)) \
    FUNCTION(fmi3Set##TYPE, (REFERENCES, const C *x, size_t m), R, IN(x, m * sizeof *x), I(m))

VALUES(Float64, double)
VALUES(Float32, float)
VALUES(Int8, int8_t)
VALUES(UInt8, uint8_t)
VALUES(Int16, int16_t)
VALUES(UInt16, uint16_t)
VALUES(Int32, int32_t)
VALUES(UInt32, uint32_t)
VALUES(Int64, int64_t)
VALUES(UInt64, uint64_t)
VALUES(Boolean, bool)
FUNCTION(fmi3GetClock, (REFERENCES, bool *x), R, OUT(x, n))
FUNCTION(fmi3SetClock, (REFERENCES, const bool *x), R, IN(x, n))
FUNCTION(fmi3GetIntervalDecimal, (REFERENCES, double *x, int32_t *how), R, OUT(x, n * 8), OUT(how, n * 4))
FUNCTION(fmi3SetIntervalDecimal, (REFERENCES, const double *x), R, IN(x, n * 8))
FUNCTION(fmi3GetShiftDecimal, (REFERENCES, double *x), R, OUT(x, n * 8))
FUNCTION(fmi3EnterInitializationMode, (Guest *g, bool has, double tolerance, double start, bool ends, double end), I(has),
         D(tolerance), D(start), I(ends), D(end))
FUNCTION(fmi3EnterConfigurationMode, (Guest *g))
FUNCTION(fmi3ExitConfigurationMode, (Guest *g))
FUNCTION(fmi3EnterStepMode, (Guest *g))
FUNCTION(fmi3EvaluateDiscreteStates, (Guest *g))
FUNCTION(fmi3DoStep, (Guest *g, double time, double step, bool kept, bool *event, bool *ends, bool *early, double *last),
         D(time), D(step), I(kept), TO(event), TO(ends), TO(early), TO(last))
FUNCTION(fmi3UpdateDiscreteStates,
         (Guest *g, bool *again, bool *ends, bool *nominals, bool *values, bool *has_next, double *next), TO(again), TO(ends),
         TO(nominals), TO(values), TO(has_next), TO(next))
FUNCTION(fmi3CompletedIntegratorStep, (Guest *g, bool kept, bool *event, bool *ends), I(kept), TO(event), TO(ends))
FUNCTION(fmi3GetOutputDerivatives, (REFERENCES, const int32_t *orders, double *x, size_t m), R, IN(orders, n * 4),
         OUT(x, m * 8), I(m))
FUNCTION(fmi3GetDirectionalDerivative,
         (REFERENCES, const uint32_t *known, size_t n_known, const double *seed, size_t n_seed, double *x, size_t m), R,
         IN(known, n_known * 4), I(n_known), IN(seed, n_seed * 8), I(n_seed), OUT(x, m * 8), I(m))
VECTOR(fmi3GetContinuousStateDerivatives, OUT, )

#define NUMBER_OF(THINGS) \
    OURS int32_t fmi3GetNumberOf##THINGS(Guest *g, size_t *n) \
    { \
        uint32_t own = 0; /* a size_t of the guest */ \
        int32_t status = pass(g, __COUNTER__, "fmi3GetNumberOf" #THINGS, LIST(TO(&own))); \
        *n = own; \
        return status; \
    }

NUMBER_OF(ContinuousStates)
NUMBER_OF(EventIndicators)

OURS int32_t fmi3GetBinary(REFERENCES, size_t *sizes, const void **x, size_t m)
{
    return get_blocks(g, __COUNTER__, "fmi3GetBinary", r, n, sizes, x, m);
}

OURS int32_t fmi3SetBinary(REFERENCES, const size_t *sizes, const void *const *x, size_t m)
{
    return set_blocks(g, __COUNTER__, "fmi3SetBinary", r, n, sizes, x, m);
}
#endif
#define TEXT(X) #X
#define NAME_OF(X) TEXT(X)

NAMED(F(EnterEventMode), (Guest *g))
NAMED(F(EnterContinuousTimeMode), (Guest *g))
NAMED(F(Terminate), (Guest *g))
NAMED(F(SetTime), (Guest *g, double time), D(time))
VECTOR(F(SetContinuousStates), IN, const)
VECTOR(F(GetContinuousStates), OUT, )
VECTOR(F(GetNominalsOfContinuousStates), OUT, )
VECTOR(F(GetEventIndicators), OUT, )

OURS int32_t F(GetString)(REFERENCES, const void **x, size_t m)
{
    return get_blocks(g, __COUNTER__, NAME_OF(F(GetString)), r, n, NULL, x, FMI == 2 ? n : m);
}

OURS int32_t F(SetString)(REFERENCES, const void *const *x, size_t m)
{
    return set_blocks(g, __COUNTER__, NAME_OF(F(SetString)), r, n, NULL, x, FMI == 2 ? n : m);
}

OURS int32_t F(ExitInitializationMode)(Guest *g)
{
    int32_t status = pass(g, __COUNTER__, NAME_OF(F(ExitInitializationMode)), NULL, 0);

    runs(g, true);
    return status;
}

OURS int32_t F(Reset)(Guest *g)
{
    runs(g, false);
    return pass(g, __COUNTER__, NAME_OF(F(Reset)), NULL, 0);
}

OURS void F(FreeInstance)(Guest *g)
{
    if (!g->is_lost) called(g, __COUNTER__, NAME_OF(F(FreeInstance)), (Raw[1]){{.i = g->component}}, 1);
    release(g);
}

OURS int32_t STATE(Get)(Guest *g, State **state)
{
    return g->is_lost ? ERROR : give(g, "there is no memory for a state", state_of(g), state);
}

OURS int32_t STATE(Set)(Guest *g, const State *state) { return set_state(g, state); }

OURS int32_t STATE(Free)(Guest *g, State **state)
{
    (void)g;
    free(*state);
    *state = NULL;
    return OK;
}

#if FMI == 2
OURS int32_t fmi2SerializedFMUstateSize(Guest *g, const State *state, size_t *size)
#else
OURS int32_t fmi3SerializedFMUStateSize(Guest *g, const State *state, size_t *size)
#endif
{
    (void)g;
    *size = state->size;
    return OK;
}

OURS int32_t STATE(Serialize)(Guest *g, const State *state, void *bytes, size_t size)
{
    if (size < state->size) return tell(g, ERROR, "sandbox", "there is too little room for a state"), ERROR;
    memcpy(bytes, state, state->size);
    return OK;
}

#if FMI == 2
OURS int32_t fmi2DeSerializeFMUstate(Guest *g, const void *bytes, size_t size, State **state)
#else
OURS int32_t fmi3DeserializeFMUState(Guest *g, const void *bytes, size_t size, State **state)
#endif
{
    State *own = is_sound(bytes, size) ? malloc(size) : NULL;

    return give(g, "the bytes are no state of this FMU in its sandbox", own != NULL ? memcpy(own, bytes, size) : NULL, state);
}

#if FMI == 2
typedef struct {
    void *logger, *allocate, *release, *finished, *environment;
} Callbacks;

OURS Guest *fmi2Instantiate(const char *name, int32_t type, const char *token, const char *resources,
                            const Callbacks *callbacks, int32_t is_visible, int32_t logs)
{
    return made("fmi2Instantiate", name, token, resources, callbacks->logger, callbacks->environment,
                (int32_t[]){type, is_visible, logs}, 3);
}
#else
OURS Guest *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources, bool is_visible,
                                        bool logs, bool events, bool early, const uint32_t *between, size_t n_between,
                                        void *environment, void *logger, void *update)
{
    (void)between, (void)n_between, (void)update;
    return made("fmi3InstantiateCoSimulation", name, token, resources, logger, environment,
                (int32_t[]){1, is_visible, logs, events, early}, 5);
}

OURS Guest *fmi3InstantiateModelExchange(const char *name, const char *token, const char *resources, bool is_visible,
                                         bool logs, void *environment, void *logger)
{
    return made("fmi3InstantiateModelExchange", name, token, resources, logger, environment,
                (int32_t[]){0, is_visible, logs, 0, 0}, 5);
}
#endif
_Static_assert(__COUNTER__ < SLOTS - 3, "each function has a slot of its own");
