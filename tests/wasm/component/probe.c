/* An FMU as a component of WebAssembly, after the draft FMI-LS-WASM: it returns in the next step what it got in this one,
 * of each type; with -DME, `x` rises by 1/s until it is 0.5, and then falls. `build.py` makes the components in this folder. */
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef ME
#define KIND "model-exchange"
#else
#define KIND "co-simulation"
#endif
#define INTERFACE "fmi:fmi3/" KIND "@3.0.0"
#define RESOURCE KIND "-instance"
#define EXPORT(NAME) __attribute__((export_name(NAME)))
#define STATIC(NAME) EXPORT(INTERFACE "#[static]" RESOURCE "." NAME)
#define METHOD(NAME) EXPORT(INTERFACE "#[method]" RESOURCE "." NAME)
#define IMPORT(MODULE, NAME) __attribute__((import_module(MODULE), import_name(NAME)))

enum { OK, WARNING, DISCARD, ERROR, TYPES = 12, SLOTS = 16, TEXT = 64, X = 200, FAULT = 201, IN = 10, OUT = 110 };
enum { TRAPS = 1, HOGS = 2, FAILS = 3, LOOPS = 4, DISCARDS = 5 };
typedef uint32_t Enum;
typedef struct { uint32_t at, size; } List;

IMPORT("fmi:fmi3/callbacks@3.0.0", "log-message")
void log_message(const char *, size_t, Enum, const char *, size_t, const char *, size_t);
IMPORT("[export]" INTERFACE, "[resource-new]" RESOURCE) uint32_t new_resource(uint32_t);

static struct {
    uint64_t in[SLOTS], out[SLOTS];
    char text_in[2][TEXT], text_out[2][TEXT];
    uint32_t size_in[2], size_out[2];
    double x, time, slope;
    int32_t fault;
} own = {.slope = 1.0};
static struct { uint32_t answer[16]; double room[512]; } result;
static char heap[1 << 20] __attribute__((aligned(16)));
static size_t top;

void *memcpy(void *to, const void *from, size_t n)
{
    for (size_t i = 0; i < n; ++i) ((char *)to)[i] = ((const char *)from)[i];
    return to;
}

void *memset(void *to, int value, size_t n)
{
    for (size_t i = 0; i < n; ++i) ((volatile char *)to)[i] = (char)value;
    return to;
}

/* Arguments are here until the function returns; it sets `top` back. */
EXPORT("cabi_realloc") void *cabi_realloc(void *old, size_t old_size, size_t alignment, size_t size)
{
    char *made = heap + ((top + alignment - 1) & ~(alignment - 1));

    if (size > sizeof heap - (size_t)(made - heap)) __builtin_trap();
    top = (size_t)(made - heap) + size;
    return old_size > 0 ? memcpy(made, old, old_size) : made;
}

static void *place_of(uint32_t vr, bool sets)
{
    if (vr == 0) return &own.time;
    if (vr == X) return &own.x;
    if (vr == FAULT) return &own.fault;
    if (vr >= IN && vr < IN + TYPES) return &own.in[vr - IN];
    if (vr >= OUT && vr < OUT + TYPES && !sets) return &own.out[vr - OUT];
    return NULL;
}

static void *answered(bool is_error, size_t payload, uint32_t status)
{
    top = 0;
    *(uint8_t *)result.answer = is_error;
    if (is_error) *((uint8_t *)result.answer + payload) = (uint8_t)status;
    return result.answer;
}

static void *listed(void *items, size_t n)
{
    result.answer[1] = (uint32_t)(uintptr_t)items, result.answer[2] = (uint32_t)n;
    return answered(false, 4, OK);
}

static void *refused(void) { return answered(true, 4, ERROR); }

#define VALUES(NAME, C) \
    METHOD("get-" NAME) void *get_##C(void *self, const uint32_t *vrs, size_t n) \
    { \
        C *values = (C *)result.room; \
        (void)self; \
        for (size_t i = 0; i < n; ++i) { \
            C *place = place_of(vrs[i], false); \
            if (place == NULL) return refused(); \
            values[i] = *place; \
        } \
        return listed(values, n); \
    } \
    METHOD("set-" NAME) Enum set_##C(void *self, const uint32_t *vrs, size_t n, const C *values, size_t m) \
    { \
        (void)self, (void)m; \
        top = 0; \
        for (size_t i = 0; i < n; ++i) { \
            C *place = place_of(vrs[i], true); \
            if (place == NULL) return ERROR; \
            *place = values[i]; \
        } \
        return OK; \
    }
