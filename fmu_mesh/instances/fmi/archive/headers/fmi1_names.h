/* SPDX-License-Identifier: Apache-2.0
 *
 * FMI 1.0 under its own names, for sources without the standard's headers, which an FMU need not bring (FMI 1.0 for
 * model exchange, 3; for co-simulation, 4). FMPy has the types under names that begin with fmi1.
 */
#ifndef FMI1_NAMES_H
#define FMI1_NAMES_H

#include <stddef.h>

#include "fmi1Functions.h"

typedef fmi1Component fmiComponent;
typedef fmi1ValueReference fmiValueReference;
typedef fmi1Real fmiReal;
typedef fmi1Integer fmiInteger;
typedef fmi1Boolean fmiBoolean;
typedef fmi1String fmiString;
typedef fmi1Status fmiStatus;
typedef fmi1StatusKind fmiStatusKind;
typedef fmi1EventInfo fmiEventInfo;
typedef fmi1CallbackLogger fmiCallbackLogger;
typedef fmi1CallbackAllocateMemory fmiCallbackAllocateMemory;
typedef fmi1CallbackFreeMemory fmiCallbackFreeMemory;
typedef fmi1StepFinished fmiStepFinished;
typedef fmi1CallbackFunctions fmiCallbackFunctions;

#define fmiTrue fmi1True
#define fmiFalse fmi1False
#define fmiUndefinedValueReference fmi1UndefinedValueReference
#define fmiOK fmi1OK
#define fmiWarning fmi1Warning
#define fmiDiscard fmi1Discard
#define fmiError fmi1Error
#define fmiFatal fmi1Fatal
#define fmiPending ((fmiStatus)5)
#define fmiDoStepStatus fmi1DoStepStatus
#define fmiPendingStatus fmi1PendingStatus
#define fmiLastSuccessfulTime fmi1LastSuccessfulTime

#define fmiPlatform "standard32"
#define fmiModelTypesPlatform "standard32"
#define fmiVersion "1.0"

/* The sources define MODEL_IDENTIFIER before they include a header of the standard. */
#define fmiPaste(a, b) a##b
#define fmiPasteB(a, b) fmiPaste(a, b)
#define fmiFullName(name) fmiPasteB(MODEL_IDENTIFIER, name)

#define DllExport __attribute__((visibility("default")))

#define fmiGetVersion fmiFullName(_fmiGetVersion)
#define fmiSetDebugLogging fmiFullName(_fmiSetDebugLogging)
#define fmiSetReal fmiFullName(_fmiSetReal)
#define fmiSetInteger fmiFullName(_fmiSetInteger)
#define fmiSetBoolean fmiFullName(_fmiSetBoolean)
#define fmiSetString fmiFullName(_fmiSetString)
#define fmiGetReal fmiFullName(_fmiGetReal)
#define fmiGetInteger fmiFullName(_fmiGetInteger)
#define fmiGetBoolean fmiFullName(_fmiGetBoolean)
#define fmiGetString fmiFullName(_fmiGetString)

DllExport const char *fmiGetVersion(void);
DllExport fmi1SetDebugLoggingTYPE fmiSetDebugLogging;
DllExport fmi1SetRealTYPE fmiSetReal;
DllExport fmi1SetIntegerTYPE fmiSetInteger;
DllExport fmi1SetBooleanTYPE fmiSetBoolean;
DllExport fmi1SetStringTYPE fmiSetString;
DllExport fmi1GetRealTYPE fmiGetReal;
DllExport fmi1GetIntegerTYPE fmiGetInteger;
DllExport fmi1GetBooleanTYPE fmiGetBoolean;
DllExport fmi1GetStringTYPE fmiGetString;

#endif
