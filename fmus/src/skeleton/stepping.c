/* SPDX-License-Identifier: Apache-2.0
 *
 * fmi2DoStep, the questions that may follow it, and the functions that the model description denies.
 */
#include <math.h>

#include "instance.h"

/* Two communication points closer than this count as one: importers that sum up their step sizes drift. */
static double time_tolerance(double time) { return 1e-9 * fmax(1.0, fabs(time)); }

static fmi2Status check_step(Instance *instance, double time, double step_size)
{
    const Progress *progress = &instance->progress;

    /* Written so that NaN fails every comparison. */
    if (!(step_size > 0.0 && isfinite(step_size)))
        return report(instance, fmi2Error,
                      "fmi2DoStep: the communication step size is %.17g s but has to be greater than 0",
                      step_size);
    if (!(fabs(time - progress->time) <= time_tolerance(progress->time)))
        return report(instance, fmi2Error,
                      "fmi2DoStep: the current communication point is %.17g s but the instance is at %.17g s",
                      time, progress->time);
    if (progress->stop_time_defined &&
        time + step_size > progress->stop_time + time_tolerance(progress->stop_time))
        return report(instance, fmi2Error,
                      "fmi2DoStep: the step ends at %.17g s, after the stop time %.17g s", time + step_size,
                      progress->stop_time);
    return fmi2OK;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real currentCommunicationPoint, fmi2Real communicationStepSize,
                      fmi2Boolean noSetFMUStatePriorToCurrentPoint)
{
    Instance *instance = called(c, "fmi2DoStep", MODE_STEP_COMPLETE);
    fmi2Status status;

    (void)noSetFMUStatePriorToCurrentPoint;
    if (instance == NULL) return fmi2Error;
    status = check_step(instance, currentCommunicationPoint, communicationStepSize);
    if (status != fmi2OK) return status;

    status = model.step(instance, instance->state, currentCommunicationPoint, communicationStepSize);
    switch (status) {
    case fmi2OK:
    case fmi2Warning: instance->progress.time = currentCommunicationPoint + communicationStepSize; break;
    case fmi2Discard: instance->progress.mode = MODE_STEP_FAILED; break;
    default: instance->progress.mode = MODE_ERROR; break;
    }
    return status;
}

/* ---- status of a discarded step (FMI 2.0.4, 4.2.3) ---- */

#define STATUS_MODES (MODE_STEP_COMPLETE | MODE_STEP_FAILED | MODE_TERMINATED)

static fmi2Status no_such_status(fmi2Component c, const char *function)
{
    Instance *instance = called(c, function, STATUS_MODES);

    /* Asking is no error of the simulation: fmi2Discard leaves the instance usable. */
    return instance == NULL ? fmi2Error : report(instance, fmi2Discard, "%s: no such status here", function);
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind s, fmi2Real *value)
{
    Instance *instance;

    if (s != fmi2LastSuccessfulTime) return no_such_status(c, "fmi2GetRealStatus");
    instance = called(c, "fmi2GetRealStatus", STATUS_MODES);
    if (instance == NULL) return fmi2Error;
    *value = instance->progress.time;
    return fmi2OK;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind s, fmi2Boolean *value)
{
    Instance *instance;

    if (s != fmi2Terminated) return no_such_status(c, "fmi2GetBooleanStatus");
    instance = called(c, "fmi2GetBooleanStatus", STATUS_MODES);
    if (instance == NULL) return fmi2Error;
    *value = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind s, fmi2Status *value)
{
    (void)s;
    (void)value;
    return no_such_status(c, "fmi2GetStatus");
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind s, fmi2Integer *value)
{
    (void)s;
    (void)value;
    return no_such_status(c, "fmi2GetIntegerStatus");
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind s, fmi2String *value)
{
    (void)s;
    (void)value;
    return no_such_status(c, "fmi2GetStringStatus");
}

/* ---- capabilities that the model description denies ---- */

static fmi2Status not_supported(fmi2Component c, const char *function)
{
    Instance *instance = called(c, function, ANY_MODE);

    return instance == NULL
               ? fmi2Error
               : report(instance, fmi2Error, "%s: not supported, as the model description says", function);
}

fmi2Status fmi2CancelStep(fmi2Component c) { return not_supported(c, "fmi2CancelStep"); }

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                       const fmi2Integer order[], const fmi2Real value[])
{
    (void)vr;
    (void)nvr;
    (void)order;
    (void)value;
    return not_supported(c, "fmi2SetRealInputDerivatives");
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                        const fmi2Integer order[], fmi2Real value[])
{
    (void)vr;
    (void)nvr;
    (void)order;
    (void)value;
    return not_supported(c, "fmi2GetRealOutputDerivatives");
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference vUnknown_ref[],
                                        size_t nUnknown, const fmi2ValueReference vKnown_ref[], size_t nKnown,
                                        const fmi2Real dvKnown[], fmi2Real dvUnknown[])
{
    (void)vUnknown_ref;
    (void)nUnknown;
    (void)vKnown_ref;
    (void)nKnown;
    (void)dvKnown;
    (void)dvUnknown;
    return not_supported(c, "fmi2GetDirectionalDerivative");
}
