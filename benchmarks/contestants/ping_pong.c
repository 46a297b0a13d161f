/* 16 bytes there and back, `count` times, between this process and a child: ping_pong unix|tcp|memory COUNT prints
 * seconds. Through shared memory both sides spin; a number tells the other side that the bytes are there. */
#define _GNU_SOURCE
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sched.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

static void fail(const char *what) {
    perror(what);
    exit(1);
}

static void tcp_pair(int ends[2]) {
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    socklen_t size = sizeof address;
    int listener = socket(AF_INET, SOCK_STREAM, 0), on = 1;
    if (listener < 0 || bind(listener, (struct sockaddr *)&address, size) != 0 || listen(listener, 1) != 0 ||
        getsockname(listener, (struct sockaddr *)&address, &size) != 0)
        fail("listen");
    ends[0] = socket(AF_INET, SOCK_STREAM, 0);
    if (ends[0] < 0 || connect(ends[0], (struct sockaddr *)&address, size) != 0) fail("connect");
    ends[1] = accept(listener, NULL, NULL);
    if (ends[1] < 0) fail("accept");
    setsockopt(ends[0], IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
    setsockopt(ends[1], IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
    close(listener);
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

static double over_sockets(const char *transport, long count) {
    int ends[2];
    char data[16] = {0};
    if (strcmp(transport, "tcp") == 0)
        tcp_pair(ends);
    else if (socketpair(AF_UNIX, SOCK_STREAM, 0, ends) != 0)
        fail("socketpair");
    if (forked() == 0) {
        close(ends[0]);
        while (recv(ends[1], data, sizeof data, MSG_WAITALL) == (ssize_t)sizeof data)
            if (send(ends[1], data, sizeof data, MSG_NOSIGNAL) != (ssize_t)sizeof data) _exit(1);
        _exit(0);
    }
    close(ends[1]);
    double begin = now();
    for (long i = 0; i < count; i++) {
        if (send(ends[0], data, sizeof data, MSG_NOSIGNAL) != (ssize_t)sizeof data) fail("send");
        if (recv(ends[0], data, sizeof data, MSG_WAITALL) != (ssize_t)sizeof data) fail("recv");
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
    if (argc != 3) return 2;
    long count = atol(argv[2]);
    double seconds = strcmp(argv[1], "memory") == 0 ? through_memory(count) : over_sockets(argv[1], count);
    wait(NULL);
    printf("%.9f\n", seconds);
    return 0;
}
