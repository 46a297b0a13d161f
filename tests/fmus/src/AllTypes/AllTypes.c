/* SPDX-License-Identifier: Apache-2.0
 *
 * Every type of FMI 2.0 as input, output and tunable parameter. An output takes the value of its input at the
 * end of a step. `steps` counts the steps.
 */
#include <string.h>

#include "model.h"

struct ModelState {
    double real_in, real_out, real_parameter;
    int integer_in, integer_out, integer_parameter;
    int boolean_in, boolean_out, boolean_parameter;
    int enumeration_in, enumeration_out, enumeration_parameter;
    int steps;
    char string_in[TEXT_SIZE], string_out[TEXT_SIZE], string_parameter[TEXT_SIZE];
};

static void calculate(ModelState *s)
{
    s->real_out = s->real_in;
    s->integer_out = s->integer_in;
    s->boolean_out = s->boolean_in;
    s->enumeration_out = s->enumeration_in;
    memcpy(s->string_out, s->string_in, TEXT_SIZE);
}

static fmi2Status step(Instance *instance, ModelState *s, double time, double step_size)
{
    (void)instance;
    (void)time;
    (void)step_size;
    calculate(s);
    s->steps += 1;
    return fmi2OK;
}

static const Variable variables[] = {
    REAL_VARIABLE("real_in", ROLE_INPUT, real_in, 0.0),
    INTEGER_VARIABLE("integer_in", ROLE_INPUT, integer_in, 0),
    BOOLEAN_VARIABLE("boolean_in", ROLE_INPUT, boolean_in, fmi2False),
    STRING_VARIABLE("string_in", ROLE_INPUT, string_in, ""),
    INTEGER_VARIABLE("enumeration_in", ROLE_INPUT, enumeration_in, 1),
    REAL_VARIABLE("real_out", ROLE_CALCULATED, real_out, 0.0),
    INTEGER_VARIABLE("integer_out", ROLE_CALCULATED, integer_out, 0),
    BOOLEAN_VARIABLE("boolean_out", ROLE_CALCULATED, boolean_out, fmi2False),
    STRING_VARIABLE("string_out", ROLE_CALCULATED, string_out, ""),
    INTEGER_VARIABLE("enumeration_out", ROLE_CALCULATED, enumeration_out, 1),
    REAL_VARIABLE("real_parameter", ROLE_TUNABLE, real_parameter, 2.5),
    INTEGER_VARIABLE("integer_parameter", ROLE_TUNABLE, integer_parameter, 7),
    BOOLEAN_VARIABLE("boolean_parameter", ROLE_TUNABLE, boolean_parameter, fmi2True),
    STRING_VARIABLE("string_parameter", ROLE_TUNABLE, string_parameter, "start"),
    INTEGER_VARIABLE("enumeration_parameter", ROLE_TUNABLE, enumeration_parameter, 2),
    INTEGER_VARIABLE("steps", ROLE_EXACT, steps, 0),
};

const Model model = {
    .state_size = sizeof(ModelState),
    .variables = variables,
    .variable_count = sizeof variables / sizeof variables[0],
    .calculate = calculate,
    .step = step,
};
