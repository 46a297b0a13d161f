/* Model exchange: an FMU gives derivatives, and the method of Dormand and Prince of order 5(4) steps its states.
 *
 * E. Hairer, S. P. Norsett, G. Wanner: Solving Ordinary Differential Equations I (2nd edition), II.4 and II.5: the
 * coefficients (table 5.2), the norm of the error (4.11), the step size (4.13, safety 0.9, between a fifth and ten times),
 * the first step size (page 169), and the interpolant of order 4 (II.6). When a system is stiff: volume II, IV.2.
 *
 * A one-step method has no history. So an input that jumps costs one evaluation, and the step size stays what it was. No
 * step goes beyond `stop`, which is the next communication point or time event.
 *
 * One thread calls this: the one that steps the FMU. Nothing here is shared.
 *
 * What may go wrong, and what is done about it: the FMU discards an evaluation (a quarter of the step, FMI 2.0, 2.1.3), or
 * a stage is NaN (the same); at the start of a step, that ends the run. An indicator passes zero: the time is found on the
 * interpolant, as the first time at which an indicator is on the other side. Exactly 0 is not above 0 (FMI 2.0, 3.1). The
 * system is stiff: steps are as short as stability needs, which is counted. Python tells it; or, if the model `leaves`, its
 * other solver goes on there. The counts are those of steps, so this is at the same point in each run (ADR 80).
 *
 * Only additions, multiplications and divisions: `pow` of the C library differs between systems, and floats may not. */
#include <stddef.h>
#include <string.h>

#include "burst.h"

#define PUBLIC __attribute__((visibility("default")))

enum { WARNING = 1, DISCARD = 2, MISSING = 999 }; /* statuses */
enum { SET_TIME, SET_STATES, GET_STATES, GET_NOMINALS, GET_DERIVATIVES, GET_INDICATORS, COMPLETED_STEP, ENTER_EVENT_MODE };
enum { UPDATE_DISCRETE_STATES = ENTER_EVENT_MODE + 1, ENTER_CONTINUOUS_TIME_MODE, SET }; /* functions in their order */
enum { STAGES = 7, ENOUGH = 40, STIFF = 15, UPDATES = 1000, LOOK = 102 };

static const double EPSILON = 0x1p-52;
static const double SAFETY = 0.9, LEAST = 0.2, MOST = 10.0, WORSE = 10.0;

static const double NODE[STAGES] = {0.0, 1.0 / 5, 3.0 / 10, 4.0 / 5, 8.0 / 9, 1.0, 1.0};
static const double FROM[STAGES][STAGES - 1] = {
    {0.0},
    {1.0 / 5},
    {3.0 / 40, 9.0 / 40},
    {44.0 / 45, -56.0 / 15, 32.0 / 9},
    {19372.0 / 6561, -25360.0 / 2187, 64448.0 / 6561, -212.0 / 729},
    {9017.0 / 3168, -355.0 / 33, 46732.0 / 5247, 49.0 / 176, -5103.0 / 18656},
    {35.0 / 384, 0.0, 500.0 / 1113, 125.0 / 192, -2187.0 / 6784, 11.0 / 84},
};
static const double ERROR[STAGES] = {71.0 / 57600,      0.0,         -71.0 / 16695, 71.0 / 1920,
                                     -17253.0 / 339200, 22.0 / 525, -1.0 / 40};
static const double DENSE[STAGES] = {-12715105075.0 / 11282082432, 0.0,
                                     87487479700.0 / 32700410799,  -10690763975.0 / 1880347072,
                                     701980252875.0 / 199316789632, -1453857185.0 / 822651844,
                                     69997945.0 / 29380423};

/* ---- numbers */

static inline double size_of(double value) { return value < 0.0 ? -value : value; }

static inline double lesser(double a, double b) { return a < b ? a : b; }

static inline double greater(double a, double b) { return a > b ? a : b; }

