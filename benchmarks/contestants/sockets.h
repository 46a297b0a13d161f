/* A pair of TCP sockets over loopback, and waiting for bytes without sleeping. */
#include <errno.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sched.h>
#include <sys/socket.h>
#include <unistd.h>

/* The two ends of a connection; false if there is none. */
static int tcp_pair(int ends[2]) {
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    socklen_t size = sizeof address;
    int listener = socket(AF_INET, SOCK_STREAM, 0), on = 1;
    if (listener < 0 || bind(listener, (struct sockaddr *)&address, size) != 0 || listen(listener, 1) != 0 ||
        getsockname(listener, (struct sockaddr *)&address, &size) != 0)
        return 0;
    ends[0] = socket(AF_INET, SOCK_STREAM, 0);
    if (ends[0] < 0 || connect(ends[0], (struct sockaddr *)&address, size) != 0) return 0;
    ends[1] = accept(listener, NULL, NULL);
    if (ends[1] < 0) return 0;
    setsockopt(ends[0], IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
    setsockopt(ends[1], IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
    close(listener);
    return 1;
}

/* All bytes, as soon as they are there; false if the other side has ended. From time to time, others may run. */
static int receive_spinning(int end, void *data, size_t size) {
    for (size_t had = 0, round = 1; had < size; round++) {
        ssize_t got = recv(end, (char *)data + had, size - had, MSG_DONTWAIT);
        if (got > 0)
            had += (size_t)got;
        else if (got == 0 || (errno != EAGAIN && errno != EWOULDBLOCK && errno != EINTR))
            return 0;
        else if (round % 100 == 0)
            sched_yield();
    }
    return 1;
}