typedef bool tick;
VALUES("float32", float)
VALUES("float64", double)
VALUES("int8", int8_t)
VALUES("uint8", uint8_t)
VALUES("int16", int16_t)
VALUES("uint16", uint16_t)
VALUES("int32", int32_t)
VALUES("uint32", uint32_t)
VALUES("int64", int64_t)
VALUES("uint64", uint64_t)
VALUES("boolean", bool)
VALUES("clock", tick)

/* vr 22 is a text and 23 are bytes; 122 and 123 are the outputs. */
#define BLOCKS(NAME, C) \
    METHOD("get-" NAME) void *get_##C(void *self, const uint32_t *vrs, size_t n) \
    { \
        List *values = (List *)result.room; \
        (void)self; \
        for (size_t i = 0; i < n; ++i) { \
            bool out = vrs[i] >= OUT; \
            uint32_t which = (vrs[i] - (out ? OUT : IN) - TYPES) % 2; \
            values[i].at = (uint32_t)(uintptr_t)(out ? own.text_out : own.text_in)[which]; \
            values[i].size = (out ? own.size_out : own.size_in)[which]; \
        } \
        return listed(values, n); \
    } \
    METHOD("set-" NAME) Enum set_##C(void *self, const uint32_t *vrs, size_t n, const List *values, size_t m) \
    { \
        (void)self, (void)m; \
        top = 0; \
        for (size_t i = 0; i < n; ++i) { \
            uint32_t which = (vrs[i] - IN - TYPES) % 2; \
            if (values[i].size > TEXT) return ERROR; \
            memcpy(own.text_in[which], (void *)(uintptr_t)values[i].at, own.size_in[which] = values[i].size); \
        } \
        return OK; \
    }
BLOCKS("string", text)
BLOCKS("binary", block)

static uint32_t said(const char *text, size_t size)
{
    log_message("probe", 5, WARNING, "probe", 5, text, size);
    return OK;
}
#define SAY(TEXT) said(TEXT, sizeof(TEXT) - 1)

static Enum happened(void)
{
    static volatile uint32_t turns;

    if (own.fault == TRAPS) __builtin_trap();
    if (own.fault == LOOPS)
        for (;;) ++turns;
    if (own.fault == HOGS)
        while (__builtin_wasm_memory_grow(0, 16) != SIZE_MAX) {}
    if (own.fault == HOGS) SAY("no more memory"), own.fault = FAILS;
    return own.fault == FAILS ? ERROR : own.fault == DISCARDS ? DISCARD : OK;
}

#define PLAIN(NAME, C) METHOD(NAME) Enum C(void *self) { (void)self; return OK; }
#define NOT_THERE(NAME, C, ...) METHOD(NAME) void *C(void *self, __VA_ARGS__) { (void)self; return refused(); }
#define IGNORED(NAME, C) METHOD(NAME) Enum C(void *self, void *a, size_t n, void *b, size_t m) \
    { (void)self, (void)a, (void)b, (void)n, (void)m; top = 0; return ERROR; }
#define LIST void *a, size_t n
#define LISTS void *a, size_t n, void *b, size_t m, void *c, size_t o

static void *made(void)
{
    top = 0;
    SAY("made");
    *(uint8_t *)result.answer = 1;
    result.answer[1] = new_resource((uint32_t)(uintptr_t)&own);
    return result.answer;
}