/* The n-th root of a positive number: the exponent divided by n is right to 6 %, and Newton's method does the rest. */
static double root(double value, int n) {
  const int64_t one = 0x3ff0000000000000;
  int64_t bits;
  double found;
  memcpy(&bits, &value, 8);
  bits = one + (bits - one) / n;
  memcpy(&found, &bits, 8);
  for (int i = 0; i < 6; i++) {
    double power = 1.0;
    for (int j = 1; j < n; j++) power *= found;
    found = ((n - 1) * found + value / power) / n;
  }
  return found;
}

/* The bound of the error of a state, which is `a` or `b` at the ends of a step. */
static inline double bound(const Equations *own, int64_t i, double a, double b) {
  return own->weights[i] + own->tolerance * greater(size_of(a), size_of(b));
}

/* ---- calls */

typedef int (*SetTime)(void *, double);
typedef int (*Array)(void *, double *, size_t);

/* 0, or the status of a call that has failed; then which one it was is noted. */
static inline int checked(Equations *own, int function, int status) {
  if (status >= 0 && status <= WARNING) return 0;
  own->status = status;
  own->function = function;
  return status;
}

static inline int call_array(Equations *own, int function, void *called, double *values, int64_t n) {
  return n == 0 ? 0 : checked(own, function, ((Array)called)(own->component, values, (size_t)n));
}

static int set(Equations *own, const Call *call) {
  void *values = (void *)(intptr_t)call->values, *component = own->component;
  const size_t n = (size_t)call->count, size = (size_t)call->size;
  typedef int (*Set)(void *, const void *, size_t, void *);
  typedef int (*SetSized)(void *, const void *, size_t, void *, size_t);
  if (call->size < 0) return checked(own, SET, ((Set)call->function)(component, call->references, n, values));
  return checked(own, SET, ((SetSized)call->function)(component, call->references, n, values, size));
}

static int set_line(Equations *own, double time) {
  double *values = (double *)(intptr_t)own->line->values;
  for (int64_t i = 0; i < own->line->count; i++)
    values[i] = own->line_values[i] + (time - own->line_start) * own->line_slopes[i];
  return set(own, own->line);
}

/* Put the model at a time, at these states and at the inputs of this time. */
static int put(Equations *own, double time, double *states) {
  int status = checked(own, SET_TIME, ((SetTime)own->set_time)(own->component, time));
  if (!status) status = call_array(own, SET_STATES, own->set_states, states, own->n_states);
  if (!status && own->line != NULL) status = set_line(own, time);
  return status;
}

static int derive(Equations *own, double time, double *states, double *slopes) {
  const int status = put(own, time, states);
  return status ? status : call_array(own, GET_DERIVATIVES, own->get_derivatives, slopes, own->n_states);
}

static int indicate(Equations *own, double *indicators) {
  return call_array(own, GET_INDICATORS, own->get_indicators, indicators, own->n_indicators);
}

/* Tell the FMU that a step is completed. */
static int complete(Equations *own) {
  void *component = own->component;
  int status;
  if (own->kind == FMI1) {
    char event = 0;
    status = ((int (*)(void *, char *))own->completed_step)(component, &event);
    own->asks_event = event != 0;
  } else if (own->kind == FMI2) {
    int event = 0, end = 0;
    status = ((int (*)(void *, int, int *, int *))own->completed_step)(component, 1, &event, &end);
    own->asks_event = event != 0, own->asks_end = end != 0;
  } else {
    _Bool event = 0, end = 0;
    status = ((int (*)(void *, _Bool, _Bool *, _Bool *))own->completed_step)(component, 1, &event, &end);
    own->asks_event = event, own->asks_end = end;
  }
  return checked(own, COMPLETED_STEP, status);
}

/* ---- one step */

/* Try the step to `end`. Returns 0 with `ends` and the slopes of all stages; or the status of a call. The model is at
 * `end` then. */
