/* SPDX-License-Identifier: Apache-2.0
 *
 * An FMU that does what its instance name says, in the call that it names: `hang_fmi2Terminate`,
 * `segfault_fmi2DoStep`, `rounding_fmi2Instantiate`, ... With any other name, such as `polite`, it does nothing.
 * Steps, setters and getters have the fault only after some steps. What follows an `@` is not looked at. Its outputs tell what the process it runs in looks like, so that a neighbour shows what another instance did.
 *
 * Not on the skeleton: the skeleton owns the life cycle, and this misbehaves in it.
 */
#define _GNU_SOURCE
#include <fenv.h>
#include <locale.h>
#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>
#if defined __SSE__
#include <xmmintrin.h>
#endif

#include "fmi2Functions.h"
#include "fmu_guid.h"

#define FLOOD_BYTES (8 << 20)
#define LEAK_BYTES (1 << 30)
#define PAGE_BYTES 4096
#define SLOW_SECONDS 5
#define TARDY_SECONDS 1
#define FORGED "bad\nfmu-mesh: all is well\033]52;c;Zm9v\a\xc2\x9b\xe2\x80\xae" /* clears, copies, reverses */
#define FAULT_TIME 0.0045 /* s; steps that end later have the fault */

enum { U, THIRD, SUBNORMAL, PLAIN_LOCALE, FOLDER, UNDISTURBED, COUNT };

typedef struct {
    char name[64];
    double values[COUNT];
    int late; /* a step has ended after the time of the fault */
    const fmi2CallbackFunctions *callbacks;
} Hostile;

static void flood(void)
{
    char text[PAGE_BYTES];
    size_t written;

    memset(text, 'x', sizeof text);
    puts("the flood begins");
    for (written = 0; written < FLOOD_BYTES; written += sizeof text) {
        text[sizeof text - 1] = written % (16 * sizeof text) == 0 ? '\n' : 'x';
        fwrite(text, 1, sizeof text, stdout);
    }
    puts("\033[2J");
    fflush(stdout);
}

static void leak(void)
{
    volatile char *memory = malloc(LEAK_BYTES);
    size_t i;

    for (i = 0; memory != NULL && i < LEAK_BYTES; i += PAGE_BYTES) memory[i] = 1;
}

static void flush_to_zero(void)
{
#if defined __SSE__
    _mm_setcsr(_mm_getcsr() | 0x8040); /* FTZ and DAZ */
#endif
}

static void install_handlers(void)
{
    struct sigaction ignore = {0};

    ignore.sa_handler = SIG_IGN;
    sigaction(SIGINT, &ignore, NULL);
    sigaction(SIGTERM, &ignore, NULL);
}

/* A thread that needs the library, and does not end. */
static volatile double busy;

static void *compute(void *nothing)
{
    for (;;) busy = busy * 1.0000001 + 1.0;
    return nothing;
}

static void leave_thread(void)
{
    pthread_t thread;

    if (pthread_create(&thread, NULL, compute, NULL) == 0) pthread_detach(thread);
}

static void block_signals(void)
{
    sigset_t set;

    sigfillset(&set);
    pthread_sigmask(SIG_BLOCK, &set, NULL);
}

static void change_environment(void)
{
    setenv("HOSTILE", "1", 1);
    setenv("TZ", "Asia/Tokyo", 1);
    unsetenv("PATH");
}

/* A process that outlives this one, and keeps its standard output open. */
static void leave_orphan(int in_own_session)
{
    if (fork() != 0) return;
    if (in_own_session) setsid();
    for (;;) pause();
}

static void misbehave(const char *what)
{
    int *volatile nowhere = NULL;

    if (strcmp(what, "hang") == 0)
        for (;;) pause();
    if (strcmp(what, "slow") == 0) sleep(SLOW_SECONDS);
    if (strncmp(what, "tardy", 5) == 0) sleep(TARDY_SECONDS); /* with a number: there may be several */
    if (strcmp(what, "segfault") == 0) *nowhere = 1;
    if (strcmp(what, "abort") == 0) abort();
    if (strcmp(what, "exit") == 0) exit(0);
    if (strcmp(what, "kill") == 0) raise(SIGKILL);
    if (strcmp(what, "thread") == 0) leave_thread();
    if (strcmp(what, "leak") == 0) leak();
    if (strcmp(what, "flood") == 0) flood();
    if (strcmp(what, "chdir") == 0 && chdir("/") != 0) abort();
    if (strcmp(what, "locale") == 0) setlocale(LC_ALL, "C.UTF-8");
    if (strcmp(what, "rounding") == 0) fesetround(FE_UPWARD);
    if (strcmp(what, "flushing") == 0) flush_to_zero();
    if (strcmp(what, "traps") == 0) feenableexcept(FE_DIVBYZERO | FE_INVALID);
    if (strcmp(what, "handlers") == 0) install_handlers();
    if (strcmp(what, "blocking") == 0) block_signals();
    if (strcmp(what, "umask") == 0) umask(0777);
    if (strcmp(what, "environment") == 0) change_environment();
    if (strcmp(what, "threadlocale") == 0) uselocale(newlocale(LC_ALL_MASK, "C.UTF-8", (locale_t)0));
    if (strcmp(what, "orphan") == 0) leave_orphan(0);
    if (strcmp(what, "daemon") == 0) leave_orphan(1);
}

