/* Bytes there and back, COUNT times, between this process and a child; it prints seconds:
 *
 *   ping_pong unix|tcp|memory COUNT                   16 bytes
 *   ping_pong unix|tcp COUNT trip|exchange BYTES      the same, but who waits spins; or both send at once, then both wait
 *
 * Through shared memory both sides spin; a number tells the other side that the bytes are there. */
#define _GNU_SOURCE
#include <signal.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <time.h>

#include "sockets.h"

enum { MOST = 4096 };

static void fail(const char *what) {
    perror(what);
    exit(1);
}

static double now(void) {
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

static pid_t forked(void) {
    pid_t child = fork();
    if (child < 0) fail("fork");
    if (child == 0) prctl(PR_SET_PDEATHSIG, SIGKILL);
    return child;
}

/* ---- over a socket */

static int spins; /* whether who waits for bytes spins */

static int send_all(int end, const char *data, size_t size) {
    return send(end, data, size, MSG_NOSIGNAL) == (ssize_t)size;
}

static int receive_all(int end, char *data, size_t size) {
    return spins ? receive_spinning(end, data, size) : recv(end, data, size, MSG_WAITALL) == (ssize_t)size;
}

static double over_sockets(const char *transport, long count, size_t size, int exchange) {
    int ends[2];
    char data[MOST] = {0};
    if (strcmp(transport, "tcp") == 0 ? !tcp_pair(ends) : socketpair(AF_UNIX, SOCK_STREAM, 0, ends) != 0)
        fail("sockets");
    if (forked() == 0) {
        close(ends[0]);
        if (exchange && !send_all(ends[1], data, size)) _exit(1);
        while (receive_all(ends[1], data, size))
            if (!send_all(ends[1], data, size)) _exit(1);
        _exit(0);
    }
    close(ends[1]);
    double begin = now();
    for (long i = 0; i < count; i++) {
        if (!send_all(ends[0], data, size)) fail("send");
        if (!receive_all(ends[0], data, size)) fail("recv");
    }
    double end = now();
    close(ends[0]);
    return end - begin;
}

/* ---- through shared memory */

typedef struct { /* a cache line: 16 bytes, and how often they were written */
    _Alignas(64) _Atomic long written;
    char data[16];
} Side;

static void put(Side *side, const char *data, long number) {
    memcpy(side->data, data, sizeof side->data);
    atomic_store_explicit(&side->written, number, memory_order_release);
}

static void take(Side *side, char *data, long number) {
    for (long round = 1; atomic_load_explicit(&side->written, memory_order_acquire) < number; round++) {
#if defined(__x86_64__)
        __builtin_ia32_pause();
#endif
        if (round % 10000 == 0) sched_yield(); /* the other side may have no core */
    }
    memcpy(data, side->data, sizeof side->data);
}

static double through_memory(long count) {
    char data[16] = {0};
    Side *sides = mmap(NULL, 2 * sizeof(Side), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (sides == MAP_FAILED) fail("mmap");
    if (forked() == 0) {
        for (long i = 0; i <= count; i++) {
            take(&sides[0], data, i + 1);
            put(&sides[1], data, i + 1);
        }
        _exit(0);
    }
    put(&sides[0], data, 1); /* the first round trip waits for the start of the child */
    take(&sides[1], data, 1);
    double begin = now();
    for (long i = 1; i <= count; i++) {
        put(&sides[0], data, i + 1);
        take(&sides[1], data, i + 1);
    }
    return now() - begin;
}

int main(int argc, char **argv) {
    if (argc != 3 && argc != 5) return 2;
    const long count = atol(argv[2]);
    const size_t size = argc == 5 ? strtoul(argv[4], NULL, 10) : 16;
    if (size < 1 || size > MOST) return 2;
    spins = argc == 5;
    const int exchange = spins && strcmp(argv[3], "exchange") == 0;
    double seconds = strcmp(argv[1], "memory") == 0 ? through_memory(count) : over_sockets(argv[1], count, size, exchange);
    wait(NULL);
    printf("%.9f\n", seconds);
    return 0;
}