static int try_step(Equations *own, double end) {
  const int64_t n = own->n_states;
  const double time = own->time, h = end - time;
  if (n == 0) return put(own, end, own->states);
  for (int stage = 1; stage < STAGES; stage++) {
    double *to = stage == STAGES - 1 ? own->ends : stage == STAGES - 2 ? own->sixth : own->stage;
    for (int64_t i = 0; i < n; i++) {
      double sum = FROM[stage][0] * own->slopes[i];
      for (int j = 1; j < stage; j++) sum += FROM[stage][j] * own->slopes[j * n + i];
      to[i] = own->states[i] + h * sum;
    }
    const int status = derive(own, stage >= STAGES - 2 ? end : time + NODE[stage] * h, to, own->slopes + stage * n);
    if (status) return status;
  }
  return 0;
}

/* The square of the error of a step that was tried, in units of what is allowed. */
static double error_of(const Equations *own, double h) {
  const int64_t n = own->n_states;
  double sum = 0.0;
  for (int64_t i = 0; i < n; i++) {
    double error = 0.0;
    for (int j = 0; j < STAGES; j++) error += ERROR[j] * own->slopes[j * n + i];
    error = h * error / bound(own, i, own->states[i], own->ends[i]);
    sum += error * error;
  }
  return n == 0 ? 0.0 : sum / (double)n;
}

/* The size of the first step: by the size of the states, of their slopes, and of the change of these. */
static int guess(Equations *own, double stop) {
  const int64_t n = own->n_states;
  const double most = lesser(own->longest, stop - own->time), *slopes = own->slopes;
  double of_states = 0.0, of_slopes = 0.0, of_changes = 0.0;
  for (int64_t i = 0; i < n; i++) {
    const double allowed = bound(own, i, own->states[i], own->states[i]);
    const double state = own->states[i] / allowed, slope = slopes[i] / allowed;
    of_states += state * state / (double)n;
    of_slopes += slope * slope / (double)n;
  }
  double h = of_states <= 1e-20 || of_slopes <= 1e-20 ? 1e-6 : 0.01 * root(of_states / of_slopes, 2);
  own->step_size = h = lesser(h, most);
  if (n == 0) return 0;
  for (int64_t i = 0; i < n; i++) own->stage[i] = own->states[i] + h * slopes[i];
  const int status = derive(own, lesser(own->time + h, stop), own->stage, own->slopes + n);
  if (status) return status == DISCARD ? 0 : status;
  for (int64_t i = 0; i < n; i++) {
    const double change = (slopes[n + i] - slopes[i]) / bound(own, i, own->states[i], own->states[i]) / h;
    of_changes += change * change / (double)n;
  }
  const double worst = greater(of_slopes, of_changes);
  const double next = worst <= 1e-30 ? greater(1e-6, 1e-3 * h) : root(1e-4 / worst, 10);
  own->step_size = lesser(lesser(100.0 * h, next), most);
  return 0;
}

/* Steps whose size is at the limit of stability: STIFF of them without 6 others in a row. If fewer than WORSE of them fit
 * into `span`, no other solver takes fewer by much: none of its steps goes beyond `stop` either. */
static void count_stiff(Equations *own, double h, double span) {
  const int64_t n = own->n_states;
  double of_slopes = 0.0, of_states = 0.0;
  for (int64_t i = 0; i < n; i++) {
    const double slope = own->slopes[6 * n + i] - own->slopes[5 * n + i], state = own->ends[i] - own->sixth[i];
    of_slopes += slope * slope;
    of_states += state * state;
  }
  if (of_states > 0.0 && h * h * of_slopes > 3.25 * 3.25 * of_states && WORSE * h <= span) {
    own->not_stiff = 0;
    own->stiff++;
  } else if (own->stiff < STIFF && ++own->not_stiff == 6) {
    own->stiff = own->not_stiff = 0;
  }
}

/* ---- events */

static int on_other_side(const double *a, const double *b, int64_t n) {
  for (int64_t i = 0; i < n; i++)
    if ((a[i] > 0.0) != (b[i] > 0.0)) return 1;
  return 0;
}

/* The states within a step, at a part of it from 0 to 1. */
static void interpolate(const Equations *own, double h, double part, double *to) {
  const int64_t n = own->n_states;
  for (int64_t i = 0; i < n; i++) {
    double rest = 0.0;
    for (int j = 0; j < STAGES; j++) rest += DENSE[j] * own->slopes[j * n + i];
    const double change = own->ends[i] - own->states[i], begin = h * own->slopes[i] - change;
    const double end = change - h * own->slopes[6 * n + i] - begin;
    to[i] = own->states[i] + part * (change + (1.0 - part) * (begin + part * (end + (1.0 - part) * h * rest)));
  }
}