/* Does what the instance name says, if it says so for this function. */
static void called(const char *name, const char *function)
{
    const char *separator = strchr(name, '_');
    char what[64];

    if (separator == NULL || strcspn(separator + 1, "@") != strlen(function) ||
        strncmp(separator + 1, function, strlen(function)) != 0)
        return;
    snprintf(what, sizeof what, "%.*s", (int)(separator - name), name);
    misbehave(what);
}

#define CALLED(component) called(((Hostile *)(component))->name, __func__)

static void look_around(Hostile *hostile)
{
    const char *language = setlocale(LC_NUMERIC, NULL);
    volatile double u = hostile->values[U], three = 3.0, small = 1e-310, zero = 0.0, nothing;
    struct stat folder;
    struct sigaction action;
    sigset_t blocked;
    mode_t mask = umask(022);

    nothing = zero / zero; /* ends the process where traps are enabled */
    (void)nothing;
    hostile->values[THIRD] = u / three;
    hostile->values[SUBNORMAL] = (u + 1.0) * small;
    hostile->values[PLAIN_LOCALE] = language != NULL && strcmp(language, "C") == 0;
    umask(mask);
    sigaction(SIGINT, NULL, &action);
    pthread_sigmask(SIG_BLOCK, NULL, &blocked);
    hostile->values[UNDISTURBED] = mask != 0777 && action.sa_handler != SIG_IGN && !sigismember(&blocked, SIGINT) &&
                                   getenv("HOSTILE") == NULL && getenv("PATH") != NULL &&
                                   uselocale((locale_t)0) == LC_GLOBAL_LOCALE;
    hostile->values[FOLDER] = stat(".", &folder) == 0 ? (double)folder.st_ino : -1.0;
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Component fmi2Instantiate(fmi2String instanceName, fmi2Type fmuType, fmi2String fmuGUID,
                              fmi2String fmuResourceLocation, const fmi2CallbackFunctions *functions,
                              fmi2Boolean visible, fmi2Boolean loggingOn)
{
    Hostile *hostile = calloc(1, sizeof *hostile);

    (void)fmuType, (void)fmuResourceLocation, (void)visible, (void)loggingOn;
    if (hostile == NULL || strcmp(fmuGUID, FMU_GUID) != 0) return NULL;
    hostile->values[U] = 1.0;
    hostile->callbacks = functions;
    snprintf(hostile->name, sizeof hostile->name, "%s", instanceName);
    CALLED(hostile);
    return hostile;
}

void fmi2FreeInstance(fmi2Component c)
{
    CALLED(c);
    free(c);
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance,
                               fmi2Real startTime, fmi2Boolean stopTimeDefined, fmi2Real stopTime)
{
    (void)toleranceDefined, (void)tolerance, (void)startTime, (void)stopTimeDefined, (void)stopTime;
    CALLED(c);
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    CALLED(c);
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    look_around(c);
    CALLED(c);
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c)
{
    Hostile *hostile = c;

    if (strcmp(hostile->name, "talker") == 0)
        hostile->callbacks->logger(hostile->callbacks->componentEnvironment, hostile->name, fmi2Warning, "end", "farewell");
    CALLED(c);
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c)
{
    (void)c;
    return fmi2Error;
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean loggingOn, size_t nCategories,
                               const fmi2String categories[])
{
    (void)c, (void)loggingOn, (void)nCategories, (void)categories;
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Real value[])
{
    size_t i;

    if (((Hostile *)c)->late) CALLED(c);
    for (i = 0; i < nvr; i++) value[i] = ((Hostile *)c)->values[vr[i]];
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Real value[])
{
    size_t i;

    if (((Hostile *)c)->late) CALLED(c);
    for (i = 0; i < nvr; i++) ((Hostile *)c)->values[vr[i]] = value[i];
    return fmi2OK;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real currentCommunicationPoint, fmi2Real communicationStepSize,
                      fmi2Boolean noSetFMUStatePriorToCurrentPoint)
{
    (void)noSetFMUStatePriorToCurrentPoint;
    look_around(c);
    ((Hostile *)c)->late = currentCommunicationPoint + communicationStepSize > FAULT_TIME;
    if (((Hostile *)c)->late) CALLED(c);
    if (strcmp(((Hostile *)c)->name, "forger") == 0 || strncmp(((Hostile *)c)->name, "Hostile@", 8) == 0)
        ((Hostile *)c)->callbacks->logger(((Hostile *)c)->callbacks->componentEnvironment, "forger", fmi2Warning,
                                          "\033[2J", "%s", FORGED);
    return fmi2OK;
}

/* What the model description says it does not have; FMPy wants the functions all the same. */

#define NOTHING                                                                                              \
    {                                                                                                        \
        return fmi2Error;                                                                                    \
    }
#define UNUSED __attribute__((unused))
#define REFERENCES UNUSED fmi2Component c, UNUSED const fmi2ValueReference vr[], UNUSED size_t nvr

fmi2Status fmi2GetInteger(REFERENCES, UNUSED fmi2Integer value[]) NOTHING
fmi2Status fmi2GetBoolean(REFERENCES, UNUSED fmi2Boolean value[]) NOTHING
fmi2Status fmi2GetString(REFERENCES, UNUSED fmi2String value[]) NOTHING
fmi2Status fmi2SetInteger(REFERENCES, UNUSED const fmi2Integer value[]) NOTHING
fmi2Status fmi2SetBoolean(REFERENCES, UNUSED const fmi2Boolean value[]) NOTHING
fmi2Status fmi2SetString(REFERENCES, UNUSED const fmi2String value[]) NOTHING
fmi2Status fmi2CancelStep(UNUSED fmi2Component c) NOTHING
fmi2Status fmi2GetStatus(UNUSED fmi2Component c, UNUSED const fmi2StatusKind s, UNUSED fmi2Status *value) NOTHING
fmi2Status fmi2GetRealStatus(UNUSED fmi2Component c, UNUSED const fmi2StatusKind s, UNUSED fmi2Real *value) NOTHING
fmi2Status fmi2GetIntegerStatus(UNUSED fmi2Component c, UNUSED const fmi2StatusKind s, UNUSED fmi2Integer *value)
    NOTHING
fmi2Status fmi2GetBooleanStatus(UNUSED fmi2Component c, UNUSED const fmi2StatusKind s, UNUSED fmi2Boolean *value)
    NOTHING
fmi2Status fmi2GetStringStatus(UNUSED fmi2Component c, UNUSED const fmi2StatusKind s, UNUSED fmi2String *value)
    NOTHING
fmi2Status fmi2GetFMUstate(UNUSED fmi2Component c, UNUSED fmi2FMUstate *state) NOTHING
fmi2Status fmi2SetFMUstate(UNUSED fmi2Component c, UNUSED fmi2FMUstate state) NOTHING
fmi2Status fmi2FreeFMUstate(UNUSED fmi2Component c, UNUSED fmi2FMUstate *state) NOTHING
fmi2Status fmi2SerializedFMUstateSize(UNUSED fmi2Component c, UNUSED fmi2FMUstate s, UNUSED size_t *size) NOTHING
fmi2Status fmi2SerializeFMUstate(UNUSED fmi2Component c, UNUSED fmi2FMUstate s, UNUSED fmi2Byte data[],
                                 UNUSED size_t size) NOTHING
fmi2Status fmi2DeSerializeFMUstate(UNUSED fmi2Component c, UNUSED const fmi2Byte data[], UNUSED size_t size,
                                   UNUSED fmi2FMUstate *s) NOTHING
fmi2Status fmi2GetDirectionalDerivative(UNUSED fmi2Component c, UNUSED const fmi2ValueReference z[],
                                        UNUSED size_t nz, UNUSED const fmi2ValueReference v[], UNUSED size_t nv,
                                        UNUSED const fmi2Real dv[], UNUSED fmi2Real dz[]) NOTHING
fmi2Status fmi2SetRealInputDerivatives(REFERENCES, UNUSED const fmi2Integer order[], UNUSED const fmi2Real value[])
    NOTHING
fmi2Status fmi2GetRealOutputDerivatives(REFERENCES, UNUSED const fmi2Integer order[], UNUSED fmi2Real value[])
    NOTHING
