/* SPDX-License-Identifier: Apache-2.0
 *
 * The functions of FMI 3.0 that a test FMU does not have: a loader wants all of them, and calling one is an error.
 * Include it at the end of the C file, after defining HAS_ALL_TYPES, HAS_CONFIGURATION_MODE or HAS_EVENT_MODE for what is
 * there.
 */
#define VR const fmi3ValueReference vr[], size_t n
#define REFUSED { return fmi3Error; }
#if defined __GNUC__
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

#ifndef HAS_ALL_TYPES /* only Float64 is there */
#define REFUSED_TYPE(Name) \
    fmi3Status fmi3Get##Name(fmi3Instance i, VR, fmi3##Name values[], size_t count) REFUSED \
    fmi3Status fmi3Set##Name(fmi3Instance i, VR, const fmi3##Name values[], size_t count) REFUSED
REFUSED_TYPE(Float32)
REFUSED_TYPE(Int8)
REFUSED_TYPE(UInt8)
REFUSED_TYPE(Int16)
REFUSED_TYPE(UInt16)
REFUSED_TYPE(Int32)
REFUSED_TYPE(UInt32)
REFUSED_TYPE(Int64)
REFUSED_TYPE(UInt64)
REFUSED_TYPE(Boolean)
REFUSED_TYPE(String)
fmi3Status fmi3GetBinary(fmi3Instance i, VR, size_t sizes[], fmi3Binary values[], size_t count) REFUSED
fmi3Status fmi3SetBinary(fmi3Instance i, VR, const size_t sizes[], const fmi3Binary values[], size_t count) REFUSED
#endif

#ifndef HAS_CONFIGURATION_MODE
fmi3Status fmi3EnterConfigurationMode(fmi3Instance i) REFUSED
fmi3Status fmi3ExitConfigurationMode(fmi3Instance i) REFUSED
#endif

#ifndef HAS_EVENT_MODE
fmi3Status fmi3EnterEventMode(fmi3Instance i) REFUSED
fmi3Status fmi3EnterStepMode(fmi3Instance i) REFUSED
fmi3Status fmi3UpdateDiscreteStates(fmi3Instance i, fmi3Boolean *update, fmi3Boolean *terminate,
                                    fmi3Boolean *nominals, fmi3Boolean *values, fmi3Boolean *defined,
                                    fmi3Float64 *time) REFUSED
#endif

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                          fmi3Boolean logging, fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log) { return NULL; }
fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
                                               fmi3Boolean visible, fmi3Boolean logging,
                                               fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                               fmi3ClockUpdateCallback update, fmi3LockPreemptionCallback lock,
                                               fmi3UnlockPreemptionCallback unlock) { return NULL; }
fmi3Status fmi3SetDebugLogging(fmi3Instance i, fmi3Boolean on, size_t n, const fmi3String categories[]) REFUSED
fmi3Status fmi3Reset(fmi3Instance i) REFUSED
fmi3Status fmi3GetClock(fmi3Instance i, VR, fmi3Clock values[]) REFUSED
fmi3Status fmi3SetClock(fmi3Instance i, VR, const fmi3Clock values[]) REFUSED
fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance i, fmi3ValueReference vr, size_t *n) REFUSED
fmi3Status fmi3GetVariableDependencies(fmi3Instance i, fmi3ValueReference vr, size_t e[], fmi3ValueReference r[],
                                       size_t f[], fmi3DependencyKind k[], size_t n) REFUSED
fmi3Status fmi3GetFMUState(fmi3Instance i, fmi3FMUState *state) REFUSED
fmi3Status fmi3SetFMUState(fmi3Instance i, fmi3FMUState state) REFUSED
fmi3Status fmi3FreeFMUState(fmi3Instance i, fmi3FMUState *state) REFUSED
fmi3Status fmi3SerializedFMUStateSize(fmi3Instance i, fmi3FMUState state, size_t *size) REFUSED
fmi3Status fmi3SerializeFMUState(fmi3Instance i, fmi3FMUState state, fmi3Byte bytes[], size_t size) REFUSED
fmi3Status fmi3DeserializeFMUState(fmi3Instance i, const fmi3Byte bytes[], size_t size, fmi3FMUState *state) REFUSED
fmi3Status fmi3GetDirectionalDerivative(fmi3Instance i, const fmi3ValueReference u[], size_t nu,
                                        const fmi3ValueReference k[], size_t nk, const fmi3Float64 s[], size_t ns,
                                        fmi3Float64 r[], size_t nr) REFUSED
fmi3Status fmi3GetAdjointDerivative(fmi3Instance i, const fmi3ValueReference u[], size_t nu,
                                    const fmi3ValueReference k[], size_t nk, const fmi3Float64 s[], size_t ns,
                                    fmi3Float64 r[], size_t nr) REFUSED
fmi3Status fmi3GetIntervalDecimal(fmi3Instance i, VR, fmi3Float64 intervals[],
                                  fmi3IntervalQualifier qualifiers[]) REFUSED
fmi3Status fmi3GetIntervalFraction(fmi3Instance i, VR, fmi3UInt64 counters[], fmi3UInt64 resolutions[],
                                   fmi3IntervalQualifier qualifiers[]) REFUSED
fmi3Status fmi3GetShiftDecimal(fmi3Instance i, VR, fmi3Float64 shifts[]) REFUSED
fmi3Status fmi3GetShiftFraction(fmi3Instance i, VR, fmi3UInt64 counters[], fmi3UInt64 resolutions[]) REFUSED
fmi3Status fmi3SetIntervalDecimal(fmi3Instance i, VR, const fmi3Float64 intervals[]) REFUSED
fmi3Status fmi3SetIntervalFraction(fmi3Instance i, VR, const fmi3UInt64 counters[],
                                   const fmi3UInt64 resolutions[]) REFUSED
fmi3Status fmi3SetShiftDecimal(fmi3Instance i, VR, const fmi3Float64 shifts[]) REFUSED
fmi3Status fmi3SetShiftFraction(fmi3Instance i, VR, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]) REFUSED
fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance i) REFUSED
fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance i) REFUSED
fmi3Status fmi3CompletedIntegratorStep(fmi3Instance i, fmi3Boolean no_set, fmi3Boolean *event,
                                       fmi3Boolean *terminate) REFUSED
fmi3Status fmi3SetTime(fmi3Instance i, fmi3Float64 time) REFUSED
fmi3Status fmi3SetContinuousStates(fmi3Instance i, const fmi3Float64 states[], size_t n) REFUSED
fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance i, fmi3Float64 derivatives[], size_t n) REFUSED
fmi3Status fmi3GetEventIndicators(fmi3Instance i, fmi3Float64 indicators[], size_t n) REFUSED
fmi3Status fmi3GetContinuousStates(fmi3Instance i, fmi3Float64 states[], size_t n) REFUSED
fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance i, fmi3Float64 nominals[], size_t n) REFUSED
fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance i, size_t *n) REFUSED
fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance i, size_t *n) REFUSED
fmi3Status fmi3GetOutputDerivatives(fmi3Instance i, VR, const fmi3Int32 orders[], fmi3Float64 values[],
                                    size_t count) REFUSED
fmi3Status fmi3ActivateModelPartition(fmi3Instance i, fmi3ValueReference clock, fmi3Float64 time) REFUSED