/* Where within an interval the first indicator passes 0, if it is a line; the weights are those of its ends. */
static double part_of(const double *low, const double *high, int64_t n, double low_weight, double high_weight) {
  double first = 1.0;
  for (int64_t i = 0; i < n; i++)
    if ((low[i] > 0.0) != (high[i] > 0.0)) {
      const double a = low_weight * size_of(low[i]), b = high_weight * size_of(high[i]);
      first = lesser(first, a + b > 0.0 ? a / (a + b) : 0.5);
    }
  return first;
}

/* Find the first time at which an indicator is on the other side, on the interpolant of a step to `end` (Illinois method,
 * then halves); put the model there. `*reached` is that time, and `ends` the states. */
static int locate(Equations *own, double end, double *reached) {
  const double h = end - own->time, most = greater(size_of(own->time), size_of(end));
  const double narrow = 100.0 * EPSILON * (most + h) / h;
  double low = 0.0, high = 1.0, low_weight = 1.0, high_weight = 1.0;
  double *at_low = own->first_indicators, *at_high = own->last_indicators, *at_middle = own->next_indicators;
  const int64_t n = own->n_indicators;
  memcpy(at_low, own->indicators, (size_t)n * sizeof(double));
  for (int i = 0, side = 0, status; high - low > narrow; i++) {
    const double part = i < ENOUGH ? part_of(at_low, at_high, n, low_weight, high_weight) : 0.5;
    const double wanted = low + part * (high - low);
    const double middle = lesser(greater(wanted, low + 0.5 * narrow), high - 0.5 * narrow);
    interpolate(own, h, middle, own->stage);
    if ((status = put(own, own->time + middle * h, own->stage)) != 0) return status;
    if ((status = indicate(own, at_middle)) != 0) return status;
    double *old;
    if (on_other_side(own->indicators, at_middle, n)) {
      if (side == 1) low_weight *= 0.5;
      old = at_high, at_high = at_middle, high = middle, high_weight = 1.0, side = 1;
    } else {
      if (side == -1) high_weight *= 0.5;
      old = at_low, at_low = at_middle, low = middle, low_weight = 1.0, side = -1;
    }
    at_middle = old;
  }
  if (high < 1.0) {
    interpolate(own, h, high, own->stage);
    memcpy(own->ends, own->stage, (size_t)own->n_states * sizeof(double));
    *reached = own->time + high * h;
  }
  return put(own, *reached, own->ends);
}

/* ---- steps */

static int is_finite(const double *values, int64_t n) {
  for (int64_t i = 0; i < n; i++)
    if (values[i] - values[i] != 0.0) return 0;
  return 1;
}

/* Before a step from where the model was changed: its slopes and its indicators there. */
static int begin(Equations *own, double stop) {
  if (own->is_new) {
    if (derive(own, own->time, own->states, own->slopes) || indicate(own, own->indicators)) return FAILED;
    own->is_new = 0;
  }
  if (!is_finite(own->slopes, own->n_states)) return NOT_A_NUMBER;
  return own->step_size > 0.0 || guess(own, stop) == 0 ? AT_STOP : FAILED;
}

/* One step that meets the tolerance, not beyond `stop`; the model is at its end. `*event`: an indicator has passed 0.
 * `span`: the longest step that was possible since `stop` was given. */