EXPORT("fmi:fmi3/common@3.0.0#get-version") void *version(void) { return result.answer[0] = (uint32_t)(uintptr_t)"3.0", result.answer[1] = 3, result.answer; }
EXPORT(INTERFACE "#[dtor]" RESOURCE) void freed(void *self) { (void)self; SAY("freed"); }
METHOD("set-debug-logging") Enum debug(void *self, int on, void *a, size_t n) { (void)self, (void)on, (void)a, (void)n; top = 0; return OK; }
METHOD("enter-initialization-mode")
Enum enter(void *self, int has, double tolerance, double start, int ends, double stop)
{
    (void)self, (void)tolerance, (void)stop;
    own.time = start;
    if (!ends) SAY("no end");
    if (has) SAY("a tolerance");
    return OK;
}
METHOD("reset") Enum reset(void *self) { (void)self; memset(&own, 0, sizeof own); own.slope = 1.0; return OK; }
PLAIN("exit-initialization-mode", exit_initialization)
PLAIN("enter-event-mode", enter_event)
PLAIN("terminate", terminate)
PLAIN("enter-configuration-mode", enter_configuration)
PLAIN("exit-configuration-mode", exit_configuration)
PLAIN("evaluate-discrete-states", evaluate)
PLAIN("enter-step-mode", enter_step)
METHOD("update-discrete-states") void *update(void *self)
{
    (void)self;
    memset(result.answer, 0, sizeof result.answer);
    if (own.x >= 0.5) own.slope = -1.0;
    return answered(false, 8, OK);
}
METHOD("get-fmu-state") void *get_state(void *self) { (void)self; memcpy(result.room, &own, sizeof own); return listed(result.room, sizeof own); }
METHOD("set-fmu-state") Enum set_state(void *self, const void *state, size_t n)
{
    (void)self;
    top = 0;
    if (n != sizeof own) return ERROR;
    memcpy(&own, state, n);
    return OK;
}
METHOD("get-number-of-variable-dependencies") void *count(void *self, uint32_t vr) { (void)self, (void)vr; return answered(true, 8, ERROR); }
NOT_THERE("get-variable-dependencies", dependencies, uint32_t vr)
NOT_THERE("get-directional-derivative", directional, LISTS)
NOT_THERE("get-adjoint-derivative", adjoint, LISTS)
NOT_THERE("get-interval-decimal", interval, LIST)
NOT_THERE("get-interval-fraction", fraction, LIST)
NOT_THERE("get-shift-decimal", shift, LIST)
NOT_THERE("get-shift-fraction", shift_fraction, LIST)
NOT_THERE("get-output-derivatives", output_derivatives, LIST)
IGNORED("set-interval-decimal", set_interval)
IGNORED("set-interval-fraction", set_fraction)
IGNORED("set-shift-decimal", set_shift)
IGNORED("set-shift-fraction", set_shift_fraction)

#ifdef ME
STATIC("instantiate-model-exchange")
void *make(const char *name, size_t n, const char *token, size_t m, const char *path, size_t o, int visible, int logs)
{
    (void)name, (void)n, (void)token, (void)m, (void)path, (void)o, (void)visible, (void)logs;
    return made();
}
PLAIN("enter-continuous-time-mode", enter_continuous)
METHOD("set-time") Enum set_time(void *self, double time) { (void)self; own.time = time; return OK; }
METHOD("set-continuous-states") Enum set_states(void *self, const double *x, size_t n) { (void)self, (void)n; own.x = *x, top = 0; return OK; }
static void *one(double value) { return result.room[0] = value, listed(result.room, 1); }
METHOD("get-continuous-states") void *states(void *self) { (void)self; return one(own.x); }
METHOD("get-continuous-state-derivatives") void *slopes(void *self) { (void)self; return one(happened() == OK ? own.slope : 0.0); }
METHOD("get-nominals-of-continuous-states") void *nominals(void *self) { (void)self; return one(1.0); }
METHOD("get-event-indicators") void *indicators(void *self) { (void)self; return one(own.slope > 0.0 ? 0.5 - own.x : 1.0); }
static void *number(uint64_t n) { *(uint64_t *)(result.answer + 2) = n; return answered(false, 8, OK); }
METHOD("get-number-of-continuous-states") void *n_states(void *self) { (void)self; return number(1); }
METHOD("get-number-of-event-indicators") void *n_indicators(void *self) { (void)self; return number(1); }
METHOD("completed-integrator-step") void *completed(void *self, int kept) { (void)self, (void)kept; result.answer[1] = 0; return answered(false, 4, OK); }
#else
STATIC("instantiate-co-simulation")
void *make(const char *name, size_t n, const char *token, size_t m, const char *path, size_t o, int visible, int logs,
           int events, int early, const uint32_t *between, size_t p)
{
    (void)name, (void)n, (void)token, (void)m, (void)path, (void)o, (void)visible, (void)logs, (void)events, (void)early;
    (void)between, (void)p;
    return made();
}
IGNORED("set-input-derivatives", set_derivatives)
METHOD("do-step") void *step(void *self, double time, double size, int kept)
{
    uint32_t status = happened();

    (void)self, (void)kept;
    if (status != OK) return answered(true, 8, status);
    memcpy(own.out, own.in, sizeof own.in);
    memcpy(own.text_out, own.text_in, sizeof own.text_in);
    memcpy(own.size_out, own.size_in, sizeof own.size_in);
    own.x += size * *(double *)&own.in[1];
    own.time = time + size;
    memset(result.answer, 0, sizeof result.answer);
    *(double *)(result.answer + 2) = own.time;
    return answered(false, 8, OK);
}
#endif
