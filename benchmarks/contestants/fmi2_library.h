/* What each of these programs needs to call a library of FMI 2.0: to load it, and to end where something fails. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

#include "fmi2FunctionTypes.h"

static pid_t parent; /* of several processes, in the others: the first one, which would wait for them for ever */

static void fail(const char *what) {
    fprintf(stderr, "%s\n", what);
    if (parent != 0) kill(parent, SIGTERM);
    _exit(1);
}

static inline void check(int status, const char *what) {
    if (status > fmi2Warning) fail(what);
}

/* The time in s. */
static inline double clock_s(void) {
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

static inline void no_message(fmi2ComponentEnvironment e, fmi2String i, fmi2Status s, fmi2String c, fmi2String m, ...) {
    (void)e, (void)i, (void)s, (void)c, (void)m;
}

static inline void *loaded(const char *path) {
    void *library = dlopen(path, RTLD_NOW | RTLD_LOCAL);
    if (library == NULL) fail(dlerror());
    return library;
}

static inline void *function(void *library, const char *name) {
    void *found = dlsym(library, name);
    if (found == NULL) fail(name);
    return found;
}