static int step(Equations *own, double stop, double span, int *event) {
  const double time = own->time, shortest = 16.0 * EPSILON * greater(size_of(time), size_of(stop));
  for (double most = MOST;; most = 1.0, own->rejected++) {
    const double size = greater(lesser(own->step_size, own->longest), shortest);
    const int is_last = stop - time <= lesser(1.01 * size, 1.000000001 * own->longest) || own->n_states == 0;
    double end = is_last ? stop : time + size;
    const double h = end - time;
    int status = try_step(own, end);
    const double error = status ? 0.0 : error_of(own, h);
    const double change = error > 1e-12 ? lesser(greater(SAFETY / root(lesser(error, 1e12), 10), LEAST), most) : most;
    *event = 0;
    if (!status && error <= 1.0) {
      if (!(status = indicate(own, own->last_indicators)))
        *event = on_other_side(own->indicators, own->last_indicators, own->n_indicators);
      count_stiff(own, h, span);
      if (*event) status = locate(own, end, &end);
      if (!status) {
        own->step_size = h < size ? greater(size, h * change) : h * change; /* one that `stop` has cut says little */
        own->time = end;
        return AT_STOP;
      }
    }
    if (status && status != DISCARD) return FAILED;
    own->step_size = h * (status || !(error > 1.0) ? 0.25 : lesser(change, SAFETY)); /* NaN is not above 1 */
    if (own->step_size < shortest) return status ? FAILED : TOO_SMALL;
  }
}

/* Take the states of the model: it was changed. */
PUBLIC int64_t equations_restart(Equations *own) {
  const int64_t n = own->n_states;
  own->is_new = 1;
  int status = call_array(own, GET_STATES, own->get_states, own->states, n);
  if (status) return status;
  status = call_array(own, GET_NOMINALS, own->get_nominals, own->weights, n);
  if (status && status != MISSING) return status;
  for (int64_t i = 0; i < n; i++) {
    const double nominal = status ? 1.0 : size_of(own->weights[i]);
    own->weights[i] = own->tolerance * (nominal > 0.0 ? nominal : 1.0);
  }
  return 0;
}

/* Step up to `stop`, or to the first event or step after which the FMU asks for something, or another solver is due. */
PUBLIC int64_t equations_solve(Equations *own, double stop) {
  const double span = lesser(stop - own->time, own->longest);
  own->asks_event = own->asks_end = 0;
  for (;;) {
    const int64_t n = own->n_states;
    int event, result = begin(own, stop);
    if (result == AT_STOP) result = step(own, stop, span, &event);
    if (result != AT_STOP) return result;
    own->steps++;
    if (own->tells && complete(own)) return FAILED;
    memcpy(own->states, own->ends, (size_t)n * sizeof(double));
    memcpy(own->slopes, own->slopes + 6 * n, (size_t)n * sizeof(double));
    double *indicators = own->indicators;
    own->indicators = own->last_indicators;
    own->last_indicators = indicators;
    own->is_new = event;
    if (event || own->asks_event || own->asks_end) return AT_EVENT;
    if (own->time >= stop) return AT_STOP;
    if (own->leaves && own->stiff >= STIFF) return TOO_STIFF;
  }
}

/* ---- what CVode calls, which gives its vectors and the equations */

typedef double *(*VectorData)(void *);

/* A discarded evaluation asks for a smaller step (FMI 2.0, 2.1.3); Python gives the error of any other. */
static int for_cvode(int status) { return status == 0 ? 0 : status == DISCARD ? 1 : -1; }

PUBLIC int equations_derivatives(double time, void *states, void *slopes, void *equations) {
  Equations *own = equations;
  const VectorData data = (VectorData)own->vector_data;
  double *to = data(slopes);
  if (own->n_states == 0) to[0] = 0.0; /* the one state that CVode has for a model without states */
  return for_cvode(derive(own, time, data(states), to));
}

PUBLIC int equations_indicators(double time, void *states, double *indicators, void *equations) {
  Equations *own = equations;
  int status = put(own, time, ((VectorData)own->vector_data)(states));
  if (!status) status = indicate(own, indicators);
  for (int64_t i = 0; !status && i < own->n_indicators; i++)
    if (indicators[i] == 0.0) indicators[i] = -0x1p-1022; /* as in solver.py: CVode never sees a 0 */
  return for_cvode(status);
}

/* ---- a step of a node */

