/* SPDX-License-Identifier: Apache-2.0
 *
 * Looks at what its process may do to the host: each output is 1 if it could. The environment says where:
 * FMU_MESH_PRY_SECRET is a file to read, FMU_MESH_PRY_OUTSIDE one to write, FMU_MESH_PRY_PORT a port of TCP, and
 * FMU_MESH_PRY_PROCESS a process. In its steps it takes memory, processor time and descriptors.
 */
#define _GNU_SOURCE

#include <arpa/inet.h>
#include <fcntl.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "model.h"

#define PAGE_BYTES 4096
#define MEBIBYTE (1 << 20)

struct ModelState {
    double shadow, secret, outside, network, process, relative;
    double grow; /* MiB a step, which stay */
    double burn; /* s of processor time a step */
    double open; /* descriptors a step, which stay */
    int crashes; /* without memory, as an FMU that does not look at what malloc returns */
};

static const char *given(const char *name)
{
    const char *value = getenv(name);
    return value != NULL ? value : "";
}

static double can_open(const char *path, int flags)
{
    const int descriptor = open(path, flags, 0600);
    if (descriptor >= 0) close(descriptor);
    return descriptor >= 0;
}

static double can_connect(int port)
{
    struct sockaddr_in address = {0};
    const int descriptor = socket(AF_INET, SOCK_STREAM, 0);
    int connected;

    address.sin_family = AF_INET;
    address.sin_port = htons((unsigned short)port);
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    connected = connect(descriptor, (struct sockaddr *)&address, sizeof address) == 0;
    close(descriptor);
    return connected;
}

static void calculate(ModelState *s) { (void)s; }

static fmi2Status initialise(Instance *instance, ModelState *s, double start_time)
{
    const int process = atoi(given("FMU_MESH_PRY_PROCESS"));

    (void)instance, (void)start_time;
    s->shadow = can_open("/etc/shadow", O_RDONLY);
    s->secret = can_open(given("FMU_MESH_PRY_SECRET"), O_RDONLY);
    s->outside = can_open(given("FMU_MESH_PRY_OUTSIDE"), O_WRONLY | O_CREAT);
    s->network = can_connect(atoi(given("FMU_MESH_PRY_PORT")));
    s->process = process > 1 && kill(process, 0) == 0;
    s->relative = can_open("relative.txt", O_WRONLY | O_CREAT);
    return fmi2OK;
}

static fmi2Status step(Instance *instance, ModelState *s, double time, double step_size)
{
    const clock_t end = clock() + (clock_t)(s->burn * CLOCKS_PER_SEC);
    const size_t bytes = (size_t)(s->grow * MEBIBYTE);
    volatile char *memory = bytes > 0 ? malloc(bytes) : NULL;
    size_t i;
    int count;

    (void)time, (void)step_size;
    if (bytes > 0 && memory == NULL && !s->crashes) return report(instance, fmi2Error, "there is no memory");
    for (i = 0; i < bytes; i += PAGE_BYTES) memory[i] = 1;
    for (count = 0; count < (int)s->open; count++)
        if (open("/dev/null", O_RDONLY) < 0) return report(instance, fmi2Error, "there is no descriptor");
    while (clock() < end) continue;
    return fmi2OK;
}

static const Variable variables[] = {
    REAL_VARIABLE("shadow", ROLE_CALCULATED, shadow, 0.0),
    REAL_VARIABLE("secret", ROLE_CALCULATED, secret, 0.0),
    REAL_VARIABLE("outside", ROLE_CALCULATED, outside, 0.0),
    REAL_VARIABLE("network", ROLE_CALCULATED, network, 0.0),
    REAL_VARIABLE("process", ROLE_CALCULATED, process, 0.0),
    REAL_VARIABLE("relative", ROLE_CALCULATED, relative, 0.0),
    REAL_VARIABLE("grow", ROLE_TUNABLE, grow, 0.0),
    REAL_VARIABLE("burn", ROLE_TUNABLE, burn, 0.0),
    REAL_VARIABLE("open", ROLE_TUNABLE, open, 0.0),
    BOOLEAN_VARIABLE("crashes", ROLE_FIXED, crashes, fmi2False),
};

const Model model = {
    .state_size = sizeof(ModelState),
    .variables = variables,
    .variable_count = sizeof variables / sizeof variables[0],
    .calculate = calculate,
    .initialise = initialise,
    .step = step,
};
