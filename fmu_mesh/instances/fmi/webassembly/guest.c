/* The part of a sandbox that is compiled with the sources of an FMU for WebAssembly: it gives them the callbacks of FMI,
 * and `host.c` a few functions without pointers to functions. -DFMI=2 or 3, -DPREFIX=name: as in `name_fmi2DoStep`. */
#include <errno.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define OURS(NAME) __attribute__((export_name("fmu_mesh_" #NAME)))
#define FROM_HOST(NAME) __attribute__((import_module("fmu_mesh"), import_name(#NAME)))
#define JOINED(A, B) A##_##B
#define PREFIXED(A, B) JOINED(A, B)
#define PAGE 65536u

FROM_HOST(log) void host_log(int32_t status, const char *category, const char *text);
FROM_HOST(out_of_memory) void out_of_memory(uint32_t size);

/* ---- memory: blocks of some sizes, four to each power of two, and a list of those that are free for each size. That of
 * the C library says nothing when there is no more, and many an FMU does not look; and where it has what it knows is its
 * own affair. */

typedef struct Block {
    struct Block *next; /* while it is free */
    uint32_t kind, start; /* 0, or how far the memory begins behind the one that was allocated */
} Block;

static Block *free_blocks[128];
static uintptr_t top;

void *malloc(size_t size)
{
    size_t whole = (size < 16 ? 16 : size) + sizeof(Block), step, there;
    uint32_t bits, kind;
    Block *own;

    if (whole < size || whole > INT32_MAX) return out_of_memory(size), errno = ENOMEM, NULL;
    bits = 31 - (uint32_t)__builtin_clz((uint32_t)whole - 1);
    step = (size_t)1 << (bits - 2);
    whole = (whole + step - 1) / step * step;
    kind = bits * 4 + (uint32_t)((whole >> (bits - 2)) - 4);
    own = free_blocks[kind];
    if (own != NULL) {
        free_blocks[kind] = own->next;
        return own + 1;
    }
    if (top == 0) top = (uintptr_t)__builtin_wasm_memory_size(0) * PAGE;
    whole = (whole + 15) & ~(size_t)15;
    there = (size_t)__builtin_wasm_memory_size(0) * PAGE;
    if (top + whole < top ||
        (top + whole > there && __builtin_wasm_memory_grow(0, (top + whole - there + PAGE - 1) / PAGE) == SIZE_MAX))
        return out_of_memory(size), errno = ENOMEM, NULL;
    own = (Block *)top;
    top += whole;
    *own = (Block){NULL, kind, 0};
    return own + 1;
}

void free(void *given)
{
    Block *own = (Block *)given - 1;

    if (given == NULL) return;
    own = (Block *)((char *)own - own->start);
    if (own->kind >= 128) __builtin_trap(); /* it was not allocated, or is overwritten */
    own->next = free_blocks[own->kind];
    free_blocks[own->kind] = own;
}

void *calloc(size_t count, size_t size)
{
    size_t whole;
    void *made = __builtin_mul_overflow(count, size, &whole) ? malloc(SIZE_MAX) : malloc(whole);

    return made == NULL ? NULL : memset(made, 0, whole);
}

size_t malloc_usable_size(void *given)
{
    const Block *own = (const Block *)given - 1, *first = (const Block *)((const char *)own - own->start);

    return ((size_t)(4 + first->kind % 4) << (first->kind / 4 - 2)) - sizeof(Block) - own->start;
}

void *realloc(void *given, size_t size)
{
    size_t old = given != NULL ? malloc_usable_size(given) : 0;
    void *made = given;

    if (given != NULL && size <= old) return given;
    made = malloc(size);
    if (made == NULL || given == NULL) return made;
    memcpy(made, given, old);
    free(given);
    return made;
}

void *aligned_alloc(size_t alignment, size_t size)
{
    char *made = alignment <= 16 ? malloc(size) : malloc(size + alignment + sizeof(Block));
    size_t more = (alignment - (uintptr_t)made % alignment) % alignment;

    if (made == NULL || alignment <= 16 || more == 0) return made;
    ((Block *)(made + more))[-1] = (Block){NULL, 0, (uint32_t)more};
    return made + more;
}

int posix_memalign(void **made, size_t alignment, size_t size)
{
    return (*made = aligned_alloc(alignment, size)) == NULL ? ENOMEM : 0;
}

/* ---- what the host calls */

/* Where it puts arguments: room for `size` bytes until it asks for more. */
OURS(room) void *room(uint32_t size)
{
    static void *own;

    free(own);
    return own = malloc(size);
}

#if FMI == 2
static void log_message(void *environment, const char *name, int status, const char *category, const char *format, ...)
{
    char text[4096];
    va_list values;

    (void)environment;
    (void)name;
    va_start(values, format);
    vsnprintf(text, sizeof text, format, values);
    va_end(values);
    host_log(status, category, text);
}

static const struct {
    void (*log)(void *, const char *, int, const char *, const char *, ...);
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*finished)(void *, int);
    void *environment;
} callbacks = {log_message, calloc, free, NULL, NULL};

#define MAKES(NAME) __attribute__((weak)) void *NAME(const char *, int, const char *, const char *, const void *, int, int)
MAKES(fmi2Instantiate);
MAKES(PREFIXED(PREFIX, fmi2Instantiate));

OURS(instantiate)
void *instantiate(int type, const char *name, const char *guid, const char *resources, int visible, int logs)
{
    return (fmi2Instantiate ? fmi2Instantiate : PREFIXED(PREFIX, fmi2Instantiate))(name, type, guid, resources,
                                                                                   &callbacks, visible, logs);
}
#else
static void log_message(void *environment, int status, const char *category, const char *text)
{
    (void)environment;
    host_log(status, category, text);
}

typedef void Log(void *, int, const char *, const char *);
__attribute__((weak)) void *fmi3InstantiateCoSimulation(const char *, const char *, const char *, bool, bool, bool, bool,
                                                        const uint32_t *, size_t, void *, Log *, void *);
__attribute__((weak)) void *fmi3InstantiateModelExchange(const char *, const char *, const char *, bool, bool, void *,
                                                         Log *);

OURS(instantiate)
void *instantiate(int type, const char *name, const char *guid, const char *resources, int visible, int logs, int events,
                  int early)
{
    if (type == 0) return fmi3InstantiateModelExchange(name, guid, resources, visible, logs, NULL, log_message);
    return fmi3InstantiateCoSimulation(name, guid, resources, visible, logs, events, early, NULL, 0, NULL, log_message,
                                       NULL);
}
#endif