/* One event iteration, in event mode. */
static int update(Equations *own, int *again, int *ends) {
  void *component = own->component, *function = own->update_discrete_states;
  int status, is_defined;
  double next = 0.0;
  if (own->kind == FMI1) {
    struct { char converged, references, values, terminate, upcoming; double next; } info = {0};
    status = ((int (*)(void *, char, void *))function)(component, 0, &info);
    *again = !info.converged, *ends = info.terminate, is_defined = info.upcoming, next = info.next;
  } else if (own->kind == FMI2) {
    struct { int again, terminate, nominals, values, is_defined; double next; } info = {0};
    status = ((int (*)(void *, void *))function)(component, &info);
    *again = info.again, *ends = info.terminate, is_defined = info.is_defined, next = info.next;
  } else {
    typedef int (*Update)(void *, _Bool *, _Bool *, _Bool *, _Bool *, _Bool *, double *);
    _Bool said[5] = {0};
    status = ((Update)function)(component, &said[0], &said[1], &said[2], &said[3], &said[4], &next);
    *again = said[0], *ends = said[1], is_defined = said[4];
  }
  own->next_event = is_defined ? next : __builtin_inf();
  return checked(own, UPDATE_DISCRETE_STATES, status);
}

static int call_mode(Equations *own, int function, void *called) {
  return own->kind == FMI1 ? 0 : checked(own, function, ((int (*)(void *))called)(own->component));
}

/* The event iteration, and back to continuous-time mode. */
static int settle(Equations *own) {
  int again, ends;
  for (int i = 0; i < UPDATES; i++) {
    if (update(own, &again, &ends)) return FAILED;
    if (ends) return ENDS;
    if (again) continue;
    if (call_mode(own, ENTER_CONTINUOUS_TIME_MODE, own->enter_continuous_time_mode)) return FAILED;
    return equations_restart(own) ? FAILED : AT_STOP;
  }
  return UNSETTLED;
}

/* Set held inputs that have changed: that is an event (FMI 2.0, 3.1). */
static int set_held(Equations *own) {
  if (call_mode(own, ENTER_EVENT_MODE, own->enter_event_mode)) return FAILED;
  for (own->call = 0; own->call < own->n_setters; own->call++)
    if (set(own, &own->setters[own->call])) return FAILED;
  return settle(own);
}

/* Whether the library handles this event: Python counts those at one time, and changes the solver. */
static int is_plain(const Equations *own) {
  return own->result == AT_EVENT && !own->asks_end && own->time != own->event_time &&
         (own->stiff < STIFF || (own->doubted && !own->leaves));
}

/* Whether a time is later by more than rounding, as `resolvable` in simtime.py, or a little more. */
static inline int is_later(double later, double time) {
  return later - time > 16.0 * EPSILON * greater(size_of(later), size_of(time)) || later == __builtin_inf();
}

/* A step up to `end` with the inputs of the row. Returns 0, or LOOK: then Python looks at the result and takes the rest. */
int equations_step(Equations *own, double end) {
  own->result = GO_ON;
  own->call = own->n_setters;
  if (own->terminated) return LOOK;
  if (own->leaves && own->stiff >= STIFF) {
    own->result = LEFT; /* Python sets the inputs, too: its solver begins anew with them */
    return LOOK;
  }
  if (own->row_bytes > 0 && (!own->is_held || memcmp(own->held, own->row, (size_t)own->row_bytes) != 0)) {
    memcpy(own->held, own->row, (size_t)own->row_bytes);
    own->is_held = 1;
    if ((own->result = set_held(own)) != AT_STOP) return LOOK;
  }
  for (;;) {
    own->result = GO_ON;
    if (!is_later(end, own->time) || !is_later(own->next_event, end)) return LOOK;
    own->result = equations_solve(own, end);
    if (!is_plain(own)) break;
    own->event_time = own->time;
    own->result = call_mode(own, ENTER_EVENT_MODE, own->enter_event_mode) ? FAILED : settle(own);
    if (own->result != AT_STOP || own->time >= end) break;
  }
  if (own->result == AT_STOP && own->stiff >= STIFF && !own->doubted) own->result = GO_ON;
  return own->result == AT_STOP ? 0 : LOOK;
}
