/* 16 bytes there and back, `count` times, between this process and a child: ping_pong unix|tcp COUNT prints seconds. */
#define _GNU_SOURCE
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
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

int main(int argc, char **argv) {
    int ends[2];
    char data[16] = {0};
    if (argc != 3) return 2;
    if (strcmp(argv[1], "tcp") == 0)
        tcp_pair(ends);
    else if (socketpair(AF_UNIX, SOCK_STREAM, 0, ends) != 0)
        fail("socketpair");
    long count = atol(argv[2]);
    pid_t child = fork();
    if (child < 0) fail("fork");
    if (child == 0) {
        close(ends[0]);
        while (recv(ends[1], data, sizeof data, MSG_WAITALL) == (ssize_t)sizeof data)
            if (send(ends[1], data, sizeof data, MSG_NOSIGNAL) != (ssize_t)sizeof data) return 1;
        return 0;
    }
    close(ends[1]);
    struct timespec start, end;
    clock_gettime(CLOCK_MONOTONIC, &start);
    for (long i = 0; i < count; i++) {
        if (send(ends[0], data, sizeof data, MSG_NOSIGNAL) != (ssize_t)sizeof data) fail("send");
        if (recv(ends[0], data, sizeof data, MSG_WAITALL) != (ssize_t)sizeof data) fail("recv");
    }
    clock_gettime(CLOCK_MONOTONIC, &end);
    close(ends[0]);
    waitpid(child, NULL, 0);
    printf("%.9f\n", (double)(end.tv_sec - start.tv_sec) + 1e-9 * (double)(end.tv_nsec - start.tv_nsec));
    return 0;
}
