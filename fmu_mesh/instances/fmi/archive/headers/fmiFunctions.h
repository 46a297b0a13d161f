/* SPDX-License-Identifier: Apache-2.0 */
#ifndef FMIFUNCTIONS_H
#define FMIFUNCTIONS_H

#include "fmi1_names.h"

#define fmiGetTypesPlatform fmiFullName(_fmiGetTypesPlatform)
#define fmiInstantiateSlave fmiFullName(_fmiInstantiateSlave)
#define fmiInitializeSlave fmiFullName(_fmiInitializeSlave)
#define fmiTerminateSlave fmiFullName(_fmiTerminateSlave)
#define fmiResetSlave fmiFullName(_fmiResetSlave)
#define fmiFreeSlaveInstance fmiFullName(_fmiFreeSlaveInstance)
#define fmiSetRealInputDerivatives fmiFullName(_fmiSetRealInputDerivatives)
#define fmiGetRealOutputDerivatives fmiFullName(_fmiGetRealOutputDerivatives)
#define fmiCancelStep fmiFullName(_fmiCancelStep)
#define fmiDoStep fmiFullName(_fmiDoStep)
#define fmiGetStatus fmiFullName(_fmiGetStatus)
#define fmiGetRealStatus fmiFullName(_fmiGetRealStatus)
#define fmiGetIntegerStatus fmiFullName(_fmiGetIntegerStatus)
#define fmiGetBooleanStatus fmiFullName(_fmiGetBooleanStatus)
#define fmiGetStringStatus fmiFullName(_fmiGetStringStatus)

DllExport const char *fmiGetTypesPlatform(void);
DllExport fmi1InstantiateSlaveTYPE fmiInstantiateSlave;
DllExport fmi1InitializeSlaveTYPE fmiInitializeSlave;
DllExport fmi1TerminateSlaveTYPE fmiTerminateSlave;
DllExport fmi1ResetSlaveTYPE fmiResetSlave;
DllExport fmi1FreeSlaveInstanceTYPE fmiFreeSlaveInstance;
DllExport fmi1SetRealInputDerivativesTYPE fmiSetRealInputDerivatives;
DllExport fmi1GetRealOutputDerivativesTYPE fmiGetRealOutputDerivatives;
DllExport fmi1CancelStepTYPE fmiCancelStep;
DllExport fmi1DoStepTYPE fmiDoStep;
DllExport fmi1GetStatusTYPE fmiGetStatus;
DllExport fmi1GetRealStatusTYPE fmiGetRealStatus;
DllExport fmi1GetIntegerStatusTYPE fmiGetIntegerStatus;
DllExport fmi1GetBooleanStatusTYPE fmiGetBooleanStatus;
DllExport fmi1GetStringStatusTYPE fmiGetStringStatus;

#endif
