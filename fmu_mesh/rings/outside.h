/* For a program that takes part in a running mesh as an instance of the kind `outside`. C99; link `outside.c`, or the
 * library `burst-linux-*.so` of the package, which has these functions, too. docs/outside.md has an example.
 *
 * Contract. One thread calls, in this order:
 *
 *   outside_attach                         finds the node of the instance; the variables are known from here on
 *   outside_set_*, outside_begin           the outputs in Initialization Mode; afterwards the inputs are those at point 0
 *   outside_set_*, outside_step, outside_get_*    as often as the program likes
 *   outside_detach                         always, and once
 *
 * outside_step takes the instance from point k to k + 1: what was set before holds in the mesh from point k on (its
 * connections have delay 1), and what outside_get_* returns afterwards is what the mesh has for the step from k to
 * k + 1: its values at k + 1 where the connection has delay 0, at k where it has delay 1. Outputs that are not set keep
 * their last value; at the beginning that is the start value of the configuration. The last row of outputs is what is set
 * when outside_detach is called.
 *
 * Directions are those of the configuration: outputs of the instance are set by the program, inputs are read by it.
 * A point here is an own step of the instance, which may be several of the mesh (`step_size` of the instance).
 *
 * Waits have no end while the mesh lives: it may be paused, or in a debugger. When the run has ended, or its node was
 * killed, a wait ends with OUTSIDE_ENDED or OUTSIDE_LOST within 0.1 s. After a result that is not OUTSIDE_OK,
 * outside_error says why in one sentence; after OUTSIDE_WRONG the program may go on.
 *
 * All functions return OUTSIDE_OK or another result of this enumeration, if nothing else is said. */
#ifndef FMU_MESH_OUTSIDE_H
#define FMU_MESH_OUTSIDE_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define OUTSIDE_VERSION 1

enum OutsideResult {
  OUTSIDE_OK,
  OUTSIDE_WRONG, /* a wrong index, type, size or order of calls; nothing has changed */
  OUTSIDE_ENDED, /* the run has ended, as it should or with an error: outside_error has its words */
  OUTSIDE_LOST   /* the node was killed, or this program has no connection any more */
};

enum OutsideType { /* as in FMI 3.0 */
  OUTSIDE_FLOAT64, OUTSIDE_FLOAT32, OUTSIDE_INT8, OUTSIDE_UINT8, OUTSIDE_INT16, OUTSIDE_UINT16, OUTSIDE_INT32,
  OUTSIDE_UINT32, OUTSIDE_INT64, OUTSIDE_UINT64, OUTSIDE_BOOLEAN, OUTSIDE_STRING
};

typedef struct Outside Outside;

/* Attach to an instance, for which nobody else is attached.
 *
 * address     `mesh/instance` of a mesh of this user on this host, or the path of the socket (with a slash at its
 *             beginning); NULL: the environment variable FMU_MESH_CONNECT
 * timeout_ns  how long to wait for a mesh that does not run yet; 0: try once
 * error       room for one sentence, if the result is NULL; may be NULL */
Outside *outside_attach(const char *address, int64_t timeout_ns, char *error, size_t error_size);

/* The variables: numbers from 0, inputs first, in the order of the configuration; an unknown name is -1. */
int64_t outside_count(const Outside *outside);
int64_t outside_index(const Outside *outside, const char *name);
const char *outside_name(const Outside *outside, int64_t index);   /* NULL for a wrong index */
int outside_type(const Outside *outside, int64_t index);           /* an OutsideType, or -1 */
int outside_is_output(const Outside *outside, int64_t index);      /* 1: this program sets it */
int64_t outside_elements(const Outside *outside, int64_t index);   /* 1 for a scalar; arrays are row by row */

/* Set an output, or get an input or an output: all its `n` elements. Floats are for FLOAT64 and FLOAT32, int64 for all
 * integers but UINT64 values above INT64_MAX, and for BOOLEAN, which is 0 or 1. A string has zero at its end; the pointer
 * that is returned is valid until the next outside_step. A value that does not fit its type is OUTSIDE_WRONG. */
int outside_set_float64(Outside *outside, int64_t index, const double *values, int64_t n);
int outside_get_float64(Outside *outside, int64_t index, double *values, int64_t n);
int outside_set_int64(Outside *outside, int64_t index, const int64_t *values, int64_t n);
int outside_get_int64(Outside *outside, int64_t index, int64_t *values, int64_t n);
int outside_set_string(Outside *outside, int64_t index, const char *value);
int outside_get_string(Outside *outside, int64_t index, const char **value);

/* Give the outputs that the mesh uses in its Initialization Mode, and wait until that is over: the inputs are those at
 * point 0. outside_step calls it, where the program has not. */
int outside_begin(Outside *outside);

/* Take `steps` steps (at least 1) with the outputs as they are. */
int outside_step(Outside *outside, int64_t steps);

/* Where the instance is: its point, its time in s, and the length of one step in s. Known after outside_begin. */
int64_t outside_point(const Outside *outside);
double outside_time(const Outside *outside);
double outside_step_size(const Outside *outside);

/* Why the last result was not OUTSIDE_OK; valid until the next call. */
const char *outside_error(const Outside *outside);

/* End politely: before the last point of the run, the run ends here without an error. Frees `outside`; NULL is allowed. */
void outside_detach(Outside *outside);

#ifdef __cplusplus
}
#endif

#endif
