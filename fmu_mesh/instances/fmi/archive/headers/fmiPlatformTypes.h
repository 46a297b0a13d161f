/* SPDX-License-Identifier: Apache-2.0 */
#include "fmi1_names.h"
