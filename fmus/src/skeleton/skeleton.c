/* SPDX-License-Identifier: Apache-2.0
 *
 * The life cycle of an FMI 2.0 co-simulation FMU, from fmi2Instantiate to fmi2FreeInstance. All data lives in
 * the instance, so any number of instances can share one process.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "fmu_guid.h"
#include "instance.h"

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }

const char *fmi2GetVersion(void) { return fmi2Version; }

/* ---- memory ---- */

void *instance_memory(const Instance *instance) { return instance->memory; }

size_t instance_memory_size(const Instance *instance) { return instance->memory_size; }

bool resize_instance_memory(Instance *instance, size_t size)
{
    void *memory;

    if (size == instance->memory_size) return true;
    if (size == 0) {
        free(instance->memory);
        memory = NULL;
    } else {
        memory = realloc(instance->memory, size);
        if (memory == NULL) return false;
        /* No byte of a stored FMU state may be left to chance. */
        if (size > instance->memory_size)
            memset((char *)memory + instance->memory_size, 0, size - instance->memory_size);
    }
    instance->memory = memory;
    instance->memory_size = size;
    return true;
}

/* ---- life cycle ---- */

static bool may_instantiate(Instance *instance, fmi2Type type, fmi2String guid)
{
    if (instance->name == NULL || instance->name[0] == '\0') {
        report(instance, fmi2Error, "fmi2Instantiate: the instance name is missing");
        return false;
    }
    if (type != fmi2CoSimulation) {
        report(instance, fmi2Error, "fmi2Instantiate: this FMU has co-simulation only");
        return false;
    }
    if (guid == NULL || strcmp(guid, FMU_GUID) != 0) {
        report(instance, fmi2Error, "fmi2Instantiate: the GUID of this FMU is %s, not %s", FMU_GUID,
               guid == NULL ? "nothing" : guid);
        return false;
    }
    return true;
}

static void start_again(Instance *instance)
{
    resize_instance_memory(instance, 0);
    memset(&instance->progress, 0, sizeof instance->progress);
    instance->progress.mode = MODE_INSTANTIATED;
    memset(instance->state, 0, model.state_size);
    apply_start_values(instance->state);
}

static char *copy_of(const char *text)
{
    char *copy = malloc(strlen(text) + 1);
    return copy == NULL ? NULL : strcpy(copy, text);
}

fmi2Component fmi2Instantiate(fmi2String instanceName, fmi2Type fmuType, fmi2String fmuGUID,
                              fmi2String fmuResourceLocation, const fmi2CallbackFunctions *functions,
                              fmi2Boolean visible, fmi2Boolean loggingOn)
{
    Instance draft = {0};
    Instance *instance;

    (void)fmuResourceLocation;
    (void)visible;
    draft.name = (char *)instanceName;
    draft.debug = loggingOn != 0;
    if (functions != NULL) {
        draft.logger = functions->logger;
        draft.environment = functions->componentEnvironment;
    }
    if (!may_instantiate(&draft, fmuType, fmuGUID)) return NULL;

    instance = calloc(1, sizeof *instance);
    if (instance != NULL) {
        *instance = draft;
        instance->name = copy_of(instanceName);
        instance->state = calloc(1, model.state_size);
    }
    if (instance == NULL || instance->name == NULL || instance->state == NULL) {
        report(&draft, fmi2Error, "fmi2Instantiate: out of memory");
        fmi2FreeInstance(instance);
        return NULL;
    }
    start_again(instance);
    return instance;
}

void fmi2FreeInstance(fmi2Component c)
{
    Instance *instance = c;

    if (instance == NULL) return;
    free(instance->memory);
    free(instance->state);
    free(instance->name);
    free(instance);
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance,
                               fmi2Real startTime, fmi2Boolean stopTimeDefined, fmi2Real stopTime)
{
    Instance *instance = called(c, "fmi2SetupExperiment", MODE_INSTANTIATED);
    Progress *progress;

    (void)toleranceDefined;
    (void)tolerance;
    if (instance == NULL) return fmi2Error;
    if (!isfinite(startTime))
        return report(instance, fmi2Error, "fmi2SetupExperiment: the start time has to be finite");
    if (stopTimeDefined && !(stopTime >= startTime))
        return report(instance, fmi2Error,
                      "fmi2SetupExperiment: the stop time %.17g s is before the start time %.17g s", stopTime,
                      startTime);
    progress = &instance->progress;
    progress->experiment_defined = true;
    progress->start_time = startTime;
    progress->stop_time_defined = stopTimeDefined != 0;
    progress->stop_time = stopTimeDefined ? stopTime : 0.0;
    progress->time = startTime;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    Instance *instance = called(c, "fmi2EnterInitializationMode", MODE_INSTANTIATED);

    if (instance == NULL) return fmi2Error;
    if (!instance->progress.experiment_defined)
        return report(instance, fmi2Error,
                      "fmi2EnterInitializationMode: fmi2SetupExperiment has to be called before");
    instance->progress.mode = MODE_INITIALIZATION;
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    Instance *instance = called(c, "fmi2ExitInitializationMode", MODE_INITIALIZATION);

    if (instance == NULL) return fmi2Error;
    if (model.initialise != NULL) {
        fmi2Status status = model.initialise(instance, instance->state, instance->progress.start_time);
        if (status != fmi2OK) {
            instance->progress.mode = MODE_ERROR;
            return fmi2Error;
        }
    }
    if (model.calculate != NULL) model.calculate(instance->state);
    instance->progress.mode = MODE_STEP_COMPLETE;
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c)
{
    Instance *instance = called(c, "fmi2Terminate", MODE_STEP_COMPLETE | MODE_STEP_FAILED);

    if (instance == NULL) return fmi2Error;
    instance->progress.mode = MODE_TERMINATED;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c)
{
    Instance *instance = called(c, "fmi2Reset", ANY_MODE);

    if (instance == NULL) return fmi2Error;
    start_again(instance);
    return fmi2OK;
}
