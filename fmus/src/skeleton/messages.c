/* SPDX-License-Identifier: Apache-2.0
 *
 * Messages to the importer, and the check that a function may be called now.
 */
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#include "instance.h"

#define MESSAGE_SIZE 512

static const char *category_of(fmi2Status status)
{
    switch (status) {
    case fmi2Error: return "logStatusError";
    case fmi2Discard: return "logStatusDiscard";
    default: return "logAll";
    }
}

/* The logger takes a printf format, so a percent sign in a finished message has to be doubled. */
static void escape_percent(const char *from, char *to, size_t size)
{
    size_t used = 0;
    for (; *from != '\0' && used + 2 < size; ++from) {
        if (*from == '%') to[used++] = '%';
        to[used++] = *from;
    }
    to[used] = '\0';
}

fmi2Status report(Instance *instance, fmi2Status status, const char *format, ...)
{
    char text[MESSAGE_SIZE], message[2 * MESSAGE_SIZE];
    va_list arguments;

    /* FMI 2.0.4, 2.1.3: after an error the simulation cannot go on with this instance. */
    if (status == fmi2Error) instance->progress.mode = MODE_ERROR;
    if (instance->logger == NULL) return status;
    va_start(arguments, format);
    vsnprintf(text, sizeof text, format, arguments);
    va_end(arguments);
    escape_percent(text, message, sizeof message);
    instance->logger(instance->environment, instance->name, status, category_of(status), message);
    return status;
}

const char *mode_name(Mode mode)
{
    switch (mode) {
    case MODE_INSTANTIATED: return "instantiated";
    case MODE_INITIALIZATION: return "initialization mode";
    case MODE_STEP_COMPLETE: return "step complete";
    case MODE_STEP_FAILED: return "step failed";
    case MODE_TERMINATED: return "terminated";
    case MODE_ERROR: return "error";
    }
    return "unknown";
}

Instance *called(fmi2Component component, const char *function, unsigned allowed_modes)
{
    Instance *instance = component;

    if (instance == NULL) return NULL;
    if (instance->debug) report(instance, fmi2OK, "%s", function);
    if ((instance->progress.mode & allowed_modes) == 0) {
        report(instance, fmi2Error, "%s: not allowed in the state \"%s\"", function,
               mode_name(instance->progress.mode));
        return NULL;
    }
    return instance;
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean loggingOn, size_t nCategories,
                               const fmi2String categories[])
{
    static const char *const known[] = {"logStatusError", "logStatusDiscard", "logAll"};
    Instance *instance = called(c, "fmi2SetDebugLogging", ANY_MODE);
    bool all = nCategories == 0;

    if (instance == NULL) return fmi2Error;
    for (size_t i = 0; i < nCategories; ++i) {
        size_t k = 0;
        while (k < 3 && strcmp(categories[i], known[k]) != 0) ++k;
        if (k == 3)
            return report(instance, fmi2Error, "fmi2SetDebugLogging: unknown log category \"%s\"",
                          categories[i]);
        all = all || k == 2;
    }
    /* Errors and discarded steps are always reported; debug logging adds the calls. */
    instance->debug = loggingOn && all;
    return fmi2OK;
}
