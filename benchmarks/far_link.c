/* A far network between two hosts on this machine: packets arrive later, some never, and only so many a second.
 *
 *   far_link PID PID DELAY_US LOST_PER_MILLION BITS_PER_S SEED
 *
 * The network namespace of each process gets a TUN device "wire", which has no address yet; a line is printed when both
 * are there. DELAY_US is for one way; 0 bits per second are no limit. It runs until it is ended, or its parent ends.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <linux/if.h>
#include <linux/if_tun.h>
#include <poll.h>
#include <sched.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/prctl.h>
#include <time.h>
#include <unistd.h>

enum { PACKETS = 1 << 15, BYTES = 1500, BATCH = 64 };
static const int64_t PATIENCE_NS = 200000000; /* a router has no room for what would wait longer for a slow line */

typedef struct {
    int64_t due;
    ssize_t size;
    char data[BYTES];
} Packet;

typedef struct { /* one way; packets leave in the order in which they came */
    int from, to;
    uint64_t first, end; /* of the packets on the way; they count up */
    int64_t line_free;   /* when a slow line has sent all that came before */
    Packet *packets;
} Way;

static void fail(const char *what) {
    perror(what);
    exit(1);
}

static int64_t now(void) {
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return time.tv_sec * INT64_C(1000000000) + time.tv_nsec;
}

/* A device in the network namespace of another process, in which this one stays. */
static int device_of(const char *pid) {
    char path[64];
    struct ifreq request = {.ifr_flags = IFF_TUN | IFF_NO_PI, .ifr_name = "wire"};
    snprintf(path, sizeof path, "/proc/%s/ns/net", pid);
    int space = open(path, O_RDONLY | O_CLOEXEC);
    if (space < 0 || setns(space, CLONE_NEWNET) != 0) fail(path);
    int device = open("/dev/net/tun", O_RDWR | O_NONBLOCK | O_CLOEXEC);
    if (device < 0 || ioctl(device, TUNSETIFF, &request) != 0) fail("/dev/net/tun");
    close(space);
    return device;
}

static uint64_t next_random(uint64_t *state) { /* splitmix64 */
    uint64_t z = (*state += UINT64_C(0x9e3779b97f4a7c15));
    z = (z ^ (z >> 30)) * UINT64_C(0xbf58476d1ce4e5b9);
    z = (z ^ (z >> 27)) * UINT64_C(0x94d049bb133111eb);
    return z ^ (z >> 31);
}

int main(int argc, char **argv) {
    if (argc != 7) return 2;
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    prctl(PR_SET_TIMERSLACK, 1);
    const int64_t delay = 1000 * atoll(argv[3]), bits_per_s = atoll(argv[5]);
    const uint64_t lost = strtoull(argv[4], NULL, 10);
    uint64_t random = strtoull(argv[6], NULL, 10);
    const int first = device_of(argv[1]), second = device_of(argv[2]);
    Way ways[2] = {{.from = first, .to = second}, {.from = second, .to = first}};
    struct pollfd devices[2] = {{.fd = first, .events = POLLIN}, {.fd = second, .events = POLLIN}};
    for (int i = 0; i < 2; i++)
        if ((ways[i].packets = malloc(PACKETS * sizeof(Packet))) == NULL) fail("malloc");
    puts("ready");
    fflush(stdout);

    for (;;) {
        int64_t next = INT64_MAX;
        int more = 0;
        for (int i = 0; i < 2; i++) {
            Way *way = &ways[i];
            /* Where there is no room, packets wait in the device. */
            for (int taken = 0; taken < BATCH && way->end - way->first < PACKETS; taken++) {
                Packet *packet = &way->packets[way->end % PACKETS];
                packet->size = read(way->from, packet->data, BYTES);
                if (packet->size < 0 && errno == EINTR) continue;
                if (packet->size <= 0) break; /* nothing is there, or the device is down */
                more |= taken + 1 == BATCH;
                if (next_random(&random) % 1000000 < lost) continue;
                int64_t sent = now();
                if (bits_per_s > 0) {
                    if (way->line_free > sent + PATIENCE_NS) continue;
                    if (way->line_free > sent) sent = way->line_free;
                    sent += packet->size * INT64_C(8000000000) / bits_per_s;
                    way->line_free = sent;
                }
                packet->due = sent + delay;
                way->end++;
            }
            for (; way->first < way->end; way->first++) {
                const Packet *packet = &way->packets[way->first % PACKETS];
                if (packet->due > now()) {
                    if (packet->due < next) next = packet->due;
                    break;
                }
                /* A device that is down takes nothing: that is a cut. */
                if (write(way->to, packet->data, (size_t)packet->size) < 0) continue;
            }
        }
        if (more) continue;
        int64_t left = next == INT64_MAX ? 0 : next - now();
        if (left < 0) left = 0;
        const struct timespec wait = {left / 1000000000, left % 1000000000};
        for (int i = 0; i < 2; i++) devices[i].events = ways[i].end - ways[i].first < PACKETS ? POLLIN : 0;
        if (ppoll(devices, 2, next == INT64_MAX ? NULL : &wait, NULL) < 0 && errno != EINTR) fail("ppoll");
    }
}
